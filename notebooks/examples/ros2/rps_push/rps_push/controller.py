"""The law on a robot, without ROS: inputs with their times in, a bounded twist out.

As `controller.hpp` does it, but with the law in JAX, so that nothing has to be exported: for trying
a law on a robot, at 50 commands in a second. Times are seconds of one steady clock.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import Observation
from rps_jax.control import registry
from rps_jax.robot.skin import CapacitiveSkin


@dataclass(frozen=True)
class Limits:
    """Bounds on what is commanded, and on how old an input may be."""

    v_max: float = 0.05  # [m/s] of the speed in any direction
    omega_max: float = 0.15  # [rad/s]
    a_max: float = 0.5  # [m/s^2] of the change of the velocity
    alpha_max: float = 1.0  # [rad/s^2]
    odometry_age: float = 0.08  # [s] after which an input counts as silent
    taxels_age: float = 0.08  # [s]
    target_age: float = 0.08  # [s]


class Command(NamedTuple):
    """A twist in the robot's frame, and why it is that."""

    v_x: float = 0.0  # [m/s]
    v_y: float = 0.0  # [m/s]
    omega: float = 0.0  # [rad/s]
    status: str = "waiting for odometry"


class Controller:
    """Skin, law, watchdog and limits."""

    def __init__(
        self, limits: Limits = Limits(), law: str = "rps_plus", skin: Any = CapacitiveSkin()
    ) -> None:
        """Compile skin and law, so that no step waits for a compiler; the law senses touch."""
        self.limits, self._skin = limits, skin
        self._params = registry.resolve_law(law)[1]
        self._law = registry.law_of(self._params)
        self._scan, self._step = jax.jit(skin.read), jax.jit(self._law.step)
        self.reset()
        self._decide(0.02)
        self._scan(self._felt, jnp.zeros(self.taxels), 0.02)

    def reset(self) -> None:
        """Forget all that was felt and heard."""
        self._felt = self._skin.init(jax.random.PRNGKey(0))
        self._memory = self._law.init(self._params)
        self._pose, self._target, self._contact = np.zeros(3), np.zeros(2), (np.zeros(2), False)
        self._heard = dict.fromkeys(("odometry", "taxels", "target"), -math.inf)
        self._last = self._scanned = -math.inf
        self._sent = Command()

    @property
    def taxels(self) -> int:
        """How many the skin has."""
        return self._skin.shell.count

    def odometry(self, now: float, x: float, y: float, yaw: float) -> None:
        """Where the base is."""
        if np.isfinite([x, y, yaw]).all():
            self._pose, self._heard["odometry"] = np.array([x, y, yaw], float), now

    def target(self, now: float, x: float, y: float) -> None:
        """Where the object shall go."""
        if np.isfinite([x, y]).all():
            self._target, self._heard["target"] = np.array([x, y], float), now

    def skin(self, now: float, values: Any) -> None:
        """One scan: relative changes of capacitance [1], along the strip."""
        values = np.asarray(values, np.float32)
        period = now - self._scanned if self._scanned > -math.inf else 0.02
        if values.shape != (self.taxels,) or not np.isfinite(values).all() or not period > 0:
            return
        self._felt, reading = self._scan(self._felt, values, period)
        self._contact = np.asarray(reading.p_robot_contact), bool(reading.in_contact)
        self._scanned = self._heard["taxels"] = now

    def _decide(self, period: float) -> tuple[Any, Any]:
        seen = Observation(self._pose[:2], self._pose[2], *self._contact, self._target, period)
        return self._step(self._params, self._memory, seen)[:2]

    def tick(self, now: float) -> Command:
        """What to command now."""
        limits, sent = self.limits, self._sent
        period = now - self._last if self._last > -math.inf else 0.02
        self._last = now
        for name, words in (("odometry",) * 2, ("taxels",) * 2, ("target", "a target")):
            if now - self._heard[name] > getattr(limits, f"{name}_age"):
                self._sent = Command(status=f"waiting for {words}")
                return self._sent
        if not period > 0:
            self._sent = Command(status="the clock stands still")
            return self._sent
        memory, twist = self._decide(period)
        v_x, v_y, omega = map(float, twist)
        if not np.isfinite([v_x, v_y, omega]).all():
            self._sent = Command(status="the law has no answer")
            return self._sent
        self._memory = memory
        share = min(1.0, limits.v_max / max(math.hypot(v_x, v_y), 1e-9))
        x, y = share * v_x - sent.v_x, share * v_y - sent.v_y
        part = min(1.0, limits.a_max * period / max(math.hypot(x, y), 1e-9))
        turn = limits.alpha_max * period
        omega = min(max(omega, -limits.omega_max), limits.omega_max)
        omega = sent.omega + min(max(omega - sent.omega, -turn), turn)
        self._sent = Command(sent.v_x + part * x, sent.v_y + part * y, omega, "pushing")
        return self._sent
