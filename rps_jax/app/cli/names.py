"""Which questions there are, found in the text of their files: nothing is imported for `--help`.

A module of the package is a command if it says `name = call_of(Class)`; a file or folder of a
user's own is one if it does.
"""

import functools
import importlib
import re
import sys
import textwrap
from pathlib import Path
from typing import Any, NamedTuple

from rps_jax.errors import InputError, check_name

_ROOMS = {  # where questions live, and under which heading of the help
    "runs": "sweep and replay",
    "studies": "ask of a law",
    "tuning": "tune and learn",
    "app": "look",
}
_MAKES = re.compile(r"^(\w+) = call_of\((\w+)\)$", re.MULTILINE)
_REPLACED = {"compare": "rps ladder --domain DOMAIN ..."}  # removed commands
_PACKAGE = Path(__file__).parents[2]


class Name(NamedTuple):
    """A command of the package."""

    room: str
    module: str
    question: str  # the name of the class
    summary: str


@functools.cache
def known() -> dict[str, Name]:
    """All commands by the words that call them."""
    found = {}
    for room in _ROOMS:
        for path in sorted((_PACKAGE / room).glob("*.py")):
            text = path.read_text(encoding="utf-8")
            for name, kind in _MAKES.findall(text):
                module = f"rps_jax.{room}.{path.stem}"
                found[name.replace("_", " ")] = Name(room, module, kind, _summary(text, kind))
    return found


def _summary(text: str, kind: str) -> str:
    """First line of a class's docstring."""
    found = re.search(rf'^class {kind}\b.*?"""(.*?)(?:\n|""")', text, re.MULTILINE | re.DOTALL)
    return found[1].strip() if found else ""


def overview() -> str:
    """What `rps --help` says."""
    lines = [
        "usage: rps NAME [OPTIONS]      ask one of the questions below",
        "       rps PATH [OPTIONS]      ask that of a file, or of study.py of a folder",
        "       rps NAME --help         its options",
        "       rps --version",
        "",
        "Pushing unknown objects by touch: the Reactive Pushing Strategy in MuJoCo.",
    ]
    width = max(map(len, known())) + 2
    for room, heading in _ROOMS.items():
        lines += ["", f"{heading}:"]
        for words, name in known().items():
            if name.room == room:
                hang = " " * (width + 2)
                text = textwrap.fill(name.summary, 100, initial_indent=hang, subsequent_indent=hang)
                lines.append(f"  {words.ljust(width)}{text.lstrip()}")
    return "\n".join(lines)


def split(words: list[str]) -> tuple[str, list[str]]:
    """The words that name a question, and the others."""
    for count in (2, 1):
        name = " ".join(words[:count])
        if name in known():
            return name, words[count:]
    first = words[0]
    if first in _REPLACED:
        raise InputError(f"unknown command '{first}': use `{_REPLACED[first]}`.")
    if first.endswith(".py") or "/" in first or Path(first).is_dir():
        return first, words[1:]
    check_name("command", " ".join(words[:2]) if first in ("tune", "export") else first, known())
    raise AssertionError


def question_of(name: str) -> type[Any]:
    """The class of a question, by its words or its path."""
    if name in known():
        return getattr(importlib.import_module(known()[name].module), known()[name].question)
    path = Path(name)
    path = path / "study.py" if path.is_dir() else path
    try:
        made = _MAKES.findall(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise InputError(
            f"study = {path} cannot be read ({reason}): give a file, or a folder with study.py."
        ) from error
    if len(made) != 1:
        raise InputError(
            f"study = {path} makes {len(made)} questions: it must say `name = call_of(Class)` once."
        )
    return getattr(_module_of(path.resolve()), made[0][1])


def _module_of(path: Path) -> Any:
    """The module of a file: one of its package, if it is in one, else one of its own."""
    from rps_jax.control import registry

    root = path.parent
    while (root / "__init__.py").exists():
        root = root.parent
    sys.path.insert(0, str(root))  # as Python does for a script
    if root == path.parent:
        return registry.run_file(path, f"_rps_jax_study_{path.stem}")
    try:
        return importlib.import_module(".".join(path.relative_to(root).with_suffix("").parts))
    except InputError:
        raise
    except Exception as error:  # whatever a user's file raises
        raise InputError(
            f"{path} cannot be run ({type(error).__name__}: {error}): mend the file."
        ) from error
