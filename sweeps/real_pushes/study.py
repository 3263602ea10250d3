"""Does the physics predict real pushes? 1,271 of a robot's, beside what models say.

    rps sweeps/real_pushes
    rps sweeps/real_pushes --pushes FILE.csv

predicts where each push ends with several models, and tells how far that is from where it was
measured. Friction at the fingers is fitted on one half of the pushes, and all are judged on the
other. Pushes of a file in the same columns are all judged, with the friction of `FRICTION`. In
Python, `predict_push.predict_push` predicts the motion of any known object.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
import xarray as xr
from scipy.stats import t as t_distribution

from rps_jax.geometry.solid import wrap
from rps_jax.physics import PHYSICS
from rps_jax.questions import Picture, Run, call_of, option
from sweeps.real_pushes import contact, pushes
from sweeps.real_pushes.drawing import figure
from sweeps.real_pushes.pushes import Errors
from sweeps.study_base import QuickStudy, Table, median_interval, run_parts

WORDS: Mapping[str, str] = {
    "no_motion": "no motion",
    "with_pusher": "moves with the pusher",
    "ellipsoid": "ellipsoid limit surface",
    "rigid_feet": "rigid, on its feet",
    "rigid_corners": "rigid, on the corners of its outline",
    **{name: condition.label for name, condition in contact.KINDS.items()},
}  # models
SLIDING = {"ellipsoid": "ellipsoid", "rigid_feet": "feet", "rigid_corners": "corners"}
FITTED = tuple(SLIDING)  # each has a separately fitted friction
MUJOCOS = tuple(contact.KINDS)
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
ON_FEET = (GROUPS[0], GROUPS[2], GROUPS[3])  # groups with layouts of feet
_SHOWN = {  # models in the table; all of the others
    GROUPS[1]: FITTED,
    GROUPS[2]: ("rigid_feet",),
    GROUPS[4]: FITTED,
    GROUPS[5]: ("rigid_feet",),
}
EDGES = ("y = 0", "hypotenuse", "x = 0")
_FRICTIONS = tuple(round(0.05 * i, 2) for i in range(2, 18))  # frictions at the fingers
_FIT = 100  # pushes with one finger, and with two each, that friction is fitted on
_SERIES = 10  # pushes at least of a series for the spread of series
_TOGETHER = 320  # pushes that are predicted in one batch
_DRAWS = 2000  # of the bootstrap
_SPLIT = 2015  # seed of the halves


def predict_all(
    table: pd.DataFrame,
    model: str,
    friction: Mapping[str, float] = FRICTION,
    steps: int = STEPS,
) -> pushes.Motion:
    """Return the final poses of pushes and, of sliding models, their mean forces.

    `friction` [1] is between finger(s) and object, by `point` and `two-point`; a path has `steps`,
    except in MuJoCo.
    """
    mu = np.array([friction[name] for name in pushes.kind_of_finger(table)], float)
    if model in SLIDING:
        return pushes.slide(table, mu, on=SLIDING[model], steps=steps)
    nothing = np.full((len(table), 2), np.nan)
    if model == "no_motion":
        pose = pushes.initial_poses(table)
    elif model == "with_pusher":
        pose = pushes.with_pusher(table, steps)
    else:
        pose = contact.push(table, mu, contact.KINDS[model])
    return pushes.Motion(pose, nothing)


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
class RealPushes(QuickStudy[xr.Dataset]):
    """Predict the final poses of real pushes with several models, and compute their errors.

    The answer holds predicted poses `predicted` (model, push, pose) [m, m, rad], NaN where a model
    did not run, those `measured`, and the errors `place` [m], `turn` [rad] and `both` [m].
    """

    TITLE = "Does the physics predict real pushes?"
    CHOICES: ClassVar = {"models": WORDS}
    QUICK: ClassVar = {"few": 60, "mujoco": 6}
    PRESETS: ClassVar = PHYSICS["default"]

    pushes: Path | None = None
    """CSV file of pushes to predict, with the columns of data/pushes.csv; by default that file."""
    models: tuple[str, ...] = tuple(WORDS)
    """Models to run; by default all."""
    mujoco: int = option(100, 0, 100_000)
    """Number of pushes on three feet that C MuJoCo predicts, with one finger and with two each."""
    few: int | None = option(None, 10, 100_000)
    """Number of pushes, evenly spaced in the table; by default all."""

    def check(self) -> None:
        """Check the models and the table."""
        super().check()
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
        """Return the number of pushes of all models."""
        return len(self.models) * len(self.table)

    @property
    def fits(self) -> np.ndarray:
        """Whether a push (n,) is in the half for the fit of friction."""
        none = np.zeros(len(self.table), bool)
        return halves_of(_ids(self.table)) if self.pushes is None else none

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
        parts = {model: partial(self._predict, model, friction) for model in self.models}
        results = run_parts(run, "model", parts, len(table))
        results = results.assign_coords(
            pose=list(pushes.POSE),
            id=("push", _ids(table)),
            finger=("push", pushes.kind_of_finger(table).astype(str)),
            group=("push", groups_of(table)),
            action=("push", pushes.actions(table)),
            edge=("push", pushes.edges(table)),
            fits=("push", self.fits),
        )
        actual = pushes.measured(table)
        results["measured"] = (("push", "pose"), actual)
        results["initial"] = (("push", "pose"), pushes.initial_poses(table))
        if {"force_wx", "force_wy", "surface"} <= set(table):
            results["surface"] = ("push", table.surface.fillna("").to_numpy(str))
            force = table[["force_wx", "force_wy"]].to_numpy()
            results["force_measured"] = (("push", "axis"), force)
        off = pushes.errors_of(results.predicted.values, actual)._asdict()
        results.update({name: (("model", "push"), values) for name, values in off.items()})
        if friction is not None:
            results = results.merge(friction)
        if run.folder is not None:
            (run.folder / "predictions.csv").write_text(_csv(results), encoding="utf-8")
        return results

    def _fitted(self, run: Run) -> xr.Dataset:
        """Return the errors of each friction on samples, and the best `friction`.

        A few pushes of one half determine the friction. Their median error is `fit_error` [m]
        (fitted, finger_kind, tried). `_validated` needs the errors (fitted, tried, sample) of all
        pushes on feet.
        """
        whole = self.table
        finger, support = pushes.kind_of_finger(whole), np.asarray(whole.support)
        halves = self.fits & ~pushes.doubted(whole)
        group, fitted_on = groups_of(whole), np.zeros(len(whole), bool)
        for name in FINGERS:
            rows = np.flatnonzero(halves & (finger == name))
            fitted_on[np.random.default_rng(_SPLIT).permutation(rows)[:_FIT]] = True
        on_feet = np.isin(group, ON_FEET)
        samples = fitted_on | on_feet
        table = pushes.chosen(whole, samples)
        needed = {"rigid_feet", *self.models} if set(MUJOCOS) & set(self.models) else self.models
        fitted = [name for name in FITTED if name in needed]
        by_model = [run.checkpoint(f"fit_{x}", partial(self._tried, table, x)) for x in fitted]
        series = whole.file if "file" in whole else pd.Series([""] * len(whole))
        labels = {
            "finger": finger.astype(str),
            "group": group,
            "support": np.where(on_feet, support, "").astype(str),
            "series": series.to_numpy(str),
        }
        off = xr.concat(by_model, "fitted").assign_coords(
            {f"sample_{name}": ("sample", x[samples]) for name, x in labels.items()}
            | {"fitted": ("fitted", fitted)}
        )
        rows = xr.DataArray(fitted_on[samples], dims="sample")
        by_finger = [off.sample_both.where(rows & (off.sample_finger == x)) for x in FINGERS]
        kinds = xr.IndexVariable("finger_kind", list(FINGERS))
        off["fit_error"] = xr.concat([values.median("sample") for values in by_finger], kinds)
        return off.assign(friction=off.fit_error.fillna(9.0).idxmin("tried"))

    def _tried(self, table: pd.DataFrame, model: str) -> xr.Dataset:
        """Return errors (tried, sample) of one model with all frictions."""
        errors_of, count = [], len(table)
        for tried in (_FRICTIONS[i : i + 4] for i in range(0, len(_FRICTIONS), 4)):
            repeated = pd.concat([table] * len(tried), ignore_index=True)
            mu = np.repeat(tried, count)
            pose = pushes.slide(repeated, mu, on=SLIDING[model], steps=STEPS // 2).pose
            pose = pose.reshape(len(tried), count, 3)
            errors_of.append(pushes.errors_of(pose, pushes.measured(table)))
        off = Errors(*map(np.concatenate, zip(*errors_of, strict=True)))._asdict()
        columns = {f"sample_{name}": (("tried", "sample"), values) for name, values in off.items()}
        return xr.Dataset(columns, {"tried": list(_FRICTIONS)})

    def _predict(self, model: str, friction: xr.Dataset | None) -> xr.Dataset:
        """Return the predictions of one model."""
        chosen: Mapping[str, float] = FRICTION
        fitted = model if model in FITTED else "rigid_feet"
        if friction is not None and fitted in friction.fitted:
            of_model = friction.friction.sel(fitted=fitted)
            chosen = {name: float(of_model.sel(finger_kind=name)) for name in FINGERS}
        count = len(self.table)
        pose, force = np.full((count, 3), np.nan), np.full((count, 2), np.nan)
        for first in range(0, count, _TOGETHER):
            rows = np.flatnonzero(self._rows(model)[first : first + _TOGETHER]) + first
            if rows.size:
                part = self.table.iloc[rows].reset_index(drop=True)
                pose[rows], force[rows] = predict_all(part, model, chosen)
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

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return errors by model and the fitted friction."""
        by_name = list(tables(results).values())
        if by_name and np.isfinite(results.both).any() and "rigid_feet" in self.models:
            draw = partial(figure, results, self.table, WORDS)
            by_name[0] = by_name[0]._replace(picture=Picture("real_pushes", draw))
        return by_name


