"""The law on a robot: 42 taxels, a pose and a target in, a twist out, 1000 times a second.

    python notebooks/examples/on_a_robot.py --seconds 10

NumPy in, NumPy out, no ROS. One program does a whole step: it filters and thresholds the taxels,
finds the contact, and decides. It is compiled before the loop, so no step waits for a compiler;
the garbage collector is held off meanwhile. Put your drivers in the place of `Robot`.
"""

import gc
import os
import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from rps_jax import Observation, RPSParams, RPSState, step
from rps_jax.robot.skin import CapacitiveSkin

PERIOD = 0.001  # [s]


@dataclass(frozen=True)
class Options:
    """How long to run, and on what."""

    seconds: float = 10.0
    """Length of the run [s]."""
    core: int | None = None
    """Core to stay on; by default any."""


def controller(params: RPSParams, skin: CapacitiveSkin) -> tuple[Callable, tuple]:
    """The compiled step, and what it remembers before the first.

    The step takes what it remembers, taxels (42,) [1] as relative changes of capacitance, the
    base's pose (3,) [m, m, rad] and the target (2,) [m] in the world, and the time [s] since the
    last step as it was measured. It returns what it remembers and the twist (3,) [m/s, m/s, rad/s]
    in the robot's frame.
    """

    def tick(memory, taxels, pose, p_world_target, period):
        skin_state, state = memory
        skin_state, reading = skin.read(skin_state, taxels, period)
        contact = reading.p_robot_contact, reading.in_contact
        obs = Observation(pose[:2], pose[2], *contact, p_world_target, period)
        state, twist = step(params, state, obs)
        return (skin_state, state), jnp.stack(twist)

    memory = skin.init(jax.random.PRNGKey(0)), RPSState.init(params)
    inputs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((42,), (3,), (2,), ())]
    return jax.jit(tick).lower(memory, *inputs).compile(), memory


class Robot:
    """A stand-in for drivers: an object is always felt left of the middle of the front."""

    def __init__(self) -> None:
        self.pose = np.zeros(3, np.float32)
        self._taxels = np.zeros(42, np.float32)
        self._taxels[16:20] = 0.6  # of the front's, 15 to 26

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Taxels (42,) [1] and pose (3,) [m, m, rad] in the world."""
        return self._taxels, self.pose

    def command(self, twist: np.ndarray) -> None:
        """Move at a twist (3,) [m/s, m/s, rad/s] for one period."""
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
        self.pose = self.pose + np.float32(PERIOD) * turn @ twist


def run(robot: Robot, target: np.ndarray, seconds: float) -> np.ndarray:
    """Drive for some time; returns how long each step took to decide, (n,) [s]."""
    tick, memory = controller(RPSParams.paper(), CapacitiveSkin())
    latency = np.zeros(round(seconds / PERIOD))
    period = np.float32(PERIOD)
    jax.block_until_ready(tick(memory, *robot.read(), target, period))  # sets things up
    gc.collect()
    gc.disable()
    due = time.perf_counter()
    last = due - PERIOD
    for i in range(latency.size):
        taxels, pose = robot.read()
        began = time.perf_counter()
        period, last = np.float32(began - last), began
        memory, twist = tick(memory, taxels, pose, target, period)
        twist = np.asarray(twist)
        latency[i] = time.perf_counter() - began
        robot.command(twist)
        due += PERIOD
        time.sleep(max(0.0, due - time.perf_counter()))
    gc.enable()
    return latency


def main(options: Options) -> np.ndarray:
    """Run, and print how long the steps took."""
    if options.core is not None:
        os.sched_setaffinity(0, {options.core})  # before JAX starts its threads
    latency = run(Robot(), np.array([-2.0, 0.0], np.float32), options.seconds)
    median, slow, worst = 1e6 * np.quantile(latency, [0.5, 0.999, 1.0])
    late = np.mean(latency > PERIOD)
    print(
        f"{latency.size} steps: median {median:.0f} us, 99.9th percentile {slow:.0f} us, worst "
        f"{worst:.0f} us; {late:.2%} took longer than {1e3 * PERIOD:g} ms"
    )
    return latency


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # decide here, wake no other thread
    main(tyro.cli(Options, description=__doc__))
