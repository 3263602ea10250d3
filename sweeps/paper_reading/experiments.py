"""The paper's experiments under drawn readings and drawn physics."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import Domain, Range, RPSParams, Setting
from rps_jax.laws import LawParams
from rps_jax.physics import FRICTION, PHYSICS
from rps_jax.questions import Run
from rps_jax.trials import pushes
from rps_jax.trials.batch import outcomes
from rps_jax.trials.progress import ProgressCallback
from rps_jax.trials.results import trace_dataset
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import Candidates
from rps_jax.world import paper, points, scene
from rps_jax.worlds import parse_domain
from sweeps.paper_reading import printed
from sweeps.paper_reading.printed import SHORT
from sweeps.paper_reading.unknowns import NAMES, UNKNOWNS, aps_params, params, texts, values

Target = tuple[float, float]
FIG_6: Target = (-2.0, 0.0)  # box, S1
_POINT, _LINE = 1, 2  # types of contact
_BY_OBJECT = {"friction_ground": "ground", "friction_robot": "robot"}  # in the name of an unknown
_SIMULATED = {"yaw": "yaw", "gap": "sim_gap"}  # quantity of the domain: unknown
_CORNER = (0.15, 0.25)  # [m] |l| of "0.2 m from the center"
_HIGHEST = 0.9  # [1] share of eta from which a_r is "nearly at its highest value"
_RECORDED = 0.1  # [s] between two snapshots of Fig. 6


def _ranges(part: str) -> dict[str, Range]:
    """Return the ranges of the unknowns of a part that are quantities of a domain."""
    return {
        name: unknown.range
        for name, unknown in UNKNOWNS.items()
        if unknown.part == part and hasattr(parse_domain("hardware"), name)
    }


def _by_object(prefix: str) -> Range:
    """Return the range of an unknown that both objects have."""
    return UNKNOWNS[f"{prefix}_box"].range


HARDWARE: Domain = replace(
    parse_domain("hardware"),
    targets=paper.HARDWARE_LAYOUTS["circle"],
    lateral=Range(-0.02, 0.02),
    yaw=Range(-0.05, 0.05),
    **{quantity: _by_object(prefix) for quantity, prefix in _BY_OBJECT.items()},
    **_ranges("hardware"),
)


def _simulated_domain(targets: tuple[Target, ...]) -> Domain:
    ranges = {quantity: UNKNOWNS[name].range for quantity, name in _SIMULATED.items()}
    return replace(parse_domain("paper"), targets=targets, **ranges)


@dataclass(frozen=True, eq=False)
class _Trials(Candidates):
    """Trials with drawn parameters, tolerance of the skin, and side of the load."""

    tolerance: np.ndarray | None = None  # (W,) [m] of an ideal skin
    is_far: np.ndarray | None = None  # (W,) whether the nonuniform box has its load at the far side

    @functools.cached_property
    def draws(self) -> list[tuple[np.ndarray, Domain, Any]]:
        """Worlds by domain and object, with the load of the nonuniform box at its side."""
        if self.is_far is None:
            return super().draws
        far, placed = scene.solid_of(scene.load("nonuniform_box", rear="far")), []
        for at, domain, drawn in super().draws:
            solid = drawn.solid
            if domain.objects[int(domain.object_of(drawn.cases[0]))] == "nonuniform_box":
                solid = jax.tree.map(partial(_where, self.is_far[at]), far, solid)
            placed.append((at, domain, drawn._replace(solid=solid)))
        return placed

    def batches(self, setting: Setting) -> Iterator[Any]:
        """Yield the worlds, with the tolerance of each."""
        for batch in super().batches(setting):
            if self.tolerance is None:
                yield batch
                continue
            skin: Any = batch.worlds.skin
            drawn = self.tolerance[batch.indices].astype(np.asarray(skin.tolerance).dtype)
            skin = skin._replace(tolerance=drawn)
            yield batch._replace(worlds=batch.worlds._replace(skin=skin))


def _where(mask: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return rows of the first array where the mask (n,) holds, and of the second elsewhere."""
    return np.where(mask.reshape(-1, *[1] * (second.ndim - 1)), first, second)


def _request(
    domain: Domain, u: Mapping[str, np.ndarray], law: LawParams, **fields: np.ndarray
) -> _Trials:
    """Return trials at points u (trials,) by name; leaves of the law are (trials,)."""
    columns = np.stack([u[name] for name in points.names(domain)], axis=1)
    at, count = points.check_points(domain, columns), len(columns)
    leaves = jax.tree.map(lambda leaf: leaf[None], law)
    return _Trials(leaves, [domain], 0, np.arange(count), at, per_world=True, **fields)


