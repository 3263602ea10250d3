"""Compare gradient estimators with finite differences, as a function of the simulated time.

The score is the distance from contact to target after a time, averaged over random worlds of one
object. The reference (`truth`) is the gradient of the original law and skin by central differences
in thousands of worlds. An estimator that smooths scores is biased. The results hold the gradient
in each world, so that any other statistic needs no new run. `check.py` tells whether `exact` is
the derivative of the softened score.

    rps sweeps/gradients --quick
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from rps_jax import RPSParams, Setting, errors
from rps_jax.analysis.figures.style import Axes, Figure, tiles, words
from rps_jax.control import registry
from rps_jax.laws import Space, law_of
from rps_jax.physics import PHYSICS, EngineName, get_engine
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.trials import trial
from rps_jax.trials.progress import Progress, set_phase
from rps_jax.trials.setting import seed_of
from rps_jax.trials.trial import World
from rps_jax.trials.worlds import drawn_worlds, soften_skins
from rps_jax.tuning.gradients import Options, Scores, estimate
from rps_jax.tuning.space import expand_subsets
from rps_jax.world import draws
from rps_jax.world.physics import Fidelity
from rps_jax.worlds import DomainLike, parse_domain
from sweeps.gradients import estimators
from sweeps.study_base import RANDOM_OBJECTS, QuickStudy, Rows, Table, part_name

TRUTH = "truth"
HORIZONS = (0.5, 2.0, 8.0, 30.0)  # [s]
ESTIMATORS = ("exact", "warm", "clipped", "bundled", "evolution", "mixed")
SINGLE = ("exact", "warm", "bundled", "evolution")  # estimators with separate samples
WARM = 0.1  # [1] temperature of the taxels for `warm`
# Estimators that are computed from the samples of others.
_INPUTS = {"clipped": ("exact",), "mixed": ("exact", "evolution")}
_RESAMPLES = 1000  # of the bootstrap
_INTERVAL = (0.05, 0.95)  # its quantiles


@dataclass(frozen=True)
class Gradients(QuickStudy[xr.Dataset]):
    """Compare gradient estimators with finite differences after several simulated times.

    By object, the answer has the `cosine` to finite differences (estimator, horizon) with the
    interval `low` to `high` and whether it is `decided`, the relative `error` of the estimate, and
    the standard error `doubt` of the differences (horizon). Variables named by a measurement are
    the gradients [m] in each world (world, parameter, horizon); `truth` has other worlds.
    """

    TITLE = "Gradients against finite differences"
    QUICK: ClassVar = {
        "horizons": (0.5, 2.0, 8.0),
        "worlds": 8,
        "truth": 64,
        "engine": "quasistatic",
    }
    CHOICES: ClassVar = {"estimators": tuple(estimators.ESTIMATORS), "objects": RANDOM_OBJECTS}
    GROWS = ("estimators", "objects")
    PRESETS: ClassVar = {"physics": PHYSICS["default"], "laws": ("rps",)}
    DOUBLE: ClassVar = False  # whether trials have double precision

    estimators: tuple[str, ...] = ESTIMATORS
    """exact, warm (exact, with wider switches of the taxels), clipped (exact with a bound in each
    world), bundled, evolution, mixed (exact and evolution), or forward (exact in forward mode)."""
    domain: DomainLike = "wide,gap=0:0"
    """The worlds: a domain's name or a JSON file of ranges; changes follow. By default wide without
    a gap, in which no parameter matters."""
    objects: tuple[str, ...] = ("random_box", "random_cylinder")
    """Objects to push: random_box, random_cylinder or random_prism."""
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
    """Standard deviation of the random steps, in units of the bounded map [1]."""
    pairs: int = option(1, 1, 1000)
    """Number of antithetic pairs of random steps in each world."""
    clip: float = option(2.0, above=0, at_most=5)
    """Bound on the norm of a world's gradient for the estimator clipped, as a multiple of the
    median norm [1]."""
    engine: EngineName = "fused"
    """Engine of all trials."""
    fidelity: Fidelity = "standard"
    """Fidelity of the physics."""
    seed: int = option(0, 0, 2**30)
    """Seed of the worlds."""

    @functools.cached_property
    def space(self) -> Space:
        """Parameters of the gradient."""
        return Space(expand_subsets(self.tuned))

    @property
    def setting(self) -> Setting:
        """Setting of all trials."""
        return Setting(engine=self.engine, fidelity=self.fidelity)

    def attributes(self) -> dict[str, str | int]:
        """Return the attributes of the results, with those of the setting."""
        return super().attributes() | self.setting.attributes

    def check(self) -> None:
        """Check the names, the derivatives of the engine, and that the horizons increase."""
        super().check()
        if not self.horizons or list(self.horizons) != sorted(set(self.horizons)):
            rule = "give one or more, in increasing order"
            raise errors.not_allowed("horizons", self.horizons, rule)
        _ = self.space
        for name in {"exact", "warm", "bundled", "forward"}.intersection(self.measurements):
            mode = "forward" if name == "forward" else "reverse"
            get_engine(self.engine).check_derivatives(mode)

    @property
    def measurements(self) -> tuple[str, ...]:
        """Names of all measurements in order: truth, and what the estimators average."""
        inputs = [name for x in self.estimators for name in _INPUTS.get(x, (x,))]
        return tuple(dict.fromkeys((TRUTH, *inputs)))

    def num_trials(self) -> int | None:
        """Number of measurements."""
        return len(self.objects) * len(self.measurements)

    def answer(self, run: Run) -> xr.Dataset:
        """Measure the gradients that the run folder lacks, and compare the estimators."""
        by_object, done = [], 0
        for name in self.objects:
            parts = []
            for measurement in self.measurements:
                set_phase(run.callback, f"{words(name)}, {measurement}")
                compute = partial(_measure, self, name, measurement)
                parts.append(run.checkpoint(part_name(name, measurement), compute))
                done += 1
                run.callback(Progress(done, 0.0))
            merged: Any = xr.merge(parts)
            by_object.append(self.combine(merged))
        joined: Any = xr.concat(by_object, xr.IndexVariable("object", list(self.objects)))
        return joined

    def combine(self, samples: xr.Dataset) -> xr.Dataset:
        """Return the gradients in each world of an object with the statistics of the answer."""
        return compare(samples, self.estimators, self.clip)

    def options_of(self, measurement: str) -> Options:
        """Return the options of the estimator of a measurement."""
        return Options(self.clip, self.delta if measurement == TRUTH else self.sigma, self.pairs)

    def intro(self, results: xr.Dataset) -> str:
        """Return the options in a sentence."""
        return (
            f"Gradients of the remaining distance by {', '.join(self.space.names)}, in the engine "
            f"{self.engine}; the truth are central differences in "
            f"{self.truth:,} worlds. An estimate is of {self.worlds:,} worlds. Brackets have the 5 "
            "and 95 % quantiles of a bootstrap over the worlds of the estimate and of the truth. A "
            "cosine is undecided if these have different signs, or if one world has more than half "
            "of the gradient, of which a bootstrap cannot tell how rare it is."
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the cosine of each estimator, and the gradients of single worlds."""
        merge, picture = "object", Picture("horizons", partial(figure_of, results))
        return [
            Table(
                table(results),
                merge=merge,
                name="gradients_cosine",
                title="Estimators against the truth",
                picture=picture,
            ),
            Table(
                norm_table(results),
                merge=merge,
                name="gradients_norm",
                title="Gradients in single worlds",
            ),
        ]


