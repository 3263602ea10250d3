"""Controller of a robot without ROS: from inputs with their times to a bounded twist.

It does the same as `controller.hpp`, with the law in JAX, so no export is needed. Use it to try a
law on a robot with 50 commands per second. Times are seconds of one steady clock.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import InputError, Observation, Robot
from rps_jax.laws import law_of, resolve_law
from rps_jax.worlds import CapacitiveSkin, PathCourse, Polyline

_VERTICES = 1024  # of a path, at most


@dataclass(frozen=True)
class Limits:
    """Bounds of the command, and of the age of inputs."""

    v_max: float = 0.05  # [m/s] speed in any direction
    omega_max: float = 0.15  # [rad/s]
    a_max: float = 0.5  # [m/s^2] change of the velocity
    alpha_max: float = 1.0  # [rad/s^2]
    odometry_age: float = 0.08  # [s] after which an input counts as missing
    taxels_age: float = 0.08  # [s]
    target_age: float = 0.08  # [s]
    path_age: float = 2.0  # [s]
    lookahead: float = 1.0  # [m] on the path, from the contact to the law's target


class Command(NamedTuple):
    """Twist in the robot frame, and the status of the controller."""

    v_x: float = 0.0  # [m/s]
    v_y: float = 0.0  # [m/s]
    omega: float = 0.0  # [rad/s]
    status: str = "waiting for odometry"


class Controller:
    """Controller with skin, law, watchdog and limits."""

    def __init__(
        self,
        limits: Limits = Limits(),
        law: str = "rps_plus",
        skin: Any = CapacitiveSkin(),
        robot: Any = "ideal",
    ) -> None:
        """Compile skin and law before the first step; the law must sense touch or ends.

        The skin has the shell of the base; `robot` is the base itself, whose drive the law knows.
        Odometry and command of a base that cannot move sideways are those of its axle.
        """
        self.limits, self._skin, self._robot = limits, skin, Robot.parse(robot)
        self._params = resolve_law(law)[1]
        if self._robot.drive not in law_of(self._params).drives:
            sentence = (
                f"this law moves sideways, which a base with drive = {self._robot.drive} cannot"
            )
            raise InputError(f"{sentence}: choose law unicycle.")
        self._law = law_of(self._params)
        self._scan, self._step = jax.jit(skin.read), jax.jit(self._law.step)
        self._ends = jax.jit(self._with_ends)
        self._follow = jax.jit(PathCourse.follow)
        self.reset()
        self.path(0.0, [(0.0, 0.0), (1.0, 0.0)])
        self._pursue()
        self.reset()
        self._decide(0.02)
        self._scan(self._skin_state, jnp.zeros(self.taxels), 0.02)

    def reset(self) -> None:
        """Reset all states and inputs."""
        self._skin_state = self._skin.init(jax.random.PRNGKey(0))
        self._law_state = self._law.init(self._params)
        self._pose, self._target, self._contact = np.zeros(3), np.zeros(2), (np.zeros(2), False)
        self._heading = 0.0
        self._course: PathCourse | None = None
        self._input_times = dict.fromkeys(("odometry", "taxels", "target", "path"), -math.inf)
        self._last = self._scanned = -math.inf
        self._sent = Command()

    @property
    def taxels(self) -> int:
        """Number of taxels of the skin."""
        return self._skin.shell.count

    def odometry(self, time: float, x: float, y: float, yaw: float) -> None:
        """Store the pose of the base [m, m, rad]."""
        if np.isfinite([x, y, yaw]).all():
            axle = self._robot.axle_behind
            self._pose = np.array([x + axle * math.cos(yaw), y + axle * math.sin(yaw), yaw])
            self._input_times["odometry"] = time

    def target(self, time: float, x: float, y: float) -> None:
        """Store the target [m]."""
        if np.isfinite([x, y]).all():
            self._target, self._input_times["target"] = np.array([x, y], float), time

    def goal(self, time: float, x: float, y: float, yaw: float) -> None:
        """Store a target [m] with the heading of the goal [rad], for a law that observes it."""
        if np.isfinite([x, y, yaw]).all():
            self._heading = float(yaw)
            self.target(time, x, y)

    def path(self, time: float, points: Any) -> None:
        """Store a path (K, 2) [m], which replaces the target; no point ends it.

        The same path again goes on, and another one starts anew.
        """
        vertices = np.asarray(points, np.float32).reshape(-1, 2)
        if not np.isfinite(vertices).all() or len(vertices) > _VERTICES:
            return
        self._input_times["path"] = time
        if not len(vertices):
            self._course = None
            return
        vertices = np.pad(vertices, ((0, _VERTICES - len(vertices)), (0, 0)), "edge")
        if self._course is None or (vertices != self._course.line.vertices).any():
            lookahead = np.asarray(self.limits.lookahead, np.float32)
            self._course = PathCourse(Polyline.through(vertices), lookahead)
            self._progress = self._course.start()

    def _pursue(self) -> None:
        """Set the target a lookahead ahead on the path."""
        (x, y), touches = self._contact
        c, s = math.cos(self._pose[2]), math.sin(self._pose[2])
        contact = self._pose[:2] + np.array([c * x - s * y, s * x + c * y])
        inputs = self._course, self._progress, contact.astype(np.float32), np.asarray(touches)
        self._progress, aim = self._follow(*inputs)
        self._target = np.asarray(aim.p_world_target, float)

    def skin(self, time: float, values: Any) -> None:
        """Process one scan: relative changes of capacitance [1], along the strip."""
        values = np.asarray(values, np.float32)
        period = time - self._scanned if self._scanned > -math.inf else 0.02
        if values.shape != (self.taxels,) or not np.isfinite(values).all() or not period > 0:
            return
        self._skin_state, reading = self._scan(self._skin_state, values, period)
        self._contact = np.asarray(reading.p_robot_contact), bool(reading.in_contact)
        self._scanned = self._input_times["taxels"] = time

    def _with_ends(self, state: Any, obs: Observation) -> Any:
        signal = jnp.where(state.alive, state.signal, 0.0)
        return obs.with_ends(signal, state.alive, self._skin.ends(state))

    def _decide(self, period: float) -> tuple[Any, Any]:
        obs = Observation(self._pose[:2], self._pose[2], *self._contact, self._target, period)
        obs = obs.with_base(self._skin.shell.radius, self._robot)
        if self._law.heading:
            obs = obs._replace(yaw_target=np.asarray(self._heading))
        if self._law.senses == "ends":
            obs = self._ends(self._skin_state, obs)
        return self._step(self._params, self._law_state, obs)[:2]

    def tick(self, time: float) -> Command:
        """Return the command at a time [s]."""
        limits, sent = self.limits, self._sent
        period = time - self._last if self._last > -math.inf else 0.02
        self._last = time
        goal = ("target", "a target") if self._course is None else ("path", "a path")
        for name, words in (("odometry",) * 2, ("taxels",) * 2, goal):
            if time - self._input_times[name] > getattr(limits, f"{name}_age"):
                self._sent = Command(status=f"waiting for {words}")
                return self._sent
        if not period > 0:
            self._sent = Command(status="the clock does not advance")
            return self._sent
        if self._course is not None:
            self._pursue()
        law_state, twist = self._decide(period)
        v_x, v_y, omega = map(float, twist)
        v_y = v_y if self._robot.drive == "omni" else 0.0
        if not np.isfinite([v_x, v_y, omega]).all():
            self._sent = Command(status="the law returns no finite twist")
            return self._sent
        self._law_state = law_state
        share = min(1.0, limits.v_max / max(math.hypot(v_x, v_y), 1e-9))
        x, y = share * v_x - sent.v_x, share * v_y - sent.v_y
        part = min(1.0, limits.a_max * period / max(math.hypot(x, y), 1e-9))
        turn = limits.alpha_max * period
        omega = min(max(omega, -limits.omega_max), limits.omega_max)
        omega = sent.omega + min(max(omega - sent.omega, -turn), turn)
        self._sent = Command(sent.v_x + part * x, sent.v_y + part * y, omega, "pushing")
        return self._sent
