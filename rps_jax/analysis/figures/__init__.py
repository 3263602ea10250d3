"""Figures by theme. Every function returns a figure of matplotlib."""

# ruff: noqa: F401

from rps_jax.analysis.figures.law import hysteresis, profile, twist_field
from rps_jax.analysis.figures.paper import min_distance, one_trial, stills, time_to_success
from rps_jax.analysis.figures.sweeps import failures, paired, success_curves
from rps_jax.analysis.figures.tuning import (
    between_bounds,
    estimates,
    races,
    search,
)