gradients = call_of(Gradients)


def _distances(study: Gradients, stage: Any, smooth: bool) -> Scores:
    """Return scores (n, H) [m]: the distances at the horizons."""
    physics = study.setting.physics
    at = np.round(np.array(study.horizons) / physics.control_period).astype(int) - 1
    law = registry.smooth_law(law_of(RPSParams)) if smooth else law_of(RPSParams)
    score = estimators.distances_at(at, stage, study.space.params, physics, law)

    def scores(thetas: jax.Array, worlds: World) -> jax.Array:
        live, params = jnp.ones(thetas.shape[0], bool), jax.vmap(lambda _: RPSParams())(thetas)
        start = jax.lax.stop_gradient(trial.start_all(worlds, params, live, law=law))
        return score(thetas, (worlds, start))

    return scores


def _measure(study: Gradients, name: str, measurement: str) -> xr.Dataset:
    """Return the gradient in each world of an object by one estimator, or of the truth."""
    is_true = measurement == TRUTH
    smooth = measurement not in (TRUTH, "evolution")
    seed = seed_of(study.seed, "test") if is_true else study.seed
    count = study.truth if is_true else study.worlds
    alone = replace(parse_domain(study.domain), objects=(name,))
    drawn = draws.draw(alone, seed, np.arange(count))
    estimator = estimators.ESTIMATORS["differences" if is_true else measurement]
    with jax.enable_x64(study.DOUBLE):
        part = drawn_worlds(alone, drawn, study.setting)
        softened = partial(soften_skins, taxels=WARM) if measurement == "warm" else soften_skins
        worlds = softened(part.worlds) if smooth else part.worlds
        theta = study.space.vector(study.space.base)
        scores = _distances(study, part.stage, smooth)

        @jax.jit
        def samples(theta: jax.Array, worlds: World, key: jax.Array) -> jax.Array:
            return estimator(scores, theta, worlds, key, study.options_of(measurement))

        values = np.asarray(samples(theta, worlds, jax.random.key(study.seed)), float)
    dims = (f"{TRUTH}_world" if is_true else "world", "parameter", "horizon")
    return xr.Dataset(
        {measurement: (dims, values)},
        {"parameter": list(study.space.names), "horizon": ("horizon", list(study.horizons))},
    )


