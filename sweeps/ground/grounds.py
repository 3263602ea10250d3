"""Pushes on many grounds, each a part of the run folder, beside those of a rigid object."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.physics import Physics, preset
from rps_jax.questions import Run
from rps_jax.trials.progress import Progress, ProgressCallback, SequentialProgress
from rps_jax.world.physics import MUJOCO_GROUND
from sweeps.ground import pushes
from sweeps.ground.pushes import DISTANCE, OFFSETS, SPEEDS, STEPS, Pushes
from sweeps.study_base import Rows, part_of, records, text_table

HEIGHTS = (0.06, 0.13, 0.2, 0.27, 0.34)  # [m] from the lower edge of the base to its upper one
OBJECTS = ("box", "box_60", "cylinder")
_DIMS = ("object", "offset", "speed")
_LIMIT_FIELDS = ("lateral", "force")  # results of the rigid limit beside measured ones


@dataclass(frozen=True)
class Kind:
    """A kind of ground: how the pushes are stepped, and at which speeds [m/s] of the base."""

    what: str  # label
    physics: Physics
    speeds: tuple[float, ...] = SPEEDS


def _on(base: Physics, label: str, speeds: tuple[float, ...] = SPEEDS, **changes: Any) -> Kind:
    """Return a kind of ground by its changes to a base; `solref` is that of the ground."""
    solref = changes.pop("solref", base.ground_solref)
    return Kind(label, replace(base, ground_solref=solref, **changes), speeds)


_C = preset(fidelity="reference")
_FAST = preset(fidelity="fast")
_DEFAULT = replace(_C, **MUJOCO_GROUND)
_SLOW = (0.002, *SPEEDS)
# In C MuJoCo, converged, in steps of 1 ms.
CONVERGED = {
    "ours": _on(_C, "ours, 1 ms", speeds=_SLOW),
    "mujocos": _on(_DEFAULT, "MuJoCo's own, 1 ms", speeds=_SLOW),
    "stiff": _on(
        _C, "time constant 4 ms, impedance 0.95", solref=(0.004, 1.0), ground_impedance=0.95
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
    "fast": _on(_FAST, "ours, fast: 20 ms, damping ratio 0.3"),
    "mujocos_5ms": _on(_DEFAULT, "MuJoCo's own, 5 ms", timestep=0.005),
    "mujocos_10ms": _on(_DEFAULT, "MuJoCo's own, 10 ms", timestep=0.01),
}
# Ever stiffer: first with damping that grows along, then with hops that last as long as ours.
STIFFER = {
    f"critical_{1000 * constant:g}": _on(
        _DEFAULT,
        f"MuJoCo's own, time constant {1000 * constant:g} ms",
        timestep=timestep,
        solref=(constant, 1.0),
    )
    for constant, timestep in ((0.01, 5e-4), (0.005, 2.5e-4), (0.002, 1e-4))
} | {
    f"damping_{name}": _on(
        _C,
        f"ours, damping ratio {ratio}: {times} times as stiff",
        timestep=timestep,
        solref=(0.1, ratio),
    )
    for name, ratio, times, timestep in (("01", 0.1, 4, 5e-4), ("003", 0.03, 44, 1e-4))
}
# Lifted less by MuJoCo's cones: the lower the impedance, the deeper an object rests.
_LOW = {"solref": (0.1, 0.2), "ground_impedance": 0.3}
LOWER = {
    "lower": _on(_C, "(0.1 s, 0.2), impedance 0.3", **_LOW),
    "lower_10ms": _on(preset(), "(0.1 s, 0.2), impedance 0.3, 10 ms", **_LOW),
    "damped": _on(_C, "(0.1 s, 0.3), impedance 0.7", solref=(0.1, 0.3), ground_impedance=0.7),
    "lower_20ms": _on(_FAST, "(0.1 s, 0.4), impedance 0.5, 20 ms", solref=(0.1, 0.4)),
}
GROUNDS = CONVERGED | STEPPED | STIFFER | LOWER
QUICK = ("ours", "mujocos", "standard")
DRAWN = ("ours", "standard", "fast", "lower", "mujocos", "mujocos_10ms", "stiff")


def run(
    names: Sequence[str],
    run: Run,
    *,
    objects: Sequence[str] = OBJECTS,
    offsets: Sequence[float] = OFFSETS,
    steps: int = STEPS,
) -> xr.Dataset:
    """Push on the grounds that the run folder lacks, and return all pushes and the rigid limit.

    `limit_lateral` (object, offset, at_height) [m] is where a rigid object ends that is pushed at a
    height. `error` (ground, object, offset, speed) [m] says how far from there an object ended that
    was pushed as high.
    """
    progress, datasets = SequentialProgress(run.callback), []
    options = tuple(objects), tuple(offsets)
    part = part_of("limit", *options, HEIGHTS, steps)
    limit = run.checkpoint(part, partial(_limit, *options, steps))
    for name in names:
        cases = list(itertools.product(*options, GROUNDS[name].speeds))
        part = part_of(name, *options, replace(GROUNDS[name], what=""))
        compute = partial(_pushes, GROUNDS[name].physics, cases, progress)
        datasets.append(run.checkpoint(part, compute))
        progress.finish(len(cases))
        progress(Progress(0, 0.0))
    whole = xr.concat(datasets, xr.IndexVariable("ground", list(names)), join="outer")
    whole = whole.assign_coords(what=("ground", [GROUNDS[name].what for name in names]))
    whole = whole.assign({f"limit_{name}": limit[name] for name in _LIMIT_FIELDS})
    at = whole.height.clip(min(HEIGHTS), max(HEIGHTS)).fillna(HEIGHTS[0])
    expected = whole.limit_lateral.interp(at_height=at).drop_vars("at_height")
    whole["error"] = (whole.lateral - expected).transpose(*whole.lateral.dims)
    return whole


def count(names: Sequence[str]) -> int:
    """Return the number of pushes on these grounds, of all objects at all offsets."""
    return sum(len(OBJECTS) * len(OFFSETS) * len(GROUNDS[name].speeds) for name in names)


def _pushes(
    physics: Physics,
    cases: Sequence[tuple[str, float, float]],
    callback: ProgressCallback,
) -> xr.Dataset:
    """Return the pushes (object, offset, speed) of cases in this order."""
    targets, results, simulated = pushes.targets(), [], 0.0
    for name, offset, speed in cases:
        results.append(pushes.in_mujoco(targets[name], offset, speed, physics))
        simulated += DISTANCE / speed
        callback(Progress(len(results), simulated))
    columns = zip(_DIMS, zip(*cases, strict=True), strict=True)
    coords = {dim: list(dict.fromkeys(values)) for dim, values in columns}
    return _dataset(Pushes._fields, results, coords)


def _limit(objects: Sequence[str], offsets: Sequence[float], steps: int) -> xr.Dataset:
    """Return the rigid limit (object, offset, at_height)."""
    targets = pushes.targets()
    grid = np.meshgrid(offsets, HEIGHTS, indexing="ij")
    values = [axis.ravel() for axis in grid]
    results = [pushes.in_the_limit(targets[name], *values, steps=steps) for name in objects]
    coords = {"object": objects, "offset": offsets, "at_height": HEIGHTS}
    return _dataset(_LIMIT_FIELDS, results, coords)


def _dataset(
    names: Sequence[str], results: Sequence[Pushes], coords: Mapping[str, Sequence[Any]]
) -> xr.Dataset:
    """Return fields of pushes along the dimensions of some coordinates, the last one fastest."""
    shape = [len(values) for values in coords.values()]
    columns = {
        name: (tuple(coords), np.reshape([getattr(x, name) for x in results], shape))
        for name in names
    }
    return xr.Dataset(columns, {dim: list(values) for dim, values in coords.items()})


_AT_SPEED = {
    "error": "{error:.1f} mm",
    "push over mu m g": "{force:.3f}",
}


def table(results: xr.Dataset, speeds: Sequence[float] = SPEEDS) -> Rows:
    """Return a header and a row per ground.

    The error is the root of the mean square over objects and offsets; force and height are means,
    the hop is the largest.
    """
    header = [f"{name}, {100 * speed:g} cm/s" for speed in speeds for name in _AT_SPEED]
    over, force = ["object", "offset"], float(results.limit_force.mean())
    rows = [
        ["ground", *header, "height of the push", "largest hop", "aloft"],
        ["rigid object", *["0", f"{force:.3f}"] * len(speeds), "all", "0", "0"],
    ]
    chosen = results.sel(speed=list(speeds))
    at_speed = xr.Dataset(
        {
            "error": 1000 * np.sqrt((chosen.error**2).mean(over)),
            "force": chosen.force.mean(over),
        }
    )
    for name in map(str, results.ground.values):
        ground = chosen.sel(ground=name)
        height = ground.height
        _, *cells = text_table(_AT_SPEED, records(at_speed.sel(ground=name), "speed"))
        rows.append(
            [
                str(ground.what.values),
                *itertools.chain(*cells),
                " to ".join(f"{100 * float(x):.0f}" for x in (height.min(), height.max())) + " cm",
                f"{1000 * float(ground.hop.max()):.2f} mm",
                f"{100 * float(ground.aloft.max()):.0f} %",
            ]
        )
    return rows