def _grid(u: np.ndarray, *sizes: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the draw of every trial of a grid, and the middle of each index in the unit cube.

    The grid has the draws first, then indices up to `sizes`, the last one fastest.
    """
    index = np.indices((len(u), *sizes)).reshape(1 + len(sizes), -1)
    middles = [(at + 0.5) / size for at, size in zip(index[1:], sizes, strict=True)]
    return index[0], middles


def _share(name: str, u: np.ndarray, domain: Domain, quantity: str) -> np.ndarray:
    """Return the place (n,) of an unknown in the range of a quantity of a domain."""
    low, high, log = getattr(domain, quantity)
    assert not log
    return np.clip((values(u, name) - low) / (high - low), 0, 1 - 1e-9)


# --- hardware --------------------------------------------------------------------------------


def hardware(u: np.ndarray, setting: Setting, run: Run, seed: int = 0) -> dict[str, np.ndarray]:
    """Return the numbers (draw,) of the hardware experiments at points u (draw, unknown).

    `seed` draws the start of each push, and the noise of the skin.
    """
    draw, (objects, targets) = _grid(u, len(SHORT), len(HARDWARE.targets))
    columns = {"object": objects, "target": targets}
    rng = np.random.default_rng(seed)
    for name in points.names(HARDWARE):
        if name in _BY_OBJECT:
            prefix = _BY_OBJECT[name]
            shares = [_share(f"{prefix}_{x}", u, HARDWARE, name)[draw] for x in SHORT.values()]
            columns[name] = np.where(objects < 0.5, *shares)
        elif name in UNKNOWNS:
            columns[name] = _share(name, u, HARDWARE, name)[draw]
        elif name not in columns:  # of a push
            columns[name] = rng.random(draw.size)
    law = jax.tree.map(lambda leaf: leaf[draw], params(u))
    request = _request(HARDWARE, columns, law)
    (outcome,), _ = outcomes([request], setting, **run.batch_options)
    shape = len(u), len(SHORT), len(HARDWARE.targets)
    return _hardware_numbers(u, jax.tree.map(lambda leaf: leaf.reshape(shape), _scalars(outcome)))


def _scalars(outcome: Outcome) -> dict[str, np.ndarray]:
    fields = ("success", "time", "mean_abs_l", "contact_lost_time")
    return {name: np.asarray(getattr(outcome, name), float) for name in fields}


def _hardware_numbers(u: np.ndarray, trials: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return means and counts (draw,) of outcomes (draw, object, target), as a draw counts them."""
    speed = float(RPSParams().v_approach) * (1 - values(u, "robot_slip"))
    approach = (values(u, "gap") / speed)[:, None, None]  # [s] until the first contact
    time, lost = trials["time"], trials["contact_lost_time"]
    touching = np.clip((time - approach - lost) / time, 0, 1)
    whole, late = (values(u, name)[:, None, None] > 0 for name in ("counts_d", "counts_time"))
    success = trials["success"] > 0
    measured = {
        "D": np.where(whole, touching, 1.0) * trials["mean_abs_l"],
        "time": time - np.where(late, approach, 0.0),
    }
    numbers = {}
    for i, name in enumerate(SHORT.values()):
        count = success[:, i].sum(1)
        numbers[f"hardware, {name}: successes"] = count
        for key, each in measured.items():
            total = np.where(success[:, i], each[:, i], 0.0).sum(1)
            numbers[f"hardware, {name}: {key}"] = np.where(
                count > 0, total / np.maximum(count, 1), np.nan
            )
    return numbers


# --- simulation ------------------------------------------------------------------------------


def simulation(
    u: np.ndarray, setting: Setting, targets: tuple[Target, ...], run: Run
) -> xr.DataArray:
    """Return the successes (draw, law, object, friction, target) of all trials of Table II."""
    domain = _simulated_domain(targets)
    shape = domain.counts
    success = np.empty((len(u), len(paper.LAWS), *shape), bool)
    for chosen, changed in _by_cone(u, setting):
        at = u[chosen]
        draw, columns, fields = _simulated(at, domain)
        rps = jax.tree.map(lambda leaf, draw=draw: leaf[draw], params(at))
        aps = jax.tree.map(lambda leaf, draw=draw: leaf[draw], aps_params(at))
        laws = {"rps": rps, "nps": rps._replace(reactive=np.zeros(draw.size)), "aps": aps}
        requests = [_request(domain, columns, laws[law], **fields) for law in paper.LAWS]
        results, _ = outcomes(requests, changed, **run.batch_options)
        for i, outcome in enumerate(results):
            success[chosen, i] = np.asarray(outcome.success).reshape(len(chosen), *shape)
    x, y = np.array(targets).T
    coords = {"law": list(paper.LAWS), "object": list(domain.objects), "friction": list(FRICTION)}
    coords |= {"target_x": ("target", x), "target_y": ("target", y)}
    return xr.DataArray(success, coords, ("draw", "law", "object", "friction", "target"))


def _by_cone(u: np.ndarray, setting: Setting) -> Iterator[tuple[np.ndarray, Setting]]:
    """Yield the draws of each friction cone, and a setting with this cone in the paper's simulator.

    Cones that no draw has are left out.
    """
    cones, physics = np.array(texts(u, "cone")), PHYSICS["paper_gazebo"]["standard"]
    for cone in UNKNOWNS["cone"].choices:
        if (chosen := np.flatnonzero(cones == cone)).size:
            yield chosen, replace(setting, physics=replace(physics, cone=cone))


def _simulated(
    u: np.ndarray, domain: Domain
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the draws, the coordinates and the fields of `_Trials` of the trials of each draw."""
    draw, middles = _grid(u, *domain.counts)
    columns = dict(zip(("object", "friction", "target"), middles, strict=True))
    columns |= {
        quantity: _share(name, u, domain, quantity)[draw] for quantity, name in _SIMULATED.items()
    }
    columns |= {name: np.full(draw.size, 0.5) for name in points.names(domain, "noise")}
    fields = {"tolerance": values(u, "tolerance")[draw], "is_far": values(u, "rear")[draw] > 0}
    return draw, columns, fields


def figure_6(u: np.ndarray, setting: Setting, callback: ProgressCallback) -> list[xr.Dataset]:
    """Return the trial of Fig. 6 of each draw over time: box, S1, target (-2, 0)."""
    domain = replace(_simulated_domain((FIG_6,)), objects=("box",), frictions=(FRICTION["S1"],))
    traces: list[xr.Dataset] = [xr.Dataset()] * len(u)
    for chosen, changed in _by_cone(u, setting):
        at = u[chosen]
        _, columns, fields = _simulated(at, domain)
        (batch,) = _request(domain, columns, params(at), **fields).batches(changed)
        dtype = jnp.result_type(float)
        law = jax.tree.map(lambda leaf, dtype=dtype: np.asarray(leaf, dtype), params(at))
        batch = batch._replace(params=law)
        recorded = pushes.record_batch(batch, changed, interval=_RECORDED, callback=callback)
        for i, trajectory in zip(chosen, recorded, strict=True):
            traces[i] = trace_dataset(trajectory)
    return traces


def observations(trace: xr.Dataset) -> dict[str, float]:
    """Return what the text tells of Fig. 6, 1 if it holds in a trial and 0 if not."""
    kind, l = trace.contact_type.values, trace.l.values  # noqa: E741
    realigning, touched = trace.realigning.values > 0, kind > 0
    first = int(np.argmax(touched)) if touched.any() else 0
    starts = np.flatnonzero(np.diff(realigning.astype(int), prepend=0) == 1)
    before = slice(first, starts[0] if starts.size else None)
    low, high = _CORNER
    corner = bool(touched.any() and kind[first] == _POINT and low <= -l[first] <= high)
    rate = abs(trace.a_r.values[first]) >= _HIGHEST * RPSParams().eta
    return {
        "Fig. 6: success": float(trace.outcome_success),
        "Fig. 6: the right corner touches first": float(corner),
        "Fig. 6: a_r starts near its highest": float(touched.any() and rate),
        "Fig. 6: line contact before Realignment": float((kind[before] == _LINE).any()),
        "Fig. 6: one Realignment State": float(starts.size == 1),
    }


# --- all of them -----------------------------------------------------------------------------


def numbers(
    u: np.ndarray, samples: int, setting: Setting, targets: tuple[Target, ...], run: Run, seed: int
) -> xr.Dataset:
    """Return all simulated numbers (draw, number), and the trials (number) of the counts.

    Points u (draw, unknown) differ in the hardware alone within each `samples` of them, for which
    the simulation runs once. Without targets only the hardware's experiments run.
    """
    results = {
        name: (x, len(HARDWARE.targets)) for name, x in hardware(u, setting, run, seed).items()
    }
    if targets:
        once = u[::samples]
        observed = [observations(trace) for trace in figure_6(once, setting, run.callback)]
        simulated = printed.counts(simulation(once, setting, targets, run))
        simulated |= {
            name: (np.array([each[name] for each in observed]), 1) for name in observed[0]
        }
        results |= {name: (np.repeat(x, samples), count) for name, (x, count) in simulated.items()}
    names = [name for name in printed.PRINTED if name in results]
    columns = {
        "simulated": (("draw", "number"), np.stack([results[n][0] for n in names], 1)),
        "trials": ("number", [results[name][1] for name in names]),
        "u": (("draw", "unknown"), u),
    }
    return xr.Dataset(columns, {"number": names, "unknown": list(NAMES)})