def compare(samples: xr.Dataset, names: Sequence[str], clip: float) -> xr.Dataset:
    """Return the gradients in each world with the comparison of estimators with the truth.

    `cosine` (estimator, horizon) is that of an estimate and the truth, and `error` the norm of
    their difference, relative to the truth's. `low` and `high`, and `error_low` and `error_high`,
    are the quantiles of `_INTERVAL` of a bootstrap over the worlds of the estimates, which all
    share, and over those of the truth. A cosine is `decided` if they have the same sign, and no
    world has more than half of the sum of the norms: the bootstrap of a mean of such samples has
    no coverage. `doubt` (horizon) is the standard error of the truth, relative to its norm.
    """
    with jax.enable_x64(True):  # norms of single worlds exceed the range of float32
        return _compare(samples, names, clip)


def _compare(samples: xr.Dataset, names: Sequence[str], clip: float) -> xr.Dataset:
    values = {str(name): jnp.asarray(array.values, float) for name, array in samples.items()}
    true, random = values.pop(TRUTH), np.random.default_rng(0)
    sizes = [samples.sizes["world"], samples.sizes[f"{TRUTH}_world"]]
    rows = [random.integers(n, size=(_RESAMPLES, n), dtype=np.int32) for n in sizes]
    drawn = _compared(tuple(names), values, true, clip, *rows)
    whole = _compared(tuple(names), values, true, clip, *(np.arange(n)[None] for n in sizes))
    quantiles = [
        np.nanquantile(np.where(np.isfinite(x), x, np.nan), _INTERVAL, axis=0) for x in drawn
    ]
    (low, high), (error_low, error_high) = quantiles
    shares = {name: np.zeros(low.shape[1:]) for name in names}
    shares |= {name: _largest_share(samples[name]) for name in values}
    shared = np.stack([shares[name] < 0.5 for name in names])
    dims, of_truth = ("estimator", "horizon"), estimate(true)
    doubt = jnp.sqrt(jnp.sum(of_truth.variance, axis=0) / jnp.sum(of_truth.gradient**2, axis=0))
    columns = {
        "cosine": whole[0][0],
        "low": low,
        "high": high,
        "decided": shared & (low * high > 0),
        "error": whole[1][0],
        "error_low": error_low,
        "error_high": error_high,
    }
    compared = samples.assign({k: (dims, np.asarray(x)) for k, x in columns.items()})
    doubt = ("horizon", np.asarray(doubt))
    return compared.assign(doubt=doubt).assign_coords(estimator=list(names))


def norms(gradient: xr.DataArray) -> xr.DataArray:
    """Return the norms over the parameters; squares of large ones do not overflow."""
    scale = abs(gradient).max("parameter", skipna=False)
    return scale * ((gradient / scale.where(scale > 0, 1.0)) ** 2).sum("parameter") ** 0.5


def _largest_share(gradient: xr.DataArray) -> np.ndarray:
    """Return the share (H,) [1] of the largest norm in the sum of the norms of all worlds."""
    norm = norms(gradient.where(np.isfinite(gradient), 0.0))
    return (norm.max("world") / norm.sum("world").clip(min=np.finfo(float).tiny)).values


