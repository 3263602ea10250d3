"""Figures by theme. Every function writes one PNG and returns its path."""

# ruff: noqa: F401

from rps_jax.analysis.figures.failures import archive, interactions, search, sobol, splitting
from rps_jax.analysis.figures.law import hysteresis, profile, twist_field
from rps_jax.analysis.figures.losses import losses
from rps_jax.analysis.figures.paper import min_distance, one_trial, paths, stills, time_to_success
from rps_jax.analysis.figures.studies import (
    agreement,
    front,
    gradient_quality,
    grounds,
    levers,
    limits,
    sensitivity,
    shift_curve,
    throughput,
    tolerance_curve,
    turning,
)
from rps_jax.analysis.figures.sweeps import failures, ladder, paired, success_curves
from rps_jax.analysis.figures.tuning import (
    between_bounds,
    estimates,
    learning_curve,
    races,
    tuning_log,
)
