"""All of the paper in one run folder: tables, figures, hardware experiments, and what it leaves
open. Every part leaves its file as soon as it is done, and a part whose file is there is not run
again, so a run that was killed continues.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax.analysis import figures, statistics, tables, video
from rps_jax.analysis.report import Section, write_report
from rps_jax.control.law import RPSParams
from rps_jax.engines import EngineName
from rps_jax.record import files, provenance
from rps_jax.record.checkpoint import Parts
from rps_jax.studies import fidelity, study
from rps_jax.studies.replication import ambiguity, hardware
from rps_jax.studies.study import Condition, Grid
from rps_jax.trials import pushes
from rps_jax.trials.pushes import Case
from rps_jax.trials.results import title_of, trace_dataset
from rps_jax.trials.setting import Progress, Report, Setting, unheard
from rps_jax.world import paper, scene
from rps_jax.world.objects import PAPER_OBJECTS
from rps_jax.world.scene import FRICTION

_FIG_6 = Case("box", FRICTION["S1"], (-2.0, 0.0))


@dataclass(frozen=True)
class Plan:
    """How much to run."""

    engine: EngineName = "mjx"  # of Table II and Fig. 6
    # Of the studies; Table II has all.
    targets: tuple[tuple[float, float], ...] = paper.TARGETS
    strategies: tuple[str, ...] = paper.STRATEGIES
    fidelity: tuple[str, ...] = tuple(fidelity.CONDITIONS)
    readings: tuple[str, ...] = tuple(ambiguity.READINGS)
    gazebo: tuple[str, ...] = tuple(ambiguity.GAZEBO)
    tolerances: tuple[float, ...] = ambiguity.TOLERANCES
    shifts: tuple[float, ...] = hardware.SHIFTS

    @classmethod
    def quick(cls) -> Plan:
        """RPS to four of 24 targets under the most telling conditions, for a first look."""
        return cls(
            engine="fused",
            targets=study.FEW_TARGETS,
            strategies=("rps",),
            fidelity=fidelity.QUICK,
            readings=ambiguity.QUICK_READINGS,
            gazebo=ambiguity.QUICK_GAZEBO,
            tolerances=ambiguity.QUICK_TOLERANCES,
            shifts=(0.1, 0.2, 0.3),
        )

    @property
    def all_strategies(self) -> Grid:
        """The studies' trials of all strategies."""
        return Grid(strategies=self.strategies, targets=self.targets)

    @property
    def rps_alone(self) -> Grid:
        """The studies' trials of RPS."""
        return Grid(targets=self.targets)

    def trials(self) -> int:
        """How many trials the whole plan counts."""
        table = Grid(strategies=paper.STRATEGIES).size
        many = len(self.fidelity) + len(self.gazebo)
        few = len(self.readings) + len(ambiguity.ON_LOSS) * len(self.tolerances)
        targets = len(paper.HARDWARE_LAYOUTS["circle"])
        hard = (
            len(paper.HARDWARE_OBJECTS)
            * targets
            * (len(hardware.frictions()) + 2 * len(self.shifts))
        )
        return table + many * self.all_strategies.size + few * self.rps_alone.size + hard


class _Progress:
    """Progress of the whole from the progress of its parts."""

    def __init__(self, report: Callable[[Progress], Any]):
        self._report = report
        self._before = Progress(0, 0.0)
        self._last = Progress(0, 0.0)

    def part(self) -> Callable[[Progress], None]:
        """What the next part reports to."""
        self._before = self._last

        def tell(progress: Progress) -> None:
            self._last = Progress(
                self._before.finished + progress.finished,
                self._before.simulated + progress.simulated,
            )
            self._report(self._last)

        return tell

    def skip(self, trials: int) -> None:
        """A part that was found done."""
        self.part()(Progress(trials, 0.0))


def run(
    out: Path,
    plan: Plan,
    *,
    report: Report = unheard,
    **shape: Any,
) -> Path:
    """Run what is missing and write the report; returns the path of `report.html`."""
    progress = _Progress(report)
    sections = [
        *_setup(out),
        *_table_ii(out, plan, progress, shape),
        *_one_trial(out, plan, progress),
        *_hardware(out, plan, progress, shape),
        *_fidelity(out, plan, progress, shape),
        *_gazebo(out, plan, progress, shape),
        *_readings(out, plan, progress, shape),
        *_curve(out, plan, progress, shape),
    ]
    return report_to(out, sections)


def report_to(out: Path, sections: list[Section]) -> Path:
    """`report.md` and `report.html`, with what they were made by."""
    intro = (
        "The numbers of the paper *Pushing in the Dark* beside ours. Intervals: Wilson 95 %.\n\n"
        + provenance.told(out)
    )
    return write_report(out, "Pushing in the Dark, reproduced", intro, sections)


