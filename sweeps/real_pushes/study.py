"""Does the physics predict real pushes? 1,271 of a robot's, beside what models say.

    rps sweeps/real_pushes
    rps sweeps/real_pushes --pushes FILE.csv

predicts where each push ends with several models, and tells how far that is from where it was
measured. Friction at the fingers is fitted on one half of the pushes, and all are judged on the
other. Pushes of a file in the same columns are all judged, with the friction of `FRICTION`.

    from sweeps.real_pushes.study import predict
    predict("pushes.csv", model="rigid_feet")
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax import errors
from rps_jax.analysis.report import Picture, Section, save
from rps_jax.record import files
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps.real_pushes import contact, pushes
from sweeps.real_pushes.drawing import figure
from sweeps.real_pushes.pushes import Errors
from sweeps.study_base import Study, Table

Model = Literal[
    "no_motion",
    "with_pusher",
    "ellipsoid",
    "rigid_feet",
    "rigid_corners",
    "mujoco_ours",
    "mujoco_ours_stiff",
    "mujoco_ground",
    "mujoco_default",
    "mujoco_light",
    "mujoco_light_stiff",
    "mujoco_ours_true_size",
    "mujoco_light_true_size",
    "mujoco_ground_true_size",
]
WORDS: Mapping[str, str] = {
    "no_motion": "no motion",
    "with_pusher": "moves with the pusher",
    "ellipsoid": "ellipsoid limit surface",
    "rigid_feet": "rigid, on its feet",
    "rigid_corners": "rigid, on the corners of its outline",
    "mujoco_ours": "C MuJoCo with feet, our ground",
    "mujoco_ours_stiff": "our ground, stiff fingers",
    "mujoco_ground": "MuJoCo's ground, our cone and impratio",
    "mujoco_default": "MuJoCo's full default",
    "mujoco_light": "ground of (0.1 s, 0.2), impedance 0.3",
    "mujoco_light_stiff": "that ground, stiff fingers",
    "mujoco_ours_true_size": "our ground, true size, 2.5 mm/s",
    "mujoco_light_true_size": "that ground, true size, 2.5 mm/s",
    "mujoco_ground_true_size": "MuJoCo's ground, true size, 2.5 mm/s",
}
FITTED = ("ellipsoid", "rigid_feet", "rigid_corners")  # each has a separately fitted friction
SLIDING = {"ellipsoid": "ellipsoid", "rigid_feet": "feet", "rigid_corners": "corners"}
MUJOCOS = tuple(name for name in get_args(Model) if name.startswith("mujoco"))
FINGERS = ("point", "two-point")
# Friction at the fingers, as fitted for `rigid_feet` (results/real_pushes_friction.json).
FRICTION = {"point": 0.5, "two-point": 0.35}
STEPS = 60  # of a push; with 150 ends move by 0.03 mm in the median, one in ten by 0.2 mm
GROUPS = (
    "point, three feet",
    "point, flat",
    "point, three feet, earliest logs",
    "two-point, three feet",
    "two-point, flat",
    "two-point, support in doubt",
)
_SHOWN = {  # models in the table; all of the others
    GROUPS[1]: ("ellipsoid", "rigid_feet", "rigid_corners"),
    GROUPS[2]: ("rigid_feet",),
    GROUPS[4]: ("ellipsoid", "rigid_feet", "rigid_corners"),
    GROUPS[5]: ("rigid_feet",),
}
_FRICTIONS = tuple(round(0.05 * i, 2) for i in range(2, 18))  # frictions at the fingers
_FIT = 100  # pushes with one finger, and with two each, that friction is fitted on
_TOGETHER = 320  # pushes that are predicted as one part of the run
_DRAWS = 2000  # of the bootstrap
_SPLIT = 2015  # seed of the halves


def predict(
    table: pushes.PushTable | None = None,
    model: Model = "rigid_feet",
    *,
    friction: Mapping[str, float] = FRICTION,
    steps: int = STEPS,
) -> xr.Dataset:
    """Predict the final poses of pushes.

    Args:
      table: a data frame, a dataset of one dimension, or the path of a CSV file, with the columns
        of `data/pushes.csv` (measurements after a push are optional); by default the
        pushes of this project.
      model: name of the model.
      friction: between finger(s) and object [1], by `point` and `two-point`.
      steps: of the path of the fingers, except for MuJoCo.

    Returns:
      `post_x`, `post_y` [m] and `post_yaw` [rad] by `push`, with the coordinate `id`.

    Raises:
      InputError: the table cannot be read or is incomplete, or the model is unknown.
    """
    errors.check_name("model", model, get_args(Model))
    read = pushes.read(table)
    pose = _predicted(read, model, friction, steps).pose
    data = {f"post_{name}": ("push", pose[:, i]) for i, name in enumerate(pushes.POSE)}
    return xr.Dataset(data, {"id": ("push", _ids(read))}, {"model": model})


def _predicted(
    table: pd.DataFrame, model: str, friction: Mapping[str, float], steps: int = STEPS
) -> pushes.Motion:
    """Return final poses and, for sliding models, mean forces."""
    mu = np.array([friction[name] for name in pushes.kind_of_finger(table)], float)
    if model in SLIDING:
        return pushes.slide(table, mu, on=SLIDING[model], steps=steps)
    nothing = np.full((len(table), 2), np.nan)
    if model == "no_motion":
        return pushes.Motion(pushes.no_motion(table), nothing)
    if model == "with_pusher":
        return pushes.Motion(pushes.with_pusher(table, steps), nothing)
    return pushes.Motion(contact.push(table, mu, contact.KINDS[model]), nothing)


def _ids(table: pd.DataFrame) -> np.ndarray:
    return table.id.to_numpy() if "id" in table else np.arange(len(table))


def groups_of(table: pd.DataFrame) -> np.ndarray:
    """Return the group of each push (n,)."""
    finger, flat = pushes.kind_of_finger(table), np.asarray(table.support == pushes.FLAT)
    early = np.asarray(table.paper_set == 0 if "paper_set" in table else np.zeros(len(table), bool))
    groups = np.where(
        finger == "point",
        np.where(flat, GROUPS[1], np.where(early, GROUPS[2], GROUPS[0])),
        np.where(pushes.doubted(table), GROUPS[5], np.where(flat, GROUPS[4], GROUPS[3])),
    )
    return groups.astype(str)


def halves_of(ids: np.ndarray) -> np.ndarray:
    """Return whether each push (n,) is in the half for the fit of friction, by its id."""
    return np.array([np.random.default_rng((_SPLIT, int(i))).random() < 0.5 for i in ids])


@dataclass(frozen=True)
class RealPushes(Study[xr.Dataset]):
    """Predict the final poses of real pushes with several models, and compute their errors.

    The answer holds predicted poses `predicted` (model, push, pose) [m, m, rad], NaN where a model
    did not run, those `measured`, and the errors `place` [m], `turn` [rad] and `both` [m].
    """

    TITLE: ClassVar[str] = "Does the physics predict real pushes?"
    QUICK: ClassVar[Mapping[str, Any]] = {"few": 60, "mujoco": 6}

    pushes: Path | None = None
    """CSV file of pushes to predict, with the columns of data/pushes.csv; by default that file."""
    models: tuple[Model, ...] = get_args(Model)
    """Models to run; by default all."""
    mujoco: int = option(100, 0, 100_000)
    """Number of pushes on three feet that C MuJoCo predicts, with one finger and with two each."""
    few: int | None = option(None, 10, 100_000)
    """Number of pushes, evenly spaced in the table; by default all."""
    quick: bool = False
    """Whether to run only a few pushes, in less than a minute."""

    def check(self) -> None:
        """Check the models and the table."""
        errors.check_each_once("models", self.models)
        _ = self.table

    @cached_property
    def table(self) -> pd.DataFrame:
        """The pushes."""
        whole = pushes.read(self.pushes)
        if self.few is None or self.few >= len(whole):
            return whole
        rows = np.linspace(0, len(whole) - 1, self.few).round().astype(int)
        return whole.iloc[rows].reset_index(drop=True)

    def num_trials(self) -> int | None:
        """Return the number of predictions, without those of the fit."""
        return sum(int(self._rows(name).sum()) for name in self.models)

    @property
    def fits(self) -> np.ndarray:
        """Whether a push (n,) is in the half for the fit of friction."""
        is_default_table = self.pushes is None
        return halves_of(_ids(self.table)) if is_default_table else np.zeros(len(self.table), bool)

    def _rows(self, model: str) -> np.ndarray:
        """Return whether a model predicts a push (n,)."""
        all_rows = np.ones(len(self.table), bool)
        if model not in MUJOCOS:
            return all_rows
        chosen = np.zeros(len(self.table), bool)
        group = groups_of(self.table)
        for name in (GROUPS[0], GROUPS[3]):
            rows = np.flatnonzero((group == name) & ~self.fits)
            shuffled = np.random.default_rng(_SPLIT).permutation(rows)
            chosen[shuffled[: self.mujoco]] = True
        return chosen

    def answer(self, run: Run) -> xr.Dataset:
        """Fit friction, and predict the poses."""
        table = self.table
        fit = self.fits.any() and set(self.models) & {*FITTED, *MUJOCOS}
        friction = self._fitted(run) if fit else None
        done, by_model = 0, []
        for model in self.models:
            parts = []
            for first in range(0, len(table), _TOGETHER):
                rows = slice(first, first + _TOGETHER)
                make = partial(self._predict_rows, model, friction, rows)
                parts.append(run.checkpoint(f"{model}-{first}", make))
                done += int(self._rows(model)[rows].sum())
                run.callback(Progress(done, 0.0))
            by_model.append(xr.concat(parts, "push"))
        results = xr.concat(by_model, "model", join="override", coords="minimal", compat="override")
        results = results.assign_coords(
            model=list(self.models),
            pose=list(pushes.POSE),
            id=("push", _ids(table)),
            finger=("push", pushes.kind_of_finger(table).astype(str)),
            group=("push", groups_of(table)),
            fits=("push", self.fits),
        )
        actual = pushes.measured(table)
        results["measured"] = (("push", "pose"), actual)
        if {"force_wx", "force_wy", "surface"} <= set(table):
            results["surface"] = ("push", table.surface.fillna("").to_numpy(str))
            results["force_measured"] = (
                ("push", "axis"),
                table[["force_wx", "force_wy"]].to_numpy(),
            )
        off = pushes.errors_of(results.predicted.values, actual)
        results.update({name: (("model", "push"), one) for name, one in off._asdict().items()})
        if friction is not None:
            results = results.merge(friction)
        if run.folder is not None:
            files.write_text(run.folder / "predictions.csv", _csv(results))
        return results

    def _fitted(self, run: Run) -> xr.Dataset:
        """Median error `fit_error` [m] (fitted, finger_kind, tried), and the best friction.

        And errors (fitted, tried, few) of pushes with each friction, for `layout_rows`.
        """
        whole, indices = self.table, np.arange(len(self.table))
        finger, clear = pushes.kind_of_finger(whole), ~pushes.doubted(whole)
        fitted_on, layouts = self.fits & clear, np.isin(groups_of(whole), (GROUPS[0], GROUPS[3]))
        kinds = [[indices[fitted_on][finger[fitted_on] == name]] for name in FINGERS]
        support = np.asarray(whole.support)
        kinds += [
            [np.flatnonzero(layouts & (finger == name) & (support == one))]
            for name in FINGERS
            for one in dict.fromkeys(support)
        ]
        few = [np.random.default_rng(_SPLIT).permutation(rows)[:_FIT] for (rows,) in kinds]
        fits = np.isin(indices, np.concatenate(few[: len(FINGERS)]))
        laid = np.isin(indices, np.concatenate(few[len(FINGERS) :]))
        table = pushes.chosen(whole, fits | laid)
        needed = {"rigid_feet", *self.models} if set(MUJOCOS) & set(self.models) else self.models
        fitted = [name for name in FITTED if name in needed]
        by_model = [
            xr.concat(
                [run.checkpoint(f"fit-{model}-{mu[0]:g}", partial(self._tried, table, model, mu))
                 for mu in (_FRICTIONS[i : i + 4] for i in range(0, len(_FRICTIONS), 4))],
                "tried",
            )
            for model in fitted
        ]  # fmt: skip
        off = xr.concat(by_model, "fitted").assign_coords(
            fitted=fitted,
            few_finger=("few", pushes.kind_of_finger(table).astype(str)),
            few_support=("few", np.where(laid, support, "")[fits | laid].astype(str)),
        )
        rows = xr.DataArray(fits[fits | laid], dims="few")
        by_finger = [off.few_both.where(rows & (off.few_finger == name)) for name in FINGERS]
        median = xr.concat([one.median("few") for one in by_finger], "finger_kind")
        off["fit_error"] = median.assign_coords(finger_kind=list(FINGERS))
        return off.assign(friction=off.fit_error.fillna(9.0).idxmin("tried"))

    def _tried(self, table: pd.DataFrame, model: str, tried: Sequence[float]) -> xr.Dataset:
        """Return errors (tried, few) of one model with some frictions."""
        repeated = pd.concat([table] * len(tried), ignore_index=True)
        mu = np.repeat(tried, len(table))
        pose = pushes.slide(repeated, mu, on=SLIDING[model], steps=STEPS // 2).pose
        pose = pose.reshape(len(tried), len(table), 3)
        off = pushes.errors_of(pose, pushes.measured(table))._asdict()
        errors_ = {f"few_{name}": (("tried", "few"), one) for name, one in off.items()}
        return xr.Dataset(errors_, {"tried": list(tried)})

    def _predict_rows(self, model: str, friction: xr.Dataset | None, chunk: slice) -> xr.Dataset:
        """Return the predictions of one model for its pushes in a chunk."""
        chosen: Mapping[str, float] = FRICTION
        if friction is not None:
            fitted = model if model in FITTED else "rigid_feet"
            of_model = friction.friction.sel(fitted=fitted) if fitted in friction.fitted else None
            if of_model is not None:
                chosen = {name: float(of_model.sel(finger_kind=name)) for name in FINGERS}
        rows = self._rows(model)[chunk]
        pose, force = np.full((len(rows), 3), np.nan), np.full((len(rows), 2), np.nan)
        if rows.any():
            part = pushes.chosen(self.table.iloc[chunk], rows)
            pose[rows], force[rows] = _predicted(part, model, chosen)
        return xr.Dataset(
            {"predicted": (("push", "pose"), pose), "force": (("push", "axis"), force)}
        )

    def intro(self, results: xr.Dataset) -> str:
        """Return a description of the data and the errors."""
        return (
            f"{results.sizes['push']} pushes of a real robot (an aluminium triangle of 150 mm on "
            "three feet or flat), predicted. Errors are medians, with the 95 % interval of a "
            "bootstrap over pushes in brackets, and the 90 % quantile."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return sections with errors by model and the fitted friction."""
        sections = [
            Section(name.replace("_", " ").capitalize(), "", _texts(*columns_and_rows))
            for name, columns_and_rows in tables(results).items()
        ]
        if sections and np.isfinite(results.both).any() and "rigid_feet" in self.models:
            draw = partial(figure, results, self.table, WORDS)
            sections[0] = sections[0]._replace(picture=Picture("real_pushes", draw))
        return sections

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return all tables."""
        return {
            f"real_pushes_{name}": Table(rows, columns=columns)
            for name, (columns, rows) in tables(results).items()
        }

    def publish(self, results: xr.Dataset, run_folder: Path) -> None:
        """Write the data files and the figure."""
        super().publish(results, run_folder)
        save(figure(results, self.table, WORDS), self.folder / "real_pushes.png")


real_pushes = call_of(RealPushes)


# --- the tables ---


def _csv(results: xr.Dataset) -> str:
    """Return one row per push and model with the predicted pose."""
    rows = results.predicted.to_dataset("pose").rename(
        {name: f"post_{name}" for name in pushes.POSE}
    )
    frame = rows[[f"post_{name}" for name in pushes.POSE]].to_dataframe().reset_index()
    names = ["id", "model", *(f"post_{name}" for name in pushes.POSE)]
    return frame[names].dropna().to_csv(index=False, lineterminator="\n")


def median_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Return the median of values (n,) and its 95 % interval by a bootstrap."""
    drawn = np.random.default_rng(0).choice(values, (_DRAWS, values.size))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return float(np.median(values)), float(low), float(high)


