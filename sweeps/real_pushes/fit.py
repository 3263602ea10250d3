"""Fit friction and the centre of pressure to real pushes, by least squares and by other methods.

    rps sweeps/real_pushes/fit.py

A cell is one support of the object, surface and kind of finger. Each method fits the quantities of
a cell to one half of its pushes and predicts the other half, and the reverse. The pushes have no
base, touch or law, so they are no logs of `rps fit`: this study has its methods in the model of
`problem.py`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar, NamedTuple

import cmaes
import numpy as np
import pandas as pd
import xarray as xr
from scipy.optimize import least_squares

from rps_jax.questions import Run, call_of, option
from rps_jax.tuning import posterior
from sweeps.real_pushes import pushes, study
from sweeps.real_pushes.problem import HIGH, LOW, QUANTITIES, Cell
from sweeps.study_base import Parts, QuickStudy, Table, text_table

GROUPS = ("point, three feet", "two-point, three feet", "point, flat", "two-point, flat")
_PRIOR = np.sqrt(12)  # inverse standard deviation in the unit cube
_GRID = np.arange(0.10, 0.91, 0.05)  # frictions that `sweeps/real_pushes` scans
_STARTS = (0.2, 0.5)  # of least squares, as shares of the range of friction
_POPULATION, _GENERATIONS = 12, 16  # of CMA-ES
_NOISE, _DRAWS = 6, 2000  # noisy copies of each simulated world, and draws, of the networks
_NORMAL = 1.645  # half width of a 90 % interval in standard deviations


# --- methods --------------------------------------------------------------------------------


class Fitted(NamedTuple):
    """Quantities of a cell."""

    theta: np.ndarray  # (4,)
    covariance: np.ndarray  # (4, 4)
    simulated: int  # pushes


def world(x: np.ndarray) -> np.ndarray:
    """Return worlds (..., 4) at points of the unit cube."""
    return LOW + (HIGH - LOW) * x


def scan(cell: Cell, worlds: int) -> Fitted:
    """Return the friction at the finger with the least median error, as `sweeps/real_pushes`."""
    theta = np.array([[mu, known(cell)[1], 0.0, 0.0] for mu in _GRID])
    pose = cell.simulate(theta)[1].pose[-1].reshape(len(theta), -1, 3)
    off = pushes.errors_of(pose, pushes.measured(cell.table)).both
    return Fitted(theta[np.median(off, axis=1).argmin()], np.zeros((4, 4)), off.size)


def learn(cell: Cell, worlds: int) -> Fitted:
    """Return mean and covariance of the posterior of `rps fit`, with pushes as a log."""
    rng = np.random.default_rng(0)
    u = rng.random((worlds, 4))
    r = cell.residuals(np.concatenate([cell.simulate(world(x))[0] for x in np.array_split(u, 8)]))
    noise = rng.standard_normal((worlds, _NOISE, *r.shape[1:])) * np.isfinite(cell.measured)
    statistics = (r[:, None] + noise).reshape(worlds, _NOISE, -1)
    networks = posterior.train(u, statistics, 0)
    samples = world(posterior.sample(networks, 0 * statistics[0, :1], _DRAWS, 0))
    return Fitted(samples.mean(axis=0), np.cov(samples.T), r[..., 0].size)


def evolve(cell: Cell, worlds: int) -> Fitted:
    """Minimise the cost of `descend` by CMA-ES."""
    strategy = cmaes.CMA(
        np.full(4, 0.5), 0.25, bounds=np.array([[0, 1]] * 4), population_size=_POPULATION, seed=0
    )
    best, least = np.full(4, 0.5), np.inf
    for _ in range(_GENERATIONS):
        u = np.stack([strategy.ask() for _ in range(_POPULATION)])
        r = cell.residuals(cell.simulate(world(u))[0]).reshape(len(u), -1)
        r = np.concatenate([r, _PRIOR * (u - 0.5)], axis=1)
        costs = np.sum(np.sqrt(1 + r * r) - 1, axis=1)
        strategy.tell(list(zip(u, costs, strict=True)))
        if costs.min() < least:
            best, least = u[costs.argmin()], costs.min()
    return _laplace(cell, best, _POPULATION * _GENERATIONS)


def descend(cell: Cell, worlds: int) -> Fitted:
    """Minimise robust residuals, with a weak prior, by least squares with exact derivatives."""

    def values(x: np.ndarray) -> np.ndarray:
        return np.append(cell.residuals(cell.simulate(world(x)[None])[0]), _PRIOR * (x - 0.5))

    def slopes(x: np.ndarray) -> np.ndarray:
        j = cell.derivatives(world(x)) * (HIGH - LOW)
        return np.concatenate([j.reshape(-1, 4), _PRIOR * np.eye(4)])

    options: dict[str, Any] = {"jac": slopes, "bounds": (0, 1), "loss": "soft_l1"}
    fits = [
        least_squares(
            values, np.array([x, 0.5, 0.5, 0.5]), xtol=1e-3, ftol=1e-3, max_nfev=12, **options
        )
        for x in _STARTS
    ]
    best = min(fits, key=lambda fit: fit.cost)
    return _laplace(cell, best.x, sum(fit.nfev + fit.njev for fit in fits))


def _laplace(cell: Cell, x: np.ndarray, simulations: int) -> Fitted:
    """Return a minimum and its covariance, which does not assume the size of the residuals."""
    outcome, motion = cell.simulate(world(x)[None])
    r, j = cell.residuals(outcome[0]), cell.derivatives(world(x), motion) * (HIGH - LOW)
    weight, prior = 1 / np.sqrt(1 + r * r), _PRIOR**2 * np.eye(4)
    gradient = np.einsum("nc,ncp->np", weight * r, j)
    inverse = np.linalg.inv(np.einsum("nc,ncp,ncq->pq", weight, j, j) + prior)
    middle = gradient.T @ gradient * len(r) / max(1, len(r) - 4) + prior
    covariance = np.diag(HIGH - LOW) @ inverse @ middle @ inverse @ np.diag(HIGH - LOW)
    return Fitted(world(x), covariance, simulations * len(r))


METHODS: Mapping[str, Callable[[Cell, int], Fitted]] = {
    "scan of one friction": scan,
    "networks": learn,
    "CMA-ES": evolve,
    "least squares": descend,
}


def known(cell: Cell) -> np.ndarray:
    """Return the quantities (4,) that others measured, or that follow from the shape; or NaN."""
    surface = str(cell.table.surface.iloc[0])
    ground = pushes.GROUND.get(surface, pushes.GROUND["hardboard"])
    return np.array([np.nan, ground, 0.0, 0.0])


# --- the study ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Real(QuickStudy[xr.Dataset]):
    """Fit friction and the centre of pressure to real pushes by several methods.

    The answer has, by method and push, the errors `place` [m], `turn` [rad] and `both` [m] of the
    prediction by the other half of the pushes of its cell, and the share of its coordinates within
    the 90 % intervals; by method, cell and half, the quantities and their standard deviations.
    """

    TITLE = "Friction and centre of pressure of real pushes"
    CHOICES: ClassVar = {"groups": GROUPS}
    GROWS = ("groups",)
    DIMENSION = "cell"
    QUICK: ClassVar = {"few": 6, "worlds": 32, "cells": 1}

    few: int = option(12, 6, 1000)
    """Greatest number of pushes of each half of a cell."""
    worlds: int = option(512, 32, 100_000)
    """Number of simulated worlds from which the networks learn."""
    cells: int = option(100, 1, 100)
    """Greatest number of cells."""
    groups: tuple[str, ...] = GROUPS[:2]
    """Groups of pushes; a flat object stands on many points and takes several times as long."""

    @cached_property
    def tables(self) -> dict[str, pd.DataFrame]:
        """Pushes of each cell, at most `few` of each half."""
        table = pushes.read()
        halves, action = study.halves_of(table.id.to_numpy()), pushes.actions(table)
        table = table.assign(group=study.groups_of(table), half=halves, action=action)
        table = table[table.group.isin(self.groups)].fillna({"surface": "unknown"})
        labelled: Any = table.groupby(["group", "support", "surface"], sort=False)
        cells = {
            ", ".join(map(str, label)): rows.groupby("half").head(self.few).reset_index(drop=True)
            for label, rows in labelled
        }
        return dict(list(cells.items())[: self.cells])

    def parts(self, run: Run) -> Parts:
        """Return the function that fits the pushes of each cell."""
        return {label: partial(self._fit, rows) for label, rows in self.tables.items()}

    def _fit(self, table: pd.DataFrame) -> xr.Dataset:
        """Return the fits of one cell, from each half of its pushes."""
        halves = [Cell.of(rows.reset_index(drop=True)) for _, rows in table.groupby("half")]
        parts = []
        for name in METHODS:
            pairs = (halves, halves[::-1])
            rows = [self._predict(name, *pair) for pair in pairs]
            parts.append(xr.concat(rows, xr.IndexVariable("half", [0, 1])))
        result: Any = xr.concat(parts, xr.IndexVariable("estimator", list(METHODS)))
        has_force = bool(np.isfinite(halves[0].measured[:, 3]).all())
        return result.assign(group=str(table.group.iloc[0]), has_force=has_force)

    def _predict(self, name: str, train: Cell, test: Cell) -> xr.Dataset:
        """Fit one half of a cell and predict the other; the columns of pushes are padded."""
        train.derivatives(world(np.full(4, 0.5)))  # compile
        start = time.process_time()
        fitted = METHODS[name](train, self.worlds)
        seconds = time.process_time() - start
        outcome, motion = test.simulate(fitted.theta[None])
        fits = train.residuals(train.simulate(fitted.theta[None])[0][0])[:, :3]
        j, r = test.derivatives(fitted.theta, motion)[:, :3], test.residuals(outcome[0])[:, :3]
        spread = _NORMAL**2 * np.einsum("ncp,pq,ncq->nc", j, fitted.covariance, j)
        scatter = np.quantile(abs(fits), 0.9, axis=0)
        covered = np.mean(abs(r) <= np.sqrt(spread + scatter**2), axis=1)
        off = pushes.errors_of(motion.pose[-1], pushes.measured(test.table))
        padding = (0, self.few - len(test.table))
        columns = {**off._asdict(), "covered": covered}.items()
        padded = {k: ("push", np.pad(x, padding, constant_values=np.nan)) for k, x in columns}
        values = {
            "theta": fitted.theta,
            "deviation": np.sqrt(np.diag(fitted.covariance)),
            "known": known(test),
        }
        return xr.Dataset(
            {
                **padded,
                **{k: ("quantity", x) for k, x in values.items()},
                "seconds": seconds,
                "simulated": fitted.simulated,
            },
            {"quantity": list(QUANTITIES)},
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return errors by group of pushes, and quantities by method."""
        errors, quantities = (
            text_table(columns, rows(results))
            for columns, rows in ((_ERRORS, _error_rows), (_FITTED, _quantity_rows))
        )
        return [
            Table(errors, merge="pushes", name="fit_real", title="Predictions"),
            Table(quantities, merge="quantity", name="fit_real_quantities", title="Quantities"),
        ]


