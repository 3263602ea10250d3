"""The checker of shapes and types that the tests add to the calls of some modules.

beartype looks into arguments and results, and `checked` into the fields of the records among
them, too. A call is checked once for each set of types and shapes.
"""

import functools
import inspect
import typing
from typing import Any

import jax
import jaxtyping
from beartype import BeartypeConf, beartype
from beartype.door import is_bearable

MODULES = [
    "rps_jax.control.laws",
    "rps_jax.control.observation",
    "rps_jax.geometry.footprint",
    "rps_jax.geometry.planar",
    "rps_jax.robot.skin",
    "rps_jax.trials.trial",
]
CONF = BeartypeConf(is_pep484_tower=True)  # a whole number is a float


JAXTYPED = jaxtyping.jaxtyped


def install():
    """Check the calls of `MODULES`; call this before they are imported."""
    jaxtyping.install_import_hook(MODULES, "shapes.checked")
    jaxtyping.jaxtyped = checked_once  # the decorator that the hook writes


def checked_once(typechecker):
    """Return a decorator by which jaxtyping checks a call with new types or shapes."""

    def decorate(function):
        check, passed = JAXTYPED(typechecker=typechecker)(function), set()

        @functools.wraps(function)
        def call(*args, **kwargs):
            if (key := types_of((args, kwargs))) in passed:
                return function(*args, **kwargs)
            result = check(*args, **kwargs)
            passed.update([key] if key else [])
            return result

        return check if isinstance(function, type) else call

    return decorate


def types_of(arguments):
    """Return a key that calls with equal types and shapes share; None if there is none."""
    try:
        leaves, tree = jax.tree.flatten(arguments)
        key = tree, *((type(x), getattr(x, "shape", 0), getattr(x, "dtype", 0)) for x in leaves)
        hash(key)
    except (AttributeError, TypeError):  # a record without its fields, or with static arrays
        return None
    return key


def checked(function):
    """Return a function whose calls are checked; jaxtyping calls this decorator."""
    inner, signature = beartype(conf=CONF)(function), inspect.signature(function)
    typed = {name for name, item in signature.parameters.items() if item.annotation is not Any}

    @functools.wraps(function)
    def call(*args, **kwargs):
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            for item in value if type(value) is tuple else (value,):
                with JAXTYPED("context"):  # `*B` is of one record
                    look(item if name in typed else None)
        return inner(*args, **kwargs)

    return call


def look(value: Any) -> None:
    """Raise TypeError if an array of a record in `value` has another shape than annotated."""
    if not isinstance(value, tuple):
        return
    hints = shapes_of(type(value))
    for i, field in enumerate(value):
        name = value._fields[i] if hasattr(value, "_fields") else str(i)
        if name in hints and not is_bearable(field, hints[name], conf=CONF):
            kind = f"{getattr(field, 'dtype', type(field))}{list(getattr(field, 'shape', []))}"
            raise TypeError(f"{type(value).__name__}.{name} is {kind} and not {hints[name]}")
        look(field)


@functools.cache
def shapes_of(kind: type) -> dict[str, Any]:
    """Return the types of the fields that a record class annotates with a shape."""
    if not kind.__module__.startswith("rps_jax."):
        return {}
    hints = typing.get_type_hints(kind)
    return {name: hint for name, hint in hints.items() if "jaxtyping." in repr(hint)}
