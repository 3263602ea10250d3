"""Compare gradient estimators with finite differences, as a function of the simulated time.

The score is the distance from contact to target after a time, averaged over random worlds of one
object. The reference (`truth`) is the gradient of the original law and skin by central differences
in thousands of worlds. An estimator that smooths scores is biased. The results hold the gradient
in each world, so that any other statistic needs no new run.

    rps sweeps/gradients --quick
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import errors
from rps_jax.control import registry
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines import EngineName
from rps_jax.record.options import option
from rps_jax.runs.question import Run, Split, call_of, seed_of
from rps_jax.trials import trial
from rps_jax.trials.progress import Progress, set_phase
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import World
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.tuning.descent import soften_skins
from rps_jax.tuning.gradients import Scores, estimate, slopes
from rps_jax.tuning.space import Space, expand_subsets
from rps_jax.world import domain as domains
from rps_jax.world import draws
from rps_jax.world.domain import RANDOM, DomainLike
from rps_jax.world.physics import PHYSICS
from sweeps.gradients import estimators
from sweeps.study_base import QuickStudy, Rows, Table

TRUTH = "truth"
HORIZONS = (0.5, 2.0, 8.0, 30.0, 100.0)  # [s]
ESTIMATORS = ("reverse", "clipped", "forward", "evolution", "combined")
# Estimators that are computed from the gradients of others in each world.
_INPUTS = {"clipped": ("reverse",), "combined": ("reverse", "evolution")}
_RESAMPLES = 1000  # of the bootstrap
_INTERVAL = (0.05, 0.95)  # its quantiles


@dataclass(frozen=True)
class Gradients(QuickStudy[xr.Dataset]):
    """Compare gradient estimators with finite differences after several simulated times.

    The answer has the `cosine` to finite differences (estimator, horizon) with the interval `low`
    to `high` and whether it is `decided`, and the standard error `doubt` of the differences
    (horizon). Variables named by a measurement are the gradients [m] in each world (world,
    parameter, horizon); `truth` has other worlds.
    """

    TITLE: ClassVar[str] = "Gradients against finite differences"
    QUICK: ClassVar = {
        "horizons": (0.5, 2.0, 8.0),
        "worlds": 8,
        "truth": 64,
        "engine": "quasistatic",
    }
    CHOICES: ClassVar = {"estimators": ESTIMATORS, "object": RANDOM}
    GROWS: ClassVar[tuple[str, ...]] = ("estimators",)
    PRESETS: ClassVar = {"physics": PHYSICS["default"], "laws": ("rps",)}

    estimators: tuple[str, ...] = ESTIMATORS
    """reverse, clipped (reverse with a bound in each world), forward, evolution or combined."""
    domain: DomainLike = "wide,gap=0:0"
    """The worlds: a domain's name or a JSON file of ranges; changes follow. By default wide without
    a gap, in which no parameter matters."""
    object: str = "random_box"
    """Object to push: random_box, random_cylinder or random_prism."""
    tuned: tuple[str, ...] = ("beta", "K_h", "K_v", "L")
    """Parameters to differentiate by: names, or logistic, or full."""
    horizons: tuple[float, ...] = option(HORIZONS, 0.1, 300, unit="s")
    """Times at which the distance is measured [s]."""
    worlds: int = option(256, 2, 1_000_000)
    """Number of worlds of an estimate."""
    truth: int = option(2048, 2, 1_000_000)
    """Number of worlds of the finite differences."""
    delta: float = option(0.05, above=0, at_most=5)
    """Step of the central differences, in units of the bounded map [1]."""
    sigma: float = option(0.15, above=0, at_most=5)
    """Standard deviation of the steps of evolution, in units of the bounded map [1]."""
    clip: float = option(2.0, above=0, at_most=5)
    """Bound on the norm of a world's gradient for the estimator clipped, as a multiple of the
    median norm [1]."""
    engine: EngineName = "fused"
    """Engine of the truth, of forward and of evolution; reverse uses the quasi-static engine."""
    seed: int = option(0, 0, 2**30)
    """Seed of the worlds."""

    @functools.cached_property
    def space(self) -> Space:
        """Parameters of the gradient."""
        return Space(expand_subsets(self.tuned))

    @property
    def theta(self) -> jax.Array:
        """Vector (p,) at which the gradient is estimated."""
        return self.space.vector(self.space.base)

    def check(self) -> None:
        """Check the names and that the horizons increase."""
        super().check()
        if not self.horizons or list(self.horizons) != sorted(set(self.horizons)):
            rule = "give one or more, in increasing order"
            raise errors.not_allowed("horizons", self.horizons, rule)
        _ = self.space

    @property
    def measurements(self) -> tuple[str, ...]:
        """Names of all measurements in order: truth, and what the estimators average."""
        inputs = (name for x in self.estimators for name in _INPUTS.get(x, (x,)))
        return tuple(dict.fromkeys((TRUTH, *inputs)))

    def num_trials(self) -> int | None:
        """Number of measurements."""
        return len(self.measurements)

    def answer(self, run: Run) -> xr.Dataset:
        """Measure the gradients that the run folder lacks, and compare the estimators."""
        parts: list[xr.Dataset] = []
        for name in self.measurements:
            set_phase(run.callback, name)
            parts.append(run.checkpoint(name, partial(_measure, self, name)))
            run.callback(Progress(len(parts), 0.0))
        return compare(xr.merge(parts), self.estimators, self.clip)

    def intro(self, results: xr.Dataset) -> str:
        """Return the options in a sentence."""
        return (
            f"Gradients of the remaining distance by {', '.join(self.space.names)}, in worlds of "
            f"{self.object.replace('_', ' ')}; the truth are central differences in "
            f"{self.truth:,} worlds. An estimate is of {self.worlds:,} worlds. Brackets have the 5 "
            "and 95 % quantiles of a bootstrap over the worlds of the estimate and of the truth. A "
            "cosine is undecided if these have different signs, or if one world has more than half "
            "of the gradient, of which a bootstrap cannot tell how rare it is."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the cosine of each estimator."""
        return [Table(table(results), title="Estimators against the truth")]


