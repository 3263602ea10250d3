"""Which laws there are: those of this package, those that were registered, and those of files.

Every file of `control.laws` is a law of the package, and every shipped policy is one. One grammar
of text names a law everywhere (`parse_law`): `rps`, `rps_tuned`, `mine.py:P`, `policy.npz`, each
with changes, as `rps,K_h=0.3` or `pursuit,mine.json`.
"""

import functools
import importlib
import importlib.util
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np

from rps_jax import errors
from rps_jax.control import laws, validation
from rps_jax.control.base import Law, LawParams, Senses, named_leaves
from rps_jax.control.learned import policy
from rps_jax.errors import InputError
from rps_jax.record import files

LawLike = str | Any  # text that names a law, or parameters of its class
LawsLike = str | Any | Sequence[Any] | Mapping[str, Any]  # one or several, or with labels

LAWS: dict[str, LawParams] = {}  # parameters of all laws that are offered, by name
_INNER: dict[str, LawParams] = {}  # of those that are not, whose names begin with an underscore
_LAWS_BY_CLASS: dict[type, Law] = {}  # by class of parameters
_SOURCES: dict[type, dict[str, str]] = {}  # by class of parameters: the file it was loaded from


def _among(name: str) -> dict[str, LawParams]:
    return _INNER if name.startswith("_") else LAWS


def _find() -> None:
    """Take the laws of the package and the policies that come with it."""
    for found in pkgutil.iter_modules(laws.__path__):
        module = importlib.import_module(f"{laws.__name__}.{found.name}")
        for name, params in module.PRESETS.items():
            _LAWS_BY_CLASS[type(params)] = module.LAW
            _among(name)[name] = params
    for name, path in policy.SHIPPED.items():
        _, law, params = policy.build_law(policy.decode(path.read_bytes(), path))
        _LAWS_BY_CLASS[type(params)], LAWS[name] = law, params


_find()
PACKAGE_LAWS = tuple(LAWS)


# --- parameters ----------------------------------------------------------------------------


def leaves_to_json(params: object) -> dict[str, Any]:
    """Numbers of parameters by their place, as JSON has them: floats, and lists of floats."""
    return {name: np.asarray(leaf, float).tolist() for name, leaf in named_leaves(params).items()}


def replace_leaves(params: LawParams, changes: Mapping[str, Any]) -> LawParams:
    """Replace parameters at some places of the pytree, named as in `named_leaves`."""
    known = named_leaves(params)
    for name in changes:
        errors.check_name(f"parameter of {type(params).__name__}", name, known)
    leaves = [changes.get(name, leaf) for name, leaf in known.items()]
    return jax.tree.unflatten(jax.tree.structure(params), leaves)


def law_of(params: LawParams | type) -> Law:
    """Look up the law that parameters, or their class, belong to; InputError if there is none."""
    kind = params if isinstance(params, type) else type(params)
    if kind not in _LAWS_BY_CLASS:
        known = ", ".join(known.__name__ for known in _LAWS_BY_CLASS)
        raise InputError(
            f"params of class {kind.__name__} belong to no law: give {known}, or register theirs "
            "with register_law."
        )
    return _LAWS_BY_CLASS[kind]


def check_params(params: LawParams) -> LawParams:
    """Return the parameters if their law can be traced and they mean something to it.

    Raises:
      InputError: they belong to no law, mean nothing, or its functions return something else than
        a trial needs.
    """
    law = law_of(params)
    validation.check_law(law.init, law.step, law.senses, params)
    law.check(params)
    return params


def smooth_law(law: Law, temperatures: Any = None) -> Law:
    """Smooth form of a law, for the derivatives of what it does.

    Outcomes are judged as ever. With a `SmoothSkin` all that leads from the parameters to a
    snapshot's twist is smooth, and what it saw of the contact, in `reading` and `details`. The
    `temperatures` of its switches are by default its own.
    """
    if law.temperatures is None:
        soft = [name for name, params in LAWS.items() if law_of(params).temperatures is not None]
        raise InputError(
            f"this law has no smooth form to be differentiated: choose {', '.join(soft)}."
        )
    return _smooth(law, law.temperatures if temperatures is None else temperatures)


@functools.cache  # equal temperatures are one law, and so one compiled program
def _smooth(law: Law, temperatures: Any) -> Law:
    temperatures.check()
    init, step = (functools.partial(f, temperatures=temperatures) for f in (law.init, law.step))
    return law._replace(init=init, step=step, smooth=True)


