"""Films of many trials side by side, drawn while the trials are stepped together.

Neither trajectories nor images are stored, so memory does not grow with the film.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from rps_jax import errors
from rps_jax.analysis import statistics
from rps_jax.errors import InputError
from rps_jax.record import files, folder
from rps_jax.record.options import option
from rps_jax.runs.plan import Plan, build_batch, scene_of
from rps_jax.runs.push import find_differences, program_slots, select_law
from rps_jax.runs.question import OutputCommand, call_of
from rps_jax.trials import pushes, trial
from rps_jax.trials.progress import Bar, Progress, ProgressCallback
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import WorldBatch, memory_of, rows
from rps_jax.world import video
from rps_jax.world.scene import Scene
from rps_jax.world.video import Shot, Tile

_FILM_SIZE = (1280, 720)  # [px] that the grid is fitted into, or half as much again
_SMALL_TILE = 320  # [px] width of a tile, below which the grid is larger
_GRID_LIMIT = 12  # rows and columns
_LENGTH = 30  # [s] of a film at the default speed, at most
_FREEZE = 1.0  # [s] that the end is held
T = TypeVar("T")
_FPS = 12  # frames per second


@dataclass(frozen=True)
class Film(OutputCommand[Path]):
    """Film many worlds of a sweep side by side."""

    run: str | Path = option("", positional=True)
    """Run folder of `rps sweep`."""
    grid: str | None = None
    """Greatest number of rows and columns, as 4x6; fewer worlds have a smaller grid of larger
    tiles. By default 5x5, or with --laws a row for each and 3 columns; --worlds are all shown."""
    law: str | None = None
    """Which of the run's laws; by default the first."""
    laws: tuple[str, ...] = ()
    """Several of a sweep's laws, side by side: a row of the film for each, a column for each
    world."""
    which: Literal["first", "hardest"] = "first"
    """Whether the first or the hardest worlds of a sweep are filmed."""
    worlds: tuple[int, ...] = option((), 0)
    """Indices of the worlds of a sweep that are filmed, instead of --which."""
    seconds: float | None = option(None, above=0, at_most=1e5, unit="s")
    """Simulated time that is filmed, at most [s]; by default until the last trial ends."""
    speed: float | None = option(None, above=0, at_most=1e5)
    """Simulated seconds in a second of the film; by default the film lasts less than a minute."""
    camera: Literal["oblique", "above"] = "oblique"
    """From where the film is seen."""
    out: Path | str | None = option(None, kw_only=True)
    """The MP4 to write; by default RUN/film.mp4."""

    @property
    def default_folder(self) -> Path:
        """The MP4."""
        return Path(self.run) / "film.mp4"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, at most."""
        if self.grid is None:
            rows = len(self.laws) if len(self.laws) > 1 else 0
            columns = _GRID_LIMIT if self.worlds else 3 if rows else 5
            return rows or columns, columns
        match = re.fullmatch(r"([1-9]|1[0-2])x([1-9]|1[0-2])", self.grid)
        if match is None:
            rule = f"write ROWSxCOLUMNS, as 4x6, each from 1 to {_GRID_LIMIT}"
            raise errors.not_allowed("grid", self.grid, rule)
        return int(match[1]), int(match[2])

    def check(self) -> None:
        """Check the grid, the file and the selected trials."""
        if self.laws and self.law is not None:
            raise errors.not_allowed("law", self.law, "laws name those that are filmed; omit one")
        out = Path(self.out or self.default_folder)
        if out.is_dir():
            raise InputError(f"out = {out} is a folder: name a file, as {out / 'film.mp4'}.")
        folder.read_manifest(Path(self.run))
        folder.ensure_writable(out.parent)
        for fix in video.check().values():
            if fix:
                raise InputError(fix)
        self.takes()

    def progress_bar(self) -> Bar:
        """A bar over simulated time."""
        return Bar(self.name, self._length(self.takes()[1]), "simulated", shown=self.shows_progress)

    def _length(self, setting: Setting) -> float:
        """Simulated time that is filmed, at most [s]."""
        return min(float(setting.rules.horizon), self.seconds or math.inf)

    def execute(self, callback: ProgressCallback) -> Path:
        """Run the trials again and film them."""
        out = Path(self.out or self.default_folder)
        if self.conflict(out) and not self.overwrite:
            rule = "choose another file, or replace it by --overwrite (in Python overwrite=True)"
            raise InputError(f"out = {out} exists: {rule}.")
        takes, setting = self.takes()
        seconds = self._length(setting)
        speed = self.speed or float(max(1, math.ceil(seconds / _LENGTH)))
        tiles = [map(take.tile, range(len(take.scenes))) for take in takes]
        frames = _frames(takes, setting, speed, seconds, callback)
        ordered = _in_grid_order(tiles, takes)
        shape = fitted_grid(len(ordered), self.shape, rows=len(self.laws))
        grid = {"shape": shape, "size": _tile_size(shape), "camera": self.camera}
        video.render(ordered, frames, out, fps=_FPS, **grid)
        return out

    def takes(self) -> tuple[list[Take], Setting]:
        """Return the trials to film, limited by the grid, and their setting."""
        run = Path(self.run)
        plan, law = select_law(run, 0, self.law)
        selection = self.worlds or self.which
        return of_sweep(run, plan, self.laws or (law,), selection, self.shape), plan.setting


film = call_of(Film)


class Take(NamedTuple):
    """Filmed trials that one program steps."""

    tiles: Sequence[int]  # indices in the grid, row by row
    part: WorldBatch
    scenes: Sequence[Scene]
    labels: Sequence[str]
    slots: int  # of the program
    compare: Callable[[Outcome], object]  # warns of trials that end otherwise than in the sweep

    def tile(self, i: int) -> Tile:
        """Return the picture of one trial, with the lines of its task."""
        world = rows(self.part.worlds, i)
        return Tile(self.scenes[i], world.p_world_target, world.task.lines())


def of_sweep(
    run: Path,
    plan: Plan,
    laws: Sequence[str],
    selection: str | Sequence[int],
    shape: tuple[int, int],
) -> list[Take]:
    """Return the takes of worlds of a sweep, with a row of the grid for each of several laws.

    The `selection` is `first`, `hardest` (as in the report of the sweep), or indices; `shape` is
    rows and columns of the grid, at most.

    Raises:
      InputError: the plan has not these laws and worlds, or the grid no room for them.
    """
    errors.check_each_once("laws", laws)
    for law in laws:
        errors.check_name("law", law, plan.laws)
    if len(laws) not in (1, shape[0]):
        grid = f"{shape[0]}x{shape[1]}"
        raise errors.not_allowed("grid", grid, f"it must have a row for each of {len(laws)} laws")
    count = shape[0] * shape[1] if len(laws) == 1 else shape[1]
    if not isinstance(selection, str):
        errors.check_each_once("worlds", selection)
        for world in selection:
            errors.check_count("worlds", world, at_least=0, at_most=plan.worlds - 1)
        if len(selection) > count:
            rule = f"the film has room for {count}: name fewer, or a larger --grid"
            raise errors.not_allowed("number of worlds", len(selection), rule)
        index = np.asarray(selection, int)
    elif selection == "first":
        index = np.arange(min(count, plan.worlds))
    else:
        index = statistics.hardest(files.read_results(run), count)
        if not index.size:
            raise errors.not_allowed("which", selection, "no trial of this run failed")
    of_object = plan.object_of(index)
    takes = []
    for row, law in enumerate(laws):
        prefix = f"{law}, " if len(laws) > 1 else ""
        for object_index in np.unique(of_object):
            columns = np.flatnonzero(of_object == object_index)
            worlds = index[columns].tolist()
            tiles = (row * index.size + columns).tolist()
            part = build_batch(plan, law, index[columns])
            scenes = [scene_of(plan, i) for i in worlds]
            slots = program_slots(run, plan, law, worlds[0])
            labels = [f"{prefix}world {i}" for i in worlds]
            compare = partial(find_differences, run, law, worlds)
            takes.append(Take(tiles, part, scenes, labels, slots, compare))
    return takes


def fitted_grid(tiles: int, shape: tuple[int, int], rows: int = 1) -> tuple[int, int]:
    """Return rows and columns, at most `shape`, of the grid with the largest tiles.

    Of several `rows`, each has the tiles of one law.
    """
    if rows > 1:
        return rows, tiles // rows
    grids = [(-(-tiles // columns), columns) for columns in range(1, shape[1] + 1)]
    return min((grid for grid in grids if grid[0] <= shape[0]), key=lambda x: (max(x), *x))


def _tile_size(shape: tuple[int, int]) -> tuple[int, int]:
    """Return even width and height [px] of the largest tiles of 16 to 9 that fit."""
    rows_, columns = shape
    unit = min(_FILM_SIZE[0] / columns / 16, _FILM_SIZE[1] / rows_ / 9)
    unit = max(unit, min(1.5 * unit, _SMALL_TILE / 16))
    return 2 * int(8 * unit), 2 * int(4.5 * unit)


def _in_grid_order(items: Iterable[Iterable[T]], takes: Sequence[Take]) -> list[T]:
    """Return the items of all takes, one per trial, in the order of the grid."""
    tiles = [tile for take in takes for tile in take.tiles]
    flat = list(itertools.chain.from_iterable(items))
    return [flat[i] for i in np.argsort(tiles)]


def _frames(
    takes: Sequence[Take],
    setting: Setting,
    speed: float,
    seconds: float,
    callback: ProgressCallback,
) -> Iterator[list[Shot]]:
    """Yield the contents of all tiles, frame by frame."""
    period = setting.physics.control_period
    interval = max(1, round(speed / (_FPS * period)))  # control steps
    running = [_shots(take, setting, interval) for take in takes]
    shots: list[Shot] = []
    # One frame more for whole trials, whose ends are drawn a step later.
    whole = seconds >= float(setting.rules.horizon)
    for count in range(math.floor(seconds / (interval * period)) + 1 + whole):
        ended, of_takes = zip(*map(next, running), strict=True)
        shots = _in_grid_order(of_takes, takes)
        yield shots
        callback(Progress(0, count * interval * period))
        if all(ended):
            break
    for _ in range(round(_FREEZE * _FPS)):
        yield shots


def _shots(take: Take, setting: Setting, interval: int) -> Iterator[tuple[bool, list[Shot]]]:
    """Yield whether all trials of a take have ended, and their tiles, at each interval."""
    ended = np.zeros(len(take.labels), bool)
    period, shots = setting.physics.control_period, list[Shot]()
    moments = pushes.watch(take.part, setting, interval=interval * period, slots=take.slots)
    for trials, moment, outcomes in moments:
        contacts = np.asarray(trial.p_world_contact(moment))
        states = [rows((take.part.inputs[1], trials.law_state), i) for i in range(len(ended))]
        modes, objects = zip(*(memory_of(*x) for x in states), strict=True)
        times = trials.steps * period
        status = map(_status, trials.done, trials.success, times, modes)
        texts = [f"{label}\n{state}" for label, state in zip(take.labels, status, strict=True)]
        fresh = map(Shot, moment.qpos, contacts, texts, objects)
        # An unchanged shot is not drawn again.
        shots = [shots[i] if ended[i] else shot for i, shot in enumerate(fresh)]
        ended = trials.done
        if ended.all():
            take.compare(outcomes)
        yield bool(ended.all()), shots
    yield from itertools.repeat((True, shots))


def _status(done: bool, success: bool, time: float, mode: str) -> str:
    """Return the state of a trial after this time [s], with the mode of its law."""
    if not done:
        return f"{time:.0f} s, {mode}" if mode else f"{time:.0f} s"
    return f"reached at {time:.0f} s" if success else "not reached"
