"""Compare gradient estimators with finite differences, as a function of the simulated time.

The score is the distance from contact to target after a time, averaged over random worlds of one
object. The reference (`truth`) is the gradient of the original law and skin by central differences
in thousands of worlds. An estimator that smooths scores is biased.

    rps sweeps/gradients --quick
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from rps_jax.tuning.gradients import Estimate, Scores, reverse
from rps_jax.tuning.space import Space, expand_subsets
from rps_jax.world import domain as domains
from rps_jax.world import draws
from rps_jax.world.domain import RANDOM, DomainLike
from sweeps.gradients import estimators
from sweeps.study_base import QuickStudy, Rows, Table

TRUTH = "truth"
HORIZONS = (0.5, 2.0, 8.0, 30.0, 100.0, 300.0)  # [s]
# clipped is reverse with a bound on each world's gradient; combined, of reverse and evolution.
ESTIMATORS = ("reverse", "clipped", "forward", "evolution", "combined")


@dataclass(frozen=True)
class Gradients(QuickStudy[xr.Dataset]):
    """Compare gradient estimators with finite differences after several simulated times.

    The answer has the cosine to finite differences (estimator, horizon), and the standard error of
    these (horizon).
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
    worlds: int = option(64, 2, 1_000_000)
    """Number of worlds of one estimate."""
    repeats: int = option(4, 2, 1_000_000)
    """Number of estimates, each in other worlds."""
    truth: int = option(4096, 2, 1_000_000)
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
        """Names of all measurements in order: truth, the inputs of `combined`, and the rest."""
        inputs = ("reverse", "evolution") if "combined" in self.estimators else ()
        return tuple(dict.fromkeys((TRUTH, *inputs, *self.estimators)))

    def num_trials(self) -> int | None:
        """Number of measurements."""
        return len(self.measurements)

    def answer(self, run: Run) -> xr.Dataset:
        """Measure the truth and all estimators that the run folder lacks."""
        estimates: dict[str, xr.Dataset] = {}
        for name in self.measurements:
            set_phase(run.callback, name)
            compute = partial(_measure, self, name, estimates)
            estimates[name] = run.checkpoint(name, compute)
            run.callback(Progress(len(estimates), 0.0))
        return compare(estimates, self.estimators)

    def intro(self, results: xr.Dataset) -> str:
        """Return the options in a sentence."""
        return (
            f"Gradients of the remaining distance by {', '.join(self.space.names)}, in worlds of "
            f"{self.object.replace('_', ' ')}; the truth are central differences in "
            f"{self.truth:,} worlds."
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


def truth(study: Gradients) -> Estimate:
    """Return the central differences: gradient (p, H) [m] with its variance."""
    stage, worlds, physics = _stage_and_worlds(study, study.engine, "test", study.truth)
    scores = jax.jit(_distances(study, stage, physics, smooth=False))
    return estimators.differences(scores, study.theta, worlds, step=study.delta)


def repeats(study: Gradients, name: str) -> Iterator[Estimate]:
    """Yield estimates (p, H) by one estimator, each in other worlds."""
    engine: EngineName = "quasistatic" if name in ("reverse", "clipped") else study.engine
    smooth = name != "evolution"
    count = study.repeats * study.worlds
    stage, worlds, physics = _stage_and_worlds(study, engine, "tune", count)
    scores = _distances(study, stage, physics, smooth)
    functions: dict[str, Callable[..., Estimate]] = {
        "reverse": lambda worlds, key: reverse(scores, study.theta, worlds),
        "clipped": lambda worlds, key: reverse(scores, study.theta, worlds, clip=study.clip),
        "forward": lambda worlds, key: estimators.forward(scores, study.theta, worlds),
        "evolution": partial(estimators.evolution, scores, study.theta, sigma=study.sigma),
    }
    estimator = jax.jit(functions[name])
    if smooth:
        worlds = soften_skins(worlds)
    for r in range(study.repeats):
        rows = slice(r * study.worlds, (r + 1) * study.worlds)
        key = jax.random.fold_in(jax.random.key(study.seed), r)
        yield estimator(jax.tree.map(lambda leaf, rows=rows: leaf[rows], worlds), key)


def _measure(study: Gradients, name: str, estimates: dict[str, xr.Dataset]) -> xr.Dataset:
    """Return the repeated estimates of one estimator, or the truth."""
    if name == "combined":
        pair: Any = [
            Estimate(*(jnp.asarray(estimates[n][f].values) for f in Estimate._fields))
            for n in ("reverse", "evolution")
        ]
        leaves = jax.device_get(jax.vmap(estimators.combine)(*pair))
    else:
        all_of = [truth(study)] if name == TRUTH else repeats(study, name)
        leaves = jax.tree.map(lambda *x: np.stack(x), *jax.device_get(list(all_of)))
    dims = ("repeat", "parameter", "horizon")
    return xr.Dataset(
        {field: (dims, leaf) for field, leaf in leaves._asdict().items()},
        {"parameter": list(study.space.names), "horizon": ("horizon", list(study.horizons))},
    )


def compare(estimates: Mapping[str, xr.Dataset], names: Sequence[str]) -> xr.Dataset:
    """Return the comparison of estimators with the truth.

    `cosine` (estimator, horizon) is that of an estimate and the truth, the mean over the repeats;
    `doubt` (horizon) is the standard error of the truth, relative to its norm.
    """
    true = estimates[TRUTH].isel(repeat=0)
    norm, cosines = _norm(true.gradient), []
    for name in names:
        gradient = estimates[name].gradient
        product = (gradient * true.gradient).sum("parameter")
        cosines.append((product / (_norm(gradient) * norm)).mean("repeat"))
    cosine = xr.concat(cosines, xr.IndexVariable("estimator", list(names)))
    doubt = np.sqrt(true.variance.sum("parameter")) / norm
    return xr.Dataset({"cosine": cosine, "doubt": doubt})


def _norm(gradient: xr.DataArray) -> xr.DataArray:
    return (gradient**2).sum("parameter") ** 0.5


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per estimator: its cosine with the true gradient, by horizon."""
    horizons = sorted({*HORIZONS, *results.horizon.values})
    shown = results.reindex(horizon=horizons)

    def cells(values: xr.DataArray) -> list[str]:
        return ["" if np.isnan(value) else f"{value:.2f}" for value in values.values]

    rows = [["estimator", *(f"{horizon:g} s" for horizon in horizons)]]
    rows += [[str(c.estimator.item()), *cells(c)] for c in shown.cosine.transpose("estimator", ...)]
    if results.sizes["horizon"] == len(horizons):
        rows.append(["standard error of the truth, as a share of it", *cells(shown.doubt)])
    return rows