real_pushes = call_of(RealPushes)


# --- the tables ---


def _csv(results: xr.Dataset) -> str:
    """Return one row per push and model with the predicted pose."""
    poses = {f"post_{name}": results.predicted.sel(pose=name, drop=True) for name in pushes.POSE}
    frame = xr.Dataset(poses).to_dataframe().reset_index()[["id", "model", *poses]]
    return frame.dropna().to_csv(index=False, lineterminator="\n")


def _column(name: str, form: str = "{}", rest: str = "", **options: Any) -> dict[str, Any]:
    """Return a column of a data file."""
    formats = {"format": form, "rest": rest} if rest else {"format": form} if form != "{}" else {}
    return {"name": name} | formats | options


_INTERVAL = " [{:.2f}, {:.2f}]"
_NUMBER = _column("number", "{:d}")
_MEDIANS = {
    "place": _column("place", "{:.2f} mm", _INTERVAL),
    "turn": _column("turn", "{:.2f}°", _INTERVAL),
    "both": _column("both", "{:.2f} mm", _INTERVAL),
}
_PUSHES, _MODEL = _column("pushes", merge=True), _column("model")
_COLUMNS = [
    _PUSHES,
    _MODEL,
    _NUMBER,
    _MEDIANS["place"],
    _column("90 %", "{:.1f} mm"),
    _MEDIANS["turn"],
    _column("90 %", "{:.1f}°"),
    _MEDIANS["both"],
    _column("90 %", "{:.1f} mm"),
]
_FRICTION_COLUMNS = [
    _column("pusher", merge=True),
    _MODEL,
    _column("friction", "{:.2f}"),
    _column("both, half fitted on", "{:.2f} mm"),
    _column("within 0.1 mm of it", "{:.2f}", " to {:.2f}"),
    _column("both, other half", "{:.2f} mm", _INTERVAL),
]
_LAYOUT_COLUMNS = [
    _PUSHES,
    _column("feet that nothing was fitted on"),
    _MODEL,
    _NUMBER,
    _column("friction, fitted on other feet", "{:.2f}"),
    *_COLUMNS[3:],
    _column("both, fitted on these feet", "{:.2f} mm"),
]
_NEW = "of a new series"
_SERIES_COLUMNS = [
    _PUSHES,
    _MODEL,
    _NUMBER,
    _column("series", "{:d}"),
    _MEDIANS["place"],
    _column(_NEW, "{:.2f}", " to {:.2f} mm"),
    _MEDIANS["turn"],
    _column(_NEW, "{:.2f}", " to {:.2f}°"),
    _MEDIANS["both"],
    _column(_NEW, "{:.2f}", " to {:.2f} mm"),
    _column("both, 90 %", "{:.1f} mm", " [{:.1f}, {:.1f}]"),
    _column(_NEW, "{:.1f}", " to {:.1f} mm"),
]
_HEADING_COLUMNS = [
    _PUSHES,
    _column("pushed edge"),
    _NUMBER,
    _column("predicted heading minus measured", "{:+.2f}°", " [{:+.2f}, {:+.2f}]"),
    _column("turn", "{:.2f}°"),
    _column("turn without the offset of all", "{:.2f}°"),
]
_FORCE_COLUMNS = [
    _column("point pushes"),
    _NUMBER,
    _column("angle of the force off the predicted", "{:.1f}°"),
    _column("90 %", "{:.1f}°"),
    _column("friction with the ground that the force tells", "{:.3f}", " [{:.3f}, {:.3f}]"),
]
_UNITS = (1e3, 180 / np.pi, 1e3)  # of errors in tables: mm, degrees, mm


