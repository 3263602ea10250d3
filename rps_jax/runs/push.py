"""The commands `push` and `replay`: one trial over time, with its data, figure and film.

`push` runs a named case; `replay` runs one world of a sweep again. The result is a `Trace`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.analysis.report import Picture, Section
from rps_jax.control import registry
from rps_jax.control.base import Law, LawParams, Senses
from rps_jax.control.observation import Twist
from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import bag as bags
from rps_jax.record import files, folder, provenance
from rps_jax.record.bag import Step
from rps_jax.record.files import JsonObject
from rps_jax.record.options import option
from rps_jax.runs.plan import (
    Plan,
    attributes_of,
    build_batch,
    load_plan,
    scene_of,
    world_title,
)
from rps_jax.runs.question import Question, Run, SimulationQuestion, call_of
from rps_jax.trials import pushes
from rps_jax.trials.batch import slots_of
from rps_jax.trials.case import Case, TrialOptions
from rps_jax.trials.progress import Bar
from rps_jax.trials.pushes import Trajectory
from rps_jax.trials.results import trace_dataset
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome, object_pose, p_world_contact
from rps_jax.trials.worlds import WorldBatch, memory_of, rows
from rps_jax.world import paper, tasks
from rps_jax.world.scene import Scene

if TYPE_CHECKING:
    from rps_jax.analysis.figures.style import Figure
    from rps_jax.world.rendering import Tile


_STILL = (960, 540)  # [px] width and height of one of several pictures side by side
FILM_LENGTH = 10.0  # [s] default, whatever the length of the trial


@dataclass(frozen=True, repr=False)
class Trace(Trajectory):
    """Recorded trial, with its scene and its figures."""

    scene: Scene
    title: str
    engine: str
    attrs: Mapping[str, str | int] = field(default_factory=dict)  # of `data`

    def __repr__(self) -> str:
        return f"<Trace of {self.title}: {self.summary}>"

    @property
    def _tile(self) -> Tile:
        """The trial in pictures."""
        from rps_jax.world.rendering import Tile

        return Tile(self.scene, self.p_world_target, self.world.task.lines())

    @property
    def summary(self) -> str:
        """Outcome in words."""
        outcome, (x, y) = self.outcome, self.p_world_target
        if outcome.diverged:
            cause = "the law returned NaN" if outcome.nan_twist else "the physics ran away"
            return f"diverged at {float(outcome.time):.2f} s, since {cause}"
        parts = [f"least distance {float(outcome.min_distance):.3f} m"]
        contact = "not felt" if outcome.unfelt else "lost"
        parts.append(f"contact {contact} for {float(outcome.contact_lost_time):.1f} s")
        if outcome.repositions:
            parts[-1] += f" in {int(outcome.repositions)} repositions"
        if np.isinf(outcome.min_distance):
            parts = ["never touched"]
        elif "progress" in outcome.task:
            parts.append(f"{100 * float(outcome.task['progress']):.0f} % of the path passed")
        distance, turn = (outcome.task.get(f"{x}_error", np.nan) for x in ("place", "heading"))
        if np.isfinite(distance):
            parts.append(f"face off by {distance:.3f} m and {turn:.3f} rad")
        parts += tasks.failures_of(outcome.task)
        return (
            f"target ({x:g}, {y:g}) m {'reached' if outcome.success else 'not reached'} at "
            f"{float(outcome.time):.1f} s, {', '.join(parts)}"
        )

    @property
    def data(self) -> xr.Dataset:
        """The trial over time: variables (time, ...), its outcome as scalars."""
        return trace_dataset(self).assign_attrs(self.attrs)

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw the trial as Fig. 6 of the paper does; with a path it is written there, too."""
        from rps_jax.analysis.figures.paper import one_trial
        from rps_jax.analysis.report import save

        drawn = one_trial(self.data, self.title)
        if path is not None:
            save(drawn, Path(path))
        return drawn

    def stills(self, count: int = 6) -> Figure:
        """Draw images of the trial at equal intervals, side by side.

        Raises:
          VideoError: this machine cannot draw.
        """
        from rps_jax.analysis.figures.paper import stills
        from rps_jax.world import rendering

        shown = _evenly_spaced(len(self.snapshots.time), count)
        tiles = [self._tile] * len(shown)
        with rendering.open_renderers(tiles, _STILL, "oblique") as renderers:
            poses = zip(renderers, self.snapshots.qpos[shown], strict=True)
            images = [renderer.draw(qpos, rendering.NO_CONTACT) for renderer, qpos in poses]
        return stills(images, [f"{self.snapshots.time[i]:.0f} s" for i in shown])

    @device.standard_jax()
    def film(
        self,
        path: str | Path,
        seconds: float = FILM_LENGTH,
        *,
        fps: int = 20,
        size: tuple[int, int] = (960, 540),
        watch: Callable[[Iterable[ArrayLike]], Iterable[ArrayLike]] = iter,
    ) -> Path:
        """Write an MP4 of the trial.

        Args:
          path: of the MP4.
          seconds: length of the film, whatever the trial's.
          fps: frames per second of the film.
          size: width and height [px], even numbers.
          watch: wraps the iterable of frames, as `tqdm.tqdm` does.

        Raises:
          InputError: the length, rate or size is not allowed.
          VideoError: this machine cannot draw or encode.
        """
        from rps_jax.world import video

        errors.check_finite("film_length", seconds, above=0, at_most=600, unit="s")
        shown = _evenly_spaced(len(self.snapshots.time), round(seconds * fps))
        contacts = np.asarray(p_world_contact(self.snapshots))[shown]
        states = [rows(self.law_states, i) for i in shown]
        memories = (memory_of(self.params, state) for state in states)
        poses = watch(self.snapshots.qpos[shown])
        marks = zip(poses, contacts, memories, strict=True)
        shots = ([video.Shot(qpos, at, *memory)] for qpos, at, memory in marks)
        video.render([self._tile], shots, Path(path), fps=fps, size=size)
        return Path(path)


