"""Which published numbers are of today's code, which are not, and which command makes them anew?

rps sweeps/publish                       # what is stale, and why, and what making it anew takes
rps sweeps/publish --check-digests       # fails if a number hangs on what has changed since
rps sweeps/publish --only 'fit_*' table  # makes these anew; what was killed goes on
rps sweeps/publish --only '*' --needs gpu
"""

from __future__ import annotations

import fnmatch
import hashlib
import itertools
import json
import os
import platform
import re
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import xarray as xr

import rps_jax
from rps_jax.analysis.report import Section
from rps_jax.app.cli import flags, names
from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import provenance
from rps_jax.runs.question import Run, call_of
from sweeps.publish.recipes import HISTORY, RECIPES, Recipe
from sweeps.publish.rows import Rows
from sweeps.study_base import Study, Table, digest, write_table

_SWEEPS = Path(__file__).parents[1]
CURRENT = "of today's code"


@dataclass(frozen=True)
class Publish(Study[xr.Dataset]):
    """Say of every published number whether it is of today's code, and make anew what is asked."""

    TITLE: ClassVar[str] = "Published numbers, and what they hang on"
    GROWS: ClassVar[tuple[str, ...]] = ("only", "needs", "check_digests")

    only: tuple[str, ...] = ()
    """Data files to be made anew, as fit_coverage or fit_*; by default none."""
    needs: Literal["any", "cpu", "gpu"] = "any"
    """Which of these: those that are made on processors, or those that take a GPU."""
    check_digests: bool = False
    """Whether to fail if a number hangs on what has changed since it was made."""

    def check(self) -> None:
        """Check that such files are known."""
        known = [*(path.stem for path in published()), *RECIPES]
        for pattern in self.only:
            if not fnmatch.filter(known, pattern):
                raise InputError(f"only = {pattern} is not allowed: no data file has such a name.")

    def answer(self, run: Run) -> xr.Dataset:
        """Version, date, device, command, state and what it takes (file)."""
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
        """Make what is asked for, one file after the other; what fails is named at the end."""
        failed, folder = [], run.folder or self.default_folder
        for name, recipe in RECIPES.items():
            asked = any(_meet(name, pattern) for pattern in self.only)
            if not asked or self.needs not in ("any", recipe.device):
                continue
            began = time.perf_counter()
            try:
                make(name, recipe, folder / "runs", self.machine or machine())
                said = "made"
            except Exception as error:  # whatever a study raises: the others are made all the same
                said = f"failed, {type(error).__name__}: {error}"
                failed.append(name)
            print(f"{name}: {said}, {time.perf_counter() - began:.0f} s", flush=True)
        if failed:
            raise InputError(
                f"{len(failed)} of the files could not be made: {', '.join(failed)}. What is done "
                "is kept; the same command goes on."
            )

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """One row a data file, those that are not of today's code first."""
        shown = ("version", "date", "state", "made", "two cores", "one H100")
        rows = [["file", *shown]]
        order = results.sortby("state", ascending=False)
        for name in order.file.values:
            one = order.sel(file=name)
            rows.append([str(name), *(str(one[key].item()) for key in shown)])
        current = int((results.state == CURRENT).sum())
        text = (
            f"{current} of {results.sizes['file']} data files are of rps_jax {rps_jax.__version__} "
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
    """Version, date, device, command, state and what it takes of a data file."""
    data = json.loads(path.read_text())
    recipe = next((r for name, r in RECIPES.items() if fnmatch.fnmatch(path.stem, name)), None)
    takes = {"made": "", "two cores": "", "one H100": ""}
    if recipe is not None:
        times = (recipe.two_cores, recipe.one_gpu)
        cores, gpu = ("" if t is None else f"{t:g} min" for t in times)
        takes = {"made": f"on {recipe.device}", "two cores": cores, "one H100": gpu}
    if "command" not in data:
        known = dict.fromkeys(("version", "date", "device", "command"), "")
        return known | takes | {"state": f"cites {', '.join(sorted(_cited(data)))}"}
    commands = _commands(data)
    known = {
        "version": str(data["versions"]["rps_jax"]),
        "date": str(data["date"] or ""),
        "device": str(data["device"] or ""),
        "command": "; ".join(commands),
    }
    if path.stem in HISTORY:
        return known | takes | {"state": f"history: {HISTORY[path.stem]}"}
    return known | takes | {"state": _state(data.get("digest"), commands, known["version"])}


def _cited(data: dict[str, Any]) -> set[str]:
    """Names of the data files that a table cites."""
    return {cell["from"] for row in data["rows"] for cell in row if isinstance(cell, dict)}


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


# --- making them anew ----------------------------------------------------------------------


def make(name: str, recipe: Recipe, runs: Path, device: str) -> None:
    """Run the commands of a recipe, or read what they did, and write the data file."""
    tables, made = [], []
    labels = recipe.of or ("",) * len(recipe.commands)
    for label, command in zip(labels, recipe.commands, strict=False):
        words = shlex.split(command.replace("MACHINE", shlex.quote(device)))
        sections, answer, signed = _carried_out(words, runs)
        made.append(signed)
        wanted = recipe.section
        if not isinstance(wanted, str):
            tables += [(label, rows)] if (rows := wanted(answer)) else []
            continue
        for section in sections:
            if section.table and fnmatch.fnmatch(section.title, wanted):
                kept = label or (section.title.split(" in ")[1] if " in *" in wanted else "")
                tables.append((kept, [list(row) for row in section.table]))
    if recipe.section:
        columns, rows = joined(tables, recipe.columns)
        path = next((p for p in published() if p.stem == name), None)
        new = _SWEEPS / recipe.folder / "results" / f"{name}.json"
        write_table(path or new, made, device, Table(rows, recipe.note, columns))


def _carried_out(words: list[str], runs: Path) -> tuple[Sequence[Section], Any, dict[str, Any]]:
    """Sections of the report of a command, its answer, and what it was made by."""
    named = words.index("--out") if "--out" in words else None
    place = f"runs/{_named(words)}" if named is None else words[named + 1]
    rest = words[1:] if named is None else [*words[1:named], *words[named + 2 :]]
    here = [re.sub(r"\bruns/", f"{runs}/", word) for word in rest]
    name, options = names.split(here)
    out = runs / Path(place).name
    asked = flags.parse(names.question_of(name), name, [*options, "--out", str(out)])[
        0
    ].with_quick_values()
    asked.validate()
    before, sys.argv = sys.argv, list(words)
    try:  # so that the run folder says which command makes it
        with asked.progress_bar() as bar:
            found = asked.execute(bar)
            sections = asked.report(found, asked.create_run(out, bar))
    finally:
        sys.argv = before
    return sections, found, provenance.read_environment(out) | {"command": words}


def _named(words: Sequence[str]) -> str:
    """Name of the run folder of a command."""
    told, whole = re.sub(r"\W+", "_", " ".join(words[1:])), " ".join(words)
    return f"{told[:60]}-{hashlib.sha256(whole.encode()).hexdigest()[:8]}"


def joined(tables: Sequence[tuple[str, Rows]], columns: Sequence[str]) -> tuple[Any, Rows]:
    """Columns and rows of several tables of one header, each after what its rows are of.

    Raises:
      InputError: there is none, or their headers differ.
    """
    if not tables:
        raise InputError("table = None is not allowed: no section of the report has that title.")
    (_, (head, *_)), several = tables[0], any(label for label, _ in tables)
    kept = [i for i, column in enumerate(head) if not columns or column in columns]
    rows: Rows = []
    for label, (header, *body) in tables:
        if [header[i] for i in kept if i < len(header)] != [head[i] for i in kept]:
            raise InputError(f"columns = {header} are not allowed beside {head}.")
        told = [[*[label] * several, *(row[i] for i in kept)] for row in body]
        for above, row in itertools.pairwise(told):  # a blank at the left repeats what is above
            row[0] = row[0] or above[0]
        rows += told
    nameless = iter(("law", "whose"))
    shown = [head[i] or next(nameless) for i in kept]
    columns = [*[""] * several, *shown]
    return [{"name": one, **({} if i else {"merge": True})} for i, one in enumerate(columns)], rows


def machine() -> str:
    """What this process runs on, in words."""
    used, count = jax.devices()[0], device.count_processors()
    if used.platform != "cpu":
        return f"one {used.device_kind} and {count} processors"
    model = platform.processor() or platform.machine()
    for line in _processors().splitlines():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return f"{count} of {os.cpu_count()} processors, {model}"


def _processors() -> str:
    path = Path("/proc/cpuinfo")
    return path.read_text() if path.exists() else ""


def _meet(name: str, pattern: str) -> bool:
    """Whether one of two patterns is a name of the other."""
    return fnmatch.fnmatch(name, pattern) or fnmatch.fnmatch(pattern, name)
