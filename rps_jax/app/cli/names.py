"""Names of the commands, found in the text of their files: `rps --help` imports none of them.

A module of the package defines a command by `name = call_of(Class)`. So does the file of a custom
question, or `study.py` of a folder.
"""

import functools
import importlib
import itertools
import re
import sys
import textwrap
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

from rps_jax.errors import InputError, check_name

if TYPE_CHECKING:
    from rps_jax.runs.question import Question

_HEADINGS = {  # of the help, by the rooms that define commands
    "runs": "sweep and replay",
    "studies": "ask of a law",
    "tuning": "tune and learn",
    "app": "look",
}
_DEFINITION = re.compile(r"^(\w+) = call_of\((\w+)\)$", re.MULTILINE)
_PACKAGE = Path(__file__).parents[2]


class Command(NamedTuple):
    """A command of the package."""

    module: str
    class_name: str
    summary: str  # first line of the class's docstring


@functools.cache
def known() -> dict[str, Command]:
    """Return all commands of the package by their names."""
    commands = {}
    for room in _HEADINGS:
        for path in sorted((_PACKAGE / room).glob("*.py")):
            text = path.read_text(encoding="utf-8")
            module = f"rps_jax.{room}.{path.stem}"
            for name, class_name in _DEFINITION.findall(text):
                summary = re.findall(rf'(?ms)^class {class_name}\b.*?"""(.*?)["\n]', text)[0]
                commands[name.replace("_", " ")] = Command(module, class_name, summary)
    return commands


def overview() -> str:
    """Return the text of `rps --help`."""
    lines = [
        "usage: rps NAME [OPTIONS]      run one of the commands below",
        "       rps PATH [OPTIONS]      run that of a file, or of study.py of a folder",
        "       rps FILE.py NAME ...    run one after a file that registers tasks or engines",
        "       rps NAME --help         list its options",
        "       rps --version",
        "",
        "Pushing unknown objects by touch: the Reactive Pushing Strategy in MuJoCo.",
    ]
    width = max(map(len, known())) + 2
    for room, heading in _HEADINGS.items():
        commands = {n: c for n, c in known().items() if c.module.startswith(f"rps_jax.{room}.")}
        texts = (f"  {name:<{width}}{command.summary}" for name, command in commands.items())
        indent = " " * (width + 2)
        lines += ["", f"{heading}:"]
        lines += [textwrap.fill(text, 100, subsequent_indent=indent) for text in texts]
    return "\n".join(lines)


def extensions(words: list[str]) -> tuple[list[Path], list[str]]:
    """Return the Python files before the name of a command, and the words from this name on.

    They register laws, objects, quantities, tasks or engines.
    """
    files = list(itertools.takewhile(lambda word: word.endswith(".py"), words))
    rest = words[len(files) :]
    commands = dict.fromkeys(name.split()[0] for name in known())
    if rest and rest[0] in commands:
        return [*map(Path, files)], rest
    if files and rest and not rest[0].startswith("-") and not _definitions(Path(files[-1])):
        check_name("command", rest[0], commands)
    return [], words  # the first file is a question


def split(words: list[str]) -> tuple[str, list[str]]:
    """Return the name or path of a command, and the words after it."""
    for count in (2, 1):
        name = " ".join(words[:count])
        if name in known():
            return name, words[count:]
    first = words[0]
    if first.lower().endswith(".py") or "/" in first or Path(first).is_dir():
        return first, words[1:]
    name = " ".join(words[:2]) if first in ("tune", "export") else first
    return check_name("command", name, known()), []  # which raises


def question_type(name: str) -> "type[Question[object]]":
    """Return the class of a command, by its name or its path."""
    if name in known():
        return getattr(importlib.import_module(known()[name].module), known()[name].class_name)
    path = Path(name)
    path = path / "study.py" if path.is_dir() else path
    definitions = _definitions(path)
    if len(definitions) != 1:
        raise InputError(
            f"study = {path} defines {len(definitions)} commands: write `name = call_of(Class)` "
            "once."
        )
    return getattr(import_file(path), definitions[0][1])


def _definitions(path: Path) -> list[tuple[str, str]]:
    """Return the names and classes of the commands that a file defines."""
    from rps_jax.record import files

    return _DEFINITION.findall(files.read_regular(path, "python").decode(errors="replace"))


def import_file(path: Path) -> ModuleType:
    """Import a file, as a module of its package if it is in one."""
    from rps_jax.control import sources
    from rps_jax.record import files

    files.read_regular(path, "python")  # or InputError
    path = path.resolve()
    root = path.parent
    while (root / "__init__.py").exists():
        root = root.parent
    sys.path.insert(0, str(root))  # as Python does for a script
    if root == path.parent:
        return sources.run_file(path, f"_rps_jax_study_{path.stem}")
    name = ".".join(path.relative_to(root).with_suffix("").parts)
    return sys.modules.get(name) or sources.run_file(path, name)
