"""What labelled results say: statistics, tables, figures and reports."""