_COLUMNS = [
    {"name": "pushes", "merge": True},
    {"name": "model"},
    {"name": "number", "format": "{:d}"},
    {"name": "place", "format": "{:.2f} mm", "rest": " [{:.2f}, {:.2f}]"},
    {"name": "90 %", "format": "{:.1f} mm"},
    {"name": "turn", "format": "{:.2f}°", "rest": " [{:.2f}, {:.2f}]"},
    {"name": "90 %", "format": "{:.1f}°"},
    {"name": "both", "format": "{:.2f} mm", "rest": " [{:.2f}, {:.2f}]"},
    {"name": "90 %", "format": "{:.1f} mm"},
]  # fmt: skip


_UNITS = (1e3, 180 / np.pi, 1e3)  # of errors in tables: mm, degrees, mm


def _row(label: str, model: str, off: Errors) -> list[Any]:
    cells: list[Any] = []
    for values, unit in zip(off, _UNITS, strict=True):
        cells += [[unit * x for x in median_interval(values)], unit * np.quantile(values, 0.9)]
    return [label, WORDS[model], off.both.size, *_rounded(cells)]


def _rounded(cells: list[Any]) -> list[Any]:
    return [[round(x, 3) for x in c] if isinstance(c, list) else round(float(c), 3) for c in cells]


