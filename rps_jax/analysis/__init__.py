"""Statistics, tables, figures and reports of labelled results."""
