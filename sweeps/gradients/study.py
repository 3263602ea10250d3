"""How good is a gradient? Each estimator against finite differences, by the time simulated.

What is differentiated is the mean, over random worlds of one kind, of the distance from contact to
target that is left after a time. The truth is of the hard law and skin: central differences in
thousands of worlds, all of them met by both sides. What an estimator softens is its bias.

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
from rps_jax.analysis.figures.style import Figure
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines import EngineName
from rps_jax.record.options import option
from rps_jax.runs.question import Run, Split, call_of, seed_of
from rps_jax.trials import trial
from rps_jax.trials.progress import Progress, set_phase
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Snapshot, World
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.tuning.descent import soften_skins
from rps_jax.tuning.gradients import Estimate, Scores, reverse, window
from rps_jax.tuning.space import Space, expand_subsets
from rps_jax.world import domain as domains
from rps_jax.world import draws
from rps_jax.world.domain import RANDOM, DomainLike
from sweeps.gradients import estimators
from sweeps.study_base import Study

TRUTH = "truth"
# clipped is reverse with a bound on each world's gradient; combined, of reverse and evolution.
ESTIMATORS = ("reverse", "clipped", "forward", "evolution", "combined")


@dataclass(frozen=True)
class Gradients(Study[xr.Dataset]):
    """Tell how good the gradient of each estimator is, after how many seconds of simulation.

    The answer holds, by (estimator, horizon), the cosine to finite differences, bias, standard
    error, and the share of finite derivatives.
    """

    TITLE: ClassVar[str] = "Gradients against finite differences"
    QUICK: ClassVar[Mapping[str, Any]] = {
        "horizons": (0.5, 2.0, 8.0),
        "worlds": 8,
        "truth": 64,
        "engine": "quasistatic",
    }
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
    horizons: tuple[float, ...] = option((0.5, 2.0, 8.0, 30.0, 100.0, 300.0), 0.1, 300, unit="s")
    """Times after which the distance is looked at [s]."""
    worlds: int = option(64, 2, 1_000_000)
    """Number of worlds of one estimate."""
    repeats: int = option(4, 2, 1_000_000)
    """Number of estimates, each in worlds of its own."""
    truth: int = option(4096, 2, 1_000_000)
    """Number of worlds of the finite differences."""
    delta: float = option(0.05, above=0, at_most=5)
    """Half a finite difference, in units of the bounded map [1]."""
    sigma: float = option(0.15, above=0, at_most=5)
    """Standard deviation of the steps of evolution, likewise [1]."""
    clip: float = option(2.0, above=0, at_most=5)
    """Bound on the norm of a world's gradient, of the estimator clipped, in their medians [1]."""
    engine: EngineName = "fused"
    """Engine of the truth, of forward mode and of evolution; reverse mode takes the quasi-static
    one."""
    seed: int = option(0, 0, 2**30)
    """Seed of the worlds."""
    quick: bool = False
    """Whether to make a small run of minutes: what is not asked for becomes small."""

    @functools.cached_property
    def space(self) -> Space:
        """The parameters that are differentiated by."""
        return Space(expand_subsets(self.tuned))

    @property
    def theta(self) -> jax.Array:
        """Where the gradient is looked for, (p,)."""
        return self.space.vector(self.space.base)

    def check(self) -> None:
        """Check the names, and that horizons follow one another."""
        for name in self.estimators:
            errors.check_name("estimator", name, ESTIMATORS)
        errors.check_name("object", self.object, RANDOM)
        if not self.horizons or list(self.horizons) != sorted(set(self.horizons)):
            raise errors.InputError(
                f"horizons = {self.horizons} is not allowed: give one or more, each longer than "
                "the one before."
            )
        _ = self.space

    @property
    def wanted(self) -> tuple[str, ...]:
        """What has to be measured, in turn: the truth first, and what others are made of."""
        of_both = ("reverse", "evolution") if "combined" in self.estimators else ()
        return tuple(dict.fromkeys((TRUTH, *of_both, *self.estimators)))

    def num_trials(self) -> int | None:
        """How many measurements there are."""
        return len(self.wanted)

    def answer(self, run: Run) -> xr.Dataset:
        """Measure the truth and every estimator that the run folder lacks."""
        found: dict[str, xr.Dataset] = {}
        for name in self.wanted:
            set_phase(run.callback, name)
            found[name] = run.checkpoint(name, partial(_measured, self, name, found))
            run.callback(Progress(len(found), 0.0))
        return judged(found, self.estimators)

    def intro(self, results: xr.Dataset) -> str:
        """What was asked."""
        return (
            f"Of the distance that is left after a time, by {', '.join(self.space.names)}, in "
            f"worlds of {self.object.replace('_', ' ')}; the truth: central differences in "
            f"{self.truth:,} worlds."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Cosine, bias and error of each estimator."""
        picture = Picture("gradients", partial(figure_of, results))
        return [Section("Estimators against the truth", "", table(results), picture)]


gradients = call_of(Gradients)


def _stage_and_worlds(study: Gradients, engine: EngineName, split: Split, count: int) -> Any:
    """What worlds share in their engine, the first worlds (count, ...) of a split, and physics."""
    alone = replace(domains.parse_domain(study.domain), objects=(study.object,))
    setting = Setting(engine=engine)
    drawn = draws.draw(alone, seed_of(study.seed, split), np.arange(count))
    part = drawn_worlds(alone, drawn, setting)
    return part.stage, part.worlds, setting.physics


def _distances(study: Gradients, stage: Any, physics: Any, smooth: bool) -> Scores:
    """Scores (n, H) [m]: the distances after the horizons."""
    period = physics.control_period
    at = np.array([round(time / period) - 1 for time in study.horizons])
    law = registry.smooth_law(rps.LAW) if smooth else rps.LAW

    def left(seen: Snapshot) -> jax.Array:
        return seen.details.distance[at]

    loop = trial.ControlLoop(physics, law=law)
    score = window(stage, study.space.params, left, loop, int(at[-1]) + 1)

    def scores(thetas: jax.Array, worlds: World) -> jax.Array:
        live, params = jnp.ones(thetas.shape[0], bool), jax.vmap(lambda _: RPSParams())(thetas)
        start = jax.lax.stop_gradient(trial.start_all(worlds, params, live, law=law))
        return score(thetas, (worlds, start))

    return scores


def truth(study: Gradients) -> Estimate:
    """Finite differences: gradient (p, H) [m], and its variance, by the number of worlds."""
    stage, worlds, physics = _stage_and_worlds(study, study.engine, "test", study.truth)
    scores = jax.jit(_distances(study, stage, physics, smooth=False))
    return estimators.differences(scores, study.theta, worlds, step=study.delta)


def repeats(study: Gradients, name: str) -> Iterator[Estimate]:
    """Estimates (p, H) by one estimator, in other worlds each."""
    engine: EngineName = "quasistatic" if name in ("reverse", "clipped") else study.engine
    smooth = name != "evolution"
    count = study.repeats * study.worlds
    stage, worlds, physics = _stage_and_worlds(study, engine, "tune", count)
    scores = _distances(study, stage, physics, smooth)
    act: dict[str, Callable[..., Estimate]] = {
        "reverse": lambda worlds, key: reverse(scores, study.theta, worlds),
        "clipped": lambda worlds, key: reverse(scores, study.theta, worlds, clip=study.clip),
        "forward": lambda worlds, key: estimators.forward(scores, study.theta, worlds),
        "evolution": partial(estimators.evolution, scores, study.theta, sigma=study.sigma),
    }
    one = jax.jit(act[name])
    if smooth:
        worlds = soften_skins(worlds)
    for r in range(study.repeats):
        rows = slice(r * study.worlds, (r + 1) * study.worlds)
        key = jax.random.fold_in(jax.random.key(study.seed), r)
        yield one(jax.tree.map(lambda leaf, rows=rows: leaf[rows], worlds), key)


def _measured(study: Gradients, name: str, found: dict[str, xr.Dataset]) -> xr.Dataset:
    if name == TRUTH:
        all_of = [truth(study)]
    elif name == "combined":
        pair: Any = [
            Estimate(*(jnp.asarray(found[n][f].values) for f in Estimate._fields))
            for n in ("reverse", "evolution")
        ]
        every = jax.vmap(estimators.combine)(*pair)
        all_of = [jax.tree.map(lambda leaf, r=r: leaf[r], every) for r in range(study.repeats)]
    else:
        all_of = list(repeats(study, name))
    dims = ("repeat", "parameter", "horizon")
    leaves = jax.tree.map(lambda *x: np.stack(x), *jax.device_get(all_of))
    return xr.Dataset(
        {field: (dims, leaf) for field, leaf in leaves._asdict().items()},
        {"parameter": list(study.space.names), "horizon": ("horizon", list(study.horizons))},
    )


def judged(found: Mapping[str, xr.Dataset], names: Sequence[str]) -> xr.Dataset:
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


def figure_of(results: xr.Dataset) -> Figure:
    """Draw estimators against the truth over the horizon: cosine, bias, error, finite share."""
    panels = {
        "cosine": "cosine to the truth [1]",
        "bias": "bias / norm of the truth [1]",
        "error": "standard error / norm of the truth [1]",
        "finite": "share of finite derivatives [1]",
    }
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    x = results.horizon.values
    for ax, (field, label) in zip(
        figure.subplots(2, 2, sharex=True).ravel(), panels.items(), strict=True
    ):
        for i, name in enumerate(map(str, results.estimator.values)):
            one = results.sel(estimator=name)
            ax.plot(x, one[field], "o-", ms=4, color=f"C{i}", label=name)
            if field == "cosine":
                ax.fill_between(
                    x, one.least_cosine, one.greatest_cosine, color=f"C{i}", alpha=0.12, lw=0
                )
        if field in ("bias", "error"):
            ax.plot(x, results.doubt, "k--", lw=1, label="standard error of the truth")
            ax.set_yscale("log")
        if field == "finite":
            ax.set_ylim(-0.04, 1.04)
        ax.set(xscale="log", ylabel=label, xticks=x, xticklabels=[f"{t:g}" for t in x])
        ax.minorticks_off()
        ax.grid(alpha=0.3)
        if field in ("cosine", "bias"):
            ax.legend(fontsize=8)
    figure.supxlabel("horizon [s]", fontsize=10)
    return figure
