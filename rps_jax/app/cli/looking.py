"""The commands to look with: film, gallery, view, doctor."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from rps_jax import errors
from rps_jax.app.cli import parsing, running
from rps_jax.app.cli.options import Asked, Engine, Friction, Strategy
from rps_jax.app.cli.replicating import Table
from rps_jax.app.cli.sweeping import tell_followed
from rps_jax.errors import InputError

if TYPE_CHECKING:
    from rps_jax.app import viewer
    from rps_jax.app.film import Take
    from rps_jax.runs.plan import Plan
    from rps_jax.trials.setting import Setting


@dataclass(frozen=True)
class Film:
    """Film many trials of a run side by side: the targets of a table, or worlds of a sweep."""

    folder: tyro.conf.Positional[Path]
    """Run folder of `rps table` or `rps sweep`."""
    grid: str | None = None
    """Rows and columns of the film; by default 4x6, or with --arms a row for each and 3 columns."""
    object: str = "box"
    """Object to film, of a table."""
    friction: Friction = "S1"
    strategy: Strategy = "rps"
    which: Literal["first", "hardest"] = "first"
    """Whether the first or the hardest worlds of a sweep are filmed."""
    worlds: tuple[int, ...] = ()
    """Indices of the worlds of a sweep that are filmed, instead of --which."""
    arm: str | None = None
    """Which of a sweep's strategies with parameters; by default the first."""
    arms: tuple[str, ...] = ()
    """Several of them, side by side: a row of the film for each, a column for each world."""
    seconds: float | None = None
    """Simulated time that is filmed, at most [s]; by default until the last trial ends."""
    speed: float | None = None
    """Simulated seconds in a second of the film; by default the film lasts less than a minute."""
    camera: Literal["oblique", "above"] = "oblique"
    """From where the film is seen."""
    out: Path | None = None
    """The MP4 to write; by default RUN/film.mp4."""

    def run(self) -> None:
        """Run the trials again and film them."""
        from tqdm import tqdm

        from rps_jax.analysis import video
        from rps_jax.app import film
        from rps_jax.record import folder

        usual = f"{len(self.arms)}x3" if self.arms else "4x6"
        shape = film.shape_of(self.grid or usual)
        for name in ("seconds", "speed"):
            if getattr(self, name) is not None:
                errors.check_finite(name, getattr(self, name), above=0, at_most=1e5)
        out = self.out or self.folder / "film.mp4"
        if out.is_dir():
            raise InputError(f"out = {out} is a folder: name a file, as {out / 'film.mp4'}.")
        if self.out:
            folder.writable(out.parent)
        takes, setting = self.takes(shape)
        for what in video.check():
            if not what.ok:
                raise InputError(what.mend)
        running.use_cache()
        seconds = min(float(setting.rules.horizon), self.seconds or math.inf)
        with (
            tqdm(total=round(seconds), unit="s", desc="film") as bar,
            _one_sentence(video.VideoError),
        ):
            film.shoot(
                takes,
                setting,
                out,
                shape=shape,
                speed=self.speed or film.default_speed(seconds),
                seconds=seconds,
                camera=self.camera,
                report=lambda simulated: bar.update(round(simulated) - bar.n),
            )
        print(f"film: {out}")

    def takes(self, shape: tuple[int, int]) -> tuple[list[Take], Setting]:
        """The trials to film, at most as many as the grid has places, and what they share."""
        from rps_jax.app import film
        from rps_jax.record import folder
        from rps_jax.runs.push import chosen
        from rps_jax.studies.replication.table import cases_of
        from rps_jax.world import paper

        if (self.folder / folder.MANIFEST).exists():
            plan, arm = chosen(self.folder, 0, self.arm)
            tell_followed(self.folder, plan)
            if self.arms:
                film.rows_of(plan, self.arms, shape)
            arms = self.arms or (arm,)
            which = film.worlds_of(plan, self.worlds) if self.worlds else self.which
            return film.of_sweep(self.folder, plan, arms, which, shape), plan.setting
        table = _table_of(self.folder)
        for field, name in (
            ("objects", self.object),
            ("friction", self.friction),
            ("strategies", self.strategy),
        ):
            errors.check_name(f"{field} of the run", name, getattr(table, field))
        conditions = table.conditions()
        arms = parsing.arms_of([self.strategy], table.params)
        targets = (table.targets or paper.TARGETS)[: shape[0] * shape[1]]
        cases = cases_of(arms, [self.object], [self.friction], targets, conditions)
        setting = conditions.setting()
        return film.of_cases(cases, setting), setting


@contextlib.contextmanager
def _one_sentence(kind: type[Exception]) -> Iterator[None]:
    """Report an exception that is a sentence as bad input."""
    try:
        yield
    except kind as error:
        raise InputError(str(error)) from error


