"""Plans of twists that bring an object to a pose, and methods that find them.

A plan is a sequence of twists of the base, each held for a while. Its entries are theta (KNOTS, 3),
and each component of a twist is its limit times tanh(theta). The errors of a plan are the
differences (3,) between the object's final and target pose, in units of TOLERANCE. A push is solved
if the error of the position and that of the yaw are at most 1.

Every method is a generator: after each iteration it yields the best plans so far of all pushes,
their errors, and the number of rollouts of each push. A reverse pass counts as one rollout.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial, wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rps_jax import Twist
from rps_jax.engines import native
from rps_jax.geometry import planar
from rps_jax.physics import ControlPeriod, Motion, Physics
from rps_jax.trials.trial import object_pose

KNOTS = 10
LIMITS = np.array([0.05, 0.05, 0.15])  # [m/s, m/s, rad/s] of each component of a twist
TOLERANCE = np.array([0.005, 0.005, np.deg2rad(2)])  # [m, m, rad]
POPULATION = 16  # samples of a round of CMA-ES and MPPI
_FAR = 2.0  # bound of theta
_STEP = 1.0  # largest change of an entry of theta in a step of Gauss-Newton
_STUCK = 100.0  # damping of a push without progress: three rejected steps

Plans = tuple[np.ndarray, np.ndarray, int]  # theta (n, KNOTS, 3), errors (n, 3), rollouts
Method = Callable[["Problem", np.ndarray], Iterator[Plans]]


def twists_of(theta: jax.Array) -> jax.Array:
    """Return the twists (..., 3) [m/s, m/s, rad/s] of entries (..., 3) of plans."""
    return jnp.tanh(theta) * LIMITS


class Start(NamedTuple):
    """Pushes (n,) to plan, from a knot on."""

    fields: Any  # (n, ...) of the stage
    motion: Motion  # (n, ...)
    target: jax.Array  # (n, 3) [m, m, rad] pose of the object
    first: jax.Array  # (n,) index of the knot


class Simulator:
    """Compiled rollouts of a stage, for plans whose twists are held for `hold` control steps."""

    def __init__(self, stage: Any, physics: Physics, hold: int) -> None:
        def batched(function: Callable[..., Any]) -> Callable[..., Any]:
            return native.batched(function, function) if stage.native else function

        def knot(fields: Any, motion: Motion, theta: jax.Array) -> Motion:
            """Step one world, or a batch, while one twist is held."""
            twists = Twist(*jnp.moveaxis(twists_of(theta), -1, 0))
            period = ControlPeriod(twists, physics)

            def step(_: int, motion: Motion) -> Motion:
                return stage.drive(fields, motion, period).motion

            return jax.lax.fori_loop(0, hold, step, motion)

        def errors(start: Start, theta: jax.Array) -> Any:
            """Return the errors (..., 3) of the final pose of the object."""

            def step(motion: Motion, inputs: Any) -> tuple[Motion, None]:
                index, entries = inputs
                moved, active = knot(start.fields, motion, entries), index >= start.first
                keep = jax.tree.map(lambda a, b: jnp.where(active[..., None], a, b), moved, motion)
                return keep, None

            inputs = jnp.arange(KNOTS), jnp.moveaxis(theta, -2, 0)
            motion, _ = jax.lax.scan(step, start.motion, inputs)
            of_one = object_pose if motion.qpos.ndim == 1 else jax.vmap(object_pose)
            position, yaw = of_one(motion.qpos)
            return errors_of(jnp.concatenate([position, yaw[..., None]], axis=-1), start.target)

        @jax.jit
        def samples(start: Start, thetas: jax.Array) -> Any:
            """Return errors (n, K, 3) of several plans (n, K, KNOTS, 3) of each push."""
            n, k = thetas.shape[:2]
            starts = jax.tree.map(lambda x: jnp.repeat(x, k, axis=0), start)
            return batched(errors)(starts, thetas.reshape(n * k, KNOTS, 3)).reshape(n, k, 3)

        @jax.jit
        def jacobian(start: Start, theta: jax.Array) -> Any:
            """Return errors (n, 3) and derivatives (n, 3, KNOTS * 3) of three reverse passes."""
            e, pull = jax.vjp(partial(errors, start), theta)
            rows = jax.vmap(lambda row: pull(jnp.broadcast_to(row, e.shape))[0])(jnp.eye(3))
            return e, jnp.moveaxis(rows, 0, 1).reshape(len(e), 3, -1)

        @jax.jit
        def gradient(start: Start, theta: jax.Array) -> Any:
            """Return errors (n, 3) and the gradient (n, KNOTS, 3) of half the sum of squares."""
            e, pull = jax.vjp(partial(errors, start), theta)
            return e, pull(e)[0]

        self.samples, self.jacobian, self.gradient = samples, jacobian, gradient
        self.knot = jax.jit(batched(knot))


def errors_of(pose: jax.Array, target: jax.Array) -> jax.Array:
    """Return the differences of poses (..., 3) [m, m, rad] in units of TOLERANCE."""
    d = pose - target
    return jnp.concatenate([d[..., :2], planar.wrap(d[..., 2:])], axis=-1) / TOLERANCE


def solved(errors: np.ndarray) -> np.ndarray:
    """Return whether errors (..., 3) are within the tolerance."""
    return (np.hypot(errors[..., 0], errors[..., 1]) <= 1) & (np.abs(errors[..., 2]) <= 1)


class Problem(NamedTuple):
    """Pushes (n,) to plan, from the knot `first` on."""

    simulator: Simulator
    fields: Any  # (n, ...) of the stage
    start: Motion  # (n, ...)
    target: jax.Array  # (n, 3) [m, m, rad] pose of the object
    first: int = 0

    def _evaluate(self, function: Callable[..., Any], theta: np.ndarray) -> Any:
        first = jnp.full(len(theta), self.first)
        start = Start(self.fields, self.start, self.target, first)
        return jax.device_get(function(start, jnp.asarray(theta, float)))

    def samples(self, thetas: np.ndarray) -> np.ndarray:
        """Return errors (n, K, 3) of plans (n, K, KNOTS, 3)."""
        return self._evaluate(self.simulator.samples, thetas)

    def jacobian(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors (n, 3) and their exact derivatives (n, 3, KNOTS * 3)."""
        return self._evaluate(self.simulator.jacobian, theta)

    def differences(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors (n, 3) and forward differences (n, 3, KNOTS * 3)."""
        delta, size = 0.02, KNOTS * 3
        steps = np.concatenate([np.zeros((1, size)), delta * np.eye(size)]).reshape(-1, KNOTS, 3)
        e = self.samples(theta[:, None] + steps)
        return e[:, 0], np.swapaxes(e[:, 1:] - e[:, :1], 1, 2) / delta

    def gradient(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors (n, 3) and the exact gradient (n, KNOTS, 3) of half their squares."""
        return self._evaluate(self.simulator.gradient, theta)


def straight(count: int) -> np.ndarray:
    """Return plans (n, KNOTS, 3) that push straight ahead."""
    theta = np.zeros((count, KNOTS, 3))
    theta[..., 0] = 0.7
    return theta


def _cost(errors: np.ndarray) -> np.ndarray:
    return np.nan_to_num(np.sum(errors.astype(float) ** 2, axis=-1), nan=np.inf)


def _best(method: Method) -> Method:
    """Return the method that yields the best plans so far instead of the last ones."""

    @wraps(method)
    def run(problem: Problem, theta: np.ndarray) -> Iterator[Plans]:
        errors = np.full((len(theta), 3), np.inf)
        for last, last_errors, count in method(problem, theta):
            better = _cost(last_errors) < _cost(errors)
            theta = np.where(better[:, None, None], last, theta)
            errors = np.where(better[:, None], last_errors, errors)
            yield theta, errors, count

    return run


def _levenberg(
    derivatives: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    theta: np.ndarray,
    rollouts: int,
) -> Iterator[Plans]:
    """Yield the plans of Gauss-Newton with Levenberg's damping of each push.

    There are three errors and 30 entries, and the step is the shortest of all that remove the
    linearised errors. A push without progress starts again nearby.
    """
    errors, jacobian = derivatives(theta)
    damping, count, random = np.ones(len(theta)), rollouts, np.random.default_rng(0)
    while True:
        yield theta, errors, count
        step = _shortest_step(errors, jacobian, damping).reshape(theta.shape)
        stuck = (damping > _STUCK) & ~solved(errors)
        restart = theta + 0.3 * random.normal(size=theta.shape)
        trial = np.clip(np.where(stuck[:, None, None], restart, theta + step), -_FAR, _FAR)
        next_errors, next_jacobian = derivatives(trial)
        better = stuck | (_cost(next_errors) < _cost(errors))
        theta = np.where(better[:, None, None], trial, theta)
        errors = np.where(better[:, None], next_errors, errors)
        jacobian = np.where(better[:, None, None], next_jacobian, jacobian)
        damping = _next_damping(damping, stuck, better)
        count += rollouts


def _shortest_step(errors: np.ndarray, jacobian: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Return the shortest steps (n, KNOTS * 3) that remove the linearised errors."""
    j = np.nan_to_num(jacobian.astype(float), posinf=0.0, neginf=0.0)
    gram = np.einsum("nik,njk->nij", j, j)
    shift = 1e-3 + 0.01 * damping * np.trace(gram, axis1=1, axis2=2) / 3
    weights = np.linalg.solve(gram + shift[:, None, None] * np.eye(3), errors[..., None])
    step = -np.einsum("nik,ni->nk", j, weights[..., 0])
    largest = np.abs(step).max(axis=1, keepdims=True)
    return step * np.minimum(1, _STEP / np.maximum(largest, _STEP))


def _next_damping(damping: np.ndarray, stuck: np.ndarray, better: np.ndarray) -> np.ndarray:
    return np.where(stuck, 1.0, np.clip(damping * np.where(better, 0.2, 8), 1e-6, 1e9))


@_best
def gauss_newton(problem: Problem, theta: np.ndarray) -> Iterator[Plans]:
    """Yield plans of Gauss-Newton with exact derivatives: a rollout and three reverse passes."""
    return _levenberg(problem.jacobian, theta, 4)


@_best
def differences(problem: Problem, theta: np.ndarray) -> Iterator[Plans]:
    """Yield plans of Gauss-Newton with forward differences."""
    return _levenberg(problem.differences, theta, 1 + KNOTS * 3)


@_best
def adam(problem: Problem, theta: np.ndarray) -> Iterator[Plans]:
    """Yield plans of Adam on exact gradients, each scaled to length 1."""
    rule, count = optax.adam(0.2), 0
    state = rule.init(jnp.asarray(theta))
    while True:
        errors, gradient = problem.gradient(theta)
        count += 2
        yield theta, errors, count
        gradient = np.nan_to_num(gradient, posinf=0.0, neginf=0.0)
        size = np.sqrt(np.sum(gradient.astype(float) ** 2, axis=(1, 2), keepdims=True))
        change, state = rule.update(jnp.asarray(gradient / np.maximum(size, 1e-9)), state)
        theta = np.asarray(theta + change)


@_best
def mppi(problem: Problem, theta: np.ndarray) -> Iterator[Plans]:
    """Yield plans of model predictive path integral control; the spread shrinks by rounds."""
    random, spread, count = np.random.default_rng(0), 0.3, 0
    while True:
        noise = spread * random.normal(size=(len(theta), POPULATION, KNOTS, 3))
        noise[:, 0] = 0
        errors = problem.samples(theta[:, None] + noise)
        cost = _cost(errors)
        best = np.arange(len(theta)), cost.argmin(axis=1)
        count += POPULATION
        yield theta + noise[best], errors[best], count
        scaled = (cost - cost.min(axis=1, keepdims=True)) / np.maximum(
            0.1 * cost.std(axis=1, keepdims=True), 1e-9
        )
        weights = np.exp(-scaled)
        weights /= weights.sum(axis=1, keepdims=True)
        theta = theta + np.einsum("nk,nkij->nij", weights, noise)
        spread *= 0.9


@_best
def cma(problem: Problem, theta: np.ndarray) -> Iterator[Plans]:
    """Yield plans of CMA-ES with a diagonal covariance (Ros and Hansen 2008), one for each push."""
    random, n, d, k = np.random.default_rng(0), len(theta), KNOTS * 3, POPULATION
    half = k // 2
    weights = np.log(half + 0.5) - np.log(np.arange(1, half + 1))
    weights /= weights.sum()
    mass = 1 / np.sum(weights**2)
    c_sigma, c_c = (mass + 2) / (d + mass + 5), (4 + mass / d) / (d + 4 + 2 * mass / d)
    damping = 1 + c_sigma + 2 * max(0.0, np.sqrt((mass - 1) / (d + 1)) - 1)
    c_1 = (d + 2) / 3 * 2 / ((d + 1.3) ** 2 + mass)
    c_mu = min(1 - c_1, (d + 2) / 3 * 2 * (mass - 2 + 1 / mass) / ((d + 2) ** 2 + mass))
    expected = np.sqrt(d) * (1 - 1 / (4 * d) + 1 / (21 * d * d))
    mean, variance, sigma = theta.reshape(n, d), np.ones((n, d)), np.full((n, 1), 0.3)
    path_sigma, path_c, count = np.zeros((n, d)), np.zeros((n, d)), 0
    while True:
        steps = random.normal(size=(n, k, d)) * np.sqrt(variance)[:, None]
        points = mean[:, None] + sigma[..., None] * steps
        errors = problem.samples(points.reshape(n, k, KNOTS, 3))
        order = np.argsort(_cost(errors), axis=1)[:, :half]
        count += k
        first = np.arange(n), order[:, 0]
        yield points[first].reshape(theta.shape), errors[first], count
        chosen = np.take_along_axis(steps, order[..., None], axis=1)
        step = np.einsum("k,nkd->nd", weights, chosen)
        mean = mean + sigma * step
        path_sigma = (1 - c_sigma) * path_sigma
        path_sigma += np.sqrt(c_sigma * (2 - c_sigma) * mass) * step / np.sqrt(variance)
        length = np.linalg.norm(path_sigma, axis=1, keepdims=True)
        bound = (1.4 + 2 / (d + 1)) * expected * np.sqrt(1 - (1 - c_sigma) ** (2 * count / k))
        path_c = (1 - c_c) * path_c + (length < bound) * np.sqrt(c_c * (2 - c_c) * mass) * step
        spread = np.einsum("k,nkd->nd", weights, chosen**2)
        variance = (1 - c_1 - c_mu) * variance + c_1 * path_c**2 + c_mu * spread
        sigma = sigma * np.exp(c_sigma / damping * (length / expected - 1))


METHODS: dict[str, Method] = {
    "gauss_newton": gauss_newton,
    "differences": differences,
    "adam": adam,
    "cma": cma,
    "mppi": mppi,
}