gradients = call_of(Gradients)


def _stage_and_worlds(study: Gradients, engine: EngineName, split: Split, count: int) -> Any:
    """Return the stage, the first worlds (count, ...) of a split, and the physics."""
    alone = replace(domains.parse_domain(study.domain), objects=(study.object,))
    setting = Setting(engine=engine)
    drawn = draws.draw(alone, seed_of(study.seed, split), np.arange(count))
    part = drawn_worlds(alone, drawn, setting)
    return part.stage, part.worlds, setting.physics


def _distances(study: Gradients, stage: Any, physics: Any, smooth: bool) -> Scores:
    """Return scores (n, H) [m]: the distances at the horizons."""
    at = np.round(np.array(study.horizons) / physics.control_period).astype(int) - 1
    law = registry.smooth_law(rps.LAW) if smooth else rps.LAW
    score = estimators.distances_at(at, stage, study.space.params, physics, law)

    def scores(thetas: jax.Array, worlds: World) -> jax.Array:
        live, params = jnp.ones(thetas.shape[0], bool), jax.vmap(lambda _: RPSParams())(thetas)
        start = jax.lax.stop_gradient(trial.start_all(worlds, params, live, law=law))
        return score(thetas, (worlds, start))

    return scores


def _measure(study: Gradients, name: str) -> xr.Dataset:
    """Return the gradient in each world by one estimator, or of the truth."""
    is_true, smooth = name == TRUTH, name not in (TRUTH, "evolution")
    engine: EngineName = "quasistatic" if name == "reverse" else study.engine
    split, count = ("test", study.truth) if is_true else ("tune", study.worlds)
    stage, worlds, physics = _stage_and_worlds(study, engine, split, count)
    scores = _distances(study, stage, physics, smooth)
    key = jax.random.key(study.seed)
    functions: dict[str, Callable[..., jax.Array]] = {
        TRUTH: partial(estimators.differences, step=study.delta),
        "reverse": slopes,
        "forward": estimators.forward,
        "evolution": partial(estimators.evolution, key=key, sigma=study.sigma),
    }
    samples = jax.jit(partial(functions[name], scores))
    worlds = soften_skins(worlds) if smooth else worlds
    dims = (f"{TRUTH}_world" if is_true else "world", "parameter", "horizon")
    return xr.Dataset(
        {name: (dims, np.asarray(samples(study.theta, worlds)))},
        {"parameter": list(study.space.names), "horizon": ("horizon", list(study.horizons))},
    )