@partial(jax.jit, static_argnums=(0, 3))
def _compared(
    names: tuple[str, ...],
    measured: Mapping[str, jax.Array],  # (n, p, H) in the worlds of the estimates
    true: jax.Array,  # (m, p, H)
    clip: float,
    rows: jax.Array,  # (B, n) indices of worlds
    true_rows: jax.Array,  # (B, m)
) -> tuple[jax.Array, jax.Array]:
    """Return cosines and relative errors (B, estimators, H) of estimates in selected worlds."""

    def compared(selected: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        samples = {name: array[selected[0]] for name, array in measured.items()}
        if "clipped" in names:
            samples["clipped"] = estimators.clip(samples["exact"], clip)
        if "mixed" in names:
            samples["mixed"] = estimators.mix(samples["exact"], samples["evolution"])
        target = estimate(true[selected[1]]).gradient
        stacked = jnp.stack([estimate(samples[name]).gradient for name in names])
        size = jnp.sqrt(jnp.sum(target**2, axis=0))
        largest = jnp.maximum(jnp.max(jnp.abs(stacked), axis=1, keepdims=True), size)
        error = jnp.sqrt(jnp.sum(((stacked - target) / largest) ** 2, axis=1))
        scaled = stacked / largest  # without overflow of the squares
        norms = jnp.sqrt(jnp.sum(scaled**2, axis=1)) * size
        return jnp.sum(scaled * target, axis=1) / norms, error * largest[:, 0] / size

    return jax.lax.map(compared, (rows, true_rows))


def table(results: xr.Dataset) -> Rows:
    """Return a header and one row per object and estimator: its cosine with the truth, by time."""
    times = results.horizon.values

    def cell(cosine: float, low: float, high: float, decided: bool) -> str:
        word = "" if decided else ", undecided"
        return "" if np.isnan(cosine) else f"{cosine:.2f} [{low:.2f}, {high:.2f}]{word}"

    rows = [["object", "estimator", *(f"{time:g} s" for time in times)]]
    for name in map(str, results.object.values):
        of_object, label = results.sel(object=name), label_of(name)
        for estimator in map(str, results.estimator.values):
            row = of_object.sel(estimator=estimator)
            fields = (row[field].values for field in ("cosine", "low", "high", "decided"))
            rows.append([label, estimator, *map(cell, *fields)])
        doubt = [f"{value:.2f}" for value in of_object.doubt.values]
        rows.append([label, "standard error of the truth, as a share of it", *doubt])
    return rows


def norm_table(results: xr.Dataset) -> Rows:
    """Return a header and one row per object and quantity of single worlds, by time."""
    rows = [["object", "gradients in single worlds", *(f"{x:g} s" for x in results.horizon.values)]]
    for name in map(str, results.object.values):
        of_object, label = results.sel(object=name), label_of(name)

        def add(text: str, values: xr.DataArray, form: str, label: str = label) -> None:
            rows.append([label, text, *(format(x, form) for x in values.values)])

        for measurement in SINGLE:
            if measurement in results:
                norm = norms(of_object[measurement])
                finite = (
                    xr.apply_ufunc(np.isfinite, of_object[measurement])
                    .all("parameter")
                    .mean("world")
                )
                add(f"{measurement}: share finite", finite, ".3f")
                add(f"{measurement}: median norm [m]", norm.median("world"), ".1e")
                add(f"{measurement}: largest norm [m]", norm.max("world"), ".1e")
                share = xr.DataArray(_largest_share(of_object[measurement]))
                add(f"{measurement}: share of the largest norm in the sum", share, ".2f")
    return rows


def label_of(name: str) -> str:
    """Return the plural of a random object's name: boxes, cylinders or prisms."""
    kind = name.removeprefix("random_")
    return kind + ("es" if kind.endswith("x") else "s")


def figure_of(results: xr.Dataset) -> Figure:
    """Draw error and norms of gradients against the horizon, for each object in a column."""
    labels, times = [label_of(str(x)) for x in results.object.values], results.horizon.values
    figure, axes = tiles(2 * len(labels), len(labels), (5, 3.2), (0, 0), sharex=True)

    def spread(ax: Axes, middle: Any, low: Any, high: Any, name: str) -> None:
        colour = f"C{list(estimators.ESTIMATORS).index(name)}"
        ax.plot(times, middle, "o-", ms=4, color=colour, label=name)
        ax.plot(times, high, ":", color=colour, lw=1)
        ax.fill_between(times, low, high, color=colour, alpha=0.1, lw=0)

    for column, (name, label) in enumerate(zip(results.object.values, labels, strict=True)):
        of_object = results.sel(object=name)
        top, bottom = axes[:, column]
        for estimator in map(str, results.estimator.values):
            row = of_object.sel(estimator=estimator)
            spread(top, row.error, row.error_low, row.error_high, estimator)
        top.plot(times, of_object.doubt, "k:", label="standard error of the truth")
        for measurement in SINGLE:
            if measurement in results:
                norm = norms(of_object[measurement])
                low, middle, high = norm.quantile([0.05, 0.5, 1.0], "world").values
                spread(bottom, middle, low, high, measurement)
        top.set(title=label, ylim=(0.05, 1e4))  # beyond, a gradient means nothing
        bottom.set(xlabel="simulated time [s]", title="5 %, median and largest norm of worlds")
        for ax in (top, bottom):
            ax.set(xscale="log", yscale="log")
            ax.set_xticks(times, [f"{x:g}" for x in times])
            ax.set_xticks([], minor=True)
            ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("error of the gradient [1], 5 to 95 %")
    axes[1, 0].set_ylabel("norm in single worlds [m]")
    axes[0, 0].legend(fontsize=7)
    axes[1, 0].legend(fontsize=7)
    return figure
