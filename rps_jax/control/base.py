"""Types of a control law: its two functions, its parameters, and the bounds for tuning them."""

import contextlib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import (
    Any,
    Generic,
    Literal,
    NamedTuple,
    Protocol,
    TypeVar,
    get_args,
    get_type_hints,
    runtime_checkable,
)

import jax
import numpy as np

from rps_jax import errors
from rps_jax.control.observation import Details, Twist
from rps_jax.robot.base import LoadCell
from rps_jax.robot.robot import DriveKind

# What a law observes in addition to odometry and the target: the contact point (`Observation`),
# the signal of each taxel as well (`TaxelObservation`), the contact force as well
# (`ForceObservation`), or the object's position and size (`PoseObservation`).
Senses = Literal["touch", "taxels", "force", "pose"]


@runtime_checkable
class LawParams(Protocol):
    """Parameters of a law: a pytree of numbers whose class selects the law."""

    @property
    def d_success(self) -> Any:  # a number, or an array in a batch of parameters
        """Distance to the target at which a trial succeeds [m]."""
        ...


class Smoothing(Protocol):
    """Widths of the smoothed switches of a law; hashable."""

    def check(self) -> None:
        """Raise InputError for a width that is not allowed."""


T = TypeVar("T")
Leaf = float | np.ndarray | jax.Array  # of a pytree of parameters
Params = TypeVar("Params", bound=LawParams)
State = TypeVar("State")  # a pytree of arrays
Obs = TypeVar("Obs")


class Bound(NamedTuple):
    """Interval in which a parameter is tuned."""

    low: float
    high: float
    log: bool = False  # whether the scale is logarithmic
    relative_to: str = ""  # name of a parameter; the interval is then a fraction of its value


def document_fields(kind: type[T]) -> type[T]:
    """Copy the comment at each field of a NamedTuple into its docstring, for `help`."""
    with contextlib.suppress(OSError):  # there is no source
        source = Path(str(sys.modules[kind.__module__].__file__)).read_text("utf-8")
        body = source.partition(f"\nclass {kind.__name__}(")[2].partition("\n\n\n")[0]
        pattern = r"^(?:    # (.+)\n)?    (\w+): .*?(?:  # (.+))?$"
        for above, name, behind in re.findall(pattern, body, re.MULTILINE):
            getattr(kind, name).__doc__ = behind or above
    return kind


def bounds_of(kind: type) -> tuple[tuple[str, Bound], ...]:
    """Return the names of parameters and the bounds in their annotations."""
    hints = get_type_hints(kind, include_extras=True).items()
    return tuple((name, x) for name, hint in hints for x in get_args(hint) if isinstance(x, Bound))


def named_leaves(tree: object, is_leaf: Callable[[object], bool] | None = None) -> dict[str, Leaf]:
    """Return the leaves of a pytree by their paths, such as `gains.k`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_leaf)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def unit_of_leaf(params: object, path: str) -> str:
    """Return the unit in the comment of a parameter; empty if it has none."""
    *owners, name = path.split(".")
    for owner in owners:
        params = getattr(params, owner, None)
    doc = getattr(getattr(type(params), name, None), "__doc__", None) or ""
    return "".join(re.findall(r"^\[([^\]]*)\]", doc))


def check_finite_leaves(tree: T) -> T:
    """Return the pytree if all its leaves are finite numbers; otherwise raise InputError."""
    for name, leaf in named_leaves(tree).items():
        for value in np.ravel(leaf):
            errors.check_finite(name, value)
    return tree


def check_signs(
    law: str, positive: Sequence[str], params: Params, free: Sequence[str] = ()
) -> Params:
    """Return flat parameters if all are finite scalars of the right sign.

    Parameters named in `positive` must be above 0, those in `free` may have any sign, and all
    others must be at least 0.

    Raises:
      InputError: a parameter is out of range; the error names the `law` and the parameter.
    """
    for name, value in named_leaves(params, is_leaf=lambda x: x is not params).items():
        bounds = {} if name in free else {"at_least": 0}
        bounds = {"above": 0} if name in positive else bounds
        errors.check_finite(f"{law}.{name}", value, **bounds)
    return params


@dataclass(frozen=True)
class Law(Generic[Params, State, Obs]):
    """Control law: two pure functions of one world.

    A law is static: each law is compiled to its own program. Its parameters are a pytree of
    numbers, which may be nested, and their class selects the law. The field or property
    `d_success` [m] of the parameters is the distance to the target at which a trial succeeds.
    """

    init: Callable[[Params], State]
    step: Callable[[Params, State, Obs], tuple[State, Twist, Details]]
    senses: Senses = "touch"
    check: Callable[[Params], Params] = check_finite_leaves  # raises InputError for bad params
    # Of the parameters that may be tuned, by name.
    bounds: Mapping[str, Bound] | tuple[tuple[str, Bound], ...] = ()
    # Defaults of an earlier version that differ; a file of changes must name these parameters.
    earlier: tuple[tuple[str, float], ...] = ()
    # Default widths of the smoothed law, which `init` and `step` accept as the keyword
    # `temperatures`. None: the law has no smooth form.
    temperatures: Smoothing | None = None
    smooth: bool = False  # whether this is the smooth form; it observes `in_contact` as a weight
    cell: LoadCell = LoadCell()  # the sensor of a law that senses force
    drives: tuple[DriveKind, ...] = ("omni",)  # whose bases can follow its twists
    room: float = 0.0  # [m] without walls around the object, for its detours
    # (params, state, obs, sent twist) -> state, for a law whose state holds its last command.
    observe_sent: Callable[[Params, State, Obs, Twist], State] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", tuple(dict(self.bounds).items()))  # a law is hashable
