"""What labelled results say: statistics, tables, figures, pictures and videos, reports.

The functions take xarray Datasets, arrays and texts. Nothing here knows how a trial is run.
"""
