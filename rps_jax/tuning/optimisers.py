"""Optimisers and learning-rate schedules by name: those of optax, and steps of a fixed length."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax

from rps_jax import errors

OptimiserLike = str | Any  # name, or a transformation of optax; a text in the command line


def fixed_length(
    learning_rate: optax.ScalarOrSchedule, momentum: float = 0.8
) -> optax.GradientTransformation:
    """Return steps whose root mean square is the learning rate, along the momentum of gradients.

    A derivative of a chaotic push has a useful direction and a useless norm.
    """

    def normalise(updates: Any, params: Any = None) -> Any:
        size = jnp.sqrt(jnp.mean(updates**2))
        return updates / jnp.where(size > 0, size, 1.0)

    mean, scale = optax.ema(momentum, debias=False), optax.scale_by_learning_rate(learning_rate)
    return optax.chain(mean, optax.stateless(normalise), scale)


def optimisers() -> dict[str, Callable[..., optax.GradientTransformation]]:
    """Return `fixed_length` and the functions of optax whose first argument is a learning rate."""
    functions = {
        name: function
        for name, function in inspect.getmembers(optax, inspect.isfunction)
        if next(iter(inspect.signature(function).parameters), "") == "learning_rate"
        and not name.startswith(("_", "scale_"))
    }
    return {"fixed_length": fixed_length} | functions


def schedules(rate: float, steps: int) -> dict[str, Callable[[], optax.Schedule]]:
    """Return the schedules of optax that a learning rate and a number of steps determine.

    A warm-up takes a tenth of the steps, and a decay ends at zero or a tenth of the rate.
    """
    values: Mapping[str, Any] = {
        "value": rate,
        "peak_value": rate,
        "end_value": 0.0,
        "decay_steps": steps,
        "transition_steps": steps,
        "warmup_steps": max(1, steps // 10),
        "decay_rate": 0.1,
        "power": 2.0,
    }
    result: dict[str, Callable[[], optax.Schedule]] = {}
    for name, function in inspect.getmembers(optax.schedules, inspect.isfunction):
        parameters = inspect.signature(function).parameters
        known = values | {"init_value": 0.0 if "peak_value" in parameters else rate}
        needed = {k: known.get(k) for k, x in parameters.items() if x.default is x.empty}
        if needed and None not in needed.values():
            result[name.removesuffix("_schedule")] = lambda f=function, x=needed: f(**x)
    return result


def optimiser(
    name: OptimiserLike, schedule: str, learning_rate: float, steps: int
) -> optax.GradientTransformationExtraArgs:
    """Return an optimiser of vectors, for gradients and values.

    Raises:
      InputError: optax has none of this name, or it needs more than gradients and values.
    """
    rate = schedules(learning_rate, steps)
    rate = rate[errors.check_name("schedule", schedule, rate)]()
    if isinstance(name, str):
        known = optimisers()
        function = known[errors.check_name("optimiser", name, known)]
        rule = optax.inject_hyperparams(function)(learning_rate=rate)
    elif isinstance(name, optax.GradientTransformation):
        rule = name
    else:
        raise errors.not_allowed("optimiser", name, "give a name or a transformation of optax")
    rule = optax.with_extra_args_support(rule)
    vector = jnp.zeros(2)
    try:
        jax.eval_shape(lambda x: rule.update(x, rule.init(x), x, value=0.0, grad=x), vector)
    except Exception as error:
        reason = "it needs more than gradients and values; choose another, as adam"
        raise errors.not_allowed("optimiser", name, reason) from error
    return rule