def _folder(out: Path, name: str) -> Path:
    folder = out / name
    folder.mkdir(exist_ok=True)
    return folder


def _kept(
    out: Path, name: str, trials: int, progress: _Progress, make: Callable[..., xr.Dataset]
) -> xr.Dataset:
    """A part's results: read if it is finished, else made with a progress; also in `NAME.nc`."""
    parts = Parts(out)
    if parts.get(name) is not None:
        progress.skip(trials)
    results = parts.results(name, lambda: make(progress.part()))
    files.write_results(out / f"{name}.nc", results)
    return results


def _setup(out: Path) -> list[Section]:
    rows = [["", *FRICTION]]
    for i, name in enumerate(("object-ground", "object-robot")):
        rows.append([name, *(f"{friction[i]:g}" for friction in FRICTION.values())])
    picture = out / "profile.png"
    figures.profile(RPSParams.paper(), picture)
    return [
        Section("Table I: friction", "As in the paper, by construction.", rows),
        Section("Fig. 3: the adaptive rate", "", (), picture),
        *_objects(out),
    ]


def _objects(out: Path) -> list[Section]:
    path = out / "objects.png"
    try:
        images = []
        for name in PAPER_OBJECTS:
            shown = scene.load(name)
            images.append(
                video.snapshot(shown, scene.initial_qpos(shown), p_world_target=np.array([2, 0]))
            )
        figures.stills(images, PAPER_OBJECTS, path)
    except video.VideoError as error:
        return [Section("Fig. 4: the objects", f"Not drawn: {error}")]
    return [Section("Fig. 4: the objects", "", (), path)]


def _table_ii(out: Path, plan: Plan, progress: _Progress, shape: dict[str, Any]) -> list[Section]:
    name = {"mjx": "standard", "fused": "fused_standard"}[plan.engine]
    standard = {name: fidelity.CONDITIONS[name]}
    grid = Grid(strategies=paper.STRATEGIES)
    results = study.run(standard, grid, _folder(out, "trials"), **shape, report=progress.part())
    results = results.sel(condition=name)
    picture = figures.min_distance(results, out / "min_distance.png")
    text = "  \n".join(tables.summary(results).splitlines())
    return [
        Section("Table II: successes of 24", text, tables.table_ii(results)),
        Section("Fig. 5: least distance of contact to target", "", (), picture),
    ]


def _one_trial(out: Path, plan: Plan, progress: _Progress) -> list[Section]:
    picture = out / "trial.png"

    def follow(tell: Any) -> xr.Dataset:
        (trace,) = pushes.follow([_FIG_6], Setting(engine=plan.engine))
        seen = trace_dataset(trace)
        figures.one_trial(seen, title_of(_FIG_6), picture)
        return seen

    seen = _kept(out, "trial", 0, progress, follow)
    reached = "reached" if int(seen.outcome_success) else "not reached"
    text = f"The target is {reached} at {float(seen.outcome_time):.1f} s."
    return [Section("Fig. 6: the box to (-2, 0) under S1", text, (), picture)]


def _hardware(out: Path, plan: Plan, progress: _Progress, shape: dict[str, Any]) -> list[Section]:
    base = Case("hardware_box", hardware.MIDDLE, (2.1, 0.0), skin=hardware.SKIN)
    setting = Setting(engine="fused")
    each = len(paper.HARDWARE_OBJECTS) * len(paper.HARDWARE_LAYOUTS["circle"])
    results = _kept(
        out,
        "hardware",
        each * len(hardware.frictions()),
        progress,
        lambda tell: hardware.run(base, setting, report=tell, **shape),
    )
    shifted = _kept(
        out,
        "shifted",
        each * 2 * len(plan.shifts),
        progress,
        lambda tell: hardware.disturb(base, setting, shifts=plan.shifts, report=tell, **shape),
    )
    if not (out / "paths.png").exists():
        figures.paths(hardware.paths(base, setting), out / "paths.png")
    return hardware_sections(out, results, shifted)


def hardware_sections(out: Path, results: xr.Dataset, shifted: xr.Dataset) -> list[Section]:
    """The hardware experiments, with `paths.png` of the same folder."""
    friction = (
        f"Friction was not measured: object-ground {paper.HARDWARE_GROUND} and object-robot "
        f"{paper.HARDWARE_ROBOT}, every pair. Skin: 42 taxels, noise and unequal gains. D and time "
        "are means over successes; in brackets the least and greatest mean among the frictions."
    )
    ground, robot = hardware.MIDDLE
    shove = (
        f"{hardware.SHIFT_TIME:g} s after the start the object is moved at once along the front of "
        f"the robot, to either side (friction {ground:g}, {robot:g}). Trials that had ended by "
        "then are not counted."
    )
    picture = figures.shift_curve(hardware.recovered(shifted), out / "shifted.png")
    return [
        Section("Hardware experiments", friction, hardware.table(results)),
        Section("Fig. 7: paths of the base", "", (), out / "paths.png"),
        Section("The object shoved aside", shove, hardware.shift_table(shifted), picture),
    ]


