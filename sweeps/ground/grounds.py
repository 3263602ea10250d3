"""Pushes on many grounds, each a part of the run folder, beside those of a rigid object."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.errors import InputError
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.trials.progress import Progress, ProgressCallback, no_progress
from rps_jax.world.physics import MUJOCO_GROUND, Physics, preset
from rps_jax.world.scene import FRICTION
from sweeps.ground import pushes
from sweeps.ground.pushes import DISTANCE, OFFSETS, SPEEDS, STEPS, Pushes

HEIGHTS = (0.06, 0.13, 0.2, 0.27, 0.34)  # [m] from the lower edge of the base to its upper one
# [1] of a rigid object with the base: the scenes' own, and less, as where a hop has used it up.
FRICTIONS = (FRICTION["S1"].robot, 0.28, 0.2, 0.1, 0.001)
OBJECTS = ("box", "box_60", "cylinder")
LIMIT = "limit"  # name of the part that holds the rigid limit
_DIMS = ("object", "offset", "speed")
_LIMIT_FIELDS = ("lateral", "force", "spread")  # results of the rigid limit beside measured ones


@dataclass(frozen=True)
class Kind:
    """A kind of ground: how the pushes are stepped, and at which speeds [m/s] of the base."""

    what: str  # label
    physics: Physics
    speeds: tuple[float, ...] = SPEEDS


def _on(base: Physics, label: str, speeds: tuple[float, ...] = SPEEDS, **changes: Any) -> Kind:
    return Kind(label, replace(base, **changes), speeds)


_C = preset(fidelity="reference")
_DEFAULT = replace(_C, **MUJOCO_GROUND)
# In C MuJoCo, converged, in steps of 1 ms.
CONVERGED = {
    "ours": _on(_C, "ours, 1 ms", (0.002, *SPEEDS)),
    "mujocos": _on(_DEFAULT, "MuJoCo's own, 1 ms", (0.002, *SPEEDS)),
    "stiff": _on(
        _C, "time constant 4 ms, impedance 0.95", ground_solref=(0.004, 1.0), ground_impedance=0.95
    ),
    "impratio_1": _on(_C, "ours, impratio 1", impratio=1.0),
    "impratio_100": _on(_C, "ours, impratio 100", impratio=100.0),
    "impratio_1000": _on(_C, "ours, impratio 1000", impratio=1000.0),
    "mujocos_100": _on(_DEFAULT, "MuJoCo's own, impratio 100", impratio=100.0),
    "pyramid": _on(_C, "ours, friction pyramid", cone="pyramidal"),
    "mujocos_pyramid": _on(_DEFAULT, "MuJoCo's own, friction pyramid", cone="pyramidal"),
}
# As others step it: ever larger steps.
STEPPED = {
    "ours_5ms": _on(_C, "ours, 5 ms", timestep=0.005),
    "standard": _on(preset(), "ours, standard: 10 ms"),
    "fast": _on(preset(fidelity="fast"), "ours, fast: 20 ms, impedance 0.5"),
    "mujocos_5ms": _on(_DEFAULT, "MuJoCo's own, 5 ms", timestep=0.005),
    "mujocos_10ms": _on(_DEFAULT, "MuJoCo's own, 10 ms", timestep=0.01),
}
# Ever stiffer: first with damping that grows along, then with hops that last as long as ours.
STIFFER = {
    "critical_10": _on(
        _DEFAULT, "MuJoCo's own, time constant 10 ms", timestep=5e-4, ground_solref=(0.01, 1.0)
    ),
    "critical_5": _on(
        _DEFAULT, "MuJoCo's own, time constant 5 ms", timestep=2.5e-4, ground_solref=(0.005, 1.0)
    ),
    "critical_2": _on(
        _DEFAULT, "MuJoCo's own, time constant 2 ms", timestep=1e-4, ground_solref=(0.002, 1.0)
    ),
    "damping_01": _on(
        _C, "ours, damping ratio 0.1: 9 times as stiff", timestep=5e-4, ground_solref=(0.1, 0.1)
    ),
    "damping_003": _on(
        _C, "ours, damping ratio 0.03: 100 times as stiff", timestep=1e-4, ground_solref=(0.1, 0.03)
    ),
}
# Lifted less by MuJoCo's cones: the lower the impedance, the deeper an object rests.
_LOW = {"ground_solref": (0.1, 0.2), "ground_impedance": 0.3}
LOWER = {
    "lower": _on(_C, "(0.1 s, 0.2), impedance 0.3", **_LOW),
    "lower_10ms": _on(preset(), "(0.1 s, 0.2), impedance 0.3, 10 ms", **_LOW),
    "lower_20ms": _on(
        preset(fidelity="fast"), "(0.1 s, 0.4), impedance 0.5, 20 ms", ground_solref=(0.1, 0.4)
    ),
}
GROUNDS = CONVERGED | STEPPED | STIFFER | LOWER
QUICK = ("ours", "mujocos", "standard")
DRAWN = ("ours", "standard", "fast", "lower", "mujocos", "mujocos_10ms", "stiff")


def run(
    names: Sequence[str],
    folder: Path | None,
    *,
    objects: Sequence[str] = OBJECTS,
    offsets: Sequence[float] = OFFSETS,
    worlds: int | None = None,
    steps: int = STEPS,
    callback: ProgressCallback = no_progress,
) -> xr.Dataset:
    """Pushes (ground, object, offset, speed) and the rigid limit's, run or found in `folder`.

    Without a folder all is kept in memory. On each ground the first `worlds` pushes are run, by
    default all; the others are NaN.

    `limit_lateral` (object, offset, at_height, friction) [m] is where a rigid object ends that is
    pushed at a height and has some friction with the base. `apart` (ground, object, offset, speed,
    friction) [m] says how far from there an object ended that was pushed as high, and `error` [m]
    is this for the friction that both have.

    Raises:
      InputError: the folder holds a ground of the same name that was run otherwise.
    """
    parts = None if folder is None else Checkpoints(folder)
    finished, simulated = 0, 0.0

    def on_push(pushed: int, seconds: float) -> None:
        nonlocal finished, simulated
        finished, simulated = finished + pushed, simulated + seconds
        callback(Progress(finished, simulated))

    options = f"{tuple(objects)} {tuple(offsets)}"
    limit = _part(
        parts,
        LIMIT,
        f"{options} {HEIGHTS} {FRICTIONS} {steps}",
        lambda: _limit(objects, offsets, steps),
    )
    datasets = []
    for name in names:
        ground = GROUNDS[name]
        previous = finished
        dataset = _part(
            parts,
            name,
            f"{options} {replace(ground, what='')!r}{'' if worlds is None else f' {worlds}'}",
            lambda ground=ground: _pushes(ground, objects, offsets, worlds, on_push),
        )
        on_push(previous + _count(ground, objects, offsets, worlds) - finished, 0.0)
        datasets.append(dataset.drop_attrs(deep=False))
    whole = xr.concat(
        datasets, xr.DataArray(list(names), dims="ground", name="ground"), join="outer"
    )
    whole = whole.assign_coords(what=("ground", [GROUNDS[name].what for name in names]))
    whole = whole.assign({f"limit_{name}": limit[name] for name in _LIMIT_FIELDS})
    at = whole.height.clip(min(HEIGHTS), max(HEIGHTS)).fillna(HEIGHTS[0])
    expected = whole.limit_lateral.interp(at_height=at).drop_vars("at_height")
    whole["apart"] = (whole.lateral - expected).transpose(*whole.lateral.dims, "friction")
    whole["error"] = whole.apart.sel(friction=FRICTIONS[0]).drop_vars("friction")
    return whole


def as_if(results: xr.Dataset) -> xr.DataArray:
    """Friction with the base [1] of the rigid objects that end nearest, (ground, speed).

    Between two of `FRICTIONS` the place of the end is taken for linear.
    """
    fine = np.linspace(min(FRICTIONS), max(FRICTIONS), 100)
    distances = results.apart.sortby("friction").interp(friction=fine)
    return (distances**2).mean(("object", "offset")).fillna(np.inf).idxmin("friction")


def count(names: Sequence[str], worlds: int | None = None) -> int:
    """Pushes of these grounds, of all objects at all offsets."""
    return sum(_count(GROUNDS[name], OBJECTS, OFFSETS, worlds) for name in names)


def _count(
    ground: Kind, objects: Sequence[str], offsets: Sequence[float], worlds: int | None
) -> int:
    total = len(objects) * len(offsets) * len(ground.speeds)
    return total if worlds is None else min(worlds, total)


def _part(
    parts: Checkpoints | None, name: str, run_as: str, make: Callable[[], xr.Dataset]
) -> xr.Dataset:
    """A part that was run so, or is now."""
    if parts is None:
        return make()
    results = parts.load_or_compute(name, lambda: make().assign_attrs(run_as=run_as))
    if results.attrs.get("run_as") != run_as:
        raise InputError(
            f"{parts.folder / name}-*.nc was run with other options: choose another folder, or "
            "delete it to run again."
        )
    return results


def _pushes(
    ground: Kind,
    objects: Sequence[str],
    offsets: Sequence[float],
    worlds: int | None,
    on_push: Callable[[int, float], None],
) -> xr.Dataset:
    targets, results = pushes.targets(), []
    for name, offset, speed in itertools.product(objects, offsets, ground.speeds):
        if len(results) == worlds:
            break
        results.append(pushes.in_mujoco(targets[name], offset, speed, ground.physics))
        on_push(1, DISTANCE / speed)
    missing = len(objects) * len(offsets) * len(ground.speeds) - len(results)
    results += [pushes.NOTHING] * missing
    shape = (len(objects), len(offsets), len(ground.speeds))
    columns = {
        name: (_DIMS, np.reshape([getattr(result, name) for result in results], shape))
        for name in Pushes._fields
    }
    coords = {"object": list(objects), "offset": list(offsets), "speed": list(ground.speeds)}
    return xr.Dataset(columns, coords)


def _limit(objects: Sequence[str], offsets: Sequence[float], steps: int) -> xr.Dataset:
    targets = pushes.targets()
    grid = np.meshgrid(offsets, HEIGHTS, FRICTIONS, indexing="ij")
    values = [axis.ravel() for axis in grid]
    results = [pushes.in_the_limit(targets[name], *values, steps=steps) for name in objects]
    columns = {
        name: (
            ("object", "offset", "at_height", "friction"),
            np.reshape(
                [getattr(result, name) for result in results], (len(results), *grid[0].shape)
            ),
        )
        for name in _LIMIT_FIELDS
    }
    coords = {"object": list(objects), "offset": list(offsets)}
    return xr.Dataset(columns, coords | {"at_height": list(HEIGHTS), "friction": list(FRICTIONS)})


def table(results: xr.Dataset, speeds: Sequence[float] = SPEEDS) -> list[list[str]]:
    """Header and a row for each ground.

    The error is the root of the mean square over objects and offsets; force, spread and height are
    means, hop and tilt the largest.
    """
    header = ["ground"]
    for speed in speeds:
        at = f"{100 * speed:g} cm/s"
        header += [f"error, {at}", f"push over mu m g, {at}", f"spread, {at}"]
        header += [f"as if of friction, {at}"]
    header += ["height of the push", "largest hop", "largest tilt", "aloft"]
    dry = results.sel(friction=FRICTIONS[0])
    force, spread = (float(dry[f"limit_{name}"].mean()) for name in ("force", "spread"))
    rigid = ["0", f"{force:.3f}", f"{100 * spread:.1f} %", f"{FRICTIONS[0]:g}"] * len(speeds)
    rows = [header, ["rigid object", *rigid, "all", "0", "0", "0"]]
    friction = as_if(results)
    for name in map(str, results.ground.values):
        ground = results.sel(ground=name)
        row = [str(ground.what.values)]
        for speed in speeds:
            at = ground.sel(speed=speed)
            error = float(np.sqrt((at.error**2).mean()))
            row += [f"{1000 * error:.1f} mm", f"{float(at.force.mean()):.3f}"]
            row += [f"{100 * float(at.spread.mean()):.1f} %"]
            row += [f"{float(friction.sel(ground=name, speed=speed)):.2f}"]
        chosen = ground.sel(speed=list(speeds))
        row += [
            f"{100 * float(chosen.height.min()):.0f} to {100 * float(chosen.height.max()):.0f} cm",
            f"{1000 * float(chosen.hop.max()):.2f} mm",
            f"{1000 * float(chosen.tilt.max()):.1f} mrad",
            f"{100 * float(chosen.aloft.max()):.0f} %",
        ]
        rows.append(row)
    return rows
