"""What the texts of options mean."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rps_jax import errors
from rps_jax.errors import InputError

if TYPE_CHECKING:
    from rps_jax.control.law import RPSParams
    from rps_jax.control.strategies import Params
    from rps_jax.runs.plan import Shard
    from rps_jax.world.domain import Domain


def assignments(kind: str, texts: Sequence[str], known: Sequence[str]) -> dict[str, float]:
    """NAME=VALUE texts as a dict of floats."""
    values = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"{kind} '{text}' is not allowed: write name=value.")
        errors.check_name(kind, name, known)
        values[name] = errors.check_number(f"{kind} {name}", value)
    return values


def arms_of(names: Sequence[str], changes: Sequence[str]) -> dict[str, Params]:
    """Strategies with their parameters, changed as `--params` says."""
    from rps_jax.control import strategies
    from rps_jax.trials.conditions import arms_of as named

    arms = named(names)
    options = {name: _options(name, params) for name, params in arms.items()}
    known = list(dict.fromkeys(option for of in options.values() for option in of))
    given = assignments("params", changes, known)
    return {
        name: strategies.changed(params, {of[o]: v for o, v in given.items() if o in of})
        for (name, params), of in zip(arms.items(), options.values(), strict=True)
    }


def _options(strategy: str, params: Params) -> dict[str, str]:
    """How the options name the parameters of a strategy: option -> place in the pytree."""
    from rps_jax.control import strategies
    from rps_jax.control.law import RPSParams

    if isinstance(params, RPSParams):
        return {name: name for name in params._fields if name != "reactive"}
    return {f"{strategy}.{name}": name for name in strategies.numbers(params)}


def as_json(params: Params) -> dict[str, Any]:
    """The numbers of parameters by their place in the pytree."""
    from rps_jax.control import strategies

    return strategies.as_json(params)


def domain_of(text: str, changes: Sequence[str] = (), robot: str | None = None) -> Domain:
    """A domain by name or from a JSON file, with changes as QUANTITY=LOW,HIGH, and its robot."""
    from rps_jax.world import domain

    chosen = domain.named(text, robot)
    ranges = {}
    for change in changes:
        name, _, values = change.partition("=")
        errors.check_name("domain quantity", name, domain.RANGES)
        if values.count(",") != 1:
            raise InputError(f"change '{change}' is not allowed: write quantity=low,high.")
        if name in chosen.idle:
            raise InputError(
                f"change '{change}' is not allowed: the domain's objects, frictions, targets or "
                f"skin leave no {name} to draw."
            )
        low, high = (errors.check_number(f"domain {name}", end) for end in values.split(","))
        usual = getattr(chosen, name) or domain.Range(low, high)
        ranges[name] = usual._replace(low=low, high=high)
    return dataclasses.replace(chosen, **ranges)


def sweep_arms(names: Sequence[str], sets: Sequence[str]) -> dict[str, Params]:
    """Every strategy with every set of parameters; one that is not the law has but one."""
    from rps_jax.control.law import RPSParams
    from rps_jax.trials.conditions import arms_of as named

    labels = labels_of("params", sets)
    laws = {at: _of_the_law(name) for at, name in zip(labels, sets, strict=True)}
    asked, arms = named(names), {}
    for label, changes in laws.items():
        for strategy, params in asked.items():
            if not isinstance(params, RPSParams):
                arms[strategy] = params
            else:
                at = strategy if len(laws) == 1 else f"{strategy} {label}"
                arms[at] = params._replace(**changes)
    return arms


def compared_arms(names: Sequence[str], sets: Sequence[str]) -> dict[str, Params]:
    """RPS with every set of parameters, by the set's name; other strategies as `sweep_arms`."""
    others = [name for name in names if name != "rps"]
    errors.check_each_once("strategies", names)
    arms = {}
    if "rps" in names:
        arms = dict(zip(labels_of("params", sets), map(params_of, sets), strict=True))
    return arms | (sweep_arms(others, sets) if others else {})


def labels_of(field: str, names: Sequence[str]) -> list[str]:
    """Short names of what files hold: each file's own, after its folder's where two are alike.

    Raises:
      InputError: none is given, or one twice.
    """
    for parts in (1, 2):
        labels = ["/".join((*Path(name).parts[:-1], Path(name).stem)[-parts:]) for name in names]
        if len(set(labels)) == len(names):
            break
    errors.check_each_once(field, names, labels)
    return labels


def _of_the_law(name: str) -> dict[str, float]:
    """Changes of the paper's parameters: of `paper`, of `tuned`, or those of a JSON file."""
    from rps_jax.control.law import RPSParams
    from rps_jax.record import files

    known = _options("rps", RPSParams.paper())
    if name == "tuned":
        return {key: float(getattr(RPSParams.tuned(), key)) for key in known}
    values = {} if name == "paper" else files.read_json(Path(name))
    for key in values:
        errors.check_name(f"parameter of {name}", key, known)
    return {key: errors.check_number(f"{name} {key}", value) for key, value in values.items()}


def params_of(name: str) -> RPSParams:
    """The law's parameters: `paper`, `tuned`, or the paper's with the changes of a JSON file."""
    from rps_jax.control import law
    from rps_jax.control.law import RPSParams

    return law.check(RPSParams.paper()._replace(**_of_the_law(name)))


def start_of(strategy: str, start: str) -> Params:
    """Parameters of a strategy with which tuning begins: as known, or changed by a JSON file.

    Of RPS as `params_of`; there `paper` and `tuned` are two sets.
    """
    from rps_jax.control import strategies
    from rps_jax.record import files

    _, params = strategies.named(strategy)
    if strategy == "rps":
        return params_of(start)
    if not strategies.of(params).bounds:
        known = [name for name, own in strategies.PARAMS.items() if strategies.of(own).bounds]
        raise InputError(
            f"strategy = {strategy} is not allowed: it has no bounds to tune within; "
            f"{', '.join(known)} have."
        )
    values = {} if start == "paper" else files.read_json(Path(start))
    return strategies.with_values(params, values, start)


def shard_of(text: str) -> Shard:
    """A share of a run, as K/N."""
    from rps_jax.runs.plan import Shard

    number, _, of = text.partition("/")
    if not (number.isdecimal() and of.isdecimal()):
        raise InputError(f"shard '{text}' is not allowed: write k/n, as 3/8.")
    return Shard(int(number), int(of))
