"""Dependence of results on the pressure under objects.

rps sweeps/ground/support.py --machine "2 cores of an AMD EPYC"

The hardware's experiments of the paper run on a grid of supports, frictions and slips, started by
hand. The paper's D and times have normal likelihoods, and all points of the grid equal priors.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from scipy.special import logsumexp

import rps_jax
from rps_jax import Range, Setting
from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import WIDTH, Figure, tiles, words
from rps_jax.geometry.solid import SUPPORTS
from rps_jax.questions import Picture, Run, call_of, option
from rps_jax.world import paper, points
from rps_jax.worlds import parse_domain
from sweeps.study_base import Parts, QuickStudy, Table, records, run_parts, text_table

LAWS = ("rps", "rps_tuned", "rps_plus")
# The grid of the hardware: friction object-robot, and shares of v_x, v_y and omega that are lost.
FRICTIONS = (0.35, 0.6, 0.9, 1.2)
ONE_SLIP = tuple((x, x, x) for x in (0.0, 0.06, 0.13, 0.2, 0.25))
THREE_SLIPS = tuple(product((0.06, 0.13), (0.13, 0.25), (0.25, 0.4, 0.55)))
SLIPS = (*ONE_SLIP, *THREE_SLIPS)
_D, _TIME = 0.004, 2.5  # [m], [s] standard deviation of what no point explains
_TARGETS = 8  # of each mean of the paper
_RANGES = {
    "support": Range(0, 2),
    "friction_robot": Range(0.3, 1.3),
    "robot_slip": Range(0, 0.6),
    "robot_slip_sideways": Range(0, 0.6),
    "robot_slip_yaw": Range(0, 0.6),
}
HARDWARE = replace(
    parse_domain("hardware"),
    targets=paper.HARDWARE_LAYOUTS["circle"],
    lateral=Range(-0.03, 0.03),  # by hand, within 3 cm and 3 degrees
    yaw=Range(-0.0524, 0.0524),
    **_RANGES,
)


@dataclass(frozen=True)
class Support(QuickStudy[xr.Dataset]):
    """Run laws in random worlds on each support, and infer that of the hardware's objects.

    The answer has `success` (support, law) [1] with `low` and `high` of `wide`, and `successes`,
    the mean `D` [m], the mean `time` [s] and their variances (slips, object, support, friction) of
    the hardware's objects. A cylinder has no corners: NaN.
    """

    TITLE = "Pressure under objects"
    QUICK: ClassVar = {"worlds": 6, "repeats": 1}

    worlds: int = option(200, 3, 100_000)
    """Number of random worlds."""
    repeats: int = option(2, 1, 1000)
    """Number of pushes of the hardware's objects to each target at each point of the grid."""

    def answer(self, run: Run) -> xr.Dataset:
        """Run the random worlds and the grid."""
        parts: Parts = {kind: partial(self._wide, kind) for kind in SUPPORTS}
        wide = run_parts(run, "support", parts, self.worlds)
        return xr.merge([wide, run.checkpoint("hardware", self._hardware)])

    def _wide(self, kind: str) -> xr.Dataset:
        setting = Setting(physics=f"default,support={kind}")
        results = rps_jax.sweep(list(LAWS), "wide", self.worlds, setting=setting)
        won = results.success.sum("world").values
        low, high = np.array([statistics.wilson(int(x), self.worlds) for x in won]).T
        columns = {"success": won / self.worlds, "low": low, "high": high}
        return xr.Dataset({k: ("law", x) for k, x in columns.items()}, {"law": list(LAWS)})

    def _hardware(self) -> xr.Dataset:
        """Return means and variances of the pushes at each point of the grid."""
        shape = len(SLIPS), 2, len(SUPPORTS), len(FRICTIONS), _TARGETS, self.repeats
        index = np.indices(shape).reshape(len(shape), -1)
        index = index[:, (index[1] == 0) | (index[2] < 2)]  # a cylinder has no corners
        slips, kind, support, friction, target, _ = index
        rng, count = np.random.default_rng(0), index.shape[1]
        values = {
            "support": np.array(list(SUPPORTS.values()))[support],
            "friction_robot": np.array(FRICTIONS)[friction],
            **dict(zip(list(_RANGES)[2:], np.array(SLIPS)[slips].T, strict=True)),
        }
        at = {"object": (kind + 0.5) / 2, "target": (target + 0.5) / _TARGETS}
        for name, x in values.items():
            low, high = _RANGES[name].low, _RANGES[name].high
            at[name] = np.minimum((x - low) / (high - low), 1 - 1e-9)
        names = points.names(HARDWARE)
        u = np.column_stack([at[x] if x in at else rng.random(count) for x in names])
        results = rps_jax.sweep("rps", HARDWARE, points=u).isel(law=0)
        success = results.success.values
        dims = ("slips", "object", "support", "friction", "target", "repeat")
        columns: dict[str, xr.DataArray] = {}
        for name, x in (("D", results.mean_abs_l), ("time", results.time), ("successes", success)):
            table = np.full(shape, np.nan)
            table[tuple(index)] = np.where(success | (name == "successes"), x, np.nan)
            trials = xr.DataArray(table, dims=dims)
            columns[name] = trials.mean(dims[4:])
            columns[f"{name}_variance"] = trials.var(dims[4:])
        coords = {"object": ["box", "cylinder"], "friction": list(FRICTIONS)}
        return xr.Dataset(columns, coords)

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return success in random worlds, and the posterior of the hardware."""
        rows = records(results[["success", "low", "high"]], "support", "law")
        return [
            Table(text_table(_WIDE, rows), merge="pressure", name="support"),
            Table(
                text_table(_POSTERIOR, _posterior_rows(results)),
                merge="unknown",
                name="support_posterior",
                picture=Picture("posterior", partial(figure, results)),
            ),
            Table(
                text_table(_READINGS, _reading_rows(results)),
                merge="reading",
                name="support_readings",
            ),
        ]


support = call_of(Support)

_WIDE = {
    "pressure": "{support}",
    "law": "{law}",
    "success": "{success:.1%}",
    "95 % interval": "[{low:.1%}, {high:.1%}]",
}
_POSTERIOR = {"unknown": "{unknown}", "value": "{value}", "posterior": "{probability:.0%}"}
_READINGS = {
    "reading": "{reading}",
    "object": "{object}",
    "slips": "{slips}",
    "pressure": "{support}",
    "friction object-robot": "{friction}",
    "D": "{D:.3f} m (fitted)",
    "D in the paper": "{paper.mean_abs_l:.3f} m",
    "time": "{time:.0f} s (fitted)",
    "time in the paper": "{paper.time:.0f} s",
}


def log_likelihood(results: xr.Dataset) -> xr.DataArray:
    """Return the log likelihood (slips, object, support, friction) of the paper's numbers.

    The paper's means are of eight pushes, which scatter as the simulated ones.
    """
    terms: Any = _TARGETS * np.log(results.successes.clip(1e-9))
    for name, field, deviation in (("D", "mean_abs_l", _D), ("time", "time", _TIME)):
        printed = [getattr(x, field) for x in paper.HARDWARE_RESULTS.values()]
        off = results[name] - xr.DataArray(printed, dims="object")
        variance = deviation**2 + results[f"{name}_variance"] / _TARGETS
        terms = terms - 0.5 * (off**2 / variance + np.log(variance))
    return terms.fillna(-np.inf)


def posterior(results: xr.Dataset) -> xr.DataArray:
    """Return probabilities (slips, object, support, friction), which sum to 1 for each object.

    The objects share the slips. One slip and three slips have equal priors.
    """
    fit = log_likelihood(results)
    by_object = xr.apply_ufunc(
        lambda x: logsumexp(x, axis=(-2, -1)), fit, input_core_dims=[["support", "friction"]]
    )
    is_equal = np.arange(len(SLIPS)) < len(ONE_SLIP)
    counts = np.where(is_equal, len(ONE_SLIP), len(THREE_SLIPS))
    prior = xr.DataArray(-np.log(counts), dims="slips")
    of_slips = by_object.sum("object") + prior
    of_slips = np.exp(of_slips - logsumexp(of_slips))
    return of_slips * np.exp(fit - by_object.where(np.isfinite(by_object), 0))


def marginals(results: xr.Dataset) -> dict[str, dict[str, float]]:
    """Return the posterior probability of each value of each unknown."""
    p = posterior(results)
    of_slips = p.isel(object=0).sum(("support", "friction")).values
    axes = {f"share of {x} that is lost": i for i, x in enumerate(("v_x", "v_y", "omega"))}
    equal = float(of_slips[: len(ONE_SLIP)].sum())
    unknowns = {"slips": {"one for all axes": equal, "three": 1 - equal}}
    for label, i in axes.items():
        values = sorted({slip[i] for slip in SLIPS})
        totals = [of_slips[[slip[i] == x for slip in SLIPS]].sum() for x in values]
        unknowns[label] = dict(zip(map("{:g}".format, values), map(float, totals), strict=True))
    for name, label in (("support", "pressure under the"), ("friction", "friction robot-")):
        for kind in map(str, p.object.values):
            summed = "friction" if name == "support" else "support"
            shares = p.sel(object=kind).sum(("slips", summed))
            text = f"{label} {kind}" if name == "support" else f"{label}{kind}"
            unknowns[text] = dict(zip(map(str, p[name].values), map(float, shares), strict=True))
    return unknowns


def _posterior_rows(results: xr.Dataset) -> Iterator[dict[str, object]]:
    for unknown, shares in marginals(results).items():
        for value, probability in shares.items():
            yield {"unknown": unknown, "value": value, "probability": probability}


def readings(results: xr.Dataset) -> dict[str, tuple[tuple[int, ...], ...]]:
    """Return the likeliest point (slips, support, friction) of box and cylinder, by reading."""
    fit = log_likelihood(results)
    best = fit.max(("support", "friction")).sum("object").values
    same = fit.max("friction").sum("object").max("support").values
    starts = {"one slip": (0, len(ONE_SLIP)), "three slips": (len(ONE_SLIP), len(SLIPS))}
    points_of = {}
    for label, (low, high) in starts.items():
        slips = low + int(best[low:high].argmax())
        best_points = [np.unravel_index(int(np.argmax(x)), x.shape) for x in fit.values[slips]]
        points_of[label] = tuple((slips, *map(int, x)) for x in best_points)
    slips = int(same.argmax())
    support = int(fit[slips].max("friction").sum("object").values.argmax())
    frictions = fit.values[slips, :, support].argmax(axis=1)
    points_of["one pressure for both"] = tuple((slips, support, int(x)) for x in frictions)
    return points_of


def _reading_rows(results: xr.Dataset) -> Iterator[dict[str, object]]:
    for label, by_object in readings(results).items():
        for i, (slips, support, friction) in enumerate(by_object):
            at = results.isel(slips=slips, object=i, support=support, friction=friction)
            yield {
                "reading": label,
                "object": str(at.object.values),
                "slips": ", ".join(f"{x:g}" for x in SLIPS[slips]),
                "support": str(at.support.values),
                "friction": float(at.friction),
                "D": float(at.D),
                "time": float(at.time),
                "paper": list(paper.HARDWARE_RESULTS.values())[i],
            }


def figure(results: xr.Dataset) -> Figure:
    """Draw the posterior of each unknown over its prior."""
    shown: Mapping[str, Mapping[str, float]] = marginals(results)
    drawn, axes = tiles(len(shown), 4, (WIDTH / 3, 1.8), (0, 0.2))
    for ax, (unknown, shares) in zip(axes.ravel(), shown.items(), strict=False):
        ax.bar(list(shares), list(shares.values()), color="C0")
        ax.set(ylim=(0, 1), yticks=[])
        ax.set_title(words(unknown), fontsize=7)
        ax.tick_params(labelsize=6)
    return drawn
