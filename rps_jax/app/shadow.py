"""Shadow mode: the commands of a law for a recorded bag, beside the recorded commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import PyTree

from rps_jax import errors
from rps_jax.analysis.report import Section
from rps_jax.control import registry, validation
from rps_jax.control.base import Law, LawParams, named_leaves
from rps_jax.control.observation import Twist, with_base
from rps_jax.control.registry import LawLike
from rps_jax.errors import InputError
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Pytree
from rps_jax.geometry.polyline import Polyline
from rps_jax.record import bag as bags
from rps_jax.record.files import Arrays
from rps_jax.record.options import option
from rps_jax.robot import robot as robots
from rps_jax.robot.robot import Robot, RobotLike
from rps_jax.robot.skin import CapacitiveSkin, check_taxels, ends_of, with_contacts
from rps_jax.runs.question import BagQuestion, DefaultLaw, Run, call_of, suit_robot
from rps_jax.tuning.logs import COLUMNS, motion_faults
from rps_jax.world.tasks.path import PathCourse

_STILL = 1e-3  # [m] by which the points of a path may move


@dataclass(frozen=True)
class Shadow(BagQuestion[xr.Dataset]):
    """Feed a recorded bag to a law, and compare its twists with the recorded ones."""

    file: str | Path = option("", positional=True)
    """Bag with what a robot observed, as `rps push --bag` or `ros2 bag record` writes it:
    FILE.mcap, FILE.db3 or a folder."""
    law: LawLike = DefaultLaw("rps_plus")
    """The law, by its name or its file, with changes, as rps_plus,mine.json."""
    robot: RobotLike = "ideal"
    """The robot of a bag that has taxels but no contacts: its name, or a JSON file of its size and
    boards."""

    lookahead: float = option(1.0, 0.05, 5, unit="m")
    """Lookahead on the path of a bag that has no target [m]."""

    TITLE = "A law in the shadow of another"

    def __post_init__(self) -> None:
        """Set a law that suits the robot."""
        suit_robot(self, self.robot)

    @property
    def params(self) -> LawParams:
        """Parameters of the law."""
        return registry.check_params(registry.resolve_law(self.law)[1])

    @cached_property
    def steps(self) -> Arrays:
        """Steps of the bag."""
        law = registry.law_of(self.params)
        shapes = validation.observation_shapes(law.senses)
        names = [*named_leaves(shapes), *(("yaw_target",) if law.heading else ())]
        steps = bags.read(Path(self.file), self.topics, names)
        if "yaw_target" in steps and not law.follows:
            known = np.isfinite(steps["yaw_target"])
            steps = {name: column[known] for name, column in steps.items()}
        return steps

    def check(self) -> None:
        """Check the law, the robot and the bag."""
        registry.check_drive(self.params, robots.parse_robot(self.robot).drive)
        if not bags.is_bag(Path(self.file)):
            rule = "give FILE.mcap, FILE.db3 or a folder of `ros2 bag record`"
            raise errors.not_allowed("bag", self.file, rule)
        _ = self.steps

    def answer(self, run: Run) -> xr.Dataset:
        """Run the law over the bag."""
        robot = robots.parse_robot(self.robot)
        shell = robot.shell
        recorded = with_contacts(self.steps, shell, f"bag = {self.file}")
        recorded |= {"twist": robot.twist_of_middle(recorded["twist"])}
        if "target" not in recorded:
            recorded |= {"target": pursued(recorded, self.lookahead)}
        motion = (recorded[name] for name in ("time", "pose", "twist"))
        doubts = "; it ".join(motion_faults(*motion))  # the base may follow other commands
        twists = shadowed(registry.law_of(self.params), self.params, recorded, robot)
        both = np.stack([recorded["twist"], twists])
        pairs = zip(COLUMNS["twist"].items(), np.moveaxis(both, -1, 0), strict=True)
        columns = {name: (("source", "time"), x, {"units": unit}) for (name, unit), x in pairs}
        if robot.drive != "omni":  # of which v_y follows from omega
            del columns["v_y"]
        coords = {"source": ["commanded", "law"], "time": recorded["time"]}
        attrs = {"law": registry.resolve_law(self.law)[0], "doubts": doubts}
        return xr.Dataset(columns, coords, attrs)

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Return the differences between the twists of the law and the recorded ones."""
        rows = [["", "root mean square", "greatest", "at time [s]"]]
        is_nan = ~np.isfinite(results.to_array().sel(source="law").values).all(axis=0)
        finite = results.isel(time=~is_nan)
        for name, unit in ((name, COLUMNS["twist"][name]) for name in map(str, results)):
            error = np.abs(finite[name].sel(source="law") - finite[name].sel(source="commanded"))
            if not error.size:
                continue
            worst, when = float(error.max()), float(finite.time[int(np.argmax(error.values))])
            mean = f"{float(np.sqrt(np.mean(error**2))):.2g}"
            rows.append([f"{name} [{unit}]", mean, f"{worst:.2g}", f"{when:.2f}"])
        start, end = float(results.time[0]), float(results.time[-1])
        text = (
            f"{results.sizes['time']} commands in {end - start:.1f} s. The table has the "
            f"differences between the twists of {results.attrs['law']} and the recorded ones, at "
            "the same observations."
        )
        if results.attrs.get("doubts"):
            text += f" Check the bag: it {results.attrs['doubts']}."
        if count := int(is_nan.sum()):
            text += (
                f" {results.attrs['law']} returned NaN or infinity at {count} of {is_nan.size} "
                f"commands, first at {results.time.values[is_nan][0]:.2f} s; the table leaves "
                "these out."
            )
        return [Section("Differences from the recorded commands", text, rows)]


