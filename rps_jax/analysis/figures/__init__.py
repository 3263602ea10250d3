"""Figures by theme: functions that return a figure of matplotlib.

A function is imported on first use, because importing matplotlib takes half a second.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rps_jax.analysis.figures.paper import min_distance, one_trial, profile, stills
    from rps_jax.analysis.figures.sweeps import success_curves
    from rps_jax.analysis.figures.tuning import search

__all__ = ["min_distance", "one_trial", "profile", "search", "stills", "success_curves"]


def __getattr__(name: str) -> object:
    for theme in ("paper", "sweeps", "tuning") if name in __all__ else ():
        module = importlib.import_module(f"{__name__}.{theme}")
        if hasattr(module, name):
            return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
