"""Registry of laws: those of the package, those that a program registers, and those of files.

Every file of `control.laws` and every shipped policy is a law of the package. `parse_law` reads
the text that names a law: `rps`, `rps_tuned`, `mine.py:P` or `policy.npz`, followed by changes, as
in `rps,K_h=0.3` or `pursuit,mine.json`.
"""

import functools
import importlib
import pkgutil
import sys
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import jax
import numpy as np

from rps_jax import errors
from rps_jax.control import laws, sources, validation
from rps_jax.control.base import (
    Law,
    LawParams,
    Params,
    Senses,
    Smoothing,
    bounds_of,
    freeze_functions,
    named_leaves,
    thawing,
)
from rps_jax.control.learned import policy
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.record.manifest import Stored
from rps_jax.record.options import parse_changes
from rps_jax.robot.robot import DriveKind
from rps_jax.spec import Named

T = TypeVar("T")  # a pytree
# Both are `Any` for the command line, which reads a text; a program may pass parameters.
STORED_LAW = Stored(lambda name, law: {name: params_to_json(resolve_law(law)[1])})
STORED_LAWS = Stored(
    lambda name, laws: {name: {k: params_to_json(x) for k, x in resolve_laws(laws).items()}},
    lambda name, entries, folder: {
        label: params_from_json(values, folder) for label, values in dict(entries[name]).items()
    },
)
_NAMED = Named(lambda: LAWS)
# Text that names a law, or parameters of its class.
LawLike = Annotated[str | Any, STORED_LAW, _NAMED]
# One law or several, or labelled laws.
LawsLike = Annotated[str | Any | Sequence[Any] | Mapping[str, Any], STORED_LAWS, _NAMED]

LAWS: dict[str, LawParams] = {}  # parameters of all offered laws, by name
_HIDDEN: dict[str, LawParams] = {}  # of laws that are not offered: names with an underscore
_LAWS_BY_CLASS: dict[type, Law] = {}  # by class of parameters
_FILES = threading.RLock()  # a thread reads the file of a law, and others wait
_SOURCES: dict[type, dict[str, str]] = {}  # file and digest, by class of parameters


def _table(name: str) -> dict[str, LawParams]:
    """Return the table to which a law of this name belongs."""
    return _HIDDEN if name.startswith("_") else LAWS


def _load_package_laws() -> None:
    """Register the laws of the package and the policies shipped with it."""
    for file in pkgutil.iter_modules(laws.__path__):
        module = importlib.import_module(f"{laws.__name__}.{file.name}")
        for name, params in module.PRESETS.items():
            _LAWS_BY_CLASS[type(params)] = module.LAW
            _table(name)[name] = params
    for name in policy.SHIPPED:
        _, law, params = policy.build_law(policy.read(name))
        _LAWS_BY_CLASS[type(params)], LAWS[name] = law, params


_load_package_laws()
PACKAGE_LAWS = tuple(LAWS)


# --- parameters ----------------------------------------------------------------------------


def leaves_to_json(tree: object) -> JsonObject:
    """Return the leaves of a pytree by path, as floats and lists of floats."""
    return {name: np.asarray(leaf, float).tolist() for name, leaf in named_leaves(tree).items()}


def replace_leaves(tree: T, changes: Mapping[str, object]) -> T:
    """Replace leaves of parameters, or of any pytree, by their paths (see `named_leaves`)."""
    leaves = named_leaves(tree)
    for name in changes:
        errors.check_name(f"parameter of {type(tree).__name__}", name, leaves)
    return jax.tree.unflatten(jax.tree.structure(tree), list({**leaves, **changes}.values()))


def law_of(params: LawParams | type) -> Law:
    """Return the law of parameters, or of their class; InputError if there is none.

    Examples:
      >>> law_of(resolve_law("rps_plus")[1]).senses
      'touch'
    """
    kind = params if isinstance(params, type) else type(params)
    if kind not in _LAWS_BY_CLASS:
        known = ", ".join(known.__name__ for known in _LAWS_BY_CLASS)
        fix = f"give a text, {known}, a list of several, or a law of register_law"
        raise InputError(f"params of class {kind.__name__} belong to no law: {fix}.")
    return _LAWS_BY_CLASS[kind]


