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
FITTED = ("ellipsoid", "rigid_feet", "rigid_corners")  # have a friction of their own
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
_TRIED = tuple(round(0.05 * i, 2) for i in range(2, 18))  # frictions at the fingers
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
    """Predict where pushes end.

    Args:
      table: a data frame, a dataset of one dimension, or the path of a CSV file, with the columns
        of `data/pushes.csv` (what was measured after a push is not needed); by default the
        project's own pushes.
      model: which model predicts.
      friction: between finger(s) and object [1], by `point` and `two-point`.
      steps: of the way of the fingers, for all but MuJoCo.

    Returns:
      `post_x`, `post_y` [m] and `post_yaw` [rad] by `push`, with the coordinate `id`.

    Raises:
      InputError: the table cannot be read, or lacks something, or the model is unknown.
    """
    errors.check_name("model", model, get_args(Model))
    read = pushes.read(table)
    pose = _predicted(read, model, friction, steps).pose
    data = {f"post_{name}": ("push", pose[:, i]) for i, name in enumerate(pushes.POSE)}
    return xr.Dataset(data, {"id": ("push", _ids(read))}, {"model": model})


def _predicted(
    table: pd.DataFrame, model: str, friction: Mapping[str, float], steps: int = STEPS
) -> pushes.Found:
    """Poses at the end and, of those that slide, mean forces."""
    mu = np.array([friction[name] for name in pushes.kind_of_finger(table)], float)
    if model in SLIDING:
        return pushes.slide(table, mu, on=SLIDING[model], steps=steps)
    nothing = np.full((len(table), 2), np.nan)
    if model == "no_motion":
        return pushes.Found(pushes.no_motion(table), nothing)
    if model == "with_pusher":
        return pushes.Found(pushes.with_pusher(table, steps), nothing)
    return pushes.Found(contact.push(table, mu, contact.KINDS[model]), nothing)


def _ids(table: pd.DataFrame) -> np.ndarray:
    return table.id.to_numpy() if "id" in table else np.arange(len(table))


def groups_of(table: pd.DataFrame) -> np.ndarray:
    """Which of `GROUPS` (n,) pushes are of."""
    finger, flat = pushes.kind_of_finger(table), np.asarray(table.support == pushes.FLAT)
    early = np.asarray(table.paper_set == 0 if "paper_set" in table else np.zeros(len(table), bool))
    found = np.where(
        finger == "point",
        np.where(flat, GROUPS[1], np.where(early, GROUPS[2], GROUPS[0])),
        np.where(pushes.doubted(table), GROUPS[5], np.where(flat, GROUPS[4], GROUPS[3])),
    )
    return found.astype(str)


def halves_of(ids: np.ndarray) -> np.ndarray:
    """Whether each push (n,) is of the half that friction is fitted on, by its id alone."""
    return np.array([np.random.default_rng((_SPLIT, int(i))).random() < 0.5 for i in ids])


