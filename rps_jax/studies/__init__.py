"""Questions that users ask of their own laws: each file is one, with its report and its figures.

What this project asks of itself stands in folders of `sweeps`, outside the package.
"""