def _errors(results: xr.Dataset, model: str, rows: np.ndarray) -> Errors:
    """Return the errors of a model for measured pushes."""
    predictions = results.sel(model=model)
    values = [predictions[name].values[rows] for name in Errors._fields]
    is_measured = np.isfinite(values[2])
    return Errors(*(value[is_measured] for value in values))


def tables(results: xr.Dataset) -> dict[str, tuple[list[dict[str, Any]], list[list[Any]]]]:
    """Return columns and rows of each table of the page, for pushes outside the fit."""
    group, test = results.group.values, ~results.fits.values
    models = list(map(str, results.model.values))
    slow = [name for name in models if name in MUJOCOS]
    quick = [name for name in models if name not in MUJOCOS]
    rows = []
    for name in GROUPS:
        for model in quick:
            if model in _SHOWN.get(name, quick):
                off = _errors(results, model, test & (group == name))
                rows += [_row(name, model, off)] if off.both.size else []
    published = {"models": (_COLUMNS, rows)}
    if slow:
        ran = np.isfinite(results.predicted.sel(model=slow[0]).values).all(axis=1)
        rows = []
        for name in (GROUPS[0], GROUPS[3]):
            for model in [one for one in quick if one == "rigid_feet"] + slow:
                off = _errors(results, model, ran & (group == name))
                rows += [_row(name, model, off)] if off.both.size else []
        published["mujoco"] = (_COLUMNS, rows)
    if "friction" in results:
        published["friction"] = _FRICTION_COLUMNS, list(_friction_rows(results))
        published["layouts"] = _LAYOUT_COLUMNS, list(_layout_rows(results))
    if "force_measured" in results and "rigid_feet" in models:
        published["forces"] = _FORCE_COLUMNS, list(_force_rows(results))
    return {name: (columns, rows) for name, (columns, rows) in published.items() if rows}


