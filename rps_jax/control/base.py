"""What a law is: two pure functions, what it senses, and within which bounds it is tuned."""

import contextlib
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax
import numpy as np

from rps_jax import errors
from rps_jax.control.observation import Details, Twist
from rps_jax.robot.base import LoadCell

T = TypeVar("T")


@runtime_checkable
class LawParams(Protocol):
    """Parameters of a law: a pytree of numbers whose class selects the law."""

    @property
    def d_success(self) -> Any:  # a number, or an array of a batch
        """Distance to the target at which a trial has succeeded [m]."""
        ...


Params = TypeVar("Params", bound=LawParams)

# What a law senses: where the skin is touched (`Observation`), what each taxel answers as well
# (`TaxelObservation`), the contact's force as well (`ForceObservation`), or the object's place and
# size (`PoseObservation`). All know odometry and the target.
Senses = Literal["touch", "taxels", "force", "pose"]


class Bound(NamedTuple):
    """The interval in which a parameter is tuned."""

    low: float
    high: float
    log: bool = False  # evenly in its logarithm
    of: str = ""  # as a share of this other parameter


def document_fields(kind: type[T]) -> type[T]:
    """Give the fields of a NamedTuple the comments behind them as docstrings, for `help`."""
    with contextlib.suppress(OSError):  # there is no source
        text = Path(str(sys.modules[kind.__module__].__file__)).read_text("utf-8")
        own = text.partition(f"\nclass {kind.__name__}(")[2].partition("\n\n\n")[0]
        for name, comment in re.findall(r"^    (\w+): .*?  # (.+)$", own, re.MULTILINE):
            getattr(kind, name).__doc__ = comment
    return kind


def named_leaves(params: Any, is_leaf: Callable[[Any], bool] | None = None) -> dict[str, Any]:
    """Leaves of parameters by their place in the pytree, as `gains.k`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(params, is_leaf=is_leaf)
    return {jax.tree_util.keystr(at, simple=True, separator="."): leaf for at, leaf in leaves}


def check_finite_leaves(params: T) -> T:
    """Return the parameters if all their leaves are finite numbers, or raise InputError."""
    for name, leaf in named_leaves(params).items():
        for value in np.ravel(leaf):
            errors.check_finite(name, value)
    return params


def check_signs(
    law: str, positive: Sequence[str], params: Params, free: Sequence[str] = ()
) -> Params:
    """Return parameters of one level if they are finite scalars of the right signs.

    Those named `positive` must be above 0, those `free` may have any sign, and all others must not
    be negative; else InputError names the `law` and the parameter.
    """
    for name, value in params._asdict().items():
        bounds = {} if name in free else {"at_least": 0}
        bounds = {"above": 0} if name in positive else bounds
        errors.check_finite(f"{law}.{name}", value, **bounds)
    return params


class Law(NamedTuple):
    """A pushing law as two pure functions of one world.

    It is static: a change compiles another program. The parameters of a law are a pytree of
    numbers of a class of their own, which may be nested; the class selects the law. Their field or
    property `d_success` [m] is the distance to the target at which a trial has succeeded.
    """

    init: Callable[[Any], Any]  # params -> state
    step: Callable[[Any, Any, Any], tuple[Any, Twist, Details]]  # params, state, obs
    senses: Senses = "touch"
    check: Callable[[Any], Any] = check_finite_leaves  # raises InputError if params are invalid
    bounds: tuple[tuple[str, Bound], ...] = ()  # of the parameters that may be tuned
    # Of the smooth form: `init` and `step` then take them as `temperatures`. None: it has none.
    temperatures: Any = None
    smooth: bool = False  # it is that form, and observes the weight of a contact
    cell: LoadCell = LoadCell()  # by which it senses a force
    # Of a law that observes its last twist: params, state, obs, twist sent -> state.
    observe_sent: Callable[[Any, Any, Any, Twist], Any] | None = None
