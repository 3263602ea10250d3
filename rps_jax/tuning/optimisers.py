"""Optimisers and learning-rate schedules by name: those of optax, and steps of a fixed length."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import optax
from jaxtyping import PyTree

from rps_jax import errors
from rps_jax.record.manifest import Stored

_STORED = Stored(lambda name, _: {name: "custom"}, kinds=(optax.GradientTransformation,))
# Name, or a transformation of optax; a text in the command line.
OptimiserLike = Annotated[str | Any, _STORED]
ScheduleName = Literal[
    "constant", "cosine_decay", "exponential_decay", "linear", "warmup_cosine_decay"
]
SCHEDULES: dict[ScheduleName, Callable[[float, int], optax.ScalarOrSchedule]] = {
    "constant": lambda rate, steps: rate,
    "cosine_decay": optax.cosine_decay_schedule,
    "exponential_decay": lambda rate, steps: optax.exponential_decay(rate, steps, 0.1),
    "linear": lambda rate, steps: optax.linear_schedule(rate, 0.0, steps),
    "warmup_cosine_decay": lambda rate, steps: optax.warmup_cosine_decay_schedule(
        0.0, rate, max(1, steps // 10), steps
    ),
}


def fixed_length(
    learning_rate: optax.ScalarOrSchedule, momentum: float = 0.8
) -> optax.GradientTransformation:
    """Return steps whose root mean square is the learning rate, along the momentum of gradients.

    A derivative of a chaotic push has a useful direction and a useless norm.
    """

    def normalise(updates: PyTree, params: PyTree = None) -> PyTree:
        return updates / jnp.maximum(jnp.sqrt(jnp.mean(updates**2)), 1e-30)

    mean, scale = optax.ema(momentum, debias=False), optax.scale_by_learning_rate(learning_rate)
    return optax.chain(mean, optax.stateless(normalise), scale)


def optimisers() -> dict[str, Callable[..., optax.GradientTransformation]]:
    """Return `fixed_length` and the functions of optax whose first argument is a learning rate."""
    result: dict[str, Callable[..., optax.GradientTransformation]] = {"fixed_length": fixed_length}
    for name, function in inspect.getmembers(optax, inspect.isfunction):
        first = next(iter(inspect.signature(function).parameters), "")
        if first == "learning_rate" and not name.startswith(("_", "scale_by")):
            result[name] = function
    return result


def optimiser(
    name: OptimiserLike, schedule: ScheduleName, learning_rate: float, steps: int
) -> optax.GradientTransformation:
    """Return an optimiser of vectors.

    Raises:
      InputError: optax has none of this name, or it needs more than gradients and a rate.
    """
    rate = SCHEDULES[schedule](learning_rate, steps)
    rule: Any = name
    if isinstance(name, str):
        known = optimisers()
        rule = known[errors.check_name("optimiser", name, known)]
    elif not isinstance(name, optax.GradientTransformation):
        raise errors.not_allowed("optimiser", name, "give a name or a transformation of optax")
    try:
        rule = rule(rate) if isinstance(name, str) else rule
        jax.eval_shape(lambda x: rule.update(x, rule.init(x), x), jnp.zeros(2))
    except Exception as error:
        reason = "it needs more than gradients and a learning rate; choose another, as adam"
        raise errors.not_allowed("optimiser", name, reason) from error
    return rule
