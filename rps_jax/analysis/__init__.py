"""What labelled results say: statistics, tables, figures, pictures and videos, reports."""
