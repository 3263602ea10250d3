"""One trial, followed from its start to its end: its data, its picture and its film.

It is asked for by name (`push`), or is a world of a sweep again (`replay`).
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from rps_jax import engines, errors
from rps_jax.control import strategies
from rps_jax.control.strategies import Params
from rps_jax.runs.plan import Plan, load_plan, scene_of, title_of, world_part
from rps_jax.trials import pushes, results
from rps_jax.trials.conditions import Conditions, Which, arms_of
from rps_jax.trials.pushes import Trace
from rps_jax.trials.setting import Report, unheard
from rps_jax.trials.trial import Outcome, p_world_contact
from rps_jax.world.scene import Scene


@dataclass(frozen=True)
class Push:
    """One trial that was followed."""

    trace: Trace  # arrays over time, (T, ...)
    scene: Scene
    title: str

    @property
    def outcome(self) -> Outcome:
        """The result of the trial, without a leading axis."""
        return self.trace.outcome

    @property
    def data(self) -> xr.Dataset:
        """The trial over time: variables (time, ...), its outcome as scalars."""
        return results.trace_dataset(self.trace)

    def plot(self, path: str | Path | None = None) -> Any:
        """Fig. 6 of the paper as a picture, which Jupyter shows; with a path it is a PNG there."""
        from PIL import Image

        from rps_jax.analysis import figures

        file = io.BytesIO() if path is None else Path(path)
        figures.one_trial(self.data, self.title, file)
        return Image.open(file)

    def stills(self, path: str | Path, count: int = 6) -> Path:
        """A PNG of some moments of the trial, side by side.

        Raises:
          VideoError: this machine cannot draw.
        """
        from rps_jax.analysis import figures, video

        seen, target = self.trace.snapshots, np.array(self.trace.p_world_target)
        shown = _evenly(len(seen.time), count)
        images = [video.snapshot(self.scene, seen.qpos[i], p_world_target=target) for i in shown]
        return figures.stills(images, [f"{seen.time[i]:.0f} s" for i in shown], Path(path))

    def film(
        self,
        path: str | Path,
        seconds: float = 12.0,
        *,
        fps: int = 25,
        size: tuple[int, int] = (960, 540),
        watch: Callable[[Iterable[Any]], Iterable[Any]] = iter,
    ) -> Path:
        """An MP4 of the trial.

        Args:
          path: of the MP4.
          seconds: length of the film, whatever the trial's.
          fps: frames per second of the film.
          size: width and height [px], even numbers.
          watch: is handed the frames and hands them on, as `tqdm.tqdm` does.

        Raises:
          InputError: the length, rate or size is not allowed.
          VideoError: this machine cannot draw or encode.
        """
        from rps_jax.analysis import video

        check_length(seconds)
        seen = self.trace.snapshots
        shown = _evenly(len(seen.time), round(seconds * fps))
        video.render(
            self.scene,
            watch(seen.qpos[shown]),
            Path(path),
            p_world_target=np.array(self.trace.p_world_target),
            p_world_contacts=np.asarray(p_world_contact(seen))[shown],
            fps=fps,
            size=size,
        )
        return Path(path)


def check_length(seconds: float) -> None:
    """Raises InputError unless a film may be this long [s]."""
    errors.check_finite("film_length", seconds, above=0, at_most=600, unit="s")


def push(
    object: str = "box",
    target: tuple[float, float] = (-2.0, 0.0),
    friction: Which = "S1",
    strategy: str | Params = "rps",
    *,
    report: Report = unheard,
    **conditions: Any,
) -> Push:
    """One trial, followed from its start to its end.

    Args:
      object: the object, by name.
      target: x, y [m] in the world, where the base starts at the origin.
      friction: a friction set of the paper's Table I, or coefficients ground, robot [1].
      strategy: what decides, by name or by its parameters.
      report: called now and then.
      conditions: fields of `Conditions`, as `engine` or `mass`.

    Raises:
      InputError: an argument is not allowed.

    Example:
      >>> import rps_jax
      >>> seen = rps_jax.push("cylinder", (1.0, 0.5), engine="quasistatic", horizon=3.0)
      >>> seen.data.v_x.dims
      ('time',)
    """
    chosen = Conditions.of(conditions)
    setting = chosen.setting()
    named = [strategy] if isinstance(strategy, str) else {"": strategy}
    (params,) = arms_of(named).values()
    case = chosen.case(object, friction, target, params)
    engines.get(chosen.engine).check_followed()
    (trace,) = pushes.follow([case], setting, report=report)
    return Push(trace, pushes.scene_of(case, setting.physics), results.title_of(case))


def _evenly(length: int, count: int) -> list[int]:
    """At least two indices into `length` items, from the first to the last."""
    count = max(2, count)
    return [round(i * (length - 1) / (count - 1)) for i in range(count)]


def chosen(run: Path, world: int, arm: str | None = None) -> tuple[Plan, str]:
    """The plan of a sweep, one of whose worlds can be followed, and the arm that is meant.

    An engine whose trials cannot be followed is replaced by the fused one.

    Raises:
      InputError: the folder holds no sweep, or not this world or arm.
    """
    plan = load_plan(run)
    name = errors.check_name("arm", arm or next(iter(plan.arms)), plan.arms)
    errors.check_count("index", world, at_least=0, at_most=plan.worlds - 1)
    if not engines.get(plan.setting.engine).traced:
        plan = dataclasses.replace(plan, setting=dataclasses.replace(plan.setting, engine="fused"))
    engines.get(plan.setting.engine).check_followed()
    return plan, name


def replay(
    run: str | Path, world: int, arm: str | None = None, *, report: Report = unheard
) -> Push:
    """One world of a sweep again, followed from its start to its end.

    Args:
      run: the run folder of the sweep.
      world: index of the world.
      arm: which of the sweep's arms; by default the first.
      report: called now and then.

    Raises:
      InputError: the folder holds no sweep, or not this world or arm.

    Example:
      >>> import tempfile
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> arms = {"rps": rps_jax.RPSParams.paper()}
      >>> with tempfile.TemporaryDirectory() as run:
      ...     found = rps_jax.sweep(drums, arms, worlds=8, out=run, rules=rules)
      ...     again = rps_jax.replay(run, 2)
      >>> bool(again.outcome.success) == bool(found.success.sel(arm="rps", world=2))
      True
    """
    plan, name = chosen(Path(run), world, arm)
    part = world_part(plan, list(plan.arms).index(name), [world])
    decides = strategies.of(plan.arms[name])
    (trace,) = pushes.follow_part(part, decides, plan.setting, report=report)
    return Push(trace, scene_of(plan, world), title_of(plan, world))
