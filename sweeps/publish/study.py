"""State of the published numbers, and the commands that compute them again.

rps sweeps/publish                       # all data files, with version, state and duration
rps sweeps/publish --check-probes        # runs the probes; fails if a stale file is not listed
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
from typing import Any, Literal

import xarray as xr

from rps_jax import InputError, errors
from rps_jax.app.cli import flags
from rps_jax.questions import Run, Section, call_of
from rps_jax.record import provenance
from sweeps import probes
from sweeps.publish.recipes import HISTORY, RECIPES, Recipe
from sweeps.render_tables import STALE
from sweeps.study_base import (
    Rows,
    Study,
    Table,
    machine,
    records,
    split_folder,
    text_table,
    write_table,
)

_SWEEPS = Path(__file__).parents[1]
_KEYS = ("version", "commit", "date", "state", "computed on", "two cores", "one H100")


@dataclass(frozen=True)
class Publish(Study[xr.Dataset]):
    """Report whether published numbers are up to date, and compute selected ones again.

    The results hold version, commit, date, state and duration (file), in words.
    """

    TITLE = "Published numbers and their dependencies"
    GROWS = ("only", "needs", "check_probes")

    only: tuple[str, ...] = ()
    """Data files to compute again, as fit_coverage or fit_*; by default none. With --check-probes,
    those to check; by default all."""
    needs: Literal["any", "cpu", "gpu"] = "any"
    """Device of the data files to compute again: processors, a GPU, or both."""
    check_probes: bool = False
    """Whether to run the small runs of the data files, and to fail if they give other numbers than
    when a file was computed, or if STALE in sweeps/render_tables.py lists a file without need."""

    def check(self) -> None:
        """Check that the data files exist."""
        known = [*(path.stem for path in published()), *RECIPES]
        for pattern in self.only:
            if not fnmatch.filter(known, pattern):
                raise errors.not_allowed("only", pattern, "no data file has such a name")

    def answer(self, run: Run) -> xr.Dataset:
        """Compute selected data files again, and return the state of all data files."""
        if self.only and not self.check_probes:
            self._compute_again(run)
            probes.remove_unused()
        descriptions = list[xr.Dataset]()
        for path in published():
            checked = self.check_probes and self._selects(path.stem)
            description = _description(path, checked)
            descriptions.append(xr.Dataset(description, {"file": path.stem}))
            if checked:
                print(f"{path.stem}: {description['state']}", flush=True)
        results = xr.concat(descriptions, "file")
        if self.check_probes:
            rows = zip(results.file.values.tolist(), results.state.values.tolist(), strict=True)
            states = {name: state for name, state in rows if self._selects(name)}
            if problems := stale_problems(states):
                raise InputError(" ".join(problems))
        return results

    def _selects(self, name: str) -> bool:
        """Return whether `only` has a data file; empty, it has all."""
        return not self.only or any(_match(name, pattern) for pattern in self.only)

    def _compute_again(self, run: Run) -> None:
        """Compute the selected data files in turn; failures are collected until the end."""
        failed, folder = [], run.folder or self.default_folder
        for name, recipe in RECIPES.items():
            if not self._selects(name) or self.needs not in ("any", recipe.device):
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
        stale = sum(state.startswith("stale") for state in results.state.values.tolist())
        text = (
            f"{stale} of {results.sizes['file']} data files are stale. A version is that of the "
            "code at the commit: between two releases it is the earlier one. Small runs tell if "
            "later code gives the same numbers (`--check-probes`); a measured time has none."
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
            f"published numbers are stale: small runs of {', '.join(unlisted)} give other numbers; "
            f"compute them again by rps sweeps/publish --only {' '.join(unlisted)}, or list them "
            "in STALE of sweeps/render_tables.py with the change."
        )
    if current := sorted((STALE.keys() & states.keys()) - stale):
        problems.append(
            f"STALE in sweeps/render_tables.py lists {', '.join(current)}, whose small runs give "
            "the same numbers: remove these names, and run python sweeps/render_tables.py."
        )
    if unknown := sorted(STALE.keys() - {path.stem for path in published()}):
        problems.append(f"STALE in sweeps/render_tables.py lists {', '.join(unknown)}, no file.")
    return problems


def _description(path: Path, checked: bool) -> dict[str, str]:
    """Return version, commit, date, state and duration of a data file, in words."""
    data = json.loads(path.read_text())
    recipe = next((r for name, r in RECIPES.items() if fnmatch.fnmatch(path.stem, name)), None)
    commits = data.get("commit") or ""
    commits = [commits] if isinstance(commits, str) else commits
    minutes = (recipe.two_cores, recipe.one_gpu) if recipe else (None, None)
    cores, gpu = ("" if t is None else f"{t:g} min" for t in minutes)
    return {
        "version": str(data.get("versions", {}).get("rps_jax", "")),
        "commit": ", ".join(x[:8] for x in commits),
        "date": str(data.get("date") or ""),
        "computed on": recipe.device if recipe else "",
        "two cores": cores,
        "one H100": gpu,
        "state": _state(path.stem, data, checked),
    }


def _state(name: str, data: Mapping[str, Any], checked: bool) -> str:
    """Return whether a data file is up to date; its small runs tell it if `checked`."""
    if "command" not in data:
        cited = {cell["from"] for row in data["rows"] for cell in row if isinstance(cell, dict)}
        return f"cites {', '.join(sorted(cited))}"
    if name in HISTORY:
        return f"history: {HISTORY[name]}"
    state = f"computed by {data['versions']['rps_jax']}"
    if not checked:
        return f"stale: computed before {STALE[name]}" if name in STALE else state
    if not probes.probes_of(name):
        return f"{state}, a measurement"
    if missing := probes.probes_of(name) - data.get("probes", {}).keys():
        return f"stale: {state}, without records of {', '.join(sorted(missing))}"
    if changed := probes.differences(data["probes"]):
        return f"stale: {state}, today's {', '.join(changed)} differ"
    return f"{state}, still current"


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
    options = [re.sub(r"\bruns/", f"{runs}/", word) for word in options]
    out = runs / Path(folder or _folder_name(words)).name
    question, _ = flags.read([*options, "--out", str(out)])
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