_FRICTION_COLUMNS = [
    {"name": "pusher", "merge": True},
    {"name": "model"},
    {"name": "friction", "format": "{:.2f}"},
    {"name": "both, half fitted on", "format": "{:.2f} mm"},
    {"name": "within 0.1 mm of it", "format": "{:.2f}", "rest": " to {:.2f}"},
    {"name": "both, other half", "format": "{:.2f} mm", "rest": " [{:.2f}, {:.2f}]"},
]


def _friction_rows(results: xr.Dataset) -> Iterator[list[Any]]:
    finger, test = results.finger.values, ~results.fits.values
    clear = test & (results.group.values != GROUPS[5])
    tried = results.tried.values
    for name in FINGERS:
        for model in FITTED:
            if model not in results.model or not (finger == name).any():
                continue
            off = 1e3 * results.fit_error.sel(fitted=model, finger_kind=name).values
            near = tried[off <= np.nanmin(off) + 0.1]
            mu = float(results.friction.sel(fitted=model, finger_kind=name))
            told = _errors(results, model, clear & (finger == name)).both
            cells = [mu, float(np.nanmin(off)), [float(near.min()), float(near.max())],
                     [1e3 * one for one in median_interval(told)]]  # fmt: skip
            yield [name, WORDS[model], *_rounded(cells)]


