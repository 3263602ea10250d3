"""Questions that users ask of their own laws: each file is one, with its report and its figures."""