@dataclass(frozen=True)
class TraceQuestion(Question[Trace]):
    """Base class of questions whose answer is one trial over time."""

    IGNORED_FIELDS = ("bag",)

    bag: str | Path | None = option(None, kw_only=True)
    """MCAP file to write: the trial as messages of ROS 2, which Foxglove shows (extra bags)."""

    def check(self) -> None:
        if self.bag is not None:
            bags.check()
            if files.suffix_of(self.bag) != ".mcap" or Path(self.bag).is_dir():
                raise errors.not_allowed("bag", self.bag, "name a file, as push.mcap")
            folder.ensure_writable(Path(self.bag).parent)

    def record(
        self, world: WorldBatch, setting: Setting, run: Run, slots: int | None = None
    ) -> Trajectory:
        """Run a world and record it, and write its bag if one is named."""
        options: Any = {"slots": slots, "callback": run.callback}
        if self.bag is None:
            return pushes.record_batch(world, setting, **options)[0]
        period, law = setting.physics.control_period, recorded_law(world.law)
        (fine,) = pushes.record_batch(world, setting, law, interval=period, **options)
        details, observations = tuple(fine.snapshots.details)  # of `recorded_law`
        fine = dataclasses.replace(fine, snapshots=fine.snapshots._replace(details=details))
        attrs = {"law": json.dumps(registry.params_to_json(fine.params)), "period": str(period)}
        bags.write(Path(self.bag), bag_steps(fine, observations, period), attrs)
        coarse = slice(None, None, max(1, round(0.1 / period)))
        snapshots, states = rows((fine.snapshots, fine.law_states), coarse)
        return dataclasses.replace(fine, snapshots=snapshots, law_states=states)

    @property
    def horizon(self) -> float:
        """Time [s] after which the trial ends."""
        raise NotImplementedError

    def num_trials(self) -> int | None:
        return 1

    def progress_bar(self) -> Bar:
        return Bar(self.name, self.horizon, "simulated", shown=self.shows_progress)

    def report(self, results: Trace, run: Run) -> Sequence[Section]:
        text = f"{results.summary}. Stepped by the engine {results.engine}."
        return [Section("The push", text, (), Picture("trial", results.plot))]