def _row(label: str, model: str, off: Errors) -> list[Any]:
    cells: list[Any] = []
    for values, unit in zip(off, _UNITS, strict=True):
        cells += [[unit * x for x in median_interval(values)], unit * np.quantile(values, 0.9)]
    return [label, WORDS[model], off.both.size, *_rounded(cells)]


def _rounded(cells: list[Any]) -> list[Any]:
    return [
        [round(float(x), 3) for x in c] if isinstance(c, list) else c and round(float(c), 3)
        for c in cells
    ]


def _errors(results: xr.Dataset, model: str, rows: np.ndarray) -> Errors:
    """Return the errors of a model for measured pushes."""
    predictions = results.sel(model=model)
    values = [predictions[name].values[rows] for name in Errors._fields]
    is_measured = np.isfinite(values[2])
    return Errors(*(value[is_measured] for value in values))


def tables(results: xr.Dataset) -> dict[str, Table]:
    """Return the tables of the page by name, for pushes outside the fit."""
    group, test = results.group.values, ~results.fits.values
    models = results.model.values.tolist()
    slow = [name for name in models if name in MUJOCOS]
    quick = [name for name in models if name not in MUJOCOS]

    def rows(groups: Sequence[str], shown: Sequence[str], mask: np.ndarray) -> Iterator[list[Any]]:
        for name, model in product(groups, shown):
            off = _errors(results, model, mask & (group == name))
            if off.both.size and (model in slow or model in _SHOWN.get(name, quick)):
                yield _row(name, model, off)

    published = {"models": (_COLUMNS, rows(GROUPS, quick, test))}
    if slow:
        ran = np.isfinite(results.predicted.sel(model=slow[0]).values).all(axis=1)
        shown = [name for name in quick if name == "rigid_feet"] + slow
        published["mujoco"] = (_COLUMNS, rows((GROUPS[0], GROUPS[3]), shown, ran))
    if "friction" in results:
        published["friction"] = _FRICTION_COLUMNS, _friction_rows(results)
        validated = _validated(results)
        published["series"] = _SERIES_COLUMNS, _series_rows(results, validated)
        published["layouts"] = _LAYOUT_COLUMNS, _layout_rows(validated)
    if "rigid_feet" in models:
        published["heading"] = _HEADING_COLUMNS, _heading_rows(results)
    if "force_measured" in results and "rigid_feet" in models:
        published["forces"] = _FORCE_COLUMNS, _force_rows(results)
    by_name = {
        name: Table(list(values), "", columns, name=f"real_pushes_{name}", title=name.capitalize())
        for name, (columns, values) in published.items()
    }
    return {name: table for name, table in by_name.items() if table.rows}