@dataclass(frozen=True)
class RealPushes(Study[xr.Dataset]):
    """Predict where real pushes end, with several models, and tell how far off that is.

    The answer holds predicted poses `predicted` (model, push, pose) [m, m, rad], NaN where a model
    did not run, those `measured`, and the errors `place` [m], `turn` [rad] and `both` [m].
    """

    TITLE: ClassVar[str] = "Does the physics predict real pushes?"
    QUICK: ClassVar[Mapping[str, Any]] = {"few": 60, "mujoco": 6}

    pushes: Path | None = None
    """A CSV file of pushes to predict, in the columns of data/pushes.csv; by default the project's
    own."""
    models: tuple[Model, ...] = get_args(Model)
    """Which models predict; by default all."""
    mujoco: int = option(100, 0, 100_000)
    """Number of pushes on three feet that C MuJoCo predicts, with one finger and with two each."""
    few: int | None = option(None, 10, 100_000)
    """Number of pushes, every so many of the table; by default all."""
    quick: bool = False
    """Whether to try only a few pushes, in less than a minute."""

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
        """How many predictions there are, but for those of the fit."""
        return sum(int(self._rows(name).sum()) for name in self.models)

    @property
    def fits(self) -> np.ndarray:
        """Whether friction is fitted on a push (n,)."""
        own = self.pushes is None
        return halves_of(_ids(self.table)) if own else np.zeros(len(self.table), bool)

    def _rows(self, model: str) -> np.ndarray:
        """Whether a model predicts a push (n,)."""
        every = np.ones(len(self.table), bool)
        if model not in MUJOCOS:
            return every
        chosen = np.zeros(len(self.table), bool)
        group = groups_of(self.table)
        for name in (GROUPS[0], GROUPS[3]):
            rows = np.flatnonzero((group == name) & ~self.fits)
            shuffled = np.random.default_rng(_SPLIT).permutation(rows)
            chosen[shuffled[: self.mujoco]] = True
        return chosen

    def answer(self, run: Run) -> xr.Dataset:
        """Fit friction, and predict."""
        table = self.table
        fit = self.fits.any() and set(self.models) & {*FITTED, *MUJOCOS}
        friction = self._fitted(run) if fit else None
        done, found = 0, []
        for model in self.models:
            parts = []
            for first in range(0, len(table), _TOGETHER):
                rows = slice(first, first + _TOGETHER)
                make = partial(self._one, model, friction, rows)
                parts.append(run.checkpoint(f"{model}-{first}", make))
                done += int(self._rows(model)[rows].sum())
                run.callback(Progress(done, 0.0))
            found.append(xr.concat(parts, "push"))
        whole = xr.concat(found, "model", join="override", coords="minimal", compat="override")
        whole = whole.assign_coords(
            model=list(self.models),
            pose=list(pushes.POSE),
            id=("push", _ids(table)),
            finger=("push", pushes.kind_of_finger(table).astype(str)),
            group=("push", groups_of(table)),
            fits=("push", self.fits),
        )
        actual = pushes.measured(table)
        whole["measured"] = (("push", "pose"), actual)
        if {"force_wx", "force_wy", "surface"} <= set(table):
            whole["surface"] = ("push", table.surface.fillna("").to_numpy(str))
            whole["force_measured"] = (("push", "axis"), table[["force_wx", "force_wy"]].to_numpy())
        off = pushes.errors_of(whole.predicted.values, actual)
        whole.update({name: (("model", "push"), one) for name, one in off._asdict().items()})
        if friction is not None:
            whole = whole.merge(friction)
        if run.folder is not None:
            files.write_text(run.folder / "predictions.csv", _csv(whole))
        return whole

    def _fitted(self, run: Run) -> xr.Dataset:
        """Median error `fit_error` [m] (fitted, finger_kind, tried), and the best friction.

        And errors (fitted, tried, few) of pushes with each friction, for `layout_rows`: of those
        that it is fitted on, and of as many of each layout of feet.
        """
        whole, every = self.table, np.arange(len(self.table))
        finger, clear = pushes.kind_of_finger(whole), ~pushes.doubted(whole)
        fitted_on, layouts = self.fits & clear, np.isin(groups_of(whole), (GROUPS[0], GROUPS[3]))
        kinds = [[every[fitted_on][finger[fitted_on] == name]] for name in FINGERS]
        support = np.asarray(whole.support)
        kinds += [
            [np.flatnonzero(layouts & (finger == name) & (support == one))]
            for name in FINGERS
            for one in dict.fromkeys(support)
        ]
        few = [np.random.default_rng(_SPLIT).permutation(rows)[:_FIT] for (rows,) in kinds]
        fits = np.isin(every, np.concatenate(few[: len(FINGERS)]))
        laid = np.isin(every, np.concatenate(few[len(FINGERS) :]))
        table = pushes.chosen(whole, fits | laid)
        needed = {"rigid_feet", *self.models} if set(MUJOCOS) & set(self.models) else self.models
        fitted = [name for name in FITTED if name in needed]
        found = [
            xr.concat(
                [run.checkpoint(f"fit-{model}-{mu[0]:g}", partial(self._tried, table, model, mu))
                 for mu in (_TRIED[i : i + 4] for i in range(0, len(_TRIED), 4))],
                "tried",
            )
            for model in fitted
        ]  # fmt: skip
        off = xr.concat(found, "fitted").assign_coords(
            fitted=fitted,
            few_finger=("few", pushes.kind_of_finger(table).astype(str)),
            few_support=("few", np.where(laid, support, "")[fits | laid].astype(str)),
        )
        rows = xr.DataArray(fits[fits | laid], dims="few")
        each = [off.few_both.where(rows & (off.few_finger == name)) for name in FINGERS]
        median = xr.concat([one.median("few") for one in each], "finger_kind")
        off["fit_error"] = median.assign_coords(finger_kind=list(FINGERS))
        return off.assign(friction=off.fit_error.fillna(9.0).idxmin("tried"))

    def _tried(self, table: pd.DataFrame, model: str, tried: Sequence[float]) -> xr.Dataset:
        """Errors (tried, few) of one model with some frictions."""
        many = pd.concat([table] * len(tried), ignore_index=True)
        mu = np.repeat(tried, len(table))
        pose = pushes.slide(many, mu, on=SLIDING[model], steps=STEPS // 2).pose
        pose = pose.reshape(len(tried), len(table), 3)
        off = pushes.errors_of(pose, pushes.measured(table))._asdict()
        errors_ = {f"few_{name}": (("tried", "few"), one) for name, one in off.items()}
        return xr.Dataset(errors_, {"tried": list(tried)})

    def _one(self, model: str, friction: xr.Dataset | None, some: slice) -> xr.Dataset:
        """What one model predicts of its pushes among some."""
        chosen: Mapping[str, float] = FRICTION
        if friction is not None:
            fitted = model if model in FITTED else "rigid_feet"
            own = friction.friction.sel(fitted=fitted) if fitted in friction.fitted else None
            if own is not None:
                chosen = {name: float(own.sel(finger_kind=name)) for name in FINGERS}
        rows = self._rows(model)[some]
        pose, force = np.full((len(rows), 3), np.nan), np.full((len(rows), 2), np.nan)
        if rows.any():
            part = pushes.chosen(self.table.iloc[some], rows)
            pose[rows], force[rows] = _predicted(part, model, chosen)
        return xr.Dataset(
            {"predicted": (("push", "pose"), pose), "force": (("push", "axis"), force)}
        )

    def intro(self, results: xr.Dataset) -> str:
        """What was asked."""
        return (
            f"{results.sizes['push']} pushes of a real robot (an aluminium triangle of 150 mm on "
            "three feet or flat), predicted. Errors are medians, with the 95 % interval of a "
            "bootstrap over pushes in brackets, and the 90 % quantile."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Errors by model, and the friction that was fitted."""
        sections = [
            Section(name.replace("_", " ").capitalize(), "", _texts(*made))
            for name, made in tables(results).items()
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


# --- how it is told ---


def _csv(found: xr.Dataset) -> str:
    """One row for each push and model: the pose predicted."""
    rows = found.predicted.to_dataset("pose").rename({name: f"post_{name}" for name in pushes.POSE})
    frame = rows[[f"post_{name}" for name in pushes.POSE]].to_dataframe().reset_index()
    names = ["id", "model", *(f"post_{name}" for name in pushes.POSE)]
    return frame[names].dropna().to_csv(index=False, lineterminator="\n")


def median_interval(values: np.ndarray) -> tuple[float, float, float]:
    """Median of values (n,), and the ends of its 95 % interval by a bootstrap."""
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
        cells += [[unit * one for one in median_interval(values)], unit * np.quantile(values, 0.9)]
    return [label, WORDS[model], off.both.size, *_rounded(cells)]


def _rounded(cells: list[Any]) -> list[Any]:
    return [[round(x, 3) for x in c] if isinstance(c, list) else round(float(c), 3) for c in cells]


def _off(found: xr.Dataset, model: str, rows: np.ndarray) -> Errors:
    """Errors of a model on pushes that were measured."""
    one = found.sel(model=model)
    values = [one[name].values[rows] for name in Errors._fields]
    told = np.isfinite(values[2])
    return Errors(*(value[told] for value in values))


def tables(found: xr.Dataset) -> dict[str, tuple[list[dict[str, Any]], list[list[Any]]]]:
    """Columns and rows of each table of the page: of the pushes that nothing was fitted on."""
    group, test = found.group.values, ~found.fits.values
    models = list(map(str, found.model.values))
    slow = [name for name in models if name in MUJOCOS]
    quick = [name for name in models if name not in MUJOCOS]
    rows = []
    for name in GROUPS:
        for model in quick:
            if model in _SHOWN.get(name, quick):
                off = _off(found, model, test & (group == name))
                rows += [_row(name, model, off)] if off.both.size else []
    made = {"models": (_COLUMNS, rows)}
    if slow:
        ran = np.isfinite(found.predicted.sel(model=slow[0]).values).all(axis=1)
        rows = []
        for name in (GROUPS[0], GROUPS[3]):
            for model in [one for one in quick if one == "rigid_feet"] + slow:
                off = _off(found, model, ran & (group == name))
                rows += [_row(name, model, off)] if off.both.size else []
        made["mujoco"] = (_COLUMNS, rows)
    if "friction" in found:
        made["friction"] = _FRICTION_COLUMNS, list(_friction_rows(found))
        made["layouts"] = _LAYOUT_COLUMNS, list(_layout_rows(found))
    if "force_measured" in found and "rigid_feet" in models:
        made["forces"] = _FORCE_COLUMNS, list(_force_rows(found))
    return {name: (columns, rows) for name, (columns, rows) in made.items() if rows}


_FRICTION_COLUMNS = [
    {"name": "pusher", "merge": True},
    {"name": "model"},
    {"name": "friction", "format": "{:.2f}"},
    {"name": "both, half fitted on", "format": "{:.2f} mm"},
    {"name": "within 0.1 mm of it", "format": "{:.2f}", "rest": " to {:.2f}"},
    {"name": "both, other half", "format": "{:.2f} mm", "rest": " [{:.2f}, {:.2f}]"},
]


def _friction_rows(found: xr.Dataset) -> Iterator[list[Any]]:
    finger, test = found.finger.values, ~found.fits.values
    clear = test & (found.group.values != GROUPS[5])
    tried = found.tried.values
    for name in FINGERS:
        for model in FITTED:
            if model not in found.model or not (finger == name).any():
                continue
            off = 1e3 * found.fit_error.sel(fitted=model, finger_kind=name).values
            near = tried[off <= np.nanmin(off) + 0.1]
            mu = float(found.friction.sel(fitted=model, finger_kind=name))
            told = _off(found, model, clear & (finger == name)).both
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


def _layout_rows(found: xr.Dataset) -> Iterator[list[Any]]:
    """Errors on each layout of feet, with the friction that suits the other layouts best."""
    support, finger = found.few_support.values, found.few_finger.values
    for name in FINGERS:
        own = (finger == name) & (support != "")
        for layout in dict.fromkeys(support[own]):
            held, rest = own & (support == layout), own & (support != layout)
            if not rest.any():
                continue
            for model in map(str, found.fitted.values):
                off = [found[f"few_{one}"].sel(fitted=model).values for one in Errors._fields]
                best, usual = (int(np.median(off[2][:, rows], axis=1).argmin())
                               for rows in (rest, held))  # fmt: skip
                cells = [[unit * one for one in median_interval(values[best, held])]
                         for unit, values in zip(_UNITS, off, strict=True)]  # fmt: skip
                mu, alone = float(found.tried[best]), 1e3 * np.median(off[2][usual, held])
                yield [name, layout, WORDS[model], int(held.sum()), *_rounded([mu, *cells, alone])]


_FORCE_COLUMNS = [
    {"name": "point pushes"},
    {"name": "number", "format": "{:d}"},
    {"name": "angle of the force off the predicted", "format": "{:.1f}°"},
    {"name": "90 %", "format": "{:.1f}°"},
    {"name": "friction with the ground that the force tells", "format": "{:.3f}",
     "rest": " [{:.3f}, {:.3f}]"},
]  # fmt: skip


def _force_rows(found: xr.Dataset) -> Iterator[list[Any]]:
    said = found.force.sel(model="rigid_feet").values
    real = found.force_measured.values
    size = np.linalg.norm(said, axis=1)
    off = np.arctan2(real[:, 1], real[:, 0]) - np.arctan2(said[:, 1], said[:, 0])
    ratio = np.linalg.norm(real, axis=1) / (np.maximum(size, 1e-9) * pushes.MASS * 9.81)
    told = np.isfinite(real).all(axis=1) & np.isfinite(said).all(axis=1) & (size > 0.05)
    told &= ~found.fits.values
    kinds = [(one, on) for one in GROUPS[:2] for on in pushes.GROUND]
    for group, surface in kinds:
        rows = told & (found.group.values == group) & (found.surface.values == surface)
        name = f"{group}, {surface}"
        if rows.any():
            wrong = np.degrees(np.abs(pushes.angle(off[rows])))
            cells = [np.median(wrong), np.quantile(wrong, 0.9), list(median_interval(ratio[rows]))]
            yield [name, int(rows.sum()), *_rounded(cells)]


def _texts(columns: list[dict[str, Any]], rows: list[list[Any]]) -> list[list[str]]:
    """A table as texts, as the pages have it."""

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