@functools.cache
def recorded_law(law: Law, senses: Senses = "taxels") -> Law:
    """Return a law whose details are (details, observation), for the messages of a bag.

    A law that senses touch observes what `senses` names as well, such as taxels.
    """
    is_touch = law.senses == "touch"

    def step(params: LawParams, state: PyTree, obs: PyTree) -> tuple[PyTree, Twist, PyTree]:
        state, twist, details = law.step(params, state, obs.touch if is_touch else obs)
        return state, twist, (details, obs)

    return dataclasses.replace(law, step=step, senses=senses if is_touch else law.senses)


def bag_steps(trajectory: Trajectory, obs: PyTree, period: float) -> Iterator[Step]:
    """Yield the steps of a bag of a recorded trial, with its observations (T, ...)."""
    snapshots, touch = trajectory.snapshots, obs.touch
    lines = {k: x for k, x in trajectory.world.task.lines().items() if k in Step._fields}
    extra = {"signal", "f_robot", "p_world_object", "r_object"} & set(obs._fields)
    yaws = touch.yaw_target if touch.relative is None else None
    for i in range(len(snapshots.time)):
        position, yaw = object_pose(snapshots.qpos[i])
        yield Step(
            i * period,
            [*touch.p_world_robot[i], touch.yaw[i]],
            touch.p_world_target[i],
            int(snapshots.reading.contact_type[i]),
            touch.p_robot_contact[i],
            [np.broadcast_to(v, snapshots.time.shape)[i] for v in snapshots.twist],
            object_pose=[*np.asarray(position), float(yaw)],
            yaw_target=None if yaws is None else float(yaws[i]),
            **{name: getattr(obs, name)[i] for name in extra},
            **lines,
        )


def case_options(
    options: TrialOptions, setting: Setting, kind: type[TrialOptions] = TrialOptions
) -> dict[str, Any]:
    """Return fields of options as arguments of `Case`; the skin follows the physics."""
    fields = {f.name: getattr(options, f.name) for f in dataclasses.fields(kind)}
    return fields | {"skin": options.skin or paper.SKIN[setting.physics.cone]}


@dataclass(frozen=True)
class Push(Case, TraceQuestion, SimulationQuestion[Trace]):
    """Run one trial; draw the paper's Fig. 6 and film it.

    Examples:
      >>> import rps_jax
      >>> brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=3.0))
      >>> trace = rps_jax.push("cylinder", target=(1.0, 0.5), setting=brief)
      >>> trace.data.v_x.dims
      ('time',)
    """

    _: dataclasses.KW_ONLY
    quick: bool = option(False, hidden=True)

    def __post_init__(self) -> None:
        """Defer the checks of `Case` to `check`."""
        SimulationQuestion.__post_init__(self)

    @property
    def horizon(self) -> float:
        return float(self.setting.rules.horizon)

    @property
    def case(self) -> Case:
        """The trial."""
        return Case(**case_options(self, self.setting, Case))

    def fields_as_json(self) -> JsonObject:
        named = self if self.law is not None else dataclasses.replace(self, law=self.named_law)
        return super(Push, named).fields_as_json()

    def check(self) -> None:
        super().check()
        if self.quick:
            raise errors.not_allowed("quick", True, "a push has no smaller run; omit it")
        self.setting.check_here(self.case.base, [self.case.params])

    def answer(self, run: Run) -> Trace:
        case, setting = self.case, self.setting
        trajectory = self.record(pushes.build([case], setting), setting, run)
        scene = pushes.scene_of(case, setting)
        title = f"{pushes.title_of(case, scene)}, {registry.resolve_law(case.named_law)[0]}"
        named = {"scene": scene, "title": title, "engine": setting.engine}
        return Trace(**vars(trajectory), **named, attrs=self.attributes())


push = call_of(Push)


