"""Digests of the source code that the numbers of a data file depend on.

A room is a subpackage of `rps_jax`, the scenes (`mjcf`), a folder of `sweeps`, or a module beside
these folders. Its digest covers the syntax trees of its modules without comments, docstrings, types
and texts of errors, and the content of its other source files. `EQUAL` lists changes that alter no
published number, such as renamed variables: the last of several digests of a room equals the
others.
"""

import ast
import functools
import hashlib
import io
import json
import subprocess
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import rps_jax
from rps_jax.record import files, provenance

ROOT = Path(__file__).resolve().parents[1]
EQUAL = Path(__file__).with_name("publish") / "equal.json"
COMMITS = EQUAL.with_name("commits.json")  # digests of files that are older than the digests
_FOLDERS = ("rps_jax", "mjcf", "sweeps")
_SUFFIXES = (".py", ".npz", ".nc", ".c", ".h", ".in", ".js", ".xml")  # in `sweeps` .py alone
_OF_TYPES = ("typing", "collections.abc", "jaxtyping", "types")  # modules that annotations name
# Modules that store and show numbers: a change of them alters none.
_NEUTRAL = (
    *("rps_jax.record", "rps_jax.errors", "rps_jax.app.cli", "rps_jax.__main__"),
    *("rps_jax.analysis.figures", "rps_jax.analysis.report"),
    *("sweeps.study_base", "sweeps.render_tables", "sweeps.sources", "sweeps.publish"),
)


def rooms_of(paths: Iterable[Path]) -> set[str]:
    """Return the rooms of some modules and of all modules that they import."""
    queue = [_module(path.resolve().relative_to(ROOT)) for path in paths]
    known = set[str]()
    while queue:
        if (module := queue.pop()) not in known and not module.startswith(_NEUTRAL):
            known.add(module)
            queue += _imports(module)
    rooms = {_room(_path(module)) for module in known}
    return rooms | ({"mjcf"} if "world" in rooms else set())


def changed_rooms(name: str, data: Mapping[str, Any], rooms: Iterable[str]) -> list[str]:
    """Return the rooms whose source differs from that of a data file in more than form.

    Args:
      name: name of the data file, for `EQUAL`; without it every difference counts.
      data: its content.
      rooms: rooms that its numbers depend on.
    """
    return [room for room in sorted(rooms) if latest(name, room, data) != digests().get(room)]


def store(commits: Iterable[str]) -> None:
    """Store the digests at some commits, for data files that have no digests of their code."""
    known = _stored()
    code = known | {c: digests_at(c) for c in commits if c not in known}
    lines = (f" {json.dumps(commit)}: {json.dumps(code[commit])}" for commit in sorted(code))
    files.write_text(COMMITS, "{\n" + ",\n".join(lines) + "\n}\n")
    _stored.cache_clear()


@functools.cache
def _stored() -> dict[str, dict[str, str]]:
    return json.loads(COMMITS.read_text(encoding="utf-8")) if COMMITS.exists() else {}


def latest(name: str, room: str, data: Mapping[str, Any]) -> str:
    """Return the last digest of a room that gives the numbers of a data file, by `EQUAL`."""
    code = data.get("code") or _stored().get(data["commit"], {})
    digest = code.get(room, "")
    for change in equal_changes():
        if name in change["files"] and digest in change["code"].get(room, ()):
            digest = change["code"][room][-1]
    return digest


def equal_changes() -> list[dict[str, Any]]:
    """Return the changes that alter no number: `reason`, `files`, and digests by room (`code`)."""
    return json.loads(EQUAL.read_text(encoding="utf-8")) if EQUAL.exists() else []


def digests_at(commit: str | None) -> dict[str, str]:
    """Return a digest of each room at the commit of a run; none if git does not have it."""
    if commit in (None, provenance.git_commit()):
        return digests()
    try:
        return digests(str(commit).removesuffix("-changed"))
    except (OSError, subprocess.SubprocessError):
        return {}


@functools.cache
def digests(commit: str | None = None) -> dict[str, str]:
    """Return a digest of each room, of the working tree or of a commit."""
    hashes: dict[str, Any] = {}
    for name, content in sorted(_sources(commit)):
        if _module(Path(name)).startswith(_NEUTRAL):
            continue
        text = _tree(ast.parse(content)).encode() if name.endswith(".py") else content
        line = f"{name} {hashlib.sha256(text).hexdigest()}\n"
        hashes.setdefault(_room(Path(name)), hashlib.sha256()).update(line.encode())
    return {room: value.hexdigest()[:12] for room, value in hashes.items()}


def _sources(commit: str | None) -> Iterable[tuple[str, bytes]]:
    """Yield path and content of all source files."""
    if commit is None:
        for path in (path for folder in _FOLDERS for path in (ROOT / folder).rglob("*.*")):
            if _is_source(name := path.relative_to(ROOT).as_posix()):
                yield name, path.read_bytes()
        return
    command = ["git", "-C", str(ROOT), "archive", commit, "rps_jax", "mjcf", "sweeps"]
    archive = subprocess.run(command, capture_output=True, check=True, timeout=60).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        for member in tar.getmembers():
            if _is_source(member.name) and (file := tar.extractfile(member)):
                yield member.name, file.read()


def _is_source(name: str) -> bool:
    suffixes = ".py" if name.startswith("sweeps") else _SUFFIXES
    return name.endswith(suffixes)


def _room(path: Path) -> str:
    """Return the room of a path relative to the root."""
    top, *inner = path.parts
    if top == "mjcf":
        return top
    return inner[0] if top == "rps_jax" else f"{top}/{inner[0]}"


def _tree(node: Any) -> str:
    """Return a syntax tree as a text that is equal for all versions of Python."""
    if isinstance(node, list):
        return "".join(map(_tree, node))
    if not isinstance(node, ast.AST):
        return repr(node)
    if isinstance(node, ast.Raise):
        return "raise"
    if isinstance(node, ast.ImportFrom) and node.module in _OF_TYPES:
        return ""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return ""  # a docstring
    if isinstance(node, ast.JoinedStr):  # Python 3.12 adds empty parts
        return _tree([x for x in node.values if getattr(x, "value", None) != ""])
    fields = (pair for pair in ast.iter_fields(node) if pair[0] not in ("annotation", "returns"))
    texts = (f" {name}={_tree(value)}" for name, value in fields if value not in (None, []))
    return f"({type(node).__name__}{''.join(texts)})"


# --- imports --------------------------------------------------------------------------------


def _module(path: Path) -> str:
    """Return the module of a path relative to the root."""
    parts = path.with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _path(module: str) -> Path:
    """Return the path of a module relative to the root."""
    path = Path(*module.split("."))
    return path / "__init__.py" if (ROOT / path).is_dir() else path.with_suffix(".py")


@functools.cache
def _imports(module: str) -> list[str]:
    """Return the modules of this repository that a module imports, also inside functions."""
    names = set[str]()
    for node in ast.walk(ast.parse((ROOT / _path(module)).read_bytes())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names.add(f"{node.value.id}.{node.attr}")  # `rps_jax.sweep` of `import rps_jax`
    homes = {f"rps_jax.{name}": home for name, home in rps_jax._HOMES.items()}
    names |= {homes[name] for name in names & homes.keys()}
    return [name for name in names if name.startswith(("rps_jax.", "sweeps.")) and _exists(name)]


def _exists(module: str) -> bool:
    return (ROOT / _path(module)).is_file()
