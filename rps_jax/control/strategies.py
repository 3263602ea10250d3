"""What decides: the law, its baselines and strategies of one's own, by name and by parameters.

The class of the parameters selects the strategy. Parameters may be any pytree of numbers.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from rps_jax import errors
from rps_jax.control import guided, law, rps_plus
from rps_jax.control.bounds import Bound
from rps_jax.control.guided import GuidedParams
from rps_jax.control.law import Details, RPSParams, RPSState, Temperatures, Twist
from rps_jax.control.learned import policy
from rps_jax.control.rivals import aps, dipole, force_push, force_push_published, pursuit
from rps_jax.control.rivals.aps import APSParams, APSState
from rps_jax.control.rivals.dipole import DipoleParams
from rps_jax.control.rivals.force_push import ForcePushParams
from rps_jax.control.rivals.force_push_published import PublishedForcePushParams
from rps_jax.control.rivals.pursuit import PursuitParams
from rps_jax.control.rps_plus import RPSPlusParams
from rps_jax.robot.load_cell import LoadCell

# What a strategy is told: where the skin is touched (`law.Observation`), what each taxel answers as
# well (`learned.observation.TaxelObservation`), the contact's force as well
# (`law.LoadedObservation`), or the object's place and size (`aps.TrackedObservation`). All know
# odometry and the target.
Senses = Literal["touch", "taxels", "force", "pose"]


def numbers(params: Any) -> dict[str, Any]:
    """The leaves of parameters by their place in the pytree, as `gains.k`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(params)
    return {jax.tree_util.keystr(at, simple=True, separator="."): leaf for at, leaf in leaves}


def as_json(params: Any) -> dict[str, Any]:
    """`numbers` as JSON has them: floats, and lists of floats."""
    found = numbers(params)
    return {name: np.asarray(leaf, float).tolist() for name, leaf in found.items()}


def changed(params: Any, changes: Mapping[str, Any]) -> Any:
    """The parameters with other values at some places of the pytree, named as in `numbers`.

    Raises:
      InputError: there is no such place.
    """
    known = numbers(params)
    for name in changes:
        errors.check_name(f"parameter of {type(params).__name__}", name, known)
    leaves = [changes.get(name, leaf) for name, leaf in known.items()]
    return jax.tree.unflatten(jax.tree.structure(params), leaves)


def with_values(params: Params, values: Mapping[str, Any], source: str) -> Params:
    """The parameters with values that somebody gave, checked by their law.

    Raises:
      InputError: one of them, which came from `source`, is unknown, no number, or not allowed.
    """
    given = {key: errors.check_number(f"{source} {key}", value) for key, value in values.items()}
    found = changed(params, given)
    return of(found).check(found)


def check_finite(params: Any) -> Any:
    """The same parameters, if all their leaves are finite numbers; otherwise an InputError."""
    for name, leaf in numbers(params).items():
        for value in np.ravel(leaf):
            errors.check_finite(name, value)
    return params


class Strategy(NamedTuple):
    """Two pure functions of one world. Static, so a change compiles another program."""

    init: Callable[[Any], Any]  # params -> state
    step: Callable[[Any, Any, Any], tuple[Any, Twist, Details]]  # params, state, observation
    senses: Senses = "touch"
    smooth: bool = False  # is told the weight of a contact; others whether there is one
    check: Callable[[Any], Any] = check_finite  # raises InputError for params that mean nothing
    bounds: tuple[tuple[str, Bound], ...] = ()  # of the parameters that `rps tune es` may tune
    cell: LoadCell = LoadCell()  # by which one is told a force


def _of_module(module: ModuleType, senses: Senses = "touch") -> Strategy:
    """The strategy of a module that has `init`, `step`, `check` and BOUNDS."""
    bounds = tuple(module.BOUNDS.items())
    return Strategy(module.init, module.step, senses, check=module.check, bounds=bounds)


def _of_policy(content: bytes, source: Any) -> tuple[str, Strategy, Params]:
    """What a policy's file holds, as a strategy: its label, the strategy and its parameters."""
    found = policy.decoded(content, source)
    strategy = Strategy(*policy.functions(found), "taxels", check=policy.check)
    return policy.label(found), strategy, policy.parameters(found)


