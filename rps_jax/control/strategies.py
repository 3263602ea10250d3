"""What decides: the law, its baselines and one's own strategies, by name and by their parameters.

A strategy is known by the class of its parameters: whoever has parameters has the strategy.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

from rps_jax import errors
from rps_jax.control import aps, law
from rps_jax.control.aps import APSParams, APSState
from rps_jax.control.law import Details, RPSParams, RPSState, Temperatures, Twist


def check_finite(params: Any) -> Any:
    """The same parameters (a NamedTuple), if all are finite numbers; otherwise an InputError."""
    for name, value in params._asdict().items():
        errors.check_finite(name, value)
    return params


class Strategy(NamedTuple):
    """Two pure functions of one world. Static, so a change compiles another program."""

    init: Callable[[Any], Any]  # params -> state
    step: Callable[[Any, Any, Any], tuple[Any, Twist, Details]]  # params, state, observation
    tracks: bool = False  # observes a TrackedObservation: the object's place as well
    smooth: bool = False  # is told the weight of a contact; others whether there is one
    check: Callable[[Any], Any] = check_finite  # raises InputError for params that mean nothing


Params = RPSParams | APSParams | Any  # a NamedTuple of numbers, of a class in STRATEGIES
RPS = Strategy(RPSState.init, law.step_with_details, check=law.check)  # and NPS, by `reactive`
APS = Strategy(APSState.init, aps.aps_step, tracks=True, check=aps.check)
STRATEGIES: dict[type, Strategy] = {RPSParams: RPS, APSParams: APS}  # by class of parameters
# The paper's, by name, with their parameters.
PAPER: dict[str, Params] = {"rps": RPSParams.paper(), "nps": RPSParams.nps(), "aps": APSParams()}
PARAMS: dict[str, Params] = dict(PAPER)  # by name


@functools.cache  # equal temperatures are one strategy, and so one compiled program
def smooth_rps(temperatures: Temperatures = Temperatures()) -> Strategy:
    """RPS by the smooth law, for the derivatives of what it does.

    Outcomes are judged as ever. With a `SmoothSkin` all that leads from the parameters to a
    snapshot's twist is smooth, and what it saw of the contact, in `reading` and `details`.

    Raises:
      InputError: a temperature is not a positive length.
    """
    temperatures.check()
    return Strategy(
        functools.partial(RPSState.init, temperatures=temperatures),
        functools.partial(law.step_with_details, temperatures=temperatures),
        smooth=True,
        check=law.check,
    )


def of(params: Params) -> Strategy:
    """The strategy that parameters belong to.

    Raises:
      InputError: to none.
    """
    kind = type(params)
    if kind not in STRATEGIES:
        known = ", ".join(known.__name__ for known in STRATEGIES)
        raise errors.InputError(
            f"params of class {kind.__name__} belong to no strategy: give {known}, or register "
            "theirs with register_strategy."
        )
    return STRATEGIES[kind]


def register_strategy(name: str, strategy: Strategy, params: Params) -> None:
    """Make a strategy of one's own known, to be used as `rps`, `nps` and `aps` are.

    Args:
      name: what it is called; registered again, it replaces what was called so.
      strategy: its functions, as `law.step_with_details` and `RPSState.init`.
      params: its parameters: a NamedTuple of finite numbers, one of them `d_success` [m], the
        distance to the target at which a trial has succeeded.

    Raises:
      InputError: the name is one of the paper's, the parameters are not such, or their class is
        that of another strategy.
    """
    if name in PAPER:
        raise errors.InputError(
            f"strategy name '{name}' is not allowed: {', '.join(PAPER)} are the paper's."
        )
    if not hasattr(params, "_asdict") or not hasattr(params, "d_success"):
        raise errors.InputError(
            f"params = {params} of strategy '{name}' is not allowed: give a NamedTuple of numbers, "
            "one of them d_success [m]."
        )
    strategy.check(params)
    kind = type(params)
    for other, theirs in PARAMS.items():
        if other != name and type(theirs).__name__ == kind.__name__ and of(theirs) != strategy:
            raise errors.InputError(
                f"params of strategy '{name}' are not allowed: their class {kind.__name__} is that "
                f"of '{other}'; give them one with a name of its own."
            )
    PARAMS[name] = params
    STRATEGIES[kind] = strategy
    for unused in set(STRATEGIES) - {type(p) for p in PARAMS.values()}:
        del STRATEGIES[unused]  # of what was called so before
