"""What trials came to, as labelled data: a grid of outcomes, or one trial over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.control.laws.rps import RPSParams
from rps_jax.trials import trial
from rps_jax.trials.pushes import Trajectory
from rps_jax.trials.trial import Outcome

DIMS = ("law", "object", "friction", "target")
UNITS = {
    "success": ("1", "target reached within the rules"),
    "time": ("s", "simulated time at which the trial ended"),
    "min_distance": ("m", "least distance of the contact point to the target"),
    "contact_lost_time": ("s", "time without contact after the first touch"),
    "path_length": ("m", "length of the base's way"),
    "mean_abs_l": ("m", "mean |l| while in contact, the paper's D"),
    "tilt": ("rad", "greatest tilt of the object"),
    "tipped": ("1", "the object fell over"),
    "diverged": ("1", "physics became NaN or ran away"),
    "stalled": ("1", "it ended with the base standing still, for want of force"),
    "base_pose": ("m, m, rad", "x, y, yaw of the base in the world at the end"),
    "object_pose": ("m, m, rad", "x, y, yaw of the object in the world at the end"),
}


def outcome_dataset(
    outcome: Outcome,
    laws: Sequence[str],
    objects: Sequence[str],
    frictions: Sequence[str],
    targets: Sequence[tuple[float, float]],
) -> xr.Dataset:
    """Outcomes (S * O * F * T, ...) in this nesting order, as a Dataset labelled by `DIMS`."""
    shape = (len(laws), len(objects), len(frictions), len(targets))
    variables = {}
    for name, values in outcome._asdict().items():
        variables[name] = variable(name, DIMS, values.reshape(shape + values.shape[1:]))
    position = np.asarray(targets, float)
    return xr.Dataset(
        variables,
        coords={
            "law": list(laws),
            "object": list(objects),
            "friction": list(frictions),
            "target": np.arange(len(targets)),
            "target_x": ("target", position[:, 0], {"units": "m"}),
            "target_y": ("target", position[:, 1], {"units": "m"}),
            "pose": ["x", "y", "yaw"],
        },
    )


def variable(name: str, dims: Sequence[str], values: np.ndarray) -> xr.Variable:
    """What outcomes are in one respect, with its unit; poses (..., 3) have a dimension more."""
    unit, meaning = UNITS[name]
    attrs = {"units": unit, "long_name": meaning}
    return xr.Variable((*dims, "pose")[: values.ndim], _plain(values), attrs)


def _plain(values: Any) -> np.ndarray:
    """As an array that NetCDF can hold, which has no booleans."""
    values = np.asarray(values)
    return values.astype(np.int8) if values.dtype == bool else values


def trace_dataset(trace: Trajectory) -> xr.Dataset:
    """One trial over time: variables (time, ...), and its outcome, target and thresholds alone."""
    seen = trace.snapshots

    def over_time(values: Any, unit: str, *dims: str) -> xr.Variable:
        return xr.Variable(("time", *dims), _plain(values), {"units": unit})

    variables = {
        "qpos": over_time(seen.qpos, "m, rad, 1", "joint"),
        "contact_type": over_time(seen.reading.contact_type, "1"),
        "p_robot_contact": over_time(seen.reading.p_robot_contact, "m", "axis"),
        "v_x": over_time(seen.twist.v_x, "m/s"),
        "v_y": over_time(seen.twist.v_y, "m/s"),
        "omega": over_time(seen.twist.omega, "rad/s"),
        "l": over_time(seen.details.l, "m"),
        "distance": over_time(seen.details.distance, "m"),
        "a_r": over_time(seen.details.a_r, "1"),
        "gamma": over_time(seen.details.gamma, "rad"),
        "realigning": over_time(seen.details.realigning, "1"),
    }
    for name, value in trace.outcome._asdict().items():
        variables[f"outcome_{name}"] = variable(name, (), np.asarray(value))
    variables["p_world_contact"] = over_time(trial.p_world_contact(seen), "m", "axis")
    variables["p_world_target"] = xr.Variable("axis", list(trace.p_world_target), {"units": "m"})
    for name in ("d_success", *(("l_cr",) if isinstance(trace.params, RPSParams) else ())):
        variables[name] = xr.Variable((), _plain(getattr(trace.params, name)), {"units": "m"})
    for name, value in zip(("half_length", "half_width"), trace.half, strict=True):
        attrs = {"units": "m", "long_name": f"{name.replace('_', ' ')} of the base"}
        variables[name] = xr.Variable((), value, attrs)
    attrs = {"units": "m", "long_name": "outline of the object in its own frame"}
    variables["outline"] = xr.Variable(("corner", "axis"), trace.outline, attrs)
    return xr.Dataset(variables, coords={"time": ("time", seen.time, {"units": "s"})})