def _friction_rows(results: xr.Dataset) -> Iterator[list[Any]]:
    finger, test = results.finger.values, ~results.fits.values
    clear = test & (results.group.values != GROUPS[5])
    tried = results.tried.values
    for name, model in product(FINGERS, FITTED):
        if model in results.model and (finger == name).any():
            off = 1e3 * results.fit_error.sel(fitted=model, finger_kind=name).values
            near = tried[off <= np.nanmin(off) + 0.1]
            mu = float(results.friction.sel(fitted=model, finger_kind=name))
            other_half = _errors(results, model, clear & (finger == name)).both
            cells = [
                mu,
                float(np.nanmin(off)),
                [float(near.min()), float(near.max())],
                [1e3 * x for x in median_interval(other_half)],
            ]
            yield [name, WORDS[model], *_rounded(cells)]


def _validated(results: xr.Dataset) -> pd.DataFrame:
    """Return errors [mm, degrees] of all pushes on feet, with the best friction for other feet.

    `alone` is the error `both` with the best friction for the same feet.
    """
    group, support, finger, series = (
        results[f"sample_{name}"].values for name in ("group", "support", "finger", "series")
    )
    frames = []
    for name, layout in product(ON_FEET, dict.fromkeys(support)):
        held_out = (group == name) & (support == layout)
        rest = np.isin(group, (GROUPS[0], GROUPS[3])) & (support != layout)
        rest &= finger == name.split(",")[0]
        shown = _SHOWN.get(name, FITTED) if held_out.any() and rest.any() else ()
        for model in (x for x in shown if x in results.fitted):
            off = [results[f"sample_{x}"].sel(fitted=model).values for x in Errors._fields]
            best, best_here = (
                int(np.median(off[2][:, rows], axis=1).argmin()) for rows in (rest, held_out)
            )
            columns = dict(zip(Errors._fields, (x[best, held_out] for x in off), strict=True))
            columns = {x: unit * columns[x] for x, unit in zip(columns, _UNITS, strict=True)}
            columns |= {"group": name, "layout": layout, "model": model}
            columns |= {"friction": float(results.tried[best]), "series": series[held_out]}
            frames.append(pd.DataFrame(columns | {"alone": 1e3 * off[2][best_here, held_out]}))
    return pd.concat(frames) if frames else pd.DataFrame(columns=["group", "layout", "model"])