def laws_for(drive: DriveKind) -> list[str]:
    """Return the offered laws for goals without a heading whose twists such a base can follow."""
    laws = {name: law_of(params) for name, params in LAWS.items()}
    return [name for name, law in laws.items() if drive in law.drives and not law.heading]


def check_drive(params: LawParams, drive: DriveKind) -> None:
    """Raise InputError unless a base with this drive can follow the law's twists."""
    if drive in law_of(params).drives:
        return
    known = " or ".join(laws_for(drive))
    rule = f"it moves sideways, which a base with drive = {drive} cannot; choose {known}"
    if not type(params).__module__.startswith("rps_jax."):
        rule += f', or declare Law(..., drives=("{drive}",)) of this one if it does not'
    raise errors.not_allowed("law", name_of(params), rule)


def preset_of(params: object) -> LawParams | None:
    """Return the first registered parameters of the same class."""
    return next((x for x in LAWS.values() if type(x) is type(params)), None)


def name_of(params: LawParams) -> str:
    """Return the name of a law with these parameters, or of the first with parameters like them."""
    leaves, kind = jax.tree.leaves(params), type(params)
    names = {name: jax.tree.leaves(x) for name, x in LAWS.items() if type(x) is kind}
    same = (name for name, x in names.items() if all(map(np.array_equal, x, leaves)))
    return next(same, next(iter(names), kind.__name__))


def check_params(params: Params) -> Params:
    """Return the parameters if their law accepts them and can be traced.

    Raises:
      InputError: the parameters belong to no law, their values are not allowed, or the functions
        of their law do not return what a trial needs.
    """
    law = law_of(params)
    validation.check_law(law, params)
    law.check(params)
    return params


def smooth_law(law: Law, temperatures: Smoothing | None = None) -> Law:
    """Return the smooth form of a law, for derivatives of its actions.

    If the skin has a temperature, the twist of a snapshot is a smooth function of the parameters,
    and so are the contact in `reading` and `details`. Outcomes stay discrete. By default the
    `temperatures` (widths of the switches) are those of the law.
    """
    if law.temperatures is None:
        names = ", ".join(k for k, x in LAWS.items() if law_of(x).temperatures is not None)
        rule = f"this law has no smooth form; choose {names}, or smooth=False, whose derivatives "
        raise errors.not_allowed("smooth", True, f"{rule}miss all switches of the law")
    return _smooth_law(law, law.temperatures if temperatures is None else temperatures)


@functools.cache  # equal temperatures give one law, and so one compiled program
def _smooth_law(law: Law, temperatures: Smoothing) -> Law:
    temperatures.check()
    init, step = (functools.partial(f, temperatures=temperatures) for f in (law.init, law.step))
    return replace(law, init=init, step=step, smooth=True)


