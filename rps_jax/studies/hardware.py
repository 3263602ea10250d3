"""The paper's hardware experiments (Sec. III-C), simulated: two objects, eight targets, and the
shove of its video. Friction was never measured, so a plausible range is run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Literal

import numpy as np
import xarray as xr

from rps_jax.analysis import statistics
from rps_jax.analysis.figures.style import OBJECT_COLOURS, Figure, base_patch, success_rates, words
from rps_jax.analysis.report import Picture, Section
from rps_jax.control.registry import LawLike
from rps_jax.record.options import option
from rps_jax.robot.robot import RobotLike
from rps_jax.robot.skin import SkinLike
from rps_jax.runs.question import LawQuestion, Run, call_of, name_or_custom
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.progress import SequentialProgress
from rps_jax.trials.results import outcome_dataset, trace_dataset
from rps_jax.trials.trial import Shift
from rps_jax.world.paper import (
    HARDWARE_GROUND,
    HARDWARE_LAYOUTS,
    HARDWARE_OBJECTS,
    HARDWARE_RESULTS,
    HARDWARE_ROBOT,
)
from rps_jax.world.scene import Friction

MIDDLE = Friction(0.35, 0.5)  # of which the paths are drawn, and at which the object is shoved


def frictions() -> dict[str, Friction]:
    """The range of friction, labelled ground,robot."""
    return {f"{g:g},{r:g}": Friction(g, r) for g in HARDWARE_GROUND for r in HARDWARE_ROBOT}


@dataclass(frozen=True)
class Hardware(LawQuestion[xr.Dataset]):
    """Run the paper's hardware experiments in simulation, over a range of friction.

    The answer holds outcomes (law, object, friction, target); of the shove, `recovered` and
    `counted` (object, shift, side, target); and Fig. 7, `base_path` and `contact_path` (object,
    target, time, axis) [m] at the middle of the friction range, NaN after the end.

    Example:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=2.0))
      >>> found = rps_jax.hardware(shifts=(0.1,), setting=brief)
      >>> dict(found.recovered.sizes)
      {'object': 2, 'shift': 1, 'side': 2, 'target': 8}
    """

    TITLE: ClassVar[str] = "The hardware experiments"
    QUICK: ClassVar[Mapping[str, Any]] = {"shifts": (0.1, 0.2, 0.3)}

    law: LawLike = "rps"
    skin: SkinLike = "hardware"
    """The skin: ideal, thin, capacitive, or hardware, which has noise and unequal gains; changes
    follow, as capacitive,foam=0.01."""
    robot: RobotLike = "ideal"
    """The robot: ideal (it follows every twist at once, with any force), kairos (the paper's),
    ridgeback or mpo_500, or a JSON file of its size, boards and limits."""
    layout: Literal["circle", "grid"] = "circle"
    """The eight targets: circle puts each 2.1 m from the start, grid 2.1 m apart in x and y."""
    shifts: tuple[float, ...] = option((0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4), 0, 2, unit="m")
    """Lengths by which the object is moved aside, to either side of the robot [m]."""
    shift_time: float = option(30.0, 0, 300, unit="s")
    """Time after the start at which it is moved [s]."""

    @cached_property
    def base(self) -> Case:
        """What all trials have in common."""
        target = HARDWARE_LAYOUTS[self.layout][0]
        given = {"skin": self.skin, "robot": self.robot}
        return Case(HARDWARE_OBJECTS[0], MIDDLE, target, self.params, **given)

    @property
    def targets(self) -> tuple[tuple[float, float], ...]:
        """The eight targets [m]."""
        return HARDWARE_LAYOUTS[self.layout]

    def check(self) -> None:
        self.setting.check_here(self.base.base, [self.params])

    def num_trials(self) -> int | None:
        each = len(HARDWARE_OBJECTS) * len(self.targets)
        return each * (len(frictions()) + 2 * len(self.shifts) + 1)

    def answer(self, run: Run) -> xr.Dataset:
        heard, found = SequentialProgress(run.callback), []
        run = run._replace(callback=heard)
        parts = {"hardware": self._pushed, "shifted": self._shifted, "paths": self._paths}
        for name, make in parts.items():
            found.append(run.checkpoint(name, partial(make, run)))
            heard.finish(found[-1].attrs.pop("trials"))
        whole = xr.merge(found, combine_attrs="drop")
        assert isinstance(whole, xr.Dataset)
        return whole

    def _pushed(self, run: Run) -> xr.Dataset:
        """Outcomes over objects, friction and targets."""
        cases = [
            replace(self.base, object=name, friction=friction, target=target)
            for name in HARDWARE_OBJECTS
            for friction in frictions().values()
            for target in self.targets
        ]
        outcome, _ = pushes.run(cases, self.setting, **run.batch_options)
        labels = [self.label], HARDWARE_OBJECTS, tuple(frictions()), self.targets
        return outcome_dataset(outcome, *labels).assign_attrs(trials=len(cases))

    def _shifted(self, run: Run) -> xr.Dataset:
        """Success when the object is moved along the front of the robot, to either side."""
        sides = (1.0, -1.0)
        cases = [
            replace(self.base, object=name, target=target, shift=Shift(self.shift_time, moved))
            for name in HARDWARE_OBJECTS
            for moved in [(0.0, side * size) for size in self.shifts for side in sides]
            for target in self.targets
        ]
        outcome, _ = pushes.run(cases, self.setting, **run.batch_options)
        sizes = (len(HARDWARE_OBJECTS), len(self.shifts), len(sides), len(self.targets))
        dims = ("object", "shift", "side", "target")
        # A trial that had ended before the object was to be moved tells nothing.
        counted = outcome.time > self.shift_time
        telling = {
            "recovered": (outcome.success, "the target is reached after the shove"),
            "counted": (counted, "the trial was under way when the object was shoved"),
        }
        variables = {
            name: (dims, values.astype(np.int8).reshape(sizes), _attrs("1", meaning))
            for name, (values, meaning) in telling.items()
        }
        shift = ("shift", list(self.shifts), _attrs("m", "length of the shove"))
        coords = {"object": list(HARDWARE_OBJECTS), "shift": shift, "side": ["left", "right"]}
        return xr.Dataset(variables, coords, {"trials": len(cases)})

    def _paths(self, run: Run) -> xr.Dataset:
        """Fig. 7: every object to every target, at the middle of the friction range."""
        tracks, won = [], []
        for name in HARDWARE_OBJECTS:
            cases = [replace(self.base, object=name, target=target) for target in self.targets]
            seen = pushes.record_cases(cases, self.setting, interval=0.5, callback=run.callback)
            tracks.append([trace_dataset(one) for one in seen])
            won.append([int(one.outcome.success) for one in seen])
        longest = max(one.sizes["time"] for row in tracks for one in row)
        sizes = (len(HARDWARE_OBJECTS), len(self.targets), longest, 2)
        paths = {"base_path": np.full(sizes, np.nan), "contact_path": np.full(sizes, np.nan)}
        for i, row in enumerate(tracks):
            for j, one in enumerate(row):
                steps = one.sizes["time"]
                paths["base_path"][i, j, :steps] = one.qpos.values[:, :2]
                paths["contact_path"][i, j, :steps] = one.p_world_contact.values
        dims = ("object", "target", "path_time", "axis")
        told = {"base_path": "way of the base", "contact_path": "way of the contact point"}
        half = np.asarray(self.base.base.shell.half, float)
        variables: dict[str, Any] = {k: (dims, v, _attrs("m", told[k])) for k, v in paths.items()}
        variables["path_success"] = (dims[:2], won, _attrs("1", "the target of Fig. 7 is reached"))
        variables["half"] = ("axis", half, _attrs("m", "half length and half width of the base"))
        after = 0.5 * np.arange(1, longest + 1)
        seconds = ("path_time", after, _attrs("s", "time after the start"))
        coords = {"object": list(HARDWARE_OBJECTS), "path_time": seconds, "axis": ["x", "y"]}
        return xr.Dataset(variables, coords, {"trials": len(HARDWARE_OBJECTS) * len(self.targets)})

    def intro(self, results: xr.Dataset) -> str:
        ground, robot = HARDWARE_GROUND, HARDWARE_ROBOT
        return (
            f"{self.label}, skin {name_or_custom(self.skin)}, engine {self.setting.engine}. "
            f"Friction was not measured by the paper: here every pair of object-ground {ground} "
            f"and object-robot {robot} is run."
        )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        ground, robot = MIDDLE
        text = (
            "D is the mean of |l| over the time in contact, where l is how far the contact point "
            "lies from the centre of the robot's side that pushes (the paper's Sec. III-C). D and "
            "time are means over successes; in brackets the least and greatest mean among the "
            "frictions."
        )
        shove = (
            f"{self.shift_time:g} s after the start the object is moved at once along the front "
            f"of the robot, to either side (friction ground {ground:g}, robot {robot:g}). Trials "
            "that had ended by then are not counted."
        )
        middle = f"Friction: ground {ground:g}, robot {robot:g}, the middle of the range."
        ways = Picture("paths", partial(paths_figure, results))
        curve = Picture("shifted", partial(shift_figure, results))
        return [
            Section("Hardware experiments", text, table(results)),
            Section("Fig. 7: paths of the base", middle, (), ways),
            Section("The object shoved aside", shove, shift_table(results), curve),
        ]


hardware = call_of(Hardware)


def _attrs(unit: str, meaning: str) -> dict[str, str]:
    return {"units": unit, "long_name": meaning}


def table(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each object: success, D and time beside the paper's."""
    rows = [["object", "success", "95 %", "paper", "D", "paper", "time", "paper"]]
    for name in map(str, results.object.values):
        one = results.isel(law=0).sel(object=name)
        won = one.success.values.astype(bool)
        low, high = statistics.wilson(int(won.sum()), won.size)
        theirs = HARDWARE_RESULTS[name]
        rate = [f"{won.sum()} of {won.size}", f"{100 * low:.0f}-{100 * high:.0f} %"]
        off = [_spread(one.mean_abs_l.where(won), 3, "m"), f"{theirs.mean_abs_l:.3f} m"]
        time = [_spread(one.time.where(won), 0, "s"), f"{theirs.time:.0f} s"]
        rows.append([words(name), *rate, f"{theirs.success} of 8", *off, *time])
    return rows


def _spread(values: xr.DataArray, digits: int, unit: str) -> str:
    """Mean over targets of the successes: over all friction, then its least and greatest."""
    if not values.notnull().any():
        return "-"
    each = values.mean("target")
    mean, low, high = (f"{float(v):.{digits}f}" for v in (values.mean(), each.min(), each.max()))
    return f"{mean} {unit} (by friction {low}-{high})"


def shift_table(results: xr.Dataset) -> list[list[str]]:
    """Header and one row for each size of shift: successes of those still under way."""
    rows = [["shift", *(words(str(o)) for o in results.object.values)]]
    won, of = counts(results)
    for i, size in enumerate(results["shift"].values):
        cells = []
        for one, every in zip(won[:, i], of[:, i], strict=True):
            low, high = statistics.wilson(int(one), int(every))
            cells.append(f"{one} of {every} ({100 * low:.0f}-{100 * high:.0f} %)")
        rows.append([f"{100 * float(size):g} cm", *cells])
    return rows


def counts(results: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Trials (object, shift) that recovered, and those under way when the object was shifted."""
    counted = results.counted > 0
    both = ("side", "target")
    return (counted & (results.recovered > 0)).sum(both).values, counted.sum(both).values


def paths_figure(found: xr.Dataset) -> Figure:
    """Draw Fig. 7: the ways of the base to every target, and the contact points at the end."""
    names = list(map(str, found.object.values))
    figure = Figure(figsize=(5.2 * len(names), 5), layout="constrained")
    axes = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
    for ax, name in zip(axes, names, strict=True):
        one = found.sel(object=name)
        ax.add_patch(base_patch(np.zeros(3), tuple(found.half.values), fill=True))
        for target in range(found.sizes["target"]):
            (line,) = ax.plot(*one.base_path.values[target].T, lw=1.2)
            at = float(found.target_x[target]), float(found.target_y[target])
            ax.plot(*at, "*", ms=12, color=line.get_color())
            touching = one.contact_path.isel(target=target).dropna("path_time").values
            if len(touching):
                ax.plot(*touching[-1], "o", ms=5, mfc="white", color=line.get_color())
        won = int(one.path_success.sum())
        ax.set(xlabel="x [m]", aspect="equal")
        ax.set_title(f"{words(name)}: {won} of {found.sizes['target']}", fontsize=10)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("y [m]")
    figure.suptitle(
        f"friction ground {MIDDLE.ground:g}, robot {MIDDLE.robot:g}; lines: base; stars: targets; "
        "circles: last contact point",
        fontsize=9,
    )
    return figure


def shift_figure(found: xr.Dataset) -> Figure:
    """Draw success over the size of the shove, with Wilson 95 % intervals."""
    figure = Figure(figsize=(5.5, 3.4), layout="constrained")
    ax = figure.subplots()
    won, of = counts(found)
    size = 100 * found["shift"].values
    for i, name in enumerate(map(str, found.object.values)):
        success_rates(ax, size, won[i], of[i], color=OBJECT_COLOURS[name], label=words(name))
    ax.set(xlabel="the object is moved sideways by [cm]", ylabel="success [%]", ylim=(-3, 103))
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return figure