def _layout_rows(validated: pd.DataFrame) -> Iterator[list[Any]]:
    """Yield errors on each layout of feet, with the best friction for the other layouts."""
    columns = ["group", "layout", "model"]
    for _, rows in validated.groupby(columns, sort=False):
        group, layout, model = rows[columns].iloc[0]
        cells = [float(rows.friction.iloc[0])]
        for x in Errors._fields:
            cells += [[*median_interval(rows[x].to_numpy())], rows[x].quantile(0.9)]
        yield [group, layout, WORDS[model], len(rows), *_rounded([*cells, rows.alone.median()])]


def _series_rows(results: xr.Dataset, validated: pd.DataFrame) -> Iterator[list[Any]]:
    """Yield errors over all layouts, and the intervals in which those of a new series lie."""
    for _, rows in validated.query(f"group != {GROUPS[2]!r}").groupby(
        ["group", "model"], sort=False
    ):
        group, model = rows[["group", "model"]].iloc[0]
        series = [
            [_errors_in(x) for _, x in part.groupby("series")] for _, part in rows.groupby("layout")
        ]
        limits = np.quantile([_summary(x) for x in _resampled(series)], [0.025, 0.975], axis=0)
        new = new_interval([_summary(x) for part in series for x in part if len(x) >= _SERIES])
        cells: list[Any] = []
        for value, interval, of_new in zip(_summary(_errors_in(rows)), limits.T, new, strict=True):
            cells += [[value, *interval], of_new]
        yield [group, WORDS[model], len(rows), sum(map(len, series)), *_rounded(cells)]
    off, repeated = pushes.repetitions(results)
    of_model = _errors(results, "rigid_feet", repeated) if "rigid_feet" in results.model else off
    for name, values in (("a repetition of the push", off), (WORDS["rigid_feet"], of_model)):
        if values.both.size:
            rows = np.stack(values, axis=1) * _UNITS
            resampled = [_summary(x) for x in _resampled([[rows]])]
            limits = np.quantile(resampled, [0.025, 0.975], axis=0).T
            cells = [[value, *x] for value, x in zip(_summary(rows), limits, strict=True)]
            label = f"{GROUPS[3]}, repeated pushes"
            with_blanks = [x for cell in cells for x in (cell, None)]
            yield [label, name, len(rows), None, *_rounded(with_blanks)]