def register_law(name: str, law: Law, params: LawParams) -> None:
    """Register a custom law, to be used like `rps`.

    Args:
      name: name of the law. It replaces a custom law that was registered by this name. A law whose
        name begins with an underscore is not listed, and is selected by its parameters.
      law: the two functions of the law, and its properties.
      params: default parameters: a pytree of finite numbers or arrays, which may be nested, of a
        class that no other law has, such as a NamedTuple, with a field or property `d_success` [m].

    Raises:
      InputError: the name is a law of this package, the parameters are not as described, or their
        class belongs to another law.

    Examples:
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
        raise errors.not_allowed(f"law {name!r}", repr(law), "pass a name and a Law")
    errors.check_name(f"senses of law '{name}'", law.senses, get_args(Senses))
    if name in PACKAGE_LAWS:
        rule = f"the package has the laws {', '.join(PACKAGE_LAWS)}"
        raise errors.not_allowed("name of a law", name, rule)
    kind, leaves = type(params), jax.tree.leaves(params)
    is_custom = kind not in (dict, list, tuple) and leaves != [params]
    numbers = [leaf for leaf in leaves if not callable(leaf)]
    is_numeric = all(np.issubdtype(np.asarray(leaf).dtype, np.number) for leaf in numbers)
    if not (is_custom and is_numeric and isinstance(params, LawParams)):
        rule = "pass a pytree of numbers of a custom class with a field or property d_success [m]"
        raise errors.not_allowed(f"params of law '{name}'", params, rule)
    if len(numbers) < len(leaves):
        names = [x for x in ("init", "step", "observe_sent") if getattr(law, x)]
        law = replace(law, **{name: thawing(getattr(law, name)) for name in names})
    params = freeze_functions(params)
    errors.check_finite(f"d_success of law '{name}'", params.d_success, above=0, unit="m")
    law.check(params)
    law = law if law.bounds else replace(law, bounds=bounds_of(kind))
    for parameter in dict(law.bounds):
        errors.check_name(f"bound of law '{name}'", parameter, named_leaves(params))
    for label, known in (_HIDDEN | LAWS).items():
        if label != name and type(known).__name__ == kind.__name__ and law_of(known) != law:
            rule = f"the law '{label}' has a class of the same name {kind.__name__}; rename one"
            raise errors.not_allowed(f"class of params of law '{name}'", kind, rule)
    previous = _table(name).get(name)
    _table(name)[name], _LAWS_BY_CLASS[kind] = params, law
    if previous is not None and type(previous) not in map(type, (_HIDDEN | LAWS).values()):
        del _LAWS_BY_CLASS[type(previous)]


# --- texts that name a law -----------------------------------------------------------------


def parse_law(text: str) -> tuple[str, LawParams]:
    """Parse the text of a law, and return its label and its parameters.

    A text is the name of a law, `FILE.py:CLASS` or the `FILE.npz` of a policy, followed by any
    number of changes, each `,NAME=VALUE` or `,FILE.json` with names and values, as `rps tune`
    writes it. A Python file is run; it must register the law with parameters of that class. The
    class may be omitted if the file registers only one.

    Raises:
      InputError: the law, file, class or parameter does not exist, or a value is not allowed.
    """
    label, params = _parse_head(str(text).partition(",")[0])
    head, changes = parse_changes("law", str(text))
    shapes = {name: np.shape(leaf) for name, leaf in named_leaves(params).items()}
    values = {k: _parse_leaf(f"{head} {k}", x, shapes.get(k, ())) for k, x in changes.items()}
    words = str(text).split(",")[1:]
    parts = (Path(x).stem if files.suffix_of(x) == ".json" else x for x in words)
    label = ",".join([label, *parts])
    return label, replace_leaves(params, values)


def _parse_leaf(field: str, value: object, shape: tuple[int, ...]) -> object:
    """Return a number, or an array of this shape of nested lists, or raise InputError."""
    if not shape:
        return errors.check_number(field, value)
    several = np.array(value, object)
    if several.shape != shape:
        raise errors.not_allowed(field, f"of shape {several.shape}", f"give numbers {shape}")
    return np.reshape([errors.check_number(field, x) for x in several.flat], shape)


def _parse_head(text: str) -> tuple[str, LawParams]:
    """Return the label and the parameters of a law without changes."""
    if files.suffix_of(text) == ".npz":
        return _load_policy(Path(text))
    path, _, kind = (text, "", "") if _is_python(text) else text.rpartition(":")
    if not _is_python(path):
        return text, LAWS[errors.check_name("law", text, LAWS, "FILE.py or policy.npz")]
    with _FILES:
        # The file is run again if another law has taken its name since.
        if (law := _find_registered(sources.load(Path(path)), kind)) is None:
            law = _find_registered(sources.load(Path(path), again=True), kind)
    if law is None:
        needed = f"the class {kind}" if kind else "one class of parameters (or use FILE.py:CLASS)"
        rule = f"{path} must define {needed} and call rps_jax.register_law with an instance of it"
        raise errors.not_allowed("law", text, rule)
    _SOURCES[type(law[1])] = sources.describe(Path(path))
    return law


def _is_python(path: str) -> bool:
    return files.suffix_of(path) == ".py"


def _find_registered(module: str, kind: str) -> tuple[str, LawParams] | None:
    """Return the name and parameters of the law whose class is defined in a module.

    Without a class name, the module must define the class of exactly one law.
    """
    required = getattr(sys.modules.get(module), kind, None) if kind else None
    matches = [
        (name, params)
        for name, params in LAWS.items()
        if (type(params) is required if kind else type(params).__module__ == module)
    ]
    return matches[0] if len({type(params) for _, params in matches}) == 1 else None


def _load_policy(path: Path) -> tuple[str, LawParams]:
    """Register the learned law of a file, and return its name and parameters."""
    name, law, params = policy.build_law(policy.read(str(path)))
    kind = type(params).__name__  # contains a digest, so that a copy is the law that is known
    name = next((known for known, p in LAWS.items() if type(p).__name__ == kind), name)
    if name not in LAWS:
        register_law(name, law, params)
    params = LAWS[name]
    if name not in PACKAGE_LAWS:  # a copy of a shipped policy stays a law of the package
        _SOURCES[type(params)] = sources.describe(path)
    return name, params


def resolve_law(law: LawLike, index: int = 0) -> tuple[str, LawParams]:
    """Return the label and the parameters of a law.

    The label of parameters is the name of the law; with a number, `index` + 1, unless they are one
    of its presets.

    Examples:
      >>> label, params = resolve_law("rps,K_h=0.5")
      >>> label, params.K_h
      ('rps,K_h=0.5', 0.5)
    """
    if isinstance(law, str):
        return parse_law(law)
    if isinstance(law, type):
        rule = f"give parameters, as {law.__name__}()"
        raise errors.not_allowed("law", f"the class {law.__name__}", rule)
    law_of(law)
    frozen: LawParams = freeze_functions(law)
    presets = {name: params for name, params in LAWS.items() if type(params) is type(law)}
    for name, params in presets.items():
        if leaves_to_json(params) == leaves_to_json(frozen):
            return name, frozen
    return f"{next(iter(presets), type(law).__name__)}_{index + 1}", frozen


def resolve_laws(laws: LawsLike) -> dict[str, LawParams]:
    """Return the parameters of one law or several, by label.

    A law is a text or parameters; a mapping gives the labels. Where two texts have the same label,
    the whole text is the label.
    """
    if isinstance(laws, Mapping):
        resolved = {str(label): resolve_law(law)[1] for label, law in laws.items()}
    else:
        is_single = isinstance(laws, str) or type(laws) in _LAWS_BY_CLASS
        items = list(laws) if isinstance(laws, Sequence) and not is_single else [laws]
        pairs = [resolve_law(law, index) for index, law in enumerate(items)]
        counts = Counter(label for label, _ in pairs)
        labels = [
            law if counts[label] > 1 and isinstance(law, str) else label
            for (label, _), law in zip(pairs, items, strict=True)
        ]
        errors.check_each_once("laws", items, labels)
        resolved = dict(zip(labels, (params for _, params in pairs), strict=True))
    if not resolved:
        raise errors.not_allowed("laws", laws, "name at least one law")
    return {label: check_params(params) for label, params in resolved.items()}


# --- laws in manifests ---------------------------------------------------------------------


def params_to_json(params: LawParams) -> JsonObject:
    """Return parameters as JSON, with their class, and the file of a custom law.

    `params_from_json` is the inverse.
    """
    kind = type(params)
    return {"law": kind.__name__} | _SOURCES.get(kind, {}) | leaves_to_json(params)


def params_from_json(values: JsonObject, run: Path | None = None) -> LawParams:
    """Return the parameters that `params_to_json` wrote.

    A law whose file has changed is loaded from its copy in the folder of the run.

    Raises:
      InputError: their class is unknown, the file of their law has changed and the run has no copy,
        or names differ.
    """
    leaves = dict(values)
    kind = leaves.pop("law", None)
    source = {key: leaves.pop(key) for key in ("file", "digest", "imports") if key in leaves}
    if source:
        file = str(sources.find(source, run))
        _, law = parse_law(file if files.suffix_of(file) == ".npz" else f"{file}:{kind}")
        if type(law) in _SOURCES:
            _SOURCES[type(law)] = source
    known = {type(params).__name__: params for params in (_HIDDEN | LAWS).values()}
    params = known[errors.check_name("class of parameters", str(kind), known)]
    names = named_leaves(params)
    if set(leaves) != set(names):
        rule = f"they are {', '.join(names)}"
        raise errors.not_allowed(f"parameters of {kind}", ", ".join(leaves), rule)
    arrays = {
        name: np.asarray(x, float) if np.ndim(x) else errors.check_number(name, x)
        for name, x in leaves.items()
    }
    return replace_leaves(params, arrays)