_LAYOUT_COLUMNS = [
    {"name": "pushes", "merge": True},
    {"name": "feet that nothing was fitted on", "merge": True},
    *_COLUMNS[1:3],
    {"name": "friction, fitted on other feet", "format": "{:.2f}"},
    *(column for column in _COLUMNS[3:] if column["name"] != "90 %"),
    {"name": "both, fitted on these feet", "format": "{:.2f} mm"},
]


def _layout_rows(results: xr.Dataset) -> Iterator[list[Any]]:
    """Yield errors on each layout of feet, with the best friction for the other layouts."""
    support, finger = results.few_support.values, results.few_finger.values
    for name in FINGERS:
        has_layout = (finger == name) & (support != "")
        for layout in dict.fromkeys(support[has_layout]):
            held_out, rest = has_layout & (support == layout), has_layout & (support != layout)
            if not rest.any():
                continue
            for model in map(str, results.fitted.values):
                off = [results[f"few_{one}"].sel(fitted=model).values for one in Errors._fields]
                best, own_best = (int(np.median(off[2][:, rows], axis=1).argmin())
                               for rows in (rest, held_out))  # fmt: skip
                cells = [[unit * one for one in median_interval(values[best, held_out])]
                         for unit, values in zip(_UNITS, off, strict=True)]  # fmt: skip
                mu, alone = float(results.tried[best]), 1e3 * np.median(off[2][own_best, held_out])
                yield [
                    name,
                    layout,
                    WORDS[model],
                    int(held_out.sum()),
                    *_rounded([mu, *cells, alone]),
                ]


