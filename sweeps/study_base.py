"""Base classes of this project's studies, and the data files of their tables.

A subclass of `Study` names its tables in `published_tables`. With the option `--machine` they are
written to `results/NAME.json` in the folder of the study, and `render_tables.py` shows them on the
pages. A data file has a digest of everything that its numbers depend on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

from rps_jax.app.cli import flags, names
from rps_jax.control import registry
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.runs.question import Question, TrialQuestion
from rps_jax.trials.progress import ProgressCallback
from rps_jax.world.domain import DOMAINS, QUANTITIES

T = TypeVar("T", covariant=True)
_PACKAGES = ("rps_jax", "jax", "mujoco", "mujoco-mjx")  # whose versions a data file has


class Table(NamedTuple):
    """A table to publish."""

    rows: Sequence[Sequence[Any]]  # the first has the names of the columns
    note: str = ""  # explains the numbers to their reader
    columns: Sequence[Mapping[str, Any]] = ()  # formats, by default none; rows then have no header
    merge: str | None = None  # name of the column that shows repeated texts once

    def columns_and_rows(self) -> tuple[list[Mapping[str, Any]], list[Sequence[Any]]]:
        """Return columns and rows as a data file has them."""
        if self.columns:
            return list(self.columns), list(self.rows)
        header, *rows = self.rows
        return [
            {"name": name} | ({"merge": True} if name == self.merge else {}) for name in header
        ], rows


@dataclass(frozen=True, kw_only=True)
class Study(Question[T]):
    """Base class of the studies of this project."""

    machine: str = ""
    """Machine that runs the study, in words; with it the tables are published."""

    GROWS: ClassVar[tuple[str, ...]] = ()  # options that may change when a run is continued
    RESULTS: ClassVar[str] = "results"  # folder of the data files, relative to the study's folder

    def configuration(self) -> dict[str, Any]:
        """Return everything that the parts of the run depend on, as JSON."""
        options = super().configuration()
        return {k: v for k, v in options.items() if k not in (*self.GROWS, "machine")}

    def published_tables(self, results: Any) -> Mapping[str, Table]:
        """Return the tables to publish, by the name of their data file."""
        return {}

    def publish(self, results: Any, run_folder: Path) -> None:
        """Write the data files of all tables."""
        for name, table in self.published_tables(results).items():
            path = self.folder / self.RESULTS / f"{name}.json"
            write_table(path, [provenance.read_environment(run_folder)], self.machine, table)

    @property
    def folder(self) -> Path:
        """Folder of the study's source file."""
        return Path(inspect.getfile(type(self))).parent

    def execute(self, callback: ProgressCallback) -> T:
        """Run the study, and publish its tables if a machine is named."""
        results = super().execute(callback)
        if self.machine and self.out is not None:
            self.publish(results, Path(self.out))
        return results


@dataclass(frozen=True, kw_only=True)
class TrialStudy(Study[T], TrialQuestion[T]):
    """Base class of studies that run trials with several settings."""


def write_table(path: Path, runs: Sequence[Mapping[str, Any]], device: str, table: Table) -> Path:
    """Write the data file of a table.

    Args:
      path: `results/NAME.json` in the folder of a study.
      runs: provenance of the runs behind the table, as `provenance.read_environment` returns it.
      device: device of the runs, in words.
      table: header, rows and note.
    """
    last = runs[-1]
    with_folders = [run["command"] for run in runs]
    commands = [_without_unread_folder(command, with_folders) for command in with_folders]
    digests = {}
    with contextlib.suppress(InputError):  # a script has no digest, and its run is still published
        digests["digest"] = digest(commands)
    columns, rows = table.columns_and_rows()
    data = {
        "command": [shlex.join(command) for command in commands],
        "device": device,
        "versions": {name: last["packages"][name] for name in _PACKAGES},
        "commit": last["commit"],
        **digests,
        "date": last["time"][:10],
        **({"note": table.note} if table.note else {}),
        "columns": columns,
        "rows": rows,
    }
    path.parent.mkdir(exist_ok=True)
    return files.write_text(path, json.dumps(data, indent=1) + "\n")


def digest(commands: Sequence[Sequence[str]]) -> str:
    """Return a digest of everything that the numbers of some commands depend on, in 16 letters.

    The digest covers declared values alone: options, parameters, ranges, physics, rules and seeds.
    It stays the same when code is rewritten, and changes with a default or a tuned law.

    Raises:
      InputError: a command or an option of it does not exist.
    """
    configurations: list[Any] = []
    for program, *words in commands:
        if program != "rps":
            raise InputError(
                f"command = {program} is not allowed: only `rps NAME` or `rps PATH` has a digest."
            )
        if _reads_folder(_split_folder(words)[0]):  # the command that made the folder has a digest
            configurations.append(words)
            continue
        name, rest = names.split(words)
        question, _ = flags.parse(names.question_type(name), name, rest)
        configurations.append(_expanded(question.configuration()))
    text = json.dumps(configurations, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _expanded(value: Any) -> Any:
    """Return a configuration with the values of its laws and domains after their names."""
    if isinstance(value, dict):  # omit quantities that are not drawn, so that new ones are allowed
        items = (item for item in value.items() if item[1] is not None or item[0] not in QUANTITIES)
        return {key: _expanded(item) for key, item in items}
    if isinstance(value, list | tuple):
        return [_expanded(item) for item in value]
    if isinstance(value, str) and value in DOMAINS:
        ranges = dataclasses.asdict(DOMAINS[value])
        return [value, {name: item for name, item in ranges.items() if item is not None}]
    if isinstance(value, str) and value in registry.LAWS:
        return [value, registry.params_to_json(registry.LAWS[value])]
    return value


def _split_folder(command: Sequence[str]) -> tuple[list[str], str]:
    """Return the words of a command without its run folder, and the run folder."""
    if "--out" not in command:
        return list(command), ""
    i = list(command).index("--out")
    return [*command[:i], *command[i + 2 :]], "".join(command[i + 1 : i + 2])


def _reads_folder(words: Sequence[str], folder: str = "runs") -> bool:
    """Return whether a command reads a run folder, or a file in one."""
    return any(re.search(rf"(^|,){re.escape(folder)}(/|$)", word) for word in words)


def _without_unread_folder(command: Sequence[str], commands: Sequence[Sequence[str]]) -> list[str]:
    """Return the words of a command, without its run folder unless another command reads it."""
    words, folder = _split_folder(command)
    is_read = folder and any(_reads_folder(_split_folder(c)[0], folder) for c in commands)
    return list(command) if is_read else words