def compare(samples: xr.Dataset, names: Sequence[str], clip: float) -> xr.Dataset:
    """Return the gradients in each world with the comparison of estimators with the truth.

    `cosine` (estimator, horizon) is that of an estimate and the truth. `low` and `high` are the
    quantiles of `_INTERVAL` of a bootstrap over the worlds of the estimates, which all share, and
    over those of the truth. It is `decided` if they have the same sign, and no world has more than
    half of the sum of the norms: the bootstrap of a mean of such samples has no coverage. `doubt`
    (horizon) is the standard error of the truth, relative to its norm.
    """
    gradients = {str(name): jnp.asarray(array.values) for name, array in samples.items()}
    true, random = gradients.pop(TRUTH), np.random.default_rng(0)
    sizes = [samples.sizes["world"], samples.sizes[f"{TRUTH}_world"]]
    rows = [random.integers(n, size=(_RESAMPLES, n), dtype=np.int32) for n in sizes]
    drawn = _cosines(tuple(names), gradients, true, clip, *rows)
    whole = _cosines(tuple(names), gradients, true, clip, *(np.arange(n)[None] for n in sizes))
    low, high = np.nanquantile(drawn, _INTERVAL, axis=0)
    shares = {name: np.zeros(low.shape[1:]) for name in names}
    shares |= {name: _largest_share(samples[name]) for name in gradients}
    shared = np.stack([shares[name] < 0.5 for name in names])
    dims, of_truth = ("estimator", "horizon"), estimate(true)
    doubt = jnp.sqrt(jnp.sum(of_truth.variance, axis=0) / jnp.sum(of_truth.gradient**2, axis=0))
    return samples.assign(
        cosine=(dims, np.asarray(whole[0])),
        low=(dims, low),
        high=(dims, high),
        decided=(dims, shared & (low * high > 0)),
        doubt=("horizon", np.asarray(doubt)),
    ).assign_coords(estimator=list(names))


def _largest_share(gradient: xr.DataArray) -> np.ndarray:
    """Return the share (H,) [1] of the largest norm in the sum of the norms of all worlds."""
    finite = gradient.where(np.isfinite(gradient), 0.0).astype(float)
    norm = (finite**2).sum("parameter") ** 0.5
    return (norm.max("world") / norm.sum("world").clip(min=np.finfo(float).tiny)).values


@partial(jax.jit, static_argnums=(0, 3))
def _cosines(
    names: tuple[str, ...],
    gradients: Mapping[str, jax.Array],  # (n, p, H) in the worlds of the estimates
    true: jax.Array,  # (m, p, H)
    clip: float,
    rows: jax.Array,  # (B, n) indices of worlds
    true_rows: jax.Array,  # (B, m)
) -> jax.Array:
    """Return cosines (B, estimators, H) between estimates and the truth in selected worlds."""

    def cosines(selected: tuple[jax.Array, jax.Array]) -> jax.Array:
        drawn = {name: array[selected[0]] for name, array in gradients.items()}
        estimates = {name: estimate(array) for name, array in drawn.items()}
        if "clipped" in names:
            estimates["clipped"] = estimate(drawn["reverse"], clip)
        if "combined" in names:
            estimates["combined"] = estimators.combine(estimates["reverse"], estimates["evolution"])
        target = estimate(true[selected[1]]).gradient
        stacked = jnp.stack([estimates[name].gradient for name in names])
        stacked /= jnp.max(jnp.abs(stacked), axis=1, keepdims=True)  # no overflow of the squares
        norms = jnp.sqrt(jnp.sum(stacked**2, axis=1) * jnp.sum(target**2, axis=0))
        return jnp.sum(stacked * target, axis=1) / norms

    return jax.lax.map(cosines, (rows, true_rows))


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per estimator: its cosine with the true gradient, by horizon."""
    horizons = sorted({*HORIZONS, *results.horizon.values})
    shown = results.reindex(horizon=horizons)  # missing ones are NaN

    def cell(cosine: float, low: float, high: float, decided: bool) -> str:
        word = "" if decided else ", undecided"
        return "" if np.isnan(cosine) else f"{cosine:.2f} [{low:.2f}, {high:.2f}]{word}"

    rows = [["estimator", *(f"{horizon:g} s" for horizon in horizons)]]
    for name in map(str, results.estimator.values):
        row = shown.sel(estimator=name)
        fields = (row[field].values for field in ("cosine", "low", "high", "decided"))
        rows.append([name, *map(cell, *fields)])
    if results.sizes["horizon"] == len(horizons):
        doubt = ["" if np.isnan(value) else f"{value:.2f}" for value in shown.doubt.values]
        rows.append(["standard error of the truth, as a share of it", *doubt])
    return rows