@dataclass(frozen=True)
class Replay(TraceQuestion):
    """Run one world of a sweep again; draw it as in the paper's Fig. 6 and film it.

    On the device of the sweep the trial has the same bits. A warning names a trial that ends
    otherwise elsewhere.

    Examples:
      >>> import tempfile
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> with tempfile.TemporaryDirectory() as run:
      ...     results = rps_jax.sweep("rps", drums, worlds=8, setting=setting, out=run)
      ...     trace = rps_jax.replay(run, 2)
      >>> float(trace.outcome.time) == float(results.time.sel(law="rps", world=2))
      True
    """

    run: str | Path = option("", positional=True)
    """Run folder of the sweep."""
    world: int = option(0, 0, positional=True)
    """Index of the world."""
    law: str | None = None
    """Law of the sweep, by its label; by default the first."""

    @property
    def sources(self) -> Sequence[str | Path]:
        return (self.run,)

    @property
    def default_folder(self) -> Path:
        return Path(self.run) / f"replay-{self.world}"

    @property
    def horizon(self) -> float:
        return float(self._chosen[0].setting.rules.horizon)

    @functools.cached_property
    def _chosen(self) -> tuple[Plan, str]:
        return select_law(Path(self.run), self.world, self.law)

    @property
    def title(self) -> str:
        return f"World {self.world} of {self.run}, {self._chosen[1]}"

    def check(self) -> None:
        super().check()
        _ = self._chosen

    def answer(self, run: Run) -> Trace:
        plan, name = self._chosen
        folder, batch = Path(self.run), build_batch(plan, name, [self.world])
        slots = program_slots(folder, plan, name, self.world)
        trajectory = self.record(batch, plan.setting, run, slots)
        find_differences(folder, name, [self.world], rows(trajectory.outcome, None))
        scene, title = scene_of(plan, self.world), f"{world_title(plan, self.world)}, {name}"
        named = {"scene": scene, "title": title, "engine": plan.setting.engine}
        attrs = self.attributes() | attributes_of(plan)
        return Trace(**vars(trajectory), **named, attrs=attrs)


replay = call_of(Replay)


def _evenly_spaced(length: int, count: int) -> list[int]:
    """At least two indices into `length` items, from the first to the last."""
    count = max(2, count)
    return [round(i * (length - 1) / (count - 1)) for i in range(count)]


def select_law(run: Path, world: int, law: str | None = None) -> tuple[Plan, str]:
    """Return the plan of a sweep of which a world is recorded, and the label of the law.

    Raises:
      InputError: the folder holds no sweep, or not this world or law.
    """
    plan = load_plan(run)
    name = errors.check_name("law of the run", law or next(iter(plan.laws)), plan.laws)
    errors.check_count("world", world, at_least=0, at_most=plan.worlds - 1)
    return plan, name


def program_slots(run: Path, plan: Plan, law: str, world: int) -> int:
    """Return the number of slots of the program that ran a world of a sweep."""
    stored: Any = None
    with contextlib.suppress(InputError):  # a folder without a record has the default
        stored = provenance.read_environment(run).get("slots")
    return slots_of(plan.setting, stored, plan.count_trials(law, world))


def find_differences(run: Path, law: str, worlds: Sequence[int], outcomes: Outcome) -> np.ndarray:
    """Return whether trials (n,) end otherwise than in their sweep, and warn if one does."""
    if not (run / "results.nc").exists():  # a shard
        return np.zeros(len(worlds), bool)
    results = files.read_results(run)
    if law not in results.law:  # it has failed
        return np.zeros(len(worlds), bool)
    results = results.sel(law=law).isel(world=list(worlds))
    pairs = [(results[name].values, outcomes.columns()[name]) for name in _COMPARED]
    differ = np.any([stored != x.astype(stored.dtype) for stored, x in pairs], axis=0)
    if differ.any():
        end = results.isel(world=int(differ.argmax()))
        warnings.warn(
            f"{differ.sum()} of {differ.size} trials end otherwise than in the sweep (world "
            f"{int(end.world)}: target {end_in_words(end)} there): another device or version "
            "rounds differently.",
            stacklevel=2,
        )
    return differ


_COMPARED = "success", "time", "tipped", "diverged"  # outcomes of a trial


def end_in_words(trial: xr.Dataset) -> str:
    """Return success and end of a trial."""
    return f"{'reached' if trial.success else 'not reached'} at {float(trial.time):.1f} s"