def register_law(name: str, law: Law, params: LawParams) -> None:
    """Make a law of one's own known, to be used as `rps` is.

    Args:
      name: what it is called; registered again, it replaces what was called so. A law whose name
        begins with an underscore is known by its parameters alone, and is offered nowhere.
      law: its two functions, and what it is.
      params: its parameters: a pytree of finite numbers (or arrays of them) of a class of its own,
        as a NamedTuple, which may be nested, with a field or property `d_success` [m].

    Raises:
      InputError: the name is one of this package's, the parameters are not such, or their class is
        that of another law.

    Example:
      >>> from typing import NamedTuple
      >>> from rps_jax import Details, Law, Twist, register_law
      >>> class Ahead(NamedTuple):
      ...     v: float = 0.05  # [m/s]
      ...     d_success: float = 0.05  # [m]
      >>> def step(params, state, obs):
      ...     return state, Twist(params.v, 0.0, 0.0), Details.from_obs(obs)
      >>> register_law("ahead", Law(lambda params: (), step), Ahead())
    """
    if not isinstance(name, str) or not isinstance(law, Law):
        raise InputError(f"law {name!r} = {law!r} is not allowed: give a name and a Law.")
    errors.check_name(f"senses of law '{name}'", law.senses, get_args(Senses))
    if name in PACKAGE_LAWS:
        raise InputError(
            f"law name '{name}' is not allowed: {', '.join(PACKAGE_LAWS)} are this package's."
        )
    kind, leaves = type(params), jax.tree.leaves(params)
    own = kind not in (dict, list, tuple) and leaves != [params]
    plain = all(np.issubdtype(np.asarray(leaf).dtype, np.number) for leaf in leaves)
    if not (own and plain and hasattr(params, "d_success")):
        raise InputError(
            f"params = {params} of law '{name}' is not allowed: give a pytree of numbers of a "
            "class of its own, as a NamedTuple, with a field or property d_success [m]."
        )
    errors.check_finite(f"d_success of law '{name}'", params.d_success, above=0, unit="m")
    law.check(params)
    for other, theirs in (_INNER | LAWS).items():
        if other != name and type(theirs).__name__ == kind.__name__ and law_of(theirs) != law:
            raise InputError(
                f"params of law '{name}' are not allowed: their class {kind.__name__} is that of "
                f"'{other}'; give them one with a name of its own."
            )
    before = _among(name).get(name)
    _among(name)[name], _LAWS_BY_CLASS[kind] = params, law
    if before is not None and type(before) not in map(type, (_INNER | LAWS).values()):
        del _LAWS_BY_CLASS[type(before)]


# --- laws by their texts -------------------------------------------------------------------


def parse_law(text: str) -> tuple[str, LawParams]:
    """Read a law's text: its label and its parameters.

    A text is the name of a law, `FILE.py:CLASS` or a policy's `FILE.npz`, followed by any number of
    changes, each `,NAME=VALUE` or `,FILE.json` with names and values, as `rps tune` writes them. A
    file of Python is run; it must register the law whose parameters are of that class, which need
    not be named if it is the only one of the file.

    Raises:
      InputError: there is no such law, file, class or parameter, or a value is not allowed.
    """
    head, *changes = str(text).split(",")
    label, params = _known(head)
    for change in changes:
        name, equals, value = change.partition("=")
        if equals:
            new = {name: errors.check_number(f"{head} {name}", value, text=True)}
        elif change.endswith(".json"):
            new = {
                key: errors.check_number(f"{change} {key}", one)
                for key, one in files.read_json(Path(change)).items()
            }
        else:
            raise InputError(
                f"law = {text} is not allowed: write changes as name=value or file.json."
            )
        params = replace_leaves(params, new)
        label += f",{change if equals else Path(change).stem}"
    return label, params


def _known(text: str) -> tuple[str, LawParams]:
    """The label and the parameters of a law without changes."""
    if text.endswith(".npz"):
        return _learned(Path(text))
    path, _, kind = (text, "", "") if text.endswith(".py") else text.rpartition(":")
    if not path.endswith(".py"):
        return text, LAWS[errors.check_name("law", text, LAWS)]
    content = _read(Path(path))
    digest = files.sha256(content)[:16]
    module = f"_rps_jax_{Path(path).stem}_{digest}"
    # It is run again if something else was registered by its name since.
    if (found := _registered(module, kind)) is None:
        run_file(Path(path), module)
        found = _registered(module, kind)
    if found is not None:
        _SOURCES[type(found[1])] = {"file": str(Path(path).resolve()), "digest": digest}
        return found
    raise InputError(
        f"law = {text} is not allowed: {path} must define "
        f"{f'the class {kind}' if kind else 'one class of parameters (name one as FILE.py:CLASS)'} "
        "and call rps_jax.register_law with parameters of it."
    )


