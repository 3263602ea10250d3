"""Figures by theme. Every function returns a figure of matplotlib."""

# ruff: noqa: F401

from rps_jax.analysis.figures.paper import min_distance, one_trial, profile, stills
from rps_jax.analysis.figures.sweeps import success_curves
from rps_jax.analysis.figures.tuning import search
