"""Figures by theme: functions that return a figure of matplotlib."""

import importlib
import os
import warnings
from types import ModuleType

from rps_jax import errors

try:
    import matplotlib as matplotlib
except ValueError as error:  # of a backend, which the figures of this package do not need
    backend = os.environ.get("MPLBACKEND")
    rule = "matplotlib has no such backend; set it to agg, or unset it"
    raise errors.not_allowed("MPLBACKEND", backend, rule) from error


def __getattr__(name: str) -> ModuleType:
    """Return the module that replaces one of version 0.4."""
    if name != "tuning":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    warnings.warn(f"{__name__}.tuning will be removed: write sweeps", FutureWarning, stacklevel=2)
    return importlib.import_module(f"{__name__}.sweeps")
