"""The paper's hardware experiments (Sec. III-C) in simulation: two objects and eight targets.

The closet of the paper's video is a third object. The paper does not measure it, so each trial
draws its sizes and mass from the ranges that `mjcf/closet.xml` guesses.
The object is also shoved, as in the paper's video. The paper does not give the friction, so a
range is run. By default the base loses the shares of its twist that `sweeps/paper_reading` infers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product, starmap
from typing import ClassVar, Literal

import numpy as np
import xarray as xr

from rps_jax.analysis import tables
from rps_jax.analysis.figures.style import WIDTH, Figure, base_patch, styled, tiles, words
from rps_jax.control.registry import LawLike
from rps_jax.questions import LawQuestion, Picture, Run, Section, call_of, option
from rps_jax.robot.robot import RobotLike
from rps_jax.robot.skin import SkinLike
from rps_jax.runs.question import DefaultLaw, Rows
from rps_jax.studies.table import Table
from rps_jax.trials import pushes
from rps_jax.trials.results import labelled, trace_dataset
from rps_jax.trials.trial import Shift
from rps_jax.world.domain import name_or_custom
from rps_jax.world.paper import (
    HARDWARE_GROUND,
    HARDWARE_LAYOUTS,
    HARDWARE_OBJECTS,
    HARDWARE_RESULTS,
    HARDWARE_ROBOT,
)
from rps_jax.world.scene import Friction
from rps_jax.worlds import Case

OBJECTS = (*HARDWARE_OBJECTS, "closet")
MIDDLE = Friction(HARDWARE_GROUND[1], HARDWARE_ROBOT[1])  # friction of the paths and of the shove
_FRICTIONS = tuple(starmap(Friction, product(HARDWARE_GROUND, HARDWARE_ROBOT)))
# Label, unit, and digits in the table of two columns of the results, by name.
_MEANS = {"mean_abs_l": ("D", "m", 3), "time": ("time", "s", 0)}
_TRACED = ("qpos", "p_world_contact", "outcome_success")  # variables of a trial over time


@dataclass(frozen=True)
class Hardware(LawQuestion[xr.Dataset]):
    """Run the paper's hardware experiments in simulation, over a range of friction.

    The result has the outcomes (law, object, friction, target). Of the shove it has `recovered` and
    `counted` (object, shift, side, target). For Fig. 7 it has `base_path` and `contact_path`
    (object, target, path_time, axis) [m] at the middle of the friction range, NaN after the end.

    Examples:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> results = rps_jax.hardware(shifts=(0.1,), setting=brief)
      >>> dict(results.recovered.sizes)
      {'object': 3, 'shift': 1, 'side': 2, 'target': 8}
    """

    TITLE = "Hardware experiments"
    QUICK: ClassVar = {"shifts": (0.1, 0.2, 0.3)}

    law: LawLike = DefaultLaw("rps")
    skin: SkinLike = "hardware"
    """The skin: ideal, thin, capacitive, or hardware, which has noise and unequal gains; changes
    follow, as capacitive,foam=0.01."""
    robot: RobotLike = "slipping"
    """The robot: its name, or a JSON file of its size, boards and limits. The wheels of `slipping`
    lose shares of the twist, by which the paper's results come out."""
    layout: Literal["circle", "grid"] = "circle"
    """Layout of the eight targets: circle (each 2.1 m from the start) or grid (2.1 m apart in x and
    y)."""
    shifts: tuple[float, ...] = option((0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4), 0, 2, unit="m")
    """Lengths of the shove, to either side of the robot [m]."""
    shift_time: float = option(30.0, 0, 300, unit="s")
    """Time of the shove after the start [s]."""

    @property
    def targets(self) -> tuple[tuple[float, float], ...]:
        """Eight targets [m]."""
        return HARDWARE_LAYOUTS[self.layout]

    @cached_property
    def table(self) -> Table:
        """Trials under all frictions."""
        law = {self.label: self.params}
        world = {"skin": self.skin, "robot": self.robot, "setting": self.setting}
        return Table(law, OBJECTS, _FRICTIONS, self.targets, **world)

    @property
    def trial_counts(self) -> tuple[int, int, int]:
        """Number of trials under all frictions, with shoves, and for the paths."""
        tasks = len(OBJECTS) * len(self.targets)
        return tasks * len(_FRICTIONS), tasks * 2 * len(self.shifts), tasks

    def check(self) -> None:
        self.table.check()

    def num_trials(self) -> int | None:
        return sum(self.trial_counts)

    def answer(self, run: Run) -> xr.Dataset:
        run, progress = run.in_parts()
        parts = {"hardware": self.table.run_cases, "shifted": self._shove, "paths": self._trace}
        results = []
        for (name, compute), count in zip(parts.items(), self.trial_counts, strict=True):
            results.append(run.checkpoint(name, partial(compute, run)))
            progress.finish(count)
        merged = xr.merge(results, combine_attrs="drop")
        assert isinstance(merged, xr.Dataset)
        return merged

    def _cases(self, name: str, shift: Shift = Shift()) -> list[Case]:
        """Return the cases of all targets at the middle friction."""
        base = replace(self.table.cases[0], object=name, friction=MIDDLE, shift=shift)
        return [replace(base, target=target) for target in self.targets]

    def _shove(self, run: Run) -> xr.Dataset:
        """Return the success after the object is shoved along the front of the robot."""
        shoves = product(OBJECTS, self.shifts, (1.0, -1.0))
        shifts = [(name, Shift(self.shift_time, (0.0, side * size))) for name, size, side in shoves]
        cases = [case for name, shift in shifts for case in self._cases(name, shift)]
        outcome, _ = pushes.run(cases, self.setting, **run.batch_options)
        dims = ("object", "shift", "side", "target")
        # A trial that ends before the shove is not counted.
        shape = len(OBJECTS), len(self.shifts), 2, len(self.targets)
        recovered = outcome.success.reshape(shape)
        counted = outcome.time.reshape(shape) > self.shift_time
        variables = labelled(
            recovered=(dims, recovered, "1", "the target is reached after the shove"),
            counted=(dims, counted, "1", "the trial was under way when the object was shoved"),
            shift=("shift", list(self.shifts), "m", "length of the shove"),
        )
        return xr.Dataset(variables, {"object": list(OBJECTS), "side": ["left", "right"]})

    def _trace(self, run: Run) -> xr.Dataset:
        """Return the paths of Fig. 7: all objects and targets, at the middle friction."""
        by_object = []
        for name in OBJECTS:
            batch = pushes.build(self._cases(name), self.setting)
            trials = pushes.record_batch(batch, self.setting, interval=0.5, callback=run.callback)
            by_object.append([trace_dataset(x)[list(_TRACED)] for x in trials])
        # NaN after the end of a trial.
        traces = xr.combine_nested(by_object, ["object", "target"], join="outer")
        traces = traces.transpose("object", "target", ...)
        base, contact, success = (traces[name].values.astype(float) for name in _TRACED)
        dims = ("object", "target", "path_time", "axis")
        half = np.asarray(self.table.cases[0].base.shell.sizes, float)
        time = 0.5 * np.arange(1, traces.sizes["time"] + 1)
        variables = labelled(
            base_path=(dims, base[..., :2], "m", "path of the base"),
            contact_path=(dims, contact, "m", "path of the contact point"),
            path_success=(dims[:2], success.astype(int), "1", "the target of Fig. 7 is reached"),
            half=("axis" if half.size == 2 else "radius", half, "m", "sizes of the base"),
            path_time=("path_time", time, "s", "time after the start"),
        )
        return xr.Dataset(variables, {"object": list(OBJECTS), "axis": ["x", "y"]})

    @property
    def fitted(self) -> str:
        """Mark of D and time, to which the slips of the default robot are fitted."""
        return "fitted; " if self.robot == type(self).robot else ""

    def intro(self, results: xr.Dataset) -> str:
        return (
            f"{self.label}, skin {name_or_custom(self.skin)}, robot {name_or_custom(self.robot)}, "
            f"engine {self.setting.engine}. "
            "The paper does not give the friction; all pairs of object-ground "
            f"{HARDWARE_GROUND} and object-robot {HARDWARE_ROBOT} are run."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        ground, robot = MIDDLE
        text = (
            "D is the mean of |l| over the time in contact, where l is the contact offset from the "
            "centre of the pushing side (the paper's Sec. III-C). D and time are means over "
            "successes; in round brackets: the least and the greatest mean among the frictions. "
            "Square brackets: Wilson 95 % intervals. The paper shows a closet and does not measure "
            "it: each trial draws its sizes and mass from the guesses in `mjcf/closet.xml`."
        )
        if self.fitted:
            text += (
                " The slips of the base, and the range of its friction, are fitted to the paper's "
                "D and times, so their agreement is no prediction."
            )
        shove = (
            f"{self.shift_time:g} s after the start the object is moved at once along the front of "
            f"the robot, to either side (friction ground {ground:g}, robot {robot:g}). Trials "
            "that end earlier are not counted. Brackets: Wilson 95 % intervals [%]."
        )
        middle = f"Friction: ground {ground:g}, robot {robot:g}, the middle of the range."
        success = Picture("numbers", partial(numbers_figure, results, self.fitted))
        paths = Picture("paths", partial(paths_figure, results))
        return [
            Section("Hardware experiments", text, table(results, self.fitted), success),
            Section("Fig. 7: paths of the base", middle, (), paths),
            Section("The object shoved aside", shove, shift_table(results)),
        ]


hardware = call_of(Hardware)


def table(results: xr.Dataset, fitted: str = "") -> Rows:
    """Return a row for each object: success, D and time beside the paper's.

    D and time are marked by the text `fitted`.
    """
    rows = [["object", "success", "paper", "D", "paper", "time", "paper"]]
    for name in map(str, results.object.values):
        trials = results.isel(law=0).sel(object=name)
        success = trials.success.values.astype(bool)
        successes = int(success.sum())
        rate = f"{successes} of {success.size} {tables.interval(successes, success.size)}"
        in_paper = HARDWARE_RESULTS.get(name)  # the closet has none
        rows.append([words(name), rate, "-" if in_paper is None else f"{in_paper.success} of 8"])
        for key, (_, unit, digits) in _MEANS.items():
            values = trials[key].where(success)
            means = values.mean("target")
            levels = values.mean(), means.min(), means.max()
            mean, low, high = (f"{float(v):.{digits}f}" for v in levels)
            note = fitted if in_paper is not None else ""
            cell = f"{mean} {unit} ({note}by friction {low}-{high})" if success.any() else "-"
            known = getattr(in_paper, key, None)
            rows[-1] += [cell, "-" if known is None else f"{known:.{digits}f} {unit}"]
    return rows


@styled
def numbers_figure(results: xr.Dataset, fitted: str = "") -> Figure:
    """Draw the mean D and time of each object under each friction, and the paper's."""
    figure, axes = tiles(len(_MEANS), len(_MEANS), (WIDTH / 2, 1.3), (0, 0.3))
    for ax, (key, (label, unit, _)) in zip(axes[0], _MEANS.items(), strict=True):
        means = results[key].where(results.success > 0).isel(law=0).mean("target")
        for row, name in enumerate(results.object.values):
            ax.plot(means.sel(object=name), [row] * means.sizes["friction"], "o-", color="C0")
            if name in HARDWARE_RESULTS:
                ax.plot(getattr(HARDWARE_RESULTS[name], key), row, "k*", ms=8)
        count = results.sizes["object"]
        ax.set_yticks(range(count), [words(o) for o in results.object.values])
        ax.set(xlabel=f"{label} [{unit}]", ylim=(count - 0.5, -0.5))
    figure.legend([f"{fitted}under each friction", "paper"], loc="outside lower center", ncols=2)
    return figure


def shift_table(results: xr.Dataset) -> Rows:
    """Return a row for each shove length: successes of the trials still under way."""
    rows = [["shift", *(words(str(o)) for o in results.object.values)]]
    counted = results.counted > 0
    trials = (counted & (results.recovered > 0), counted)  # that recover, and under way at the time
    counts = (x.sum(("side", "target")).values.T for x in trials)
    for size, *by_object in zip(results["shift"].values, *counts, strict=True):
        pairs = zip(*(x.tolist() for x in by_object), strict=True)
        cells = (f"{n} of {total} {tables.interval(n, total)}" for n, total in pairs)
        rows.append([f"{100 * float(size):g} cm", *cells])
    return rows


@styled
def paths_figure(results: xr.Dataset) -> Figure:
    """Draw Fig. 7: the paths of the base to all targets, and the last contact points."""
    names = results.object.values.tolist()
    figure, axes = tiles(len(names), len(names), (WIDTH / 2, 3.5), (0, 0.2), sharey=True)
    for ax, name in zip(axes[0], names, strict=True):
        trials = results.sel(object=name)
        ax.add_patch(base_patch(np.zeros(3), tuple(results.half.values), fill=True))
        for target in range(results.sizes["target"]):
            (line,) = ax.plot(*trials.base_path.values[target].T, lw=1.2)
            xy = float(results.target_x[target]), float(results.target_y[target])
            ax.plot(*xy, "*", ms=8, color=line.get_color())
            contacts = trials.contact_path.isel(target=target).dropna("path_time").values
            if len(contacts):
                ax.plot(*contacts[-1], "o", mfc="white", color=line.get_color())
        successes = int(trials.path_success.sum())
        ax.set(xlabel="x [m]", aspect="equal")
        ax.set_title(f"{words(name)}: {successes} of {results.sizes['target']}")
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("y [m]")
    figure.suptitle(
        f"friction ground {MIDDLE.ground:g}, robot {MIDDLE.robot:g}; lines: base; stars: targets; "
        "circles: last contact point"
    )
    return figure
