"""Trials: worlds are made, stepped until they end, and judged."""
