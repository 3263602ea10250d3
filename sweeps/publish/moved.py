"""Numbers in published tables that moved beyond their intervals since an earlier commit, and why.

    rps sweeps/publish/moved.py

needs a clone with its history.
"""

from __future__ import annotations

import fnmatch
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import xarray as xr

from rps_jax.questions import Run, call_of
from sweeps.publish.study import published
from sweeps.study_base import Study, Table, records, run_process, text_table

# Change behind moved numbers, by patterns of table and row; the first that matches counts.
WHY = {
    "* *learned*": "`learned` was trained in paths and between walls, too",
    "corridors_widths * rps": "lookahead 0.38 m, no longer 0.6 m: it is chosen in worlds of tuners",
    "rivals_tuned *": "tuners got separate worlds, in which the search ends elsewhere",
    "*": "",
}
_INTERVAL = re.compile(r"([\d.]+)(?: %)? \[([\d.]+), ([\d.]+)\]")
_WITH_UNIT = re.compile(r"[\d.,]+ \S+")
_COLUMNS = {
    "table": "{file}",
    "row": "{row}",
    "column": "{column}",
    "before": "{old}",
    "now": "{new}",
    "why": "{why}",
}
_NAMES = ("file", "row", "column", "old", "new", "why")


@dataclass(frozen=True)
class Moved(Study[xr.Dataset]):
    """List published numbers whose intervals are apart from those at an earlier commit.

    The results hold file, row, column, old, new and why (cell), in words, and `compared`: how many
    numbers with an interval both versions have.
    """

    TITLE = "What moved between two versions"

    since: str = "939476ac"
    """Commit or tag with the earlier data files; by default, that of version 0.4.0."""

    def answer(self, run: Run) -> xr.Dataset:
        """Compare all data files that both versions have."""
        moved, compared = list[tuple[str, ...]](), 0
        earlier = _data_files(self.since)
        for path in published():
            old = dict(_estimates(json.loads(earlier.get(path.stem, '{"rows": []}'))))
            for key, text in _estimates(json.loads(path.read_text())):
                if former := old.get(key):
                    compared += 1
                    if _is_disjoint(former, text):
                        name = f"{path.stem} {key[0]}"
                        why = next(why for x, why in WHY.items() if fnmatch.fnmatch(name, x))
                        moved.append((path.stem, *key[:2], former, text, why))
        columns = zip(*moved, strict=True) if moved else ((),) * len(_NAMES)
        cells = {name: ("cell", list(column)) for name, column in zip(_NAMES, columns, strict=True)}
        return xr.Dataset({**cells, "compared": compared})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the table of moved numbers."""
        rows = text_table(_COLUMNS, records(results.drop_vars("compared"), "cell"))
        text = f"Of {int(results.compared):,} numbers with intervals, those not listed agree."
        return [Table(rows, name="moved", title="Moved numbers", text=text, merge="table")]


moved = call_of(Moved)


def _data_files(commit: str) -> dict[str, str]:
    """Return the texts of the data files of a commit, by name."""

    problem = f"since = {commit!r}: git finds no such commit in this folder's history"

    def git(*words: str) -> str:
        return run_process(["git", *words], problem)

    paths = git("ls-tree", "-r", "--full-tree", "--name-only", commit, "sweeps").split()
    results = [path for path in paths if fnmatch.fnmatch(path, "*/results/*.json")]
    return {path.split("/")[-1][:-5]: git("show", f"{commit}:{path}") for path in results}


def _estimates(data: Mapping[str, Any]) -> Iterator[tuple[tuple[str, str, int], str]]:
    """Yield row, column, number among equal rows and text of each interval.

    Measured cells are no part of a row's name.
    """
    labels = Counter[str]()
    for row in data["rows"]:
        cells = {
            column["name"]: cell
            for column, cell in zip(data["columns"], row, strict=True)
            if isinstance(cell, str)
        }
        is_estimate = {name: bool(_INTERVAL.match(cell)) for name, cell in cells.items()}
        label = []
        for name, cell in cells.items():
            if is_estimate[name]:
                break
            label += [cell] if not _WITH_UNIT.fullmatch(cell) else []
        labels[row_name := ", ".join(label)] += 1
        for name, cell in cells.items():
            if is_estimate[name]:
                yield (row_name, name, labels[row_name]), cell


def _is_disjoint(former: str, text: str) -> bool:
    """Return whether the intervals of two numbers have no common value."""
    (_, low, high), (_, other_low, other_high) = (
        map(float, match.groups())
        for match in (_INTERVAL.match(former), _INTERVAL.match(text))
        if match
    )
    return high < other_low or other_high < low