def _errors_in(rows: pd.DataFrame) -> np.ndarray:
    return rows[list(Errors._fields)].to_numpy()


def _summary(off: np.ndarray) -> np.ndarray:
    """Return the medians of errors (n, 3), and the 90 % quantile of the last one."""
    return np.append(np.median(off, axis=0), np.quantile(off[:, 2], 0.9))


def _resampled(series: Sequence[Sequence[np.ndarray]]) -> Iterator[np.ndarray]:
    """Yield errors (n, 3) of drawn pushes of drawn series of drawn layouts: a cluster bootstrap."""
    rng = np.random.default_rng(0)

    def drawn(items: Sequence[Any]) -> list[Any]:
        return [items[i] for i in rng.integers(len(items), size=len(items))]

    for _ in range(_DRAWS):
        parts = [x for part in drawn(series) for x in drawn(part)]
        yield np.concatenate([x[rng.integers(len(x), size=len(x))] for x in parts])


def new_interval(summaries: Sequence[np.ndarray]) -> list[list[float] | None]:
    """Return 95 % prediction intervals [low, high] for a new series, of each number.

    The logarithms of the numbers (K, n) of series are taken as normally distributed.
    """
    count = len(summaries)
    if count < 3:
        return [None] * 4
    logs = np.log(summaries)
    half = t_distribution.ppf(0.975, count - 1) * logs.std(axis=0, ddof=1) * np.sqrt(1 + 1 / count)
    middle = logs.mean(axis=0)
    return np.exp(np.stack([middle - half, middle + half], axis=1)).tolist()


def _heading_rows(results: xr.Dataset) -> Iterator[list[Any]]:
    """Yield the signed errors of the heading, which an offset of the measurement would share."""
    predicted = results.predicted.sel(model="rigid_feet").values[:, 2]
    measured = results.measured.values[:, 2]
    off = np.degrees(wrap(predicted - measured))
    for name in (GROUPS[0], GROUPS[3]):
        group = (results.group.values == name) & ~results.fits.values & np.isfinite(off)
        for i, edge in enumerate(EDGES):
            if (rows := group & (results.edge.values == i)).any():
                without = np.median(np.abs(off[rows] - np.median(off[group])))
                cells = [[*median_interval(off[rows])], np.median(np.abs(off[rows])), without]
                yield [name, edge, int(rows.sum()), *_rounded(cells)]


def _force_rows(results: xr.Dataset) -> Iterator[list[Any]]:
    predicted = results.force.sel(model="rigid_feet").values
    real = results.force_measured.values
    size = np.linalg.norm(predicted, axis=1)
    off = np.arctan2(real[:, 1], real[:, 0]) - np.arctan2(predicted[:, 1], predicted[:, 0])
    ratio = np.linalg.norm(real, axis=1) / (np.maximum(size, 1e-9) * pushes.MASS * 9.81)
    is_valid = np.isfinite(real).all(axis=1) & np.isfinite(predicted).all(axis=1) & (size > 0.05)
    is_valid &= ~results.fits.values
    for group, surface in product(GROUPS[:2], pushes.GROUND):
        rows = is_valid & (results.group.values == group) & (results.surface.values == surface)
        if rows.any():
            degrees = np.degrees(np.abs(wrap(off[rows])))
            cells = [np.median(degrees), np.quantile(degrees, 0.9), [*median_interval(ratio[rows])]]
            yield [f"{group}, {surface}", int(rows.sum()), *_rounded(cells)]
