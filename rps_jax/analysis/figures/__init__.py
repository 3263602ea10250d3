"""Figures by theme: functions that return a figure of matplotlib."""

import os

from rps_jax import errors

try:
    import matplotlib as matplotlib
except ValueError as error:  # of a backend, which the figures of this package do not need
    backend = os.environ.get("MPLBACKEND")
    rule = "matplotlib has no such backend; set it to agg, or unset it"
    raise errors.not_allowed("MPLBACKEND", backend, rule) from error