shadow = call_of(Shadow)


def pursued(recorded: Arrays, lookahead: float) -> np.ndarray:
    """Return the targets (N, 2) [m] on the path of a bag, as of the task `path`.

    Raises:
      InputError: the path changes, or has no length.
    """
    path = recorded["path"]
    if np.ptp(path, axis=0).max() > _STILL:
        raise InputError("the bag has a path that changes: cut the bag where it does.")
    if np.ptp(path[0], axis=0).max() < _STILL:
        raise InputError("the bag has a path without length: publish two different poses or more.")
    line: PyTree = jax.tree.map(jnp.asarray, Polyline.through(path[0]))
    course = PathCourse(line, jnp.asarray(lookahead))
    pose, contact = (jnp.asarray(recorded[name]) for name in ("pose", "p_robot_contact"))
    contacts = pose[:, :2] + planar.rotate(pose[:, 2], contact)
    rows = contacts, jnp.asarray(recorded["contact_type"] > 0)
    _, aims = jax.lax.scan(lambda at, row: course.follow(at, *row), course.start(), rows)
    return np.asarray(aims.p_world_target)


def recorded_ends(signal: np.ndarray, robot: Robot) -> Arrays:
    """Return the ends of contacts of recorded signals (N, T), by the default skin.

    A taxel whose signal is always 0 counts as dead.
    """
    alive = jnp.asarray((signal != 0).any(axis=0))
    ends_of_all = jax.vmap(lambda x: ends_of(x, alive, robot.shell, CapacitiveSkin().threshold))
    ends = ends_of_all(jnp.asarray(signal))._asdict()
    return {**ends, "alive": np.broadcast_to(alive, signal.shape)}


def shadowed(law: Law, params: LawParams, recorded: Arrays, robot: Robot = Robot()) -> np.ndarray:
    """Return the twists (N, 3) [m/s, m/s, rad/s] of a law on a robot for observations of a bag.

    A law that observes its last twist gets the recorded one, which moved the base. Rounding errors
    therefore do not grow from step to step.

    Raises:
      InputError: the bag lacks a field of the law's observation.
    """
    pose, contact_type = recorded["pose"], recorded["contact_type"]
    values = recorded | {"p_world_robot": pose[:, :2], "yaw": pose[:, 2]}
    values |= {"in_contact": contact_type > 0, "line": contact_type == 2}
    values |= {"p_world_target": recorded["target"]}
    if law.senses == "ends" and "signal" in recorded:
        check_taxels(recorded["signal"], robot.shell, "the bag")
        values |= recorded_ends(recorded["signal"], robot)

    def value_of(path: Pytree, shape: jax.ShapeDtypeStruct) -> Array:
        """Return the values (N, ...) of a field of the observation."""
        if (name := path[-1].name) not in values:
            raise InputError(
                f"the bag has no {name}, which the law senses ({law.senses}): record it, or choose "
                "another law."
            )
        return jnp.asarray(values[name], shape.dtype)

    @jax.jit
    def run(params: LawParams, observations: PyTree) -> Array:
        def step(state: PyTree, row: PyTree) -> PyTree:
            sensed, last = row
            obs = with_base(sensed, robot.radius, robot)
            if law.observe_sent is not None:
                state = law.observe_sent(params, state, obs, Twist(*last))
            state, twist, _ = law.step(params, state, obs)
            return state, jnp.stack([jnp.asarray(x, float) for x in Twist(*twist)])

        return jax.lax.scan(step, law.init(params), (observations, sent))[1]

    sent = jnp.asarray(np.pad(recorded["twist"][:-1], ((1, 0), (0, 0))), float)
    params = jax.tree.map(lambda x: jnp.asarray(x, float), params)
    shapes = validation.observation_shapes(law.senses, robot.shell.count, law.heading)
    return np.asarray(run(params, jax.tree_util.tree_map_with_path(value_of, shapes)))