def _fidelity(out: Path, plan: Plan, progress: _Progress, shape: dict[str, Any]) -> list[Section]:
    whole = plan.targets == paper.TARGETS
    folder = _folder(out, "trials" if whole else "few_trials")
    results = fidelity.run(
        plan.fidelity, plan.all_strategies, folder, **shape, report=progress.part()
    )
    files.write_results(out / "fidelity.nc", results)
    base = results.success.sel(condition=fidelity.REFERENCE)
    names = [str(name) for name in results.condition.values if name != fidelity.REFERENCE]
    against = [statistics.compare(base, results.success.sel(condition=name)) for name in names]
    picture = figures.agreement(
        [str(results.what.sel(condition=name).values) for name in names],
        np.array([c.equal for c in against]),
        np.array([c.equal_interval for c in against]),
        out / "fidelity.png",
    )
    text = (
        f"{plan.all_strategies.size} trials a row, compared one by one with C MuJoCo run to "
        "convergence. Successes are summed over both frictions; +/- are trials gained and lost "
        "against the reference, p is of McNemar's exact test; the error is of the object's place "
        "5 s after the start (RPS); the cost is wall clock for a simulated second of one world "
        "while these trials ran."
    )
    return [
        Section("Fidelity of the physics", text, fidelity.table(results), picture),
        Section(
            "Agreement by strategy",
            "Share of outcomes equal to the reference's.",
            fidelity.by_strategy(results),
        ),
    ]


def _gazebo(out: Path, plan: Plan, progress: _Progress, shape: dict[str, Any]) -> list[Section]:
    results = _study(
        out, "gazebo", ambiguity.GAZEBO, plan.gazebo, plan.all_strategies, progress, shape
    )
    cells = ambiguity.cells(results)
    inside = sum("yes" in row for row in cells[1:])
    rps = sum("yes" in row for row in cells[1:] if row[0].startswith("RPS"))
    text = (
        "Hypothesis: the paper's 17 lost RPS trials come from its simulator (friction pyramid, "
        f"thin contact sensor), not from its law. With both, {inside} of {len(cells) - 1} cells "
        f"lie within the Wilson 95 % interval of the paper's count, {rps} of 6 for RPS."
    )
    ingredients = [
        Section(
            f"What each ingredient does alone: {strategy.upper()}",
            "",
            study.rows(results, ambiguity.DEFAULT, strategy),
        )
        for strategy in plan.strategies
    ]
    return [Section("Did the simulator lose the paper's trials?", text, cells), *ingredients]


def _study(
    out: Path,
    name: str,
    conditions: dict[str, Condition],
    chosen: tuple[str, ...],
    grid: Grid,
    progress: _Progress,
    shape: dict[str, Any],
) -> xr.Dataset:
    results = study.run(
        {key: conditions[key] for key in chosen},
        grid,
        _folder(out, name),
        **shape,
        report=progress.part(),
    )
    files.write_results(out / f"{name}.nc", results)
    return results


def _readings(out: Path, plan: Plan, progress: _Progress, shape: dict[str, Any]) -> list[Section]:
    results = _study(
        out, "readings", ambiguity.READINGS, plan.readings, plan.rps_alone, progress, shape
    )
    text = (
        f"{plan.rps_alone.size} RPS trials a row; counts for S1 and S2. Against the first row: "
        "trials gained and lost, and the false discovery rate q of McNemar's exact test; * marks "
        "q < 0.05. Differences without a star are noise."
    )
    table = study.rows(results, ambiguity.DEFAULT)
    chosen = [["open", "our reading", "because"], *map(list, ambiguity.CHOICES)]
    return [
        Section("What the paper leaves open, one reading at a time", text, table),
        Section("What we chose", "", chosen),
    ]


def _curve(out: Path, plan: Plan, progress: _Progress, shape: dict[str, Any]) -> list[Section]:
    conditions = ambiguity.curve(plan.tolerances)
    results = _study(out, "curve", conditions, tuple(conditions), plan.rps_alone, progress, shape)
    curve = ambiguity.by_tolerance(results, plan.tolerances)
    trials = plan.rps_alone.size // len(PAPER_OBJECTS)
    picture = figures.tolerance_curve(curve, trials, out / "tolerance.png")
    text = f"RPS, {trials} trials a point, isotropic friction."
    return [Section("Skin tolerance and behaviour on loss of contact", text, (), picture)]
