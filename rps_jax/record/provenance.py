"""Provenance of a run: command, versions, device and commit, in `environment.json`."""

import contextlib
import functools
import itertools
import platform
import shlex
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

from rps_jax import __version__
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record import folder as run_folder
from rps_jax.record.files import JsonObject

ENVIRONMENT = "environment.json"
_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "scipy", "xarray")


def collect_environment(**device: object) -> JsonObject:
    """Return command, commit, time and versions of this process, and what `device` holds."""
    return {
        "command": _command(),
        "commit": git_commit(),
        "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **device,
        "packages": {"rps_jax": __version__} | {name: metadata.version(name) for name in _PACKAGES},
    }


def attributes() -> dict[str, str]:
    """Return command, version and commit of this process, as attributes of results."""
    record = {"command": shlex.join(_command()), "version": __version__, "commit": git_commit()}
    return {name: value for name, value in record.items() if value}


def _command() -> list[str]:
    """Return the words of the running command, as a shell can run it again."""
    program = Path(sys.argv[0])
    if "ipykernel" in sys.modules or program.name in ("", "-", "-c"):
        return ["python"]  # a notebook or a prompt
    if program.name in ("rps", "rps.exe") or program.parts[-2:] == ("rps_jax", "__main__.py"):
        return ["rps", *sys.argv[1:]]
    return ["python", sys.argv[0], *sys.argv[1:]] if program.suffix == ".py" else list(sys.argv)


def shell(*words: object) -> str:
    """Return a command of the shell, after the files that ran before the present one."""
    program, *rest = _command()
    files = itertools.takewhile(lambda word: word.endswith(".py"), rest)
    return shlex.join(["rps", *(files if program == "rps" else ()), *map(str, words)])


def write_environment(folder: Path, environment: JsonObject) -> None:
    """Record the environment of a run, or of a part of it, in `environment.json`.

    An earlier record is kept under `before`, if anything but the time differs.
    """
    new = dict(environment)
    with run_folder.lock_briefly(folder):
        earlier = [*new.pop("before", [])]
        if (folder / ENVIRONMENT).exists():
            earlier += _history(folder)
        different = [record for record in earlier if not _is_same(record, new)]
        record = new | ({"before": different} if different else {})
        files.write_json(folder / ENVIRONMENT, record, checked=True)


def read_environment(folder: Path) -> JsonObject:
    """Return the environment of a run; InputError if it is missing or corrupt."""
    return files.read_checked_json(folder / ENVIRONMENT)


def _history(folder: Path) -> list[JsonObject]:
    """Return all environments of a run, the latest last."""
    last = read_environment(folder)
    earlier = last.pop("before", [])
    if not (isinstance(earlier, list) and all(isinstance(record, dict) for record in earlier)):
        raise files.CorruptFileError(folder / ENVIRONMENT, "before is no list of names with values")
    return [*earlier, last]


def _is_same(record: JsonObject, new: JsonObject) -> bool:
    """Whether two records are of one process, or differ only in time and workers."""
    differ = {name for name in (*record, *new) if record.get(name) != new.get(name)}
    return not differ & {"time", "command"} or differ <= {"time", "workers", "before"}


def describe(folder: Path) -> str:
    """Return all environments of a run in words."""
    try:
        last, *earlier = (
            f"`{shlex.join(record['command'])}`, rps_jax {record['packages']['rps_jax']}"
            f"{', commit ' + record['commit'] if record['commit'] else ''}, {record['time']}, on "
            f"{record['device']['kind']} with {record['processors']} processors, jax "
            f"{record['packages']['jax']}, mujoco {record['packages']['mujoco']}"
            for record in reversed(_history(folder))
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise files.CorruptFileError(folder / ENVIRONMENT, error) from error
    return f"Made by {'; before that by '.join([last, *earlier])}."


def package_version(folder: Path) -> str:
    """Return the version of this package that last continued a run, in words."""
    try:
        return f"rps_jax {read_environment(folder)['packages']['rps_jax']}"
    except (InputError, KeyError, TypeError):
        return "a version that it does not name"


@functools.cache
def git_commit() -> str | None:
    """Return the git commit of this code, in a checkout marked if changed; None if unknown.

    In an archive of the repository, git has written it to `.git_archival.txt`.
    """
    root = Path(__file__).resolve().parents[2]
    words = ("describe", "--always", "--exclude=*", "--abbrev=40", "--dirty=-changed")
    command = ["git", "-C", str(root), *words]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        if (root / ".git").exists():
            output = subprocess.check_output(command, stderr=subprocess.DEVNULL, timeout=10)
            return output.decode().strip()
    with contextlib.suppress(OSError):
        commit = (root / ".git_archival.txt").read_text().partition("node: ")[2].strip()
        return None if "$" in commit else commit
    return None
