"""The commands that replicate the paper: table, push, hardware, paper."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rps_jax.app.cli import parsing, running
from rps_jax.app.cli.options import (
    Friction,
    Recorded,
    Skin,
    Spread,
    Strategies,
    Strategy,
    StudyOptions,
)

if TYPE_CHECKING:
    from rps_jax.runs.push import Push as Seen


@dataclass(frozen=True)
class Objects(Recorded):
    """Trials of the paper's objects."""

    mass: float | None = None
    """Mass of the object [kg]; by default its own."""
    rear: Literal["near", "far"] = "near"
    """Side of the nonuniform box on which its load stands, seen from the robot."""


@dataclass(frozen=True)
class Table(Spread, Objects):
    """Run the paper's trials and print Table II beside the paper's."""

    objects: tuple[str, ...] = ("box", "cylinder", "nonuniform_box")
    """Objects to push."""
    strategies: Strategies = ("rps", "nps", "aps")
    friction: tuple[Friction, ...] = ("S1", "S2")
    targets: tuple[tuple[float, float], ...] = ()
    """Targets X Y [m], one pair after the other; by default the paper's 24."""

    def run(self) -> None:
        """Run the trials, then write and print the table."""
        from rps_jax.analysis import figures, tables
        from rps_jax.record import files
        from rps_jax.studies.replication.table import cases_of, table
        from rps_jax.trials.setting import progress_bar
        from rps_jax.world import paper

        conditions = self.conditions()
        conditions.setting()
        arms = parsing.arms_of(self.strategies, self.params)
        targets = self.targets or paper.TARGETS
        shape = self.shape()
        cases = cases_of(arms, self.objects, self.friction, targets, conditions)
        out = self.open("table", self.strategies)
        with progress_bar(len(cases)) as report:
            results = table(
                self.objects,
                arms,
                self.friction,
                targets,
                **conditions.__dict__,
                **shape,
                report=report,
            )
        files.write_results(out / "results.nc", results)
        title = "Successes, with Wilson 95 % intervals in percent"
        counts = tables.markdown(tables.table_ii(results))
        text = f"{title}\n\n{counts}\n\n{tables.summary(results)}\n"
        files.write_text(out / "table.txt", text)
        figures.min_distance(results, out / "min_distance.png")
        print(text)
        running.tell(report.timing)
        print(f"run folder: {out}")


@dataclass(frozen=True)
class Push(Objects):
    """Run one trial; draw the paper's Fig. 6 and film it."""

    object: str = "box"
    """Object to push."""
    target: tuple[float, float] = (-2.0, 0.0)
    """Target X Y [m]."""
    friction: Friction = "S1"
    strategy: Strategy = "rps"
    video: bool = True
    """Whether to film the push."""
    film_length: float = 12.0
    """Length of the film [s], whatever the trial's."""

    def run(self) -> None:
        """Follow the trial, then show it."""
        from rps_jax import engines
        from rps_jax.runs.push import check_length, push
        from rps_jax.trials.setting import clock

        conditions = self.conditions()
        conditions.setting()
        (params,) = parsing.arms_of([self.strategy], self.params).values()
        conditions.case(self.object, self.friction, self.target, params)
        engines.get(self.engine).check_followed()
        check_length(self.film_length)
        out = self.open("push", (self.strategy,))
        with clock(self.horizon) as report:
            seen = push(
                self.object,
                self.target,
                self.friction,
                params,
                report=report,
                **conditions.__dict__,
            )
        show(seen, self.object, out, self.film_length if self.video else None)


def show(seen: Seen, name: str, out: Path, film: float | None) -> None:
    """Results, figure, film of some length [s] and a line on the screen for one trial."""
    from tqdm import tqdm

    from rps_jax.analysis import video
    from rps_jax.record import files

    files.write_results(out / "results.nc", seen.data)
    seen.plot(out / "trial.png")
    result = seen.outcome
    x, y = seen.trace.p_world_target
    print(
        f"{name}, target ({x:g}, {y:g}) m: "
        f"{'reached' if result.success else 'not reached'} at {float(result.time):.1f} s, "
        f"least distance {float(result.min_distance):.3f} m, "
        f"contact lost for {float(result.contact_lost_time):.1f} s"
    )
    running.tell(seen.trace.timing)
    if film is not None:
        try:
            seen.stills(out / "stills.png")
            watch = lambda frames: tqdm(frames, unit="frame", desc="film")  # noqa: E731
            seen.film(out / "push.mp4", film, watch=watch)
        except video.VideoError as error:
            print(f"no video: {error}")
    print(f"run folder: {out}")


@dataclass(frozen=True)
class Hardware(Spread, Recorded):
    """Run the paper's hardware experiments in simulation, over a range of friction; draw Fig. 7."""

    skin: Skin = "hardware"
    layout: Literal["circle", "grid"] = "circle"
    """The eight targets: circle puts each 2.1 m from the start, grid 2.1 m apart in x and y."""

    def run(self) -> None:
        """Run the experiments, then write and print the report."""
        from rps_jax import engines
        from rps_jax.analysis import figures
        from rps_jax.record import files
        from rps_jax.studies.replication import hardware, reproduce
        from rps_jax.trials.setting import progress_bar
        from rps_jax.world import paper

        conditions = self.conditions()
        setting = conditions.setting()
        (params,) = parsing.arms_of(["rps"], self.params).values()
        targets = paper.HARDWARE_LAYOUTS[self.layout]
        case = conditions.case(paper.HARDWARE_OBJECTS[0], hardware.MIDDLE, targets[0], params)
        engines.get(self.engine).check_followed()  # by Fig. 7
        shape = self.shape()
        out = self.open("hardware", ("rps",))
        pairs = len(paper.HARDWARE_OBJECTS) * len(targets)
        with progress_bar(pairs * len(hardware.frictions())) as report:
            results = hardware.run(case, setting, layout=self.layout, **shape, report=report)
        files.write_results(out / "results.nc", results)
        with progress_bar(2 * pairs * len(hardware.SHIFTS)) as report:
            shifted = hardware.disturb(case, setting, layout=self.layout, **shape, report=report)
        files.write_results(out / "shifted.nc", shifted)
        figures.paths(hardware.paths(case, setting, layout=self.layout), out / "paths.png")
        reproduce.report_to(out, reproduce.hardware_sections(out, results, shifted))
        print((out / "report.md").read_text())
        print(f"run folder: {out}")


@dataclass(frozen=True)
class Paper(StudyOptions):
    """Reproduce all of the paper into one run folder, with report.md and report.html."""

    out: Path = Path("runs/paper")
    """Run folder; a run that was killed is continued there. Choose another folder than the default
    for --quick, if you want both."""
    quick: bool = False
    """Whether to run Table II in full, but of everything else only a few conditions, with RPS alone
    and four of 24 targets."""

    def run(self) -> None:
        """Run what is missing, then write the report."""
        from rps_jax.record import folder
        from rps_jax.studies.replication import reproduce
        from rps_jax.trials.setting import progress_bar

        plan = reproduce.Plan.quick() if self.quick else reproduce.Plan()
        with self.opened() as out:
            folder.claim(out, dataclasses.asdict(plan))
            with progress_bar(plan.trials()) as report:
                path = reproduce.run(out, plan, report=report, **self.shape())
        print(f"report: {path}")
