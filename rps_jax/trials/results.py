"""Labelled data of outcomes: a grid of trials, or one trial over time."""

from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.observation import Details, Twist
from rps_jax.engines import device
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.spec import specs_of
from rps_jax.trials import trial
from rps_jax.trials.pushes import Trajectory
from rps_jax.trials.trial import Outcome
from rps_jax.world import tasks
from rps_jax.world.quantity import claim

DIMS = ("law", "object", "friction", "target")
WORLD = "index of the world"
POSE = xr.Variable("pose", ["x", "y", "yaw"], {"long_name": "x [m], y [m] and yaw [rad]"})
claim("an outcome", *specs_of(Outcome), "law", "world")
_TRACED = {**specs_of(Twist), **specs_of(Details)}  # numbers of a trace


def outcome_dataset(
    outcome: Outcome,
    laws: Sequence[str],
    objects: Sequence[str],
    frictions: Sequence[str],
    targets: Sequence[tuple[float, float]],
) -> xr.Dataset:
    """Return outcomes (S * O * F * T, ...), nested in this order, as a dataset with `DIMS`."""
    axes = laws, objects, frictions, range(len(targets))
    coords: dict[str, object] = {dim: list(x) for dim, x in zip(DIMS, axes, strict=True)}
    for name, values in zip(("target_x", "target_y"), np.asarray(targets, float).T, strict=True):
        coords[name] = "target", values, {"units": "m"}
    variables = {}
    for name, values in outcome.columns().items():
        shape = *map(len, axes), *values.shape[1:]
        variables[name] = variable(name, DIMS, values.reshape(shape))
    return xr.Dataset(variables, coords | {"pose": POSE})


def labelled(**columns: tuple[str | Sequence[str], ArrayLike, str, str]) -> dict[str, xr.Variable]:
    """Return variables by name, from their dimensions, values, unit and meaning."""
    return {
        name: xr.Variable(dims, _plain(values), {"units": unit, "long_name": meaning})
        for name, (dims, values, unit, meaning) in columns.items()
    }


def variable(name: str, dims: Sequence[str], values: np.ndarray) -> xr.Variable:
    """Return one field of outcomes with its unit; poses (..., 3) have one more dimension."""
    spec = specs_of(Outcome).get(name) or tasks.OUTCOMES[name]
    return xr.Variable((*dims, "pose")[: values.ndim], _plain(values), spec.attributes)


def _plain(values: ArrayLike) -> np.ndarray:
    """Return an array for NetCDF, in which booleans are integers."""
    values = np.asarray(values)
    return values.astype(np.int8) if values.dtype == bool else values


@device.standard_jax()
def trace_dataset(trajectory: Trajectory) -> xr.Dataset:
    """Return one trial over time (time, ...), with its outcome, target and thresholds."""
    snapshots, world = trajectory.snapshots, trajectory.world

    def over_time(values: ArrayLike, unit: str, *dims: str) -> xr.Variable:
        return xr.Variable(("time", *dims), _plain(values), {"units": unit})

    variables = {
        "qpos": over_time(snapshots.qpos, "m, rad, 1", "joint"),
        "contact_type": over_time(snapshots.reading.contact_type, "1"),
        "p_robot_contact": over_time(snapshots.reading.p_robot_contact, "m", "axis"),
    }
    scalars = snapshots.twist._asdict() | snapshots.details._asdict()
    variables |= {name: over_time(scalars[name], x.unit) for name, x in _TRACED.items()}
    for name, value in trajectory.outcome.columns().items():
        variables[f"outcome_{name}"] = variable(name, (), np.asarray(value))
    variables["p_world_contact"] = over_time(trial.p_world_contact(snapshots), "m", "axis")
    target = list(trajectory.p_world_target)
    variables["p_world_target"] = xr.Variable("axis", target, {"units": "m"})
    for name, points in world.task.lines().items():
        dims = *(f"{name}_{i}" for i in range(points.ndim - 1)), "axis"
        meaning = {"units": "m", "long_name": f"{name} of the task in the world"}
        variables[name] = xr.Variable(dims, points, meaning)
    for name in ("d_success", *(("l_cr",) if isinstance(trajectory.params, RPSParams) else ())):
        variables[name] = xr.Variable((), _plain(getattr(trajectory.params, name)), {"units": "m"})
    shell = world.skin.shell
    sizes = {"half_length": shell.half[0], "half_width": shell.half[1], "base_radius": shell.radius}
    for name, value in sizes.items():
        meaning = f"{name.replace('_', ' ')} of the base"
        if value is not None:
            variables |= labelled(**{name: ((), float(value), "m", meaning)})
    meaning = "outline of the object in its own frame"
    shape = ("corner", "axis"), _outline(world.footprint)
    variables |= labelled(outline=(*shape, "m", meaning))
    return xr.Dataset(variables, coords={"time": ("time", snapshots.time, {"units": "s"})})


def _outline(shape: Footprint) -> np.ndarray:
    """Return the outline (N, 2) [m] of a footprint, closed; of a circle a polygon."""
    corners, radius = np.asarray(shape.vertices, float), float(shape.radius)
    if radius > 0:
        angle = np.linspace(0, 2 * np.pi, 49)
        return corners[:1] + radius * solid.unit(angle)
    return np.concatenate([corners, corners[:1]])
