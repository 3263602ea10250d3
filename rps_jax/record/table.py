"""Tables of numbers that users write: CSV, with units in its titles.

Cells are separated by commas, semicolons or tabs, decimals have a point, and text after a # is a
comment. Titles are compared without regard to case, blanks and units: `Time [ms]` is `time`, in
milliseconds.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from rps_jax.errors import InputError, check_name, one_line
from rps_jax.record import files

SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
_TITLE = re.compile(r"\s*(.*?)\s*(?:[\[(]\s*(.*?)\s*[\])])?\s*")
# Units that a title may name, by that of the values: their size in it.
_UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad": {"rad": 1.0, "deg": np.pi / 180},
    "N": {"n": 1.0},
    "1": {"1": 1.0, "%": 0.01},
}
for _unit in ("m", "rad"):
    _UNITS[f"{_unit}/s"] = {f"{x}/s": size for x, size in _UNITS[_unit].items()}


def read(path: Path, name: str, unit_of: Callable[[str], str | None]) -> pd.DataFrame:
    """Return the known columns of a table in their units; a cell without a number is NaN.

    The index has the rows in the table, of which the header is the first. The attribute `titles`
    has all titles of the file.

    Args:
      path: of the file.
      name: start of the sentence of errors.
      unit_of: the unit of a known column, which may be empty; None of all others.

    Raises:
      InputError: the file is no table, or a column is repeated or has an unknown unit.
    """
    text = files.read_regular(path, "table").decode("utf-8-sig", "replace")
    header = next((x for x in text.splitlines() if x.partition("#")[0].strip()), "")
    options = {"sep": max(",;\t", key=header.count), "comment": "#", "skipinitialspace": True}
    try:
        cells = pd.read_csv(io.StringIO(text), header=None, dtype=str, **options)
    except ValueError as error:
        reason = one_line(error)
        raise InputError(f"{name} is no table ({reason}): write CSV with a header.") from error
    columns = dict[str, pd.Series]()
    titles = [str(title) for title in cells.iloc[0]]
    for i, title in enumerate(titles):
        match = _TITLE.fullmatch(title.casefold())
        key, unit = match.groups() if match else (title, None)
        if (expected := unit_of(key := re.sub(r"[\s.-]+", "_", key))) is None:
            continue
        if key in columns:
            raise InputError(f"{name} has several columns for {key}: remove all but one.")
        columns[key] = pd.Series(pd.to_numeric(cells[i][1:], errors="coerce"))
        if unit and expected:
            kind = f"unit of the column '{title}' in {name}:"
            columns[key] *= _UNITS[expected][check_name(kind, unit, _UNITS[expected])]
    table = pd.DataFrame(columns, cells.index[1:])
    table.index += 1
    table.attrs["titles"] = titles
    return table


def require(table: pd.DataFrame, name: str, columns: Iterable[str]) -> None:
    """Raise InputError with all columns that a table lacks."""
    if missing := [x for x in columns if x not in table]:
        titles = ", ".join(table.attrs.get("titles", map(str, table)))
        raise InputError(f"{name} lacks {', '.join(missing)}: rename its columns {titles}.")
