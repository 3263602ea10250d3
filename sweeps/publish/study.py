"""State of the published numbers, and the commands that compute them again.

rps sweeps/publish                       # stale data files, with reasons and durations
rps sweeps/publish --check-digests       # fails if a data file is stale and not listed as such
rps sweeps/publish --confirm "REASON"    # states that changes of the code altered no number
rps sweeps/publish --only 'fit_*' table  # computes these again; a killed run is continued
rps sweeps/publish --only '*' --needs gpu
"""

from __future__ import annotations

import fnmatch
import hashlib
import itertools
import json
import re
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import xarray as xr

import rps_jax
from rps_jax import errors
from rps_jax.analysis.report import Section
from rps_jax.app.cli import flags, names
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.runs.question import Run, call_of
from sweeps import sources
from sweeps.publish.recipes import HISTORY, RECIPES, Recipe
from sweeps.render_tables import STALE
from sweeps.study_base import (
    Rows,
    Study,
    Table,
    digest,
    machine,
    records,
    rooms_of,
    split_folder,
    text_table,
    write_table,
)

_SWEEPS = Path(__file__).parents[1]
CURRENT = "of today's code"
EARLIER = "still current"
_KEYS = ("version", "commit", "date", "state", "computed on", "two cores", "one H100")


@dataclass(frozen=True)
class Publish(Study[xr.Dataset]):
    """Report whether published numbers are up to date, and compute selected ones again.

    The results hold version, commit, date, state and duration (file), in words.
    """

    TITLE: ClassVar[str] = "Published numbers and their dependencies"
    GROWS: ClassVar[tuple[str, ...]] = ("only", "needs", "check_digests", "confirm")

    only: tuple[str, ...] = ()
    """Data files to compute again, as fit_coverage or fit_*; by default none. With --confirm, those
    that it is about; by default all."""
    needs: Literal["any", "cpu", "gpu"] = "any"
    """Device of the data files to compute again: processors, a GPU, or both."""
    check_digests: bool = False
    """Whether to fail if the inputs of a published number have changed since it was computed, or
    if STALE in sweeps/render_tables.py, which permits that, lists a number that is up to date."""
    confirm: str = ""
    """Reason why changes of the source code altered no number, such as equal digests of small runs,
    for all files that are stale by their code alone and not in STALE."""

    def check(self) -> None:
        """Check that the data files exist."""
        known = [*(path.stem for path in published()), *RECIPES]
        for pattern in self.only:
            if not fnmatch.filter(known, pattern):
                raise errors.not_allowed("only", pattern, "no data file has such a name")

    def answer(self, run: Run) -> xr.Dataset:
        """Compute selected data files again, and return the state of all data files."""
        if self.confirm:
            confirm(self.confirm, self.only or ("*",))
        elif self.only:
            self._compute_again(run)
        states = [xr.Dataset(_description(path), {"file": path.stem}) for path in published()]
        results = xr.concat(states, "file")
        states = dict(zip(results.file.values.tolist(), results.state.values.tolist(), strict=True))
        if self.check_digests and (problems := stale_problems(states)):
            raise InputError(" ".join(problems))
        return results

    def _compute_again(self, run: Run) -> None:
        """Compute the selected data files in turn; failures are collected until the end."""
        failed, folder = [], run.folder or self.default_folder
        for name, recipe in RECIPES.items():
            selected = any(_match(name, pattern) for pattern in self.only)
            if not selected or self.needs not in ("any", recipe.device):
                continue
            start = time.perf_counter()
            try:
                run_recipe(name, recipe, folder / "runs", self.machine or machine())
                state = "done"
            except Exception as error:  # the failure of one study must not stop the others
                state = f"failed, {type(error).__name__}: {error}"
                failed.append(name)
            print(f"{name}: {state}, {time.perf_counter() - start:.0f} s", flush=True)
        if failed:
            raise InputError(
                f"{len(failed)} of the files could not be computed: {', '.join(failed)}. The "
                "others are complete; the same command continues."
            )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return a row per data file, current ones last."""
        ordered = results.sortby("state", ascending=False)
        columns = {name: f"{{{name}}}" for name in ("file", *_KEYS)}
        states = results.state.values.tolist()
        kinds = ("stale", CURRENT, "confirmed", EARLIER)
        stale, today, *same = (sum(kind in state for state in states) for kind in kinds)
        text = (
            f"{today} of {len(states)} data files are of rps_jax {rps_jax.__version__} and today's "
            f"code. {sum(same)} are of earlier code that gives the same numbers, and {stale} are "
            "stale. A version is that of the code at the commit: between two releases it is the "
            "earlier one. A file without a digest is older than the digests: only its command and "
            "its commit tell its inputs."
        )
        rows = text_table(columns, records(ordered, "file"))
        return [Table(rows, title="Data files", text=text)]


publish = call_of(Publish)


def published() -> list[Path]:
    """Return the data files of all tables."""
    return sorted(_SWEEPS.rglob("results/*.json"))


def stale_problems(states: Mapping[str, str]) -> list[str]:
    """Return a sentence on stale files that `STALE` lacks, and one on those that it must not list.

    The states are in words, by file.
    """
    stale = {name for name, state in states.items() if state.startswith("stale")}
    problems = []
    if unlisted := sorted(stale - STALE.keys()):
        problems.append(
            f"published numbers are stale: the inputs of {', '.join(unlisted)} have changed; "
            f"compute them again by rps sweeps/publish --only {' '.join(unlisted)}, or list them "
            "in STALE of sweeps/render_tables.py with the change, or, if the code changed and the "
            "numbers are the same, state why by rps sweeps/publish --confirm REASON."
        )
    if current := sorted(STALE.keys() - stale):
        problems.append(
            f"STALE in sweeps/render_tables.py lists {', '.join(current)}, which no change has "
            "made stale: remove these names, and run python sweeps/render_tables.py."
        )
    return problems


def confirm(reason: str, patterns: Sequence[str]) -> None:
    """State in `equal.json` that the source code of today gives the numbers of current files.

    `patterns` select data files. The digests of the code of older files, which have none, are first
    stored in `commits.json`.
    """
    datas = {path.stem: json.loads(path.read_text()) for path in published()}
    datas = {name: data for name, data in datas.items() if "digest" in data}
    sources.store({data["commit"] for data in datas.values() if "code" not in data})
    names, code = [], dict[str, list[str]]()
    for name, data in datas.items():
        selected = any(fnmatch.fnmatch(name, pattern) for pattern in patterns)
        if name in STALE or not selected or not _has_current_settings(data):
            continue
        rooms = rooms_of(map(shlex.split, data["command"]))
        for room in (changed := sources.changed_rooms(name, data, rooms)):
            code.setdefault(room, []).append(sources.latest(name, room, data))
        names += [name] if changed else []
    if names:
        today = sources.digests()
        code = {room: [*sorted({*old}), today[room]] for room, old in sorted(code.items())}
        changes = [*sources.equal_changes(), {"reason": reason, "files": names, "code": code}]
        files.write_text(sources.EQUAL, json.dumps(changes, indent=1) + "\n")


def _has_current_settings(data: Mapping[str, Any]) -> bool:
    """Return whether the settings of the commands of a data file are those of today."""
    return digest([shlex.split(command) for command in data["command"]]) == data["digest"]


def _description(path: Path) -> dict[str, str]:
    """Return version, commit, date, state and duration of a data file, in words."""
    data = json.loads(path.read_text())
    recipe = next((r for name, r in RECIPES.items() if fnmatch.fnmatch(path.stem, name)), None)
    minutes = (recipe.two_cores, recipe.one_gpu) if recipe else (None, None)
    cores, gpu = ("" if t is None else f"{t:g} min" for t in minutes)
    return {
        "version": str(data.get("versions", {}).get("rps_jax", "")),
        "commit": str(data.get("commit") or "")[:8],
        "date": str(data.get("date") or ""),
        "computed on": recipe.device if recipe else "",
        "two cores": cores,
        "one H100": gpu,
        "state": _state(path.stem, data),
    }


def _state(name: str, data: Mapping[str, Any]) -> str:
    """Return whether a data file is up to date."""
    if "command" not in data:
        cited = {cell["from"] for row in data["rows"] for cell in row if isinstance(cell, dict)}
        return f"cites {', '.join(sorted(cited))}"
    if name in HISTORY:
        return f"history: {HISTORY[name]}"
    version = str(data["versions"]["rps_jax"])
    if "digest" not in data:
        return f"computed by {version}, without a digest"
    try:
        is_current = _has_current_settings(data)
    except (InputError, SystemExit) as error:
        return f"stale: its command does not exist today ({error})"
    change = "" if is_current else "a change of its laws, domains, physics or seeds"
    rooms = rooms_of(map(shlex.split, data["command"]))
    if not change and (changed := sources.changed_rooms(name, data, rooms)):
        change = f"a change of the code of {', '.join(changed)}"
    if change:
        return f"stale: computed before {STALE.get(name, change)}"
    if sources.changed_rooms("", data, rooms):
        return "confirmed: its code changed, its numbers did not, by equal.json"
    return CURRENT if version == rps_jax.__version__ else f"computed by {version}, {EARLIER}"


# --- computing data files again -------------------------------------------------------------


def run_recipe(name: str, recipe: Recipe, runs: Path, device: str) -> None:
    """Run the commands of a recipe, or load their run folders, and write the data file."""
    tables, runs_behind = [], []
    labels = recipe.labels or ("",) * len(recipe.commands)
    for label, command in zip(labels, recipe.commands, strict=False):
        words = shlex.split(command.replace("MACHINE", shlex.quote(device)))
        sections, results, signed = _run_command(words, runs)
        runs_behind.append(signed)
        pattern = recipe.section
        if not isinstance(pattern, str):
            tables += [(label, rows)] if (rows := pattern(results)) else []
            continue
        for section in sections:
            if section.table and fnmatch.fnmatch(section.title, pattern):
                in_title = section.title.split(" in ")[1] if " in *" in pattern else ""
                tables.append((label or in_title, [list(row) for row in section.table]))
    if recipe.section:
        columns, rows = joined(tables, recipe.columns)
        paths = {path.stem: path for path in published()}
        path = paths.get(name, _SWEEPS / "results" / f"{name}.json")
        write_table(path, runs_behind, device, Table(rows, columns=columns))


def _run_command(words: list[str], runs: Path) -> tuple[Sequence[Section], Any, dict[str, Any]]:
    """Run a command; return the sections of its report, its results and its provenance."""
    (_, *options), folder = split_folder(words)
    name, options = names.split([re.sub(r"\bruns/", f"{runs}/", word) for word in options])
    out = runs / Path(folder or _folder_name(words)).name
    options += ["--out", str(out)]
    question, _ = flags.parse(names.question_type(name), name, options)
    question.validate()
    arguments, sys.argv = sys.argv, list(words)  # the run folder stores the command
    try:
        with question.progress_bar() as bar:
            results = question.execute(bar)
            sections = question.report(results, question.create_run(out, bar))
    finally:
        sys.argv = arguments
    return sections, results, provenance.read_environment(out) | {"command": words}


def _folder_name(words: Sequence[str]) -> str:
    """Return the name of the run folder of a command that names none."""
    readable = re.sub(r"\W+", "_", " ".join(words[1:]))
    return f"{readable[:60]}-{hashlib.sha256(' '.join(words).encode()).hexdigest()[:8]}"


def joined(
    tables: Sequence[tuple[str, Rows]], columns: Sequence[str]
) -> tuple[list[dict[str, Any]], Rows]:
    """Return columns and rows of several tables with the same header, each row after its label.

    Raises:
      InputError: there is no table, or the headers differ.
    """
    if not tables:
        raise errors.not_allowed("table", None, "no section of the report has that title")
    (_, (header, *_)), has_labels = tables[0], any(label for label, _ in tables)
    shown = [i for i, column in enumerate(header) if not columns or column in columns]
    rows: Rows = []
    for label, (other_header, *body) in tables:
        if [other_header[i] for i in shown if i < len(other_header)] != [header[i] for i in shown]:
            raise InputError(f"columns = {other_header} are not allowed beside {header}.")
        labelled = [[*[label] * has_labels, *(row[i] for i in shown)] for row in body]
        for above, row in itertools.pairwise(labelled):  # an empty first cell repeats that above
            row[0] = row[0] or above[0]
        rows += labelled
    unnamed = iter(("law", "whose"))
    column_names = [*[""] * has_labels, *(header[i] or next(unnamed) for i in shown)]
    merged = {"merge": True}
    return [{"name": name, **({} if i else merged)} for i, name in enumerate(column_names)], rows


def _match(name: str, pattern: str) -> bool:
    """Return whether either of two patterns matches the other."""
    return fnmatch.fnmatch(name, pattern) or fnmatch.fnmatch(pattern, name)