def _table_of(run: Path) -> Table:
    """What was asked of `rps table` for the run in a folder."""
    try:
        asked = json.loads((run / "config.json").read_text())["options"]
        return Table(**{name: _tuples(value) for name, value in asked.items()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"run = {run} holds neither a table nor a sweep: give the folder of `rps table` or "
            "`rps sweep`."
        ) from error


def _tuples(value: Any) -> Any:
    """JSON's lists as tuples."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


@dataclass(frozen=True)
class Gallery:
    """Draw maps of what an arm of a sweep lost, by kind, and say what each kind has in common."""

    folder: tyro.conf.Positional[Path]
    """Run folder of a sweep or a ladder."""
    arm: str | None = None
    """Which of its strategies with parameters; by default the first."""
    each: int = 30
    """Number of trials of each kind that are followed again and drawn, at most."""
    out: Path | None = None
    """Folder of what is made; by default RUN/gallery."""

    def run(self) -> None:
        """Follow the losses, draw them, and print the report."""
        import numpy as np

        from rps_jax.record.files import read_results
        from rps_jax.runs.push import chosen
        from rps_jax.studies.failures.gallery import gallery, kinds
        from rps_jax.trials.setting import progress_bar

        errors.check_count("each", self.each, at_most=200)
        plan, name = chosen(self.folder, 0, self.arm)
        tell_followed(self.folder, plan)
        one = read_results(self.folder).sel(arm=name)
        of_kind = kinds(one, float(plan.setting.rules.max_lost))
        _, counts = np.unique(of_kind[of_kind != ""], return_counts=True)
        running.use_cache()
        with progress_bar(int(np.minimum(counts, self.each).sum()), "follow") as report:
            gallery(self.folder, name, self.each, self.out, report=report)
        out = self.out or self.folder / "gallery"
        print((out / "report.md").read_text())
        print(f"gallery: {out}")


@dataclass(frozen=True)
class View(Asked):
    """Push in the browser: watch, drag the target, shove the object, push again."""

    folder: tyro.conf.Positional[Path | None] = None
    """Run folder of a sweep, to begin with one of its worlds; by default the options' push."""
    index: tyro.conf.Positional[int] = 0
    """Index of the world in the sweep."""
    arm: str | None = None
    """Which of the sweep's strategies with parameters; by default the first."""
    object: str = "box"
    """Object to push."""
    target: tuple[float, float] = (-2.0, 0.0)
    """Target X Y [m]."""
    friction: Friction = "S1"
    strategy: Strategy = "rps"
    engine: Engine = "fused"
    mass: float | None = None
    """Mass of the object [kg]; by default its own."""
    rear: Literal["near", "far"] = "near"
    """Side of the nonuniform box on which its load stands, seen from the robot."""
    host: str = "127.0.0.1"
    """Address to serve the page on; by default to this machine alone."""
    port: int = 8080
    """Port to serve the page on; 0 takes any that is free."""

    def run(self) -> None:
        """Serve the page until it is ended."""
        from rps_jax import engines
        from rps_jax.app import viewer
        from rps_jax.runs.push import chosen

        self.conditions().setting()
        asked = viewer.Asked(self.object, self.friction, self.strategy, self.target)
        self.push_of(asked, make=False)
        engines.get(self.engine).check_followed()
        first = partial(self.push_of, asked)
        if self.folder is not None:
            plan, name = chosen(self.folder, self.index, self.arm)
            tell_followed(self.folder, plan)
            first = partial(_push_in_world, plan, name, self.index)
        page = viewer.open_page(self.host, self.port, asked, self.push_of)
        running.use_cache()
        print(f"page: {page.url} (Ctrl-C ends it)", flush=True)
        try:
            page.begin(first)
            page.run()
        except KeyboardInterrupt:
            print("page closed.")
        finally:
            page.close()

    def push_of(self, asked: viewer.Asked, make: bool = True) -> Any:
        """The push that the page asks for; only checked if it shall not be made."""
        from rps_jax.app import viewer
        from rps_jax.trials import pushes
        from rps_jax.trials.stepper import Live

        conditions = self.conditions()
        (params,) = parsing.arms_of([asked.strategy], self.params).values()
        case = conditions.case(asked.object, asked.friction, asked.p_world_target, params)
        if not make:
            return None
        title = (
            f"{case.object.replace('_', ' ')}, friction ground {case.friction.ground:g}, robot "
            f"{case.friction.robot:g}, {asked.strategy}"
        )
        setting = conditions.setting()
        scene = pushes.scene_of(case, setting.physics)
        return viewer.Push(Live.of_case(case, setting), scene, title)


def _push_in_world(plan: Plan, arm: str, index: int) -> viewer.Push:
    """A world of a sweep."""
    from rps_jax.app import viewer
    from rps_jax.control import strategies
    from rps_jax.runs.plan import scene_of, title_of, world_part
    from rps_jax.trials.stepper import Live

    part = world_part(plan, list(plan.arms).index(arm), [index])
    live = Live(part, strategies.of(plan.arms[arm]), plan.setting)
    title = title_of(plan, index).replace("$\\mu$", "friction")
    return viewer.Push(live, scene_of(plan, index), f"{title}, {arm}")


@dataclass(frozen=True)
class Doctor:
    """Print versions, devices and folders, and what does not work with its mend."""

    def run(self) -> None:
        """Print the report."""
        from rps_jax.app import doctor

        running.choose_device("auto")
        print(doctor.report(running.cache_folder()))