Params = RPSParams | APSParams | Any  # a pytree of numbers, of a class in STRATEGIES
RPS = Strategy(
    RPSState.init, law.step_with_details, check=law.check, bounds=tuple(law.BOUNDS.items())
)  # and NPS, by `reactive`
APS = Strategy(APSState.init, aps.aps_step, "pose", check=aps.check)
# The paper's, by name, with their parameters.
PAPER: dict[str, Params] = {"rps": RPSParams.paper(), "nps": RPSParams.nps(), "aps": APSParams()}
# Others of this package, likewise.
RIVALS: dict[str, tuple[Strategy, Params]] = {
    "rps_plus": (_of_module(rps_plus), RPSPlusParams()),
    "pursuit": (_of_module(pursuit), PursuitParams()),
    "force_push": (_of_module(force_push), ForcePushParams()),
    "force_push_published": (_of_module(force_push_published, "force"), PublishedForcePushParams()),
    "dipole": (_of_module(dipole, "pose"), DipoleParams()),
    "guided": (Strategy(guided.init, guided.step, check=guided.check), GuidedParams()),
} | {name: _of_policy(path.read_bytes(), path)[1:] for name, path in policy.SHIPPED.items()}
PARAMS: dict[str, Params] = PAPER | {name: params for name, (_, params) in RIVALS.items()}
STRATEGIES: dict[type, Strategy] = {RPSParams: RPS, APSParams: APS} | {
    type(params): strategy for strategy, params in RIVALS.values()
}  # by class of parameters
_OWN = tuple(PARAMS)
_SOURCES: dict[type, dict[str, str]] = {}  # by class of parameters: the file it was loaded from


@functools.cache  # equal temperatures are one strategy, and so one compiled program
def smooth_rps(temperatures: Temperatures = Temperatures()) -> Strategy:
    """RPS by the smooth law, for the derivatives of what it does.

    Outcomes are judged as ever. With a `SmoothSkin` all that leads from the parameters to a
    snapshot's twist is smooth, and what it saw of the contact, in `reading` and `details`.

    Raises:
      InputError: a temperature is not a positive length.
    """
    return _smooth(RPSState.init, law.step_with_details, law.check, temperatures)


@functools.cache
def smooth_rps_plus(temperatures: Temperatures = Temperatures()) -> Strategy:
    """RPS+ likewise, with its own switches smooth, too.

    Raises:
      InputError: a temperature is not a positive length.
    """
    return _smooth(rps_plus.init, rps_plus.step, rps_plus.check, temperatures)


def _smooth(
    init: Callable[..., Any],
    step: Callable[..., Any],
    check: Callable[[Any], Any],
    temperatures: Temperatures,
) -> Strategy:
    """A law whose `init` and `step` take temperatures, with these."""
    temperatures.check()
    warm = {"temperatures": temperatures}
    return Strategy(
        functools.partial(init, **warm), functools.partial(step, **warm), smooth=True, check=check
    )


