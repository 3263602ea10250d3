"""Python files of laws: run with the modules beside them, and copied into run folders.

A law's file may import modules of its folder. Their content identifies the law as well, so all are
part of its record in a manifest, and a run folder keeps a copy of each.
"""

from __future__ import annotations

import contextlib
import importlib.util
import sys
import warnings
from collections.abc import Mapping
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

from rps_jax.errors import InputError
from rps_jax.record import files, folder
from rps_jax.record.files import JsonObject

_IMPORTS: dict[str, dict[str, str]] = {}  # of loaded files, by the name of their module


def run_file(path: Path, name: str) -> ModuleType:
    """Run a user's Python file as a module of this name; any error becomes an InputError."""
    loader = SourceFileLoader(name, str(path))  # of any suffix, as .PY
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:  # any error of the user's file
        del sys.modules[name]
        if isinstance(error, InputError):
            raise
        fault = f"{path} cannot be run ({type(error).__name__}: {error}): correct the file."
        raise InputError(fault) from error
    return module


def load(path: Path, *, again: bool = False) -> str:
    """Run the file of a law unless it and its imports are loaded; return its module's name."""
    name = f"_rps_jax_{path.stem}_{_digest(path)}"
    imports = _IMPORTS.get(name, {})
    is_current = name in sys.modules and _digests(path.parent, imports) == imports
    if is_current and not again:
        return name
    # Allow imports from its folder. Forget them after: another folder may have the same names.
    root, known_modules, imports = path.parent.resolve(), set(sys.modules), dict[str, str]()
    sys.path.insert(0, str(root))
    importlib.invalidate_caches()
    try:
        run_file(path, name)
    finally:
        sys.path.remove(str(root))
        for module in set(sys.modules) - known_modules:
            file = Path(getattr(sys.modules[module], "__file__", None) or "/")
            if file.is_relative_to(root) and not module.startswith("_rps_jax_"):
                del sys.modules[module]
                imports[file.relative_to(root).as_posix()] = _digest(file)
    _IMPORTS[name] = imports
    return name


def describe(path: Path) -> JsonObject:
    """Return the record of a law's file for manifests: path, digest and digests of imports."""
    digest = _digest(path)
    record = {"file": str(path.resolve()), "digest": digest}
    imports = _IMPORTS.get(f"_rps_jax_{path.stem}_{digest}")
    return record | ({"imports": dict(sorted(imports.items()))} if imports else {})


def find(record: JsonObject, run: Path | None) -> Path:
    """Return the file of a law as it was when `describe` made the record.

    If the file has changed since, it is the copy in the run folder, with a warning.

    Raises:
      InputError: it has changed, and there is no copy.
    """
    path = Path(str(record["file"]))
    expected = {path.name: record["digest"], **record.get("imports", {})}
    if _digests(path.parent, expected) == expected:
        return path
    copy = None if run is None else folder.sources(run, str(record["digest"])) / path.name
    if copy is None or _digests(copy.parent, expected) != expected:
        fault = f"law = {path} has changed since the run, which has no copy: restore the file."
        raise InputError(fault)
    warnings.warn(f"law = {path} has changed since the run: its copy {copy} is used", stacklevel=2)
    return copy


def _digest(path: Path) -> str:
    """Return a digest of a file."""
    content = files.read_regular(path, "policy" if files.suffix_of(path) == ".npz" else "python")
    return files.sha256(content)[:16]


def _digests(root: Path, names: Mapping[str, str]) -> dict[str, str]:
    """Return the digests of those of some files in a folder that can be read."""
    digests = {}
    for name in names:
        with contextlib.suppress(InputError):
            digests[name] = _digest(root / name)
    return digests
