"""What a run was made by: command, versions, device and commit, noted in its folder."""

import importlib.metadata
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record import folder as run_folder

ENVIRONMENT = "environment.json"
_PACKAGES = (
    *("rps_jax", "jax", "jaxlib", "mujoco", "mujoco-mjx"),
    *("numpy", "scipy", "xarray"),
)


def collect_environment(**device: object) -> dict[str, Any]:
    """Return command, commit, time and versions of this process, and what `device` holds."""
    return {
        "command": _command(),
        "commit": git_commit(),
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **device,
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def _command() -> list[str]:
    """Words of the command that runs, as it can be run again."""
    program = Path(sys.argv[0])
    if program.name in ("rps", "rps.exe") or program.parts[-2:] == ("rps_jax", "__main__.py"):
        return ["rps", *sys.argv[1:]]
    return ["python", sys.argv[0], *sys.argv[1:]] if program.suffix == ".py" else list(sys.argv)


def write_environment(folder: Path, environment: Mapping[str, Any]) -> None:
    """Note the environment of a run, or of a piece of it, in `environment.json`.

    An earlier note stays there, under `before`, if anything but the time differs.
    """
    new = dict(environment)
    with run_folder.lock_briefly(folder):
        earlier = _history(folder) if (folder / ENVIRONMENT).exists() else []
        earlier = [*new.pop("before", []), *earlier]
        others = [one for one in earlier if not _same(one, new)]
        note = new | ({"before": others} if others else {})
        files.write_json(folder / ENVIRONMENT, note, checked=True)


def read_environment(folder: Path) -> dict[str, Any]:
    """What `write_environment` noted; InputError if there is nothing, or it is corrupt."""
    return files.read_checked_json(folder / ENVIRONMENT)


def _history(folder: Path) -> list[dict[str, Any]]:
    """What `write_environment` noted, the latest last."""
    last = read_environment(folder)
    before = last.pop("before", [])
    if not (isinstance(before, list) and all(isinstance(one, dict) for one in before)):
        raise files.CorruptFileError(folder / ENVIRONMENT, "before is no list of names with values")
    return [*before, last]


def _same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether it is one process, whose workers may have become more, or another all like it."""
    process = all(one.get(name) == other.get(name) for name in ("time", "command"))
    differ = {name for name in (*one, *other) if one.get(name) != other.get(name)}
    return process or differ <= {"time", "workers", "before"}


def describe(folder: Path) -> str:
    """What `write_environment` noted, in words."""
    try:
        last, *before = (
            f"`{shlex.join(one['command'])}`, rps_jax {one['packages']['rps_jax']}"
            f"{', commit ' + one['commit'] if one['commit'] else ''}, {one['time']}, on "
            f"{one['device']['kind']} with {one['processors']} processors, jax "
            f"{one['packages']['jax']}, mujoco {one['packages']['mujoco']}"
            for one in reversed(_history(folder))
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise files.CorruptFileError(folder / ENVIRONMENT, error) from error
    return f"Made by {'; before that by '.join([last, *before])}."


def package_version(folder: Path) -> str:
    """The version of this package that last made some of a run, in words."""
    try:
        found = read_environment(folder)["packages"]["rps_jax"]
    except (InputError, KeyError, TypeError):
        found = None
    return f"rps_jax {found}" if isinstance(found, str) else "a version that it does not name"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def git_commit() -> str | None:
    """The git commit of the checkout this code runs from, marked if changed; None elsewhere."""
    root = Path(__file__).resolve().parents[2]
    words = ("describe", "--always", "--exclude=*", "--abbrev=40", "--dirty=-changed")
    try:
        if not (root / ".git").exists():
            return None
        done = subprocess.run(
            ["git", "-C", str(root), *words],
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
