"""Real pushes of eleven objects by others, predicted after a fit to a few of them.

    rps sweeps/real_pushes/mit --data FOLDER

FOLDER is a clone of github.com/robinzhoucmu/PlanarManipulationToolBox at commit 09b70a4. Its files
have pushes of the MIT push dataset and, for each, the end that the best published model of Zhou et
al. predicts. Nothing of it is in this project; the SHA-256 of each file is in `files.json`. The
triangle of this project's own data is fitted in the same way.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import os
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import xarray as xr
from scipy.io import loadmat
from scipy.optimize import linear_sum_assignment

from rps_jax import InputError, fit_object
from rps_jax.questions import Run, call_of, option
from rps_jax.tuning import objects
from rps_jax.tuning.objects import PRIOR, Pushes
from sweeps.real_pushes import pushes as triangle
from sweeps.study_base import QuickStudy, Table, part_name, text_table, use_processors

RADIUS = 0.00475  # [m] of the finger
LOGS, SHAPES = "mcube_data_proc/motion_model_eval_logs", "pnpush_matlab/get_shape.m"
# Of the published model without its own training pushes: the same pushes, cut at both ends.
CLEAN = f"{LOGS}_train_test_searchmu2_filter/wrench1twist1_20percenttraining"
# Sizes [m] of the objects, of the dataset's description (Yu et al. 2016).
RECTANGLES = {"rect1": (0.09, 0.09), "rect2": (0.08991, 0.11258), "rect3": (0.13501, 0.08994)}
TRIANGLES = {"tri1": (0.12587, 0.1259), "tri2": (0.12587, 0.151), "tri3": (0.12561, 0.1765)}
ELLIPSES = {"ellip1": 0.105, "ellip2": 0.13089, "ellip3": 0.157}
NAMES = (*RECTANGLES, *TRIANGLES, *ELLIPSES, "hex", "butter")
# Feet of the triangle, by name; its pushes were on a table of the same kinds.
FEET = {
    "triangle_wide": "10_130_10_10_10_130",
    "triangle_middle": "30_90_30_30_30_90",
    "triangle_narrow": "30_63.33_43.33_30_43.33_63.33",
    "triangle_flat": triangle.FLAT,
}
TRIANGLE_CELLS = tuple(f"CMU-{x} {name} 2" for x in ("hardboard", "plywood") for name in FEET)
CELLS = (
    *(f"abs {name} 10" for name in NAMES),
    *(f"abs {name} 20" for name in NAMES[:-2]),
    *(f"plywood {name} 10" for name in NAMES),
    *TRIANGLE_CELLS,
)
# Shapes on which nothing was developed.
UNSEEN = ("rect3", "tri1", "ellip3")
_INSIDE = 4e-3  # [m] of the finger in the object at the start of a broken record
_PUSHES = 700  # of a cell, at most
METHODS = (
    "best published",
    "5 pushes",
    "20 pushes",
    "20 % of the pushes",
    "clean split: best published",
    "clean split: its training pushes",
)


class Cell(NamedTuple):
    """Pushes of one object on one surface at one speed."""

    outline: np.ndarray  # (N, 2) [m]
    pushes: Pushes
    published: np.ndarray  # (n, 3) ends that the published model predicts; NaN of the triangle
    radius: float = RADIUS  # [m] of the finger
    feet: np.ndarray | None = None  # (S, 2) [m] if it stands on known ones


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
    if cell in TRIANGLE_CELLS:
        return _triangle(cell)
    surface, name, speed = cell.split()
    return _logs(folder, f"{LOGS}/{surface}_{name}_poly4_v{speed}.mat", name)


def _triangle(cell: str) -> Cell:
    """Return the pushes of the triangle by a point on some feet."""
    surface, name, _ = cell.split()
    table = triangle.read()
    rows = (table.kind == "point") & (table.support == FEET[name]) & (table.paper_set == 1)
    table = triangle.chosen(table, np.asarray(rows & (table.surface == surface[4:])))
    path = triangle.finger_paths(table, 1)[:, :, 0].swapaxes(0, 1)
    end = triangle.measured(table)
    feet = None if FEET[name] == triangle.FLAT else triangle.feet_of(FEET[name])
    pushes = Pushes(path, triangle.initial_poses(table), end)
    return Cell(triangle.OUTLINE, pushes, np.full(end.shape, np.nan), 1e-4, feet)


def _logs(folder: Path, path: str, name: str) -> Cell:
    """Return the pushes of a file of an object."""
    checked(folder, path)
    logs = loadmat(folder / path, squeeze_me=True, struct_as_record=False)["record_all"]
    names = ("init_tip_pt", "final_tip_pt", "init_pose_gt", "final_pose_gt", "final_pose_sim")
    tip, end, *poses = (np.array([getattr(log, x) for log in logs], float) for x in names)
    before, after, published = poses
    pushes = Pushes(np.stack([tip, end], axis=1), before, after)
    return Cell(outline_of(name, folder), pushes, published)


def _clean_split(folder: Path, label: str, cell: Cell) -> tuple[Cell, np.ndarray]:
    """Return the published test pushes of a cell, and the rows of all others, its training pushes.

    A test push is the middle part of one of the cell.
    """
    surface, name, speed = label.split()
    test = _logs(folder, f"{CLEAN}{surface}_{name}_poly4_v{speed}.mat", name)
    middles = [
        np.column_stack(
            [x.path.mean(axis=1), 0.1 * np.diff(x.path, axis=1)[:, 0], 0.05 * x.start[:, 2]]
        )
        for x in (test.pushes, cell.pushes)
    ]
    distance = np.linalg.norm(middles[0][:, None] - middles[1], axis=2)
    rows = linear_sum_assignment(distance)[1]
    return test, np.setdiff1d(np.arange(len(cell.published)), rows)


def _unbroken(cell: Cell, rows: np.ndarray) -> np.ndarray:
    """Return the rows whose finger does not start within the object."""
    return rows[cell.pushes.gaps(cell.outline, cell.radius)[rows] > -_INSIDE]


def _order(cell: Cell, draw: int) -> np.ndarray:
    return np.random.default_rng((2016, draw)).permutation(len(cell.published))


def _chosen(pushes: Pushes, rows: np.ndarray) -> Pushes:
    return Pushes(*(x[rows] for x in pushes))


@dataclass(frozen=True)
class Mit(QuickStudy[xr.Dataset]):
    """Predict the pushes of each cell after fits to 5 and 20 random pushes, and to 20 %.

    Priors of few pushes are means and deviations of fits to 20 % of the pushes of other objects
    on the same surface. Intervals are as wide as 90 % of the errors of these objects need. The
    answer has errors `place` [m] and `turn` [rad] (cell, estimator, draw,
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
    draws: int = option(10, 1, 100)
    """Number of random choices of the pushes to which objects are fitted."""

    def check(self) -> None:
        """Check that the folder is a clone."""
        super().check()
        checked(Path(self.data), SHAPES)

    def answer(self, run: Run) -> xr.Dataset:
        """Fit each cell to 20 % of its pushes, and then to few with the prior of the others."""
        cores = len(os.sched_getaffinity(0))
        context = multiprocessing.get_context("spawn")
        processes = ProcessPoolExecutor(cores, context, use_processors)
        with processes, ThreadPoolExecutor(2 * cores) as threads:

            def parts_of(kind: str, compute: Callable[[str], xr.Dataset]) -> list[xr.Dataset]:
                def part(cell: str) -> xr.Dataset:
                    task = lambda: processes.submit(compute, cell).result()  # noqa: E731
                    return run.checkpoint(f"{kind}_{part_name(cell)}", task)

                return list(threads.map(part, self.cells))

            shares = dict(zip(self.cells, parts_of("share", self._share), strict=True))
            by_cell = parts_of("few", partial(self._few, shares=shares))
        cells = xr.IndexVariable("cell", list(self.cells))
        means = xr.concat(shares.values(), cells)[["mean"]]
        return _scaled(xr.merge([xr.concat(by_cell, cells), means]))

    def _share(self, label: str) -> xr.Dataset:
        """Fit 20 % of the pushes of a cell with the default priors, and predict the others."""
        cell = read(Path(self.data), label)
        training, rest = np.split(_order(cell, 0), [len(cell.published) // 5])
        errors, fitted = self._predicted(cell, training, _chosen(cell.pushes, rest), PRIOR)
        assert fitted is not None
        return errors.assign(mean=fitted.data["mean"])

    def _predicted(
        self, cell: Cell, training: np.ndarray, test: Pushes, prior: Mapping
    ) -> tuple[xr.Dataset, Any]:
        """Return errors (push) of test pushes after a fit to a few of a cell, and any fit."""
        chosen, fitted = _chosen(cell.pushes, _unbroken(cell, training)), None
        options: Any = {"feet": cell.feet, "progress": False}
        for tried in (prior, PRIOR):  # the gaps may not fit the prior of the others
            with contextlib.suppress(InputError):
                fitted = fitted or fit_object(
                    cell.outline, chosen, cell.radius, prior=tried, **options
                )
        if fitted is None:  # refused
            return _padded(dict.fromkeys(_ERRORS, np.full(1, np.nan))), None
        predicted = fitted.predict(test)
        off = objects.errors_of(predicted.pose.values, test.end)
        ratios = {f"{name}_ratio": x / predicted[name].values for name, x in off.items()}
        return _padded(off | ratios), fitted

    def _few(self, label: str, shares: Mapping[str, xr.Dataset]) -> xr.Dataset:
        """Return the errors (estimator, draw, push) of a cell."""
        cell = read(Path(self.data), label)
        others = _other_objects(label, list(shares))
        prior = dict(PRIOR)
        if len(others) > 1:
            means = np.array([shares[x]["mean"].values for x in others])
            deviation = np.array([*PRIOR.values()])[:, 1]
            # Offsets of markers are of a cell, and those of the camera of a sheet.
            is_marker = np.char.startswith(list(PRIOR), "marker")
            least = np.where(is_marker, 1.0, 0.3)
            spread = np.maximum(means.std(axis=0, ddof=1), least * deviation)
            prior = dict(zip(PRIOR, zip(means.mean(axis=0), spread, strict=True), strict=True))
        by_method = []
        for count in (5, 20):
            draws = []
            for draw in range(self.draws):
                training, rest = np.split(_order(cell, draw), [count])
                draws.append(self._predicted(cell, training, _chosen(cell.pushes, rest), prior)[0])
            by_method.append(xr.concat(draws, xr.IndexVariable("draw", range(self.draws))))
        published = _padded(objects.errors_of(cell.published, cell.pushes.end))
        parts = [
            published.expand_dims(draw=[0]),
            *by_method,
            shares[label][_ERRORS].expand_dims(draw=[0]),
        ]
        if label.endswith(" 10"):
            test, training = _clean_split(Path(self.data), label, cell)
            theirs = _padded(objects.errors_of(test.published, test.pushes.end))
            ours = self._predicted(cell, training, test.pushes, PRIOR)[0]
            parts += [theirs.expand_dims(draw=[0]), ours.expand_dims(draw=[0])]
        methods = list(METHODS[: len(parts)])
        joined = xr.concat(parts, xr.IndexVariable("estimator", methods), join="outer")
        return joined.reindex(estimator=list(METHODS))

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return errors by group of cells, and by cell."""
        labels = list(map(str, results.cell.values))
        developed = [x for x in labels if x.startswith("abs") and x.split()[1] not in UNSEEN]
        triangles = [x for x in labels if x in TRIANGLE_CELLS]
        groups = {
            "all": [x for x in labels if x not in triangles],
            "abs, developed on": developed,
            "abs, other objects": [x for x in labels if x[0] == "a" and x not in developed],
            "plywood": [x for x in labels if x.startswith("plywood")],
            "triangle of CMU on three feet": [x for x in triangles if "flat" not in x],
            "triangle of CMU, flat": [x for x in triangles if "flat" in x],
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


_ERRORS = ["place", "place_ratio", "turn", "turn_ratio"]


def _other_objects(label: str, cells: Sequence[str]) -> list[str]:
    """Return the cells with other objects on the same surface."""
    surface, name, _ = label.split()
    return [x for x in cells if x.split()[0] == surface and x.split()[1] != name]


def _scaled(results: xr.Dataset) -> xr.Dataset:
    """Return results with ratios to intervals that hold 90 % of the pushes of other objects."""
    results, cells = results.copy(deep=True), list(map(str, results.cell.values))
    for name in ("place_ratio", "turn_ratio"):
        ratio = results[name].copy(deep=True)
        for i, label in enumerate(cells):
            if others := _other_objects(label, cells):
                rest = ratio.sel(cell=others)
                limit = rest.quantile(0.9, ("cell", "draw", "push"))
                results[name][i] = (ratio[i] / limit).values
    return results


def _padded(columns: Mapping[str, np.ndarray]) -> xr.Dataset:
    """Return columns (n,) of pushes, filled with NaN to a common length."""
    filled = {
        k: np.pad(x, (0, _PUSHES - len(x)), constant_values=np.nan) for k, x in columns.items()
    }
    return xr.Dataset({name: ("push", x) for name, x in filled.items()})


def _rows(results: xr.Dataset, label: str, cells: Sequence[str]) -> list[dict[str, object]]:
    """Return the errors of some cells, by method."""
    rows = []
    for method in METHODS:
        part = results.sel(cell=list(cells), estimator=method)
        row: dict[str, object] = {"pushes": label, "method": method}
        row["count"] = int(part.place.count())
        if not row["count"]:
            continue
        for name, scale in (("place", 1e3), ("turn", 180 / np.pi)):
            row[name] = scale * float(part[name].median())
            row[f"{name}_most"] = scale * float(part[name].quantile(0.9))
            ratio = part[f"{name}_ratio"]
            within = float((ratio < 1).sum() / ratio.count()) if int(ratio.count()) else np.nan
            row[f"{name}_within"] = 100 * within
        rows.append(row)
    return rows
