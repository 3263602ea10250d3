"""How good is a gradient? Each estimator against finite differences, by the time simulated.

What is differentiated is the mean, over random worlds of one kind, of the distance from contact to
target that is left after a time. The truth is of the hard law and skin: central differences in
thousands of worlds, all of them met by both sides. What an estimator softens is its bias.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.control import strategies
from rps_jax.control.law import RPSParams
from rps_jax.engines import EngineName
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Parts
from rps_jax.runs.evaluate import Split, seed_of
from rps_jax.trials import trial
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Snapshot, World
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.tuning import gradients
from rps_jax.tuning.descent import soften
from rps_jax.tuning.gradients import Estimate
from rps_jax.tuning.space import Space
from rps_jax.world import draws
from rps_jax.world.domain import DOMAINS, RANDOM, Domain, Range

TRUTH = "truth"
# clipped is reverse with a bound on each world's gradient; combined, of reverse and evolution.
ESTIMATORS = ("reverse", "clipped", "forward", "evolution", "combined")


@dataclass(frozen=True)
class Study:
    """Which gradient, and of what size its estimates are."""

    domain: Domain = replace(DOMAINS["wide"], gap=Range(0, 0))
    """By default without a gap, in which no parameter matters."""
    object: str = "random_box"
    """One of the random objects."""
    space: Space = Space(("beta", "K_h", "K_v", "L"))
    horizons: tuple[float, ...] = (0.5, 2.0, 8.0, 30.0, 100.0, 300.0)
    """[s] Times after which the distance is looked at."""
    worlds: int = 64
    """Of one estimate."""
    repeats: int = 4
    """Estimates, each in worlds of its own."""
    truth: int = 4096
    """Worlds of the finite differences."""
    delta: float = 0.05
    """Half a finite difference, in units of the bounded map."""
    sigma: float = 0.15
    """Standard deviation of the steps of evolution, likewise."""
    clip: float = 2.0
    """Bound on the norm of a world's gradient, of the estimator clipped, in their medians."""
    engine: EngineName = "fused"
    """Of the truth, of forward mode and of evolution; reverse mode takes the quasi-static one."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises InputError for a study without sense."""
        errors.check_name("object", self.object, RANDOM)
        for time in self.horizons:
            errors.check_finite("horizon", time, at_least=0.1, at_most=300, unit="s")
        if not self.horizons or list(self.horizons) != sorted(set(self.horizons)):
            raise errors.InputError(
                f"horizons = {self.horizons} is not allowed: give one or more, each longer than "
                "the one before."
            )
        for name in ("worlds", "repeats", "truth"):
            errors.check_finite(name, getattr(self, name), at_least=2, at_most=1e6)
        for name in ("delta", "sigma", "clip"):
            errors.check_finite(name, getattr(self, name), above=0, at_most=5)

    @property
    def theta(self) -> jax.Array:
        """Where the gradient is looked for, (p,)."""
        return self.space.vector(self.space.base)


def _stage_and_worlds(study: Study, engine: EngineName, split: Split, count: int) -> Any:
    """What worlds share in their engine, the first worlds (count, ...) of a split, and physics."""
    alone = replace(study.domain, objects=(study.object,))
    setting = Setting(engine=engine)
    drawn = draws.draw(alone, seed_of(study.seed, split), np.arange(count))
    part = drawn_worlds(alone, drawn, RPSParams(), setting)
    return part.stage, part.worlds, setting.physics


def _distances(study: Study, stage: Any, physics: Any, smooth: bool) -> gradients.Scores:
    """Scores (n, H) [m]: the distances after the horizons."""
    period = physics.control_period
    at = np.array([round(time / period) - 1 for time in study.horizons])
    strategy = strategies.smooth_rps() if smooth else strategies.RPS

    def left(seen: Snapshot) -> jax.Array:
        return seen.details.distance[at]

    score = gradients.window(
        stage, study.space.params, left, physics=physics, strategy=strategy, steps=int(at[-1]) + 1
    )

    def scores(thetas: jax.Array, worlds: World) -> jax.Array:
        live = jnp.ones(thetas.shape[0], bool)
        return score(thetas, (worlds, trial.start_all(worlds, live, strategy=strategy)))

    return scores


def truth(study: Study) -> Estimate:
    """Finite differences: gradient (p, H) [m], and its variance, by the number of worlds."""
    stage, worlds, physics = _stage_and_worlds(study, study.engine, "test", study.truth)
    scores = jax.jit(_distances(study, stage, physics, smooth=False))
    return gradients.differences(scores, study.theta, worlds, step=study.delta)


