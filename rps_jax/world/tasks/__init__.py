"""Tasks: what a law gets as its target, and when a trial succeeds or fails; one file each."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np

from rps_jax import errors
from rps_jax.record import files
from rps_jax.record.files import JsonObject
from rps_jax.record.manifest import Stored
from rps_jax.record.options import field_types, parse_changes
from rps_jax.spec import Named, Spec
from rps_jax.world.quantity import Quantity, claim, declared, numbers_of, range_of
from rps_jax.world.tasks.base import Task

TASKS: dict[str, type[Task]] = {}  # by name
QUANTITIES: dict[str, Quantity] = {}  # drawn quantities of all tasks
UNRANGED: set[str] = set()  # random numbers of all tasks without a range
OUTCOMES: dict[str, Spec] = {}
FAILURES: dict[str, str] = {}


def add(task: type[Task]) -> None:
    """Add a class of tasks, and claim the names of its random numbers; see `register_task`."""
    quantities = declared(task)
    names = {*numbers_of(quantities), *task.NUMBERS}
    for name in {*quantities, *names}:  # the first class that declares it owns it
        owner = next(x for x in reversed(task.__mro__) if name in _names_of(x))
        claim(f"the task {getattr(owner, 'kind', '') or owner.__name__}", name)
        new = quantities.get(name)
        if owner is not task and new is not None and QUANTITIES.get(name, new) != new:
            rule = f"{owner.__name__} declares it as {QUANTITIES[name]}; choose another name"
            raise errors.not_allowed(f"quantity of the task {task.kind}", name, rule)
    claim("an outcome of tasks", *task.OUTCOMES)
    for name, outcome in task.OUTCOMES.items():
        if OUTCOMES.get(name, outcome) != outcome:
            rule = f"another task has it as {OUTCOMES[name]}; choose another name"
            raise errors.not_allowed(f"outcome of the task {task.kind}", name, rule)
    TASKS[task.kind] = task
    QUANTITIES.update(quantities)
    UNRANGED.update(names - quantities.keys())
    OUTCOMES.update(task.OUTCOMES)
    FAILURES.update(task.FAILURES)


def _names_of(kind: type) -> set[str]:
    """Return the names that a class, or a base class of it, declares."""
    if not issubclass(kind, Task):
        return set()
    return {*(quantities := declared(kind)), *numbers_of(quantities), *kind.NUMBERS}


for _file in sorted(x.name for x in pkgutil.iter_modules(__path__) if x.name != "base"):
    add(importlib.import_module(f"{__name__}.{_file}").TASK)
PACKAGE_TASKS = tuple(TASKS)
_SUBJECTS = {1: "the base ", 2: "the object "}

# For errors: of ranges, of types, and of tuples of tuples by their sizes.
_RANGE = "a number, or low and high as [0.3, 0.6]"
_FORMS = {
    bool: "true or false",
    int: "a whole number",
    2: "pairs of x, y [m], without a heading",
    3: "x, y, yaw",
}


def _stored(name: str, task: Any) -> JsonObject:
    """Return the entries of a task; none for `reach`, as in the manifests of earlier versions."""
    parsed = parse_task("reach" if task is None else task)
    return {} if parsed == TASKS["reach"]() else {name: asdict(parsed)}


_KINDS = (Task, str, Mapping, type(None))
_NAMED = Named(lambda: TASKS)
TaskLike = Annotated[Task | str | Mapping[str, Any], Stored(_stored, kinds=_KINDS), _NAMED]


def failures_of(outcomes: Mapping[str, Any]) -> list[str]:
    """Return in words how a task has failed, by the outcomes of one trial."""
    failed = {name: int(outcomes[name]) for name in FAILURES if outcomes.get(name, 0) > 0}
    return [_SUBJECTS.get(value, "") + FAILURES[name] for name, value in failed.items()]


def parse_task(task: TaskLike) -> Task:
    """Return a task from its name, as path, or from a mapping with its kind.

    Changes may follow a name, as `corridor,width=1.2:1.6`, or a JSON or YAML file of them, as
    `path,route.json` with `{"waypoints": [[0.4, 0], [2, 0], [3, 1]]}`. Without a kind, a mapping
    with waypoints is a path, and one with polygons or an image is `rooms`: see `Task.MARKS`.

    Raises:
      InputError: the name or a value is not allowed.
    """
    if isinstance(task, Task):
        return task
    if isinstance(task, str):
        name, changes = parse_changes("task", task)
        if files.suffix_of(name) in files.FIELD_FILES:
            task = files.read_fields(Path(name)) | changes
        else:
            task = {"kind": name} | changes
    if isinstance(task, Mapping):
        names = {name for name, value in task.items() if str(value) not in ("()", "[]")}
        kinds = [{"kind": name} for name, kind in TASKS.items() if names & set(kind.MARKS)]
        task = {**(kinds or [{}])[0], **task}
    if not isinstance(task, Mapping) or "kind" not in task:
        rule = f"give a kind ({', '.join(TASKS)}), waypoints as [[0.4, 0], [2, 1]], or a map"
        raise errors.not_allowed("task", repr(task), rule)
    kind = TASKS[errors.check_name("task", str(task["kind"]), TASKS, "FILE.json")]
    known = {x.name: x for x in fields(kind)}
    values: dict[str, Any] = {}
    for name, value in task.items():
        errors.check_name(f"task quantity of {kind.kind}", name, known | dict.fromkeys(kind.MARKS))
        if name == "kind" or name not in known:
            continue
        default: Any = known[name].default
        if value is default:
            continue
        inner = get_args(field_types(kind)[name])
        size = len(get_args(inner[0])) if inner else 0
        try:
            if name in declared(kind):
                value = range_of(default, value)
            elif isinstance(default, bool):
                value = {"true": True, "false": False}[str(value).lower()]
            elif isinstance(default, int) and float(value).is_integer():
                value = int(value)
            elif isinstance(default, tuple):
                points = np.asarray(value, float)
                # Of a text, as 1:0:2:1, or a single one.
                points = points.reshape(-1, size) if points.ndim == 1 else points
                if points.size and points.shape[1:] != (size,):
                    raise ValueError("other sizes")
                value = tuple(map(tuple, points.tolist()))
        except (LookupError, TypeError, ValueError, OverflowError) as error:
            form = _RANGE if name in declared(kind) else _FORMS[size or type(default)]
            raise errors.not_allowed(f"task {name}", value, f"write {form}") from error
        values[name] = value
    file = {name: value for name, value in task.items() if name not in known}
    return kind(**values | kind.read(file, values))
