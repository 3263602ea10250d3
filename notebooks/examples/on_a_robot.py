"""Run the law on a robot at 1 kHz: from 42 taxels, a pose and a target to a twist.

    python notebooks/examples/on_a_robot.py --seconds 10

Inputs and outputs are NumPy arrays; ROS is not needed. One compiled program does a whole step: it
filters and thresholds the taxels, computes the contact, and runs the law. It is compiled before the
loop, and the garbage collector is off during the loop. Replace `Robot` with your drivers.
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
from rps_jax.worlds import CapacitiveSkin

PERIOD = 0.001  # [s]


@dataclass(frozen=True)
class Options:
    """Duration and processor core of the run."""

    seconds: float = 10.0
    """Length of the run [s]."""
    core: int | None = None
    """Core to run on; by default any."""


def controller(params: RPSParams, skin: CapacitiveSkin) -> tuple[Callable, tuple]:
    """Return the compiled step, and the states of skin and law before the first step.

    The arguments of the step are the states, taxels (42,) [1] as relative changes of capacitance,
    the base's pose (3,) [m, m, rad] and the target (2,) [m] in the world, and the measured time [s]
    since the last step. It returns the states and the twist (3,) [m/s, m/s, rad/s] in the robot
    frame.
    """

    def tick(states, taxels, pose, p_world_target, period):
        skin_state, state = states
        skin_state, reading = skin.read(skin_state, taxels, period)
        contact = reading.p_robot_contact, reading.in_contact
        obs = Observation(pose[:2], pose[2], *contact, p_world_target, period)
        state, twist = step(params, state, obs)
        return (skin_state, state), jnp.stack(twist)

    states = skin.init(jax.random.PRNGKey(0)), RPSState.init(params)
    inputs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((42,), (3,), (2,), ())]
    return jax.jit(tick).lower(states, *inputs).compile(), states


class Robot:
    """Simulated drivers, with a constant contact left of the centre of the front."""

    def __init__(self) -> None:
        self.pose = np.zeros(3, np.float32)
        self._taxels = np.zeros(42, np.float32)
        self._taxels[16:20] = 0.6  # the front has taxels 15 to 26

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return taxels (42,) [1] and pose (3,) [m, m, rad] in the world."""
        return self._taxels, self.pose

    def command(self, twist: np.ndarray) -> None:
        """Move with a twist (3,) [m/s, m/s, rad/s] for one period."""
        c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], np.float32)
        self.pose = self.pose + np.float32(PERIOD) * turn @ twist


def run(robot: Robot, target: np.ndarray, seconds: float) -> np.ndarray:
    """Drive for some seconds, and return the time of each step (n,) [s]."""
    tick, states = controller(RPSParams.paper(), CapacitiveSkin())
    latency = np.zeros(round(seconds / PERIOD))
    period = np.float32(PERIOD)
    jax.block_until_ready(tick(states, *robot.read(), target, period))  # initialises JAX
    gc.collect()
    gc.disable()
    due = time.perf_counter()
    last = due - PERIOD
    for i in range(latency.size):
        taxels, pose = robot.read()
        start = time.perf_counter()
        period, last = np.float32(start - last), start
        states, twist = tick(states, taxels, pose, target, period)
        twist = np.asarray(twist)
        latency[i] = time.perf_counter() - start
        robot.command(twist)
        due += PERIOD
        time.sleep(max(0.0, due - time.perf_counter()))
    gc.enable()
    return latency


def main(options: Options) -> np.ndarray:
    """Run, and print the times of the steps."""
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
    jax.config.update("jax_cpu_enable_async_dispatch", False)  # compute in this thread
    main(tyro.cli(Options, description=__doc__))
