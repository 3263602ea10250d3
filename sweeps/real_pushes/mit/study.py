"""Real pushes of eleven objects by others, predicted after a fit to a few of them.

    rps sweeps/real_pushes/mit --data FOLDER

FOLDER is a clone of github.com/robinzhoucmu/PlanarManipulationToolBox at commit 09b70a4. Its files
have pushes of the MIT push dataset and, for each, the end that the best published model of Zhou et
al. predicts. Nothing of it is in this project; the SHA-256 of each file is in `files.json`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import xarray as xr
from scipy.io import loadmat

from rps_jax import InputError, fit_object
from rps_jax.questions import Run, call_of, option
from rps_jax.tuning import objects
from rps_jax.tuning.objects import PRIOR, Pushes
from sweeps.study_base import QuickStudy, Table, run_parts, text_table

RADIUS = 0.00475  # [m] of the finger
LOGS, SHAPES = "mcube_data_proc/motion_model_eval_logs", "pnpush_matlab/get_shape.m"
# Sizes [m] of the objects, of the dataset's description (Yu et al. 2016).
RECTANGLES = {"rect1": (0.09, 0.09), "rect2": (0.08991, 0.11258), "rect3": (0.13501, 0.08994)}
TRIANGLES = {"tri1": (0.12587, 0.1259), "tri2": (0.12587, 0.151), "tri3": (0.12561, 0.1765)}
ELLIPSES = {"ellip1": 0.105, "ellip2": 0.13089, "ellip3": 0.157}
NAMES = (*RECTANGLES, *TRIANGLES, *ELLIPSES, "hex", "butter")
CELLS = (
    *(f"abs {name} 10" for name in NAMES),
    *(f"abs {name} 20" for name in NAMES[:-2]),
    *(f"plywood {name} 10" for name in NAMES),
)
# Shapes on which nothing was developed.
UNSEEN = ("rect3", "tri1", "ellip3")
_PRESSURES = 6  # parameters of friction and pressure, the first ones
METHODS = ("best published", "5 pushes", "20 pushes", "20 % of the pushes")


class Cell(NamedTuple):
    """Pushes of one object on one surface at one speed."""

    outline: np.ndarray  # (N, 2) [m]
    pushes: Pushes
    published: np.ndarray  # (n, 3) ends that the published model predicts


def outline_of(name: str, folder: Path) -> np.ndarray:
    """Return the outline of an object; that of `butter` is read from the folder."""
    if name in RECTANGLES:
        return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array(RECTANGLES[name]) / 2
    if name in TRIANGLES:
        depth, breadth = TRIANGLES[name]
        return 0.045 - np.array([[0, 0], [breadth, 0], [0, depth]])
    angle = 2 * np.pi * np.arange(100) / 100
    if name in ELLIPSES:
        return np.stack([0.0525 * np.cos(angle), ELLIPSES[name] / 2 * np.sin(angle)], axis=1)
    if name == "hex":
        angle = np.pi / 3 * np.arange(6)
        return 0.0605 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    text = checked(folder, SHAPES).decode().partition("'butter'")[2]
    pairs = re.findall(r"\[(-?[\d.e-]+), (-?[\d.e-]+)\]", text)
    points = np.array(pairs, float)[:-1]
    return points[:: max(1, len(points) // 120)]


def checked(folder: Path, name: str) -> bytes:
    """Return the content of a file of the clone, whose SHA-256 is known."""
    known: Mapping[str, str] = json.loads(Path(__file__).with_name("files.json").read_text())
    try:
        content = (folder / name).read_bytes()
    except OSError as error:
        raise InputError(
            f"data = {folder} lacks {name}: give a clone of the repository."
        ) from error
    if name in known and hashlib.sha256(content).hexdigest() != known[name]:
        raise InputError(f"data: {name} has another SHA-256: check out commit 09b70a4.")
    return content


def read(folder: Path, cell: str) -> Cell:
    """Return the pushes of a cell."""
    surface, name, speed = cell.split()
    path = f"{LOGS}/{surface}_{name}_poly4_v{speed}.mat"
    checked(folder, path)
    logs = loadmat(folder / path, squeeze_me=True, struct_as_record=False)["record_all"]
    names = ("init_tip_pt", "final_tip_pt", "init_pose_gt", "final_pose_gt", "final_pose_sim")
    tip, end, *poses = (np.array([getattr(log, x) for log in logs], float) for x in names)
    before, after, published = poses
    pushes = Pushes(np.stack([tip, end], axis=1), before, after)
    return Cell(outline_of(name, folder), pushes, published)


def _order(cell: Cell, draw: int) -> np.ndarray:
    return np.random.default_rng((2016, draw)).permutation(len(cell.published))


def _chosen(pushes: Pushes, rows: np.ndarray) -> Pushes:
    return Pushes(*(x[rows] for x in pushes))


@dataclass(frozen=True)
class Mit(QuickStudy[xr.Dataset]):
    """Predict the pushes of each cell after fits to 5 and 20 random pushes, and to 20 %.

    Priors of few pushes are means and deviations of fits to 20 % of the pushes of other objects
    on the same surface. The answer has errors `place` [m] and `turn` [rad] (cell, estimator, draw,
    push) of all other pushes, and their ratios `place_ratio` and `turn_ratio` [1] to the radius of
    the interval of 90 %; NaN where there is none.
    """

    TITLE = "Pushes of eleven objects by others"
    QUICK: ClassVar = {"cells": ("abs rect1 10", "abs rect2 10", "abs hex 10"), "draws": 1}
    CHOICES: ClassVar = {"cells": CELLS}
    GROWS = ("cells",)
    DIMENSION = "cell"

    data: Path = Path()
    """Folder with a clone of the repository."""
    cells: tuple[str, ...] = CELLS
    """Surface, object and speed [mm/s]; by default all."""
    draws: int = option(2, 1, 100)
    """Number of random choices of the pushes to which objects are fitted."""

    def check(self) -> None:
        """Check that the folder is a clone."""
        super().check()
        checked(Path(self.data), SHAPES)

    def answer(self, run: Run) -> xr.Dataset:
        """Fit each cell to 20 % of its pushes, and then to few with the prior of the others."""
        shares = {
            cell: run.checkpoint(f"share_{cell.replace(' ', '_')}", partial(self._share, cell))
            for cell in self.cells
        }
        parts = {cell: partial(self._few, cell, shares) for cell in self.cells}
        results = run_parts(run, "cell", parts)
        share = xr.concat(shares.values(), xr.IndexVariable("cell", list(shares)))
        return xr.merge([results, share[["mean"]]])

    def _share(self, label: str) -> xr.Dataset:
        """Fit 20 % of the pushes of a cell with the default priors, and predict the others."""
        cell = read(Path(self.data), label)
        rows = np.split(_order(cell, 0), [len(cell.published) // 5])
        errors, fitted = self._predicted(cell, rows, PRIOR)
        assert fitted is not None
        return errors.assign(mean=fitted.data["mean"])

    def _predicted(
        self, cell: Cell, rows: Sequence[np.ndarray], prior: Mapping
    ) -> tuple[xr.Dataset, Any]:
        """Return errors (push) after a fit to the first of two sets of rows, and any fit."""
        few, rest = rows
        chosen, fitted = _chosen(cell.pushes, few), None
        for tried in (prior, PRIOR):  # the gaps may not fit the prior of the others
            with contextlib.suppress(InputError):
                fitted = fitted or fit_object(
                    cell.outline, chosen, RADIUS, prior=tried, progress=False
                )
        names = [x + y for x in ("place", "turn") for y in ("", "_ratio")]
        if fitted is None:  # refused
            return xr.Dataset({x: ("push", np.full(700, np.nan)) for x in names}), None
        predicted = fitted.predict(_chosen(cell.pushes, rest))
        off = objects.errors_of(predicted.pose.values, cell.pushes.end[rest])
        columns = {}
        for name, values in off.items():
            for key, x in ((name, values), (f"{name}_ratio", values / predicted[name].values)):
                column = np.full(700, np.nan)
                column[rest] = x
                columns[key] = ("push", column)
        return xr.Dataset(columns), fitted

    def _few(self, label: str, shares: Mapping[str, xr.Dataset]) -> xr.Dataset:
        """Return the errors (estimator, draw, push) of a cell."""
        cell, (surface, name, _) = read(Path(self.data), label), label.split()
        others = [x for x in shares if x.split()[0] == surface and x.split()[1] != name]
        prior = dict(PRIOR)
        if len(others) > 1:
            means = np.array([shares[x]["mean"].values for x in others])
            deviation = np.array([*PRIOR.values()])[:, 1]
            least = np.where(np.arange(len(PRIOR)) < _PRESSURES, 0.3, 1.0)  # offsets are of a cell
            spread = np.maximum(means.std(axis=0, ddof=1), least * deviation)
            prior = dict(zip(PRIOR, zip(means.mean(axis=0), spread, strict=True), strict=True))
        by_method = []
        for count in (5, 20):
            draws = [
                self._predicted(cell, np.split(_order(cell, draw), [count]), prior)[0]
                for draw in range(self.draws)
            ]
            by_method.append(xr.concat(draws, "draw"))
        off = objects.errors_of(cell.published, cell.pushes.end)
        padding = (0, 700 - len(cell.published))
        columns = {k: ("push", np.pad(x, padding, constant_values=np.nan)) for k, x in off.items()}
        published = xr.Dataset(columns).expand_dims("draw")
        share = shares[label][[*by_method[0]]].expand_dims("draw")
        return xr.concat(
            [published, *by_method, share],
            xr.IndexVariable("estimator", list(METHODS)),
            join="outer",
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return errors by group of cells, and by cell."""
        labels = list(map(str, results.cell.values))
        developed = [x for x in labels if x.startswith("abs") and x.split()[1] not in UNSEEN]
        groups = {
            "all": labels,
            "abs, developed on": developed,
            "abs, other objects": [x for x in labels if x[0] == "a" and x not in developed],
            "plywood": [x for x in labels if x.startswith("plywood")],
        }
        rows = [
            row for name, cells in groups.items() if cells for row in _rows(results, name, cells)
        ]
        cells = [row for x in labels for row in _rows(results, x, [x])]
        return [
            Table(text_table(_COLUMNS, rows), merge="pushes", name="mit", title="All pushes"),
            Table(text_table(_COLUMNS, cells), merge="pushes", name="mit_cells", title="By cell"),
        ]


mit = call_of(Mit)

_COLUMNS = {
    "pushes": "{pushes}",
    "method": "{method}",
    "predicted": "{count:,}",
    "place": "{place:.2f} mm",
    "turn": "{turn:.2f}°",
    "place, 90 %": "{place_most:.1f} mm",
    "turn, 90 %": "{turn_most:.1f}°",
    "90 % intervals hold the place": "{place_within:.0f} %",
    "90 % intervals hold the turn": "{turn_within:.0f} %",
}


def _rows(results: xr.Dataset, label: str, cells: Sequence[str]) -> list[dict[str, object]]:
    """Return the errors of some cells, by method."""
    rows = []
    for method in METHODS:
        part = results.sel(cell=list(cells), estimator=method)
        row: dict[str, object] = {"pushes": label, "method": method}
        row["count"] = int(part.place.count())
        for name, scale in (("place", 1e3), ("turn", 180 / np.pi)):
            row[name] = scale * float(part[name].median())
            row[f"{name}_most"] = scale * float(part[name].quantile(0.9))
            ratio = part[f"{name}_ratio"]
            within = float((ratio < 1).sum() / ratio.count()) if int(ratio.count()) else np.nan
            row[f"{name}_within"] = 100 * within
        rows.append(row)
    return rows