def resolve_laws(asked: LawsLike) -> dict[str, LawParams]:
    """Read one law or several: texts, parameters, or either with names of one's own, by label.

    Of parameters without a name the label is that of the law, with a number if they are none of its
    presets.
    """
    if isinstance(asked, Mapping):
        found = {str(name): resolve_law(one)[1] for name, one in asked.items()}
    else:
        one = (
            isinstance(asked, str)
            or type(asked) in _LAWS_BY_CLASS
            or not isinstance(asked, Sequence)
        )
        several = [asked] if one else list(asked)
        pairs = [resolve_law(law, number + 1) for number, law in enumerate(several)]
        labels = _apart([label for label, _ in pairs], several)
        errors.check_each_once("laws", several, labels)
        found = dict(zip(labels, (params for _, params in pairs), strict=True))
    if not found:
        raise InputError(f"laws = {asked} is not allowed: name at least one law.")
    for params in found.values():
        check_params(params)
    return found


def resolve_law(law: LawLike, number: int = 1) -> tuple[str, LawParams]:
    """Read one law: its label and its parameters."""
    if isinstance(law, str):
        return parse_law(law)
    law_of(law)
    alike = [name for name, params in LAWS.items() if type(params) is type(law)]
    mine = named_leaves(law)
    for name in alike:
        theirs = named_leaves(LAWS[name])
        if list(theirs) == list(mine) and all(np.array_equal(mine[k], theirs[k]) for k in mine):
            return name, law
    return f"{alike[0] if alike else type(law).__name__}_{number}", law


def _apart(labels: list[str], asked: Sequence[Any]) -> list[str]:
    """Labels, with the whole text where two are alike."""
    twice = {label for label in labels if labels.count(label) > 1}
    return [
        str(one) if label in twice and isinstance(one, str) else label
        for label, one in zip(labels, asked, strict=True)
    ]


def _learned(path: Path) -> tuple[str, LawParams]:
    """Name and parameters of a learned law's file, registered by a name of its own."""
    content = _read(path)
    name, law, params = policy.build_law(policy.decode(content, path))
    kind = type(params).__name__  # it says the file's content: a copy is the law that is known
    name = next((known for known, one in LAWS.items() if type(one).__name__ == kind), name)
    if name not in LAWS:
        register_law(name, law, params)
    found, digest = LAWS[name], files.sha256(content)[:16]
    if name not in PACKAGE_LAWS:  # a copy of a shipped policy leaves that what it is
        _SOURCES[type(found)] = {"file": str(path.resolve()), "digest": digest}
    return name, found


def _registered(module: str, kind: str) -> tuple[str, LawParams] | None:
    """Name and parameters of the law whose parameters are of a class of a module.

    Without the name of a class they are of the one class there that has a law.
    """
    if kind:
        own = {getattr(sys.modules.get(module), kind, None)}
    else:
        own = {type(params) for params in LAWS.values() if type(params).__module__ == module}
    found = ((name, params) for name, params in LAWS.items() if type(params) in own)
    return next(found, None) if len(own) == 1 else None


def _read(path: Path) -> bytes:
    try:
        return files.read_regular(path, "policy" if path.suffix == ".npz" else "python")
    except OSError as error:
        raise InputError(
            f"law = {path} cannot be read ({error.strerror}): give FILE.py:CLASS or a policy's "
            "FILE.npz."
        ) from error


def run_file(path: Path, name: str) -> Any:
    """Run a user's file of Python as a module of this name; InputError for whatever it raises."""
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except InputError:
        del sys.modules[name]
        raise
    except (Exception, SystemExit) as error:  # whatever a user's file raises
        del sys.modules[name]
        raise InputError(
            f"{path} cannot be run ({type(error).__name__}: {error}): mend the file."
        ) from error
    return module


# --- laws in manifests ---------------------------------------------------------------------


def params_to_json(params: LawParams) -> dict[str, Any]:
    """Parameters as JSON, with the class that selects their law, and its file if it has one.

    `params_from_json` is the opposite.
    """
    kind = type(params)
    return {"law": kind.__name__} | _SOURCES.get(kind, {}) | leaves_to_json(params)


def params_from_json(values: Mapping[str, Any]) -> LawParams:
    """Read the parameters that `params_to_json` wrote; InputError if they cannot be had."""
    left = dict(values)
    kind, file, digest = (left.pop(key, None) for key in ("law", "file", "digest"))
    if file:  # it is compared before it is run
        if files.sha256(_read(Path(str(file))))[:16] != digest:
            raise InputError(
                f"law = {file} is not what it was when the run was made: restore the file."
            )
        parse_law(file if file.endswith(".npz") else f"{file}:{kind}")
    known = {type(params).__name__: params for params in (_INNER | LAWS).values()}
    like = known[errors.check_name("class of parameters", str(kind), known)]
    if set(left) != set(named_leaves(like)):
        raise InputError(
            f"parameters of {kind} are {', '.join(named_leaves(like))}, and not {', '.join(left)}."
        )
    shaped = {
        name: np.asarray(x, float) if np.ndim(x) else errors.check_number(name, x)
        for name, x in left.items()
    }
    return replace_leaves(like, shaped)