def repeats(study: Study, name: str) -> Iterator[Estimate]:
    """Estimates (p, H) by one estimator, in other worlds each."""
    engine: EngineName = "quasistatic" if name in ("reverse", "clipped") else study.engine
    smooth = name != "evolution"
    count = study.repeats * study.worlds
    stage, worlds, physics = _stage_and_worlds(study, engine, "tune", count)
    scores = _distances(study, stage, physics, smooth)
    act: dict[str, Callable[..., Estimate]] = {
        "reverse": lambda worlds, key: gradients.reverse(scores, study.theta, worlds),
        "clipped": lambda worlds, key: gradients.reverse(
            scores, study.theta, worlds, clip=study.clip
        ),
        "forward": lambda worlds, key: gradients.forward(scores, study.theta, worlds),
        "evolution": partial(gradients.evolution, scores, study.theta, sigma=study.sigma),
    }
    one = jax.jit(act[name])
    if smooth:
        worlds = soften(worlds)
    for r in range(study.repeats):
        rows = slice(r * study.worlds, (r + 1) * study.worlds)
        key = jax.random.fold_in(jax.random.key(study.seed), r)
        yield one(jax.tree.map(lambda leaf, rows=rows: leaf[rows], worlds), key)


def run(
    study: Study, folder: Path, names: tuple[str, ...] = ESTIMATORS, *, report: Callable[[str], Any]
) -> xr.Dataset:
    """The truth and every estimator in a run folder, those that are there already not again.

    Calls `report` with the name of what comes next. Raises InputError for an unknown name, or a
    folder that cannot be written or holds another study.
    """
    for name in names:
        errors.check_name("estimator", name, ESTIMATORS)
    run_folder.claim(folder, asdict(study))
    wanted = dict.fromkeys((TRUTH, *names))
    if "combined" in wanted:
        wanted = dict.fromkeys((TRUTH, "reverse", "evolution", *names))
    found: dict[str, xr.Dataset] = {}
    parts = Parts(folder)
    for name in wanted:
        if parts.get(name) is None:
            report(name)
        found[name] = parts.results(name, partial(_measured, study, name, found))
    return judged(found, names)


def _measured(study: Study, name: str, found: dict[str, xr.Dataset]) -> xr.Dataset:
    if name == TRUTH:
        all_of = [truth(study)]
    elif name == "combined":
        pair: Any = [
            Estimate(*(jnp.asarray(found[n][f].values) for f in Estimate._fields))
            for n in ("reverse", "evolution")
        ]
        every = jax.vmap(gradients.combine)(*pair)
        all_of = [jax.tree.map(lambda leaf, r=r: leaf[r], every) for r in range(study.repeats)]
    else:
        all_of = list(repeats(study, name))
    dims = ("repeat", "parameter", "horizon")
    leaves = jax.tree.map(lambda *x: np.stack(x), *jax.device_get(all_of))
    return xr.Dataset(
        {field: (dims, leaf) for field, leaf in leaves._asdict().items()},
        {"parameter": list(study.space.names), "horizon": ("horizon", list(study.horizons))},
    )


def judged(found: dict[str, xr.Dataset], names: tuple[str, ...]) -> xr.Dataset:
    """Each estimator beside the truth, (estimator, horizon).

    cosine: between one estimate and the truth, mean of the repeats, and its range; bias: of their
    mean, and error: standard deviation of one estimate, both as shares of the truth's norm;
    finite: share of the worlds' derivatives that are; doubt: standard error of the truth itself,
    as a share of it.
    """
    true = found[TRUTH].isel(repeat=0)
    norm = _norm(true.gradient)
    doubt = np.sqrt(true.variance.sum("parameter")) / norm
    rows = []
    for name in names:
        one = found[name]
        along = (one.gradient * true.gradient).sum("parameter")
        cosine = along / (_norm(one.gradient) * norm)
        rows.append(
            xr.Dataset(
                {
                    "cosine": cosine.mean("repeat"),
                    "least_cosine": cosine.min("repeat"),
                    "greatest_cosine": cosine.max("repeat"),
                    "bias": _norm(one.gradient.mean("repeat") - true.gradient) / norm,
                    "error": np.sqrt(one.variance.sum("parameter").mean("repeat")) / norm,
                    "finite": one.finite.mean(("repeat", "parameter")),
                }
            ).expand_dims(estimator=[name])
        )
    every: Any = xr.concat(rows, "estimator")
    return every.assign(doubt=doubt)


def _norm(gradient: xr.DataArray) -> xr.DataArray:
    return (gradient**2).sum("parameter") ** 0.5


def table(results: xr.Dataset) -> list[list[str]]:
    """Header, a row for each estimator: cosine, bias, error and finite share at every horizon."""
    rows = [["estimator", "", *(f"{time:g} s" for time in results.horizon.values)]]
    for name in map(str, results.estimator.values):
        one = results.sel(estimator=name)
        rows += [
            [name, "cosine", *(f"{x:.2f}" for x in one.cosine.values)],
            ["", "bias", *(f"{x:.2g}" for x in one.bias.values)],
            ["", "standard error", *(f"{x:.2g}" for x in one.error.values)],
            ["", "finite", *(f"{100 * x:.3g} %" for x in one.finite.values)],
        ]
    rows.append(["truth", "standard error", *(f"{x:.2g}" for x in results.doubt.values)])
    return rows