real = call_of(Real)

_ERRORS = {
    "pushes": "{group}",
    "method": "{method}",
    "predicted": "{count}",
    "place": "{place:.2f} mm",
    "turn": "{turn:.2f}°",
    "both": "{both:.2f} mm",
    "both, 90 %": "{most:.1f} mm",
    "90 % intervals hold the pose": "{covered:.0f} %",
    "processor seconds a fit": "{seconds:.1f}",
    "simulated pushes a fit": "{simulated:,.0f}",
}
_FITTED = {
    "quantity": "{quantity}",
    "method": "{method}",
    "cells": "{cells}",
    "median": "{median:.3g}",
    "standard deviation": "{deviation:.2g}",
    "difference of halves": "{apart:.2g}",
    "90 % intervals hold it": "{holds:.0f} %",
    "difference from the known value": "{off:.2g}",
    "90 % intervals hold the known value": "{holds_known:.0f} %",
}


def _error_rows(results: xr.Dataset) -> Iterator[dict[str, object]]:
    """Yield errors of all pushes of a group, by method."""
    for group in dict.fromkeys(map(str, results.group.values)):
        for method in METHODS:
            fits = results.sel(estimator=method).isel(cell=results.group.values == group)
            yield {
                "group": group,
                "method": method,
                "count": int(fits.both.count()),
                "place": 1e3 * float(fits.place.median()),
                "turn": np.degrees(float(fits.turn.median())),
                "both": 1e3 * float(fits.both.median()),
                "most": 1e3 * float(fits.both.quantile(0.9)),
                "covered": 100 * float(fits.covered.mean()),
                "seconds": float(fits.seconds.mean()),
                "simulated": float(fits.simulated.mean()),
            }


def _quantity_rows(results: xr.Dataset) -> Iterator[dict[str, object]]:
    """Yield each quantity by method; friction with the ground needs forces."""
    for name in QUANTITIES:
        unit = 1e3 if name.startswith("pressure") else 1.0
        chosen = results.has_force.values | (name != QUANTITIES[1])
        for method in tuple(METHODS)[1:]:
            fits = results.sel(estimator=method, quantity=name).isel(cell=chosen)
            apart = abs(fits.theta.diff("half")).squeeze("half")
            spread = _NORMAL * np.sqrt((fits.deviation**2).sum("half"))
            off, limit = abs(fits.theta - fits.known), _NORMAL * fits.deviation
            is_known = float(np.isfinite(fits.known).all()) or np.nan
            yield {
                "quantity": name + (" [mm]" if unit > 1 else ""),
                "method": method,
                "cells": fits.sizes["cell"],
                "median": unit * float(fits.theta.median()),
                "deviation": unit * float(fits.deviation.median()),
                "apart": unit * float(apart.median()),
                "holds": 100 * float((apart <= spread).mean()),
                "off": is_known * unit * float(off.median()),
                "holds_known": is_known * 100 * float((off <= limit).mean()),
            }