_FORCE_COLUMNS = [
    {"name": "point pushes"},
    {"name": "number", "format": "{:d}"},
    {"name": "angle of the force off the predicted", "format": "{:.1f}°"},
    {"name": "90 %", "format": "{:.1f}°"},
    {"name": "friction with the ground that the force tells", "format": "{:.3f}",
     "rest": " [{:.3f}, {:.3f}]"},
]  # fmt: skip


def _force_rows(results: xr.Dataset) -> Iterator[list[Any]]:
    predicted = results.force.sel(model="rigid_feet").values
    real = results.force_measured.values
    size = np.linalg.norm(predicted, axis=1)
    off = np.arctan2(real[:, 1], real[:, 0]) - np.arctan2(predicted[:, 1], predicted[:, 0])
    ratio = np.linalg.norm(real, axis=1) / (np.maximum(size, 1e-9) * pushes.MASS * 9.81)
    is_valid = np.isfinite(real).all(axis=1) & np.isfinite(predicted).all(axis=1) & (size > 0.05)
    is_valid &= ~results.fits.values
    kinds = [(one, on) for one in GROUPS[:2] for on in pushes.GROUND]
    for group, surface in kinds:
        rows = is_valid & (results.group.values == group) & (results.surface.values == surface)
        name = f"{group}, {surface}"
        if rows.any():
            degrees = np.degrees(np.abs(pushes.angle(off[rows])))
            cells = [
                np.median(degrees),
                np.quantile(degrees, 0.9),
                list(median_interval(ratio[rows])),
            ]
            yield [name, int(rows.sum()), *_rounded(cells)]


def _texts(columns: list[dict[str, Any]], rows: list[list[Any]]) -> list[list[str]]:
    """Return a table as texts, like on the pages."""

    def text(cell: Any, column: dict[str, Any]) -> str:
        if isinstance(cell, str):
            return cell
        first, *rest = cell if isinstance(cell, list) else [cell]
        shown = column.get("format", "{}").format(first)
        return shown + (column["rest"].format(*rest) if rest else "")

    head = [column["name"] for column in columns]
    return [
        head,
        *([text(c, k) for c, k in zip(row, columns, strict=True)] for row in rows),
    ]
