"""Which published numbers are of today's code, which are not, and which command makes them anew?

rps sweeps/publish                 # what is stale, and why
rps sweeps/publish --check-digests # fails if a number hangs on what has changed since
rps sweeps/publish --only fit_*    # makes these anew; what was killed goes on
"""

from __future__ import annotations

import fnmatch
import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr

import rps_jax
from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.runs.question import Question, Run, call_of
from sweeps.shared import digest

_SWEEPS = Path(__file__).parents[1]
CURRENT = "of today's code"


@dataclass(frozen=True)
class Publish(Question[xr.Dataset]):
    """Say of every published number whether it is of today's code, and make anew what is asked."""

    TITLE: ClassVar[str] = "Published numbers, and what they hang on"

    only: tuple[str, ...] = ()
    """Data files to be made anew, as fit_coverage or fit_*; by default none."""
    check_digests: bool = False
    """Whether to fail if a number hangs on what has changed since it was made."""

    def check(self) -> None:
        """Check that there are such files."""
        for pattern in self.only:
            if not any(fnmatch.fnmatch(path.stem, pattern) for path in published()):
                raise InputError(f"only = {pattern} is not allowed: no data file has such a name.")

    def answer(self, run: Run) -> xr.Dataset:
        """Version, date, device, command and state (file)."""
        if self.only:
            self._anew(run)
        told = {path.stem: _told(path) for path in published()}
        found = xr.Dataset(
            {key: ("file", [one[key] for one in told.values()]) for key in _told(published()[0])},
            {"file": list(told)},
        )
        stale = [name for name, one in told.items() if one["state"].startswith("stale")]
        if self.check_digests and stale:
            raise InputError(
                f"published numbers are not allowed: {', '.join(stale)} hang on what has changed "
                f"since; make them anew by rps sweeps/publish --only {' '.join(stale)}."
            )
        return found

    def _anew(self, run: Run) -> None:
        """Run the commands of the files that are asked for, each in a folder of its own."""
        for path in published():
            if not any(fnmatch.fnmatch(path.stem, pattern) for pattern in self.only):
                continue
            for number, command in enumerate(_commands(json.loads(path.read_text()))):
                words = shlex.split(command)
                out = (run.folder or self.place) / f"{path.stem}_{number}"
                subprocess.run(
                    [sys.executable, "-m", "rps_jax", *words[1:], "--out", str(out)], check=True
                )

    def report(self, found: xr.Dataset, run: Run) -> Sequence[Section]:
        """One row a data file, those that are not of today's code first."""
        rows = [["file", "version", "date", "state", "device"]]
        order = found.sortby("state", ascending=False)
        for name in order.file.values:
            one = order.sel(file=name)
            cells = [str(one[key].item()) for key in ("version", "date", "state", "device")]
            rows.append([str(name), *cells])
        current = int((found.state == CURRENT).sum())
        text = (
            f"{current} of {found.sizes['file']} data files are of rps_jax {rps_jax.__version__} "
            "and hang on nothing that has changed since. A file without a digest was made before "
            "there were any: what it hangs on is known by its command and its commit alone."
        )
        return [Section("Data files", text, rows)]


publish = call_of(Publish)


def published() -> list[Path]:
    """Data files of all tables."""
    return sorted(_SWEEPS.rglob("results/*.json"))


def _commands(data: dict[str, Any]) -> list[str]:
    found = data["command"]
    return [found] if isinstance(found, str) else list(found)


def _told(path: Path) -> dict[str, str]:
    """Version, date, device, command and state of a data file."""
    data = json.loads(path.read_text())
    commands = _commands(data)
    known = {
        "version": str(data["versions"]["rps_jax"]),
        "date": str(data["date"] or ""),
        "device": str(data["device"] or ""),
        "command": "; ".join(commands),
    }
    return known | {"state": _state(data.get("digest"), commands, known["version"])}


def _state(noted: str | None, commands: Sequence[str], version: str) -> str:
    if noted is None:
        return f"made by {version}, without a digest"
    try:
        now = digest([shlex.split(one) for one in commands])
    except (InputError, SystemExit) as error:
        return f"stale: its command is none of today ({error})"
    if now != noted:
        return "stale: its laws, domains, physics or seeds have changed"
    return (
        CURRENT if version == rps_jax.__version__ else f"made by {version}, nothing changed since"
    )