def smooth_of(params: Params) -> Strategy:
    """The smooth strategy that parameters of RPS or RPS+ belong to.

    Raises:
      InputError: they are of another law, of which there is no smooth form.
    """
    known = {RPSParams: smooth_rps, RPSPlusParams: smooth_rps_plus}
    if type(params) not in known:
        raise errors.InputError(
            f"params of class {type(params).__name__} have no smooth law to be differentiated: "
            "choose rps or rps_plus."
        )
    return known[type(params)]()


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
      params: its parameters: a pytree of finite numbers (or arrays of them) of a class of its own,
        as a NamedTuple, which may be nested. Its field or property `d_success` [m] is the distance
        to the target at which a trial has succeeded.

    Raises:
      InputError: the name is one of this package's, the parameters are not such, or their class is
        that of another strategy.

    Example:
      >>> from typing import NamedTuple
      >>> from rps_jax import Details, Strategy, Twist, register_strategy
      >>> class Ahead(NamedTuple):
      ...     v: float = 0.05  # [m/s]
      ...     d_success: float = 0.05  # [m]
      >>> def step(params, memory, seen):
      ...     return memory, Twist(params.v, 0.0, 0.0), Details.of(seen)
      >>> register_strategy("ahead", Strategy(lambda params: (), step), Ahead())
    """
    if name in _OWN:
        raise errors.InputError(
            f"strategy name '{name}' is not allowed: {', '.join(_OWN)} are this package's."
        )
    kind, leaves = type(params), jax.tree.leaves(params)
    own = kind not in (dict, list, tuple) and leaves != [params]
    if not own or not hasattr(params, "d_success") or not all(map(_is_number, leaves)):
        raise errors.InputError(
            f"params = {params} of strategy '{name}' is not allowed: give a pytree of numbers of a "
            "class of its own, as a NamedTuple, with a field or property d_success [m]."
        )
    strategy.check(params)
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


def _is_number(leaf: Any) -> bool:
    return np.issubdtype(np.asarray(leaf).dtype, np.number)


# --- strategies of a user's file -----------------------------------------------------------


def named(text: str) -> tuple[str, Params]:
    """A strategy's name and parameters: by its name, as `my_law.py:MyParams`, or of `policy.npz`.

    A file of Python is run; it must register the strategy whose parameters are of that class.

    Raises:
      InputError: there is no such strategy, file or class, the file does not register it, or it
        is no policy.
    """
    if text.endswith(".npz"):
        return _learned(Path(text))
    path, _, kind = text.rpartition(":")
    if not path.endswith(".py"):
        return text, PARAMS[errors.check_name("strategy", text, PARAMS)]
    content = _read(Path(path))
    digest = hashlib.sha256(content).hexdigest()[:16]
    module = f"_rps_jax_{Path(path).stem}_{digest}"
    # It is run again if something else was registered by its name since.
    if (found := _registered(module, kind)) is None:
        _run(Path(path), module)
        found = _registered(module, kind)
    if found is not None:
        _SOURCES[type(found[1])] = {"file": str(Path(path).resolve()), "digest": digest}
        return found
    raise errors.InputError(
        f"strategy = {text} is not allowed: {path} must define the class {kind or 'of parameters'} "
        "and call rps_jax.register_strategy with parameters of it."
    )


def _learned(path: Path) -> tuple[str, Params]:
    """Name and parameters of a learned law's file, registered by a name of its own."""
    content = _read(path)
    name, strategy, params = _of_policy(content, path)
    if name not in PARAMS:
        register_strategy(name, strategy, params)
    found, digest = PARAMS[name], hashlib.sha256(content).hexdigest()[:16]
    _SOURCES[type(found)] = {"file": str(path.resolve()), "digest": digest}
    return name, found


def _registered(module: str, kind: str) -> tuple[str, Params] | None:
    """Name and parameters of the strategy whose parameters are of a class of a module."""
    own = getattr(sys.modules.get(module), kind, None)
    return next(((name, params) for name, params in PARAMS.items() if type(params) is own), None)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise errors.InputError(
            f"strategy = {path} cannot be read ({error.strerror}): give FILE.py:CLASS or "
            "a policy's FILE.npz."
        ) from error


def _run(path: Path, name: str) -> None:
    """Run a file as a module of this name."""
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except errors.InputError:
        del sys.modules[name]
        raise
    except Exception as error:  # whatever a user's file raises
        del sys.modules[name]
        raise errors.InputError(
            f"strategy = {path} cannot be run ({type(error).__name__}: {error}): mend the file."
        ) from error


def recorded(params: Params) -> dict[str, Any]:
    """Parameters as JSON, with the class that selects their strategy, and its file if it has one.

    `restored` is the opposite.
    """
    kind = type(params)
    return {"strategy": kind.__name__} | _SOURCES.get(kind, {}) | as_json(params)


def restored(values: Mapping[str, Any]) -> Params:
    """The parameters that `recorded` wrote.

    Raises:
      InputError: their class or a name in it is unknown, or their file is not what it was.
    """
    left = dict(values)
    kind, file, digest = (left.pop(key, None) for key in ("strategy", "file", "digest"))
    if file:
        _, found = named(file if file.endswith(".npz") else f"{file}:{kind}")
        if _SOURCES[type(found)]["digest"] != digest:
            raise errors.InputError(
                f"strategy = {file} is not what it was when the run was made: restore the file."
            )
    known = {type(params).__name__: params for params in PARAMS.values()}
    like = known[errors.check_name("class of parameters", str(kind), known)]
    if set(left) != set(numbers(like)):
        raise errors.InputError(
            f"parameters of {kind} are {', '.join(numbers(like))}, and not {', '.join(left)}."
        )
    shaped = {
        name: np.asarray(x, float) if np.ndim(x) else errors.check_number(name, x)
        for name, x in left.items()
    }
    return changed(like, shaped)
