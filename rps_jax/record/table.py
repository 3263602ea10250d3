"""Tables of numbers that users write: CSV in the usual dialects, or Parquet, with units in titles.

A file may be compressed by gzip, and in UTF-8, UTF-16 or Latin-1. Cells are separated by commas,
semicolons, tabs, bars or blanks; decimals have a point or a comma. Lines that start with # or % are
comments; the last comment above the first row is the header if no other line is. Titles are
compared without regard to case, blanks and units: `Time [ms]` is `time`, in milliseconds.
"""

from __future__ import annotations

import csv
import gzip
import importlib.util
import io
import re
import textwrap
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from rps_jax.errors import InputError, check_name, not_allowed
from rps_jax.record import files

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".pq", ".xlsx")
_COMMENT = re.compile(r'\s*([#%](?![A-Z]+[/!?])|"?sep=)')  # no error of Excel, as #N/A
_NUMERIC = re.compile(r"(nan|inf|e[-+]?\d|(?<=\d)[TZ]|[\W\d])*", re.IGNORECASE)
_BRACKETS = re.compile(r"(.*?)[\s/]*[\[({]\s*(.*?)\s*[\])}]")
# Units that a title may name, by that of the values: their size in it.
_UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "in": 0.0254, "ft": 0.3048},
    "rad": {"rad": 1.0, "deg": np.pi / 180, "°": np.pi / 180},
    "N": {"n": 1.0, "kn": 1e3},
    "1": {"1": 1.0, "-": 1.0, "%": 0.01},
}
for _unit in ("m", "rad"):
    _rates = {f"{a}/{t}": x / y for a, x in _UNITS[_unit].items() for t, y in _UNITS["s"].items()}
    _UNITS[f"{_unit}/s"] = _rates
_WORDS = {"second": "s", "sec": "s", "meter": "m", "metre": "m", "degree": "deg", "radian": "rad"}
_read_csv = partial(pd.read_csv, skipinitialspace=True, keep_default_na=False, low_memory=False)


def is_table(path: Path) -> bool:
    """Return whether the name of a file, perhaps a compressed one, is that of a table."""
    return files.suffix_of(files.unpacked(path)) in SUFFIXES


def check_parquet(name: str, path: Path) -> None:
    """Raise InputError for a Parquet file unless pyarrow is installed."""
    is_parquet = files.suffix_of(path) in (".parquet", ".pq")
    if is_parquet and not importlib.util.find_spec("pyarrow"):
        rule = "it needs pyarrow: run pip install pyarrow, or name a .csv file"
        raise not_allowed(name, path, rule)


def read(path: Path, name: str) -> tuple[pd.DataFrame, str]:
    """Return the cells of a table and the sign of its decimals.

    Columns are by the titles in the file, and rows by those in the file. A column with cells that
    are no numbers has texts. Errors start with the `name`.

    Raises:
      InputError: the file cannot be read, is no table, or has rows that are longer than its header.
    """
    check_parquet("log", path)
    content = files.read_regular(path, "table")
    if content.startswith(b"PK"):
        raise InputError(f"{name} is an archive: unpack it, or save its sheet as CSV.")
    try:
        content = gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{name} cannot be unpacked ({error}): write CSV.") from error
    if content[:4] != b"PAR1":
        return _parse(_decode(content), name)
    try:
        table = pd.read_parquet(io.BytesIO(content))
    except Exception as error:  # of any kind, by pyarrow on damaged files
        raise InputError(f"{name} is no Parquet table ({error}): write it again.") from error
    table = table.reset_index() if any(table.index.names) else table
    return table.set_axis(pd.RangeIndex(1, len(table) + 1)).rename(columns=str), "."


def _decode(content: bytes) -> str:
    """Return the text of a file in UTF-8, UTF-16 or Latin-1."""
    try:
        return content.decode("utf-16" if b"\0" in content[:4] else "utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


def _parse(text: str, name: str) -> tuple[pd.DataFrame, str]:
    """Return the cells of a text, and the sign of its decimals."""
    texts = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    lines = [(i, line) for i, line in enumerate(texts, 1) if line.strip(' \t,;|"')]
    rows = [(i, line) for i, line in lines if not _COMMENT.match(line)]
    if len(rows) < 2:
        raise InputError(f"{name} is empty: give a header and at least two rows.")
    middle, header = rows[len(rows) // 2][1], rows[0][1]
    counts = {x: middle.count(x) / (2.5 if x == "," else 1) for x in ";\t|,"}  # or decimal commas
    sep = max(counts, key=lambda x: counts[x]) if any(counts.values()) else " "
    if not _NUMERIC.fullmatch(header):
        rows = rows[1:]
    elif rows[0] != lines[0]:
        header = lines[lines.index(rows[0]) - 1][1].lstrip("#% ")
    else:
        raise InputError(f"{name} has no header: name its columns above row {rows[0][0]}.")
    if sep == " ":  # units are no separate cells
        header = re.sub(r"\s+(?=[\[({])", "", header)
        rows = [(i, " ".join(line.split())) for i, line in rows]
    try:
        reader = csv.reader([header], delimiter=sep, skipinitialspace=True)
        titles = [title.strip() for title in next(reader)]
        names = range(1 + max(len(titles), *(line.count(sep) + 1 for _, line in rows)))
        body = "\n".join(line for _, line in rows)
        tables = {
            mark: _read_csv(io.StringIO(body), sep=sep, names=names, decimal=mark, na_values="")
            for mark in (".," if "," in body and (sep != "," or '"' in body) else ".")
        }
        decimal = max(tables, key=lambda x: tables[x].select_dtypes("number").shape[1])
        table = tables[decimal].set_axis([i for i, _ in rows])
    except (ValueError, csv.Error) as error:
        raise InputError(f"{name} is no table ({error}): write CSV.") from error
    count = len(titles)
    more = table.iloc[:, count:].notna().sum(axis=1)
    if more.any():
        size, i = f"{count + more.max()} cells", more.idxmax()
        fix = f"correct the row, quote cells with '{sep}', or write # before lines of text"
        raise InputError(f"{name} has {size} in row {i}, and {count} in the header: {fix}.")
    return table.iloc[:, :count].set_axis(titles, axis=1), decimal


# --- titles and numbers -----------------------------------------------------------------------


UnitOf = Callable[[str], str | None]  # unit of a known column, which may be empty; else None


class Table:
    """Known columns of a table.

    Args:
      source: file, or data frame.
      name: start of the sentence of errors.
      unit_of: the unit of a known name, which may be empty; None of all others.
      titles: titles in the file of some names, perhaps with a unit, as {"yaw": "heading [deg]"}.

    Raises:
      InputError: the file is no table, or a column is repeated or has an unknown unit.
    """

    def __init__(
        self,
        source: str | Path | pd.DataFrame,
        name: str,
        unit_of: UnitOf,
        titles: Mapping[str, str] | None = None,
    ) -> None:
        is_frame = isinstance(source, pd.DataFrame)
        self._table, self._decimal = (source, ".") if is_frame else read(Path(source), name)
        if self._table.empty:
            raise InputError(f"{name} is empty: give at least one row.")
        self.name, self.rows = name, self._table.index.to_numpy()
        self._titles = [str(title) for title in self._table.columns]
        self._has_option, titles = titles is not None, titles or {}  # --columns
        self.columns = dict[str, tuple[int, str, float]]()  # index, unit, size of the file's unit
        self.conversions = list[str]()  # from other units, in words
        plain = [_split(title)[0] for title in self._titles]
        pairs = list[tuple[str, int]]()
        for key, title in titles.items():
            indices = _matches(title, self._titles) or _matches(_split(title)[0], plain)
            pairs += [(key, i) for i in indices]
            if not indices:
                check_name(f"title for {key} in {name}:", title, self._titles)
        used = {*titles, *(plain[i] for _, i in pairs)}
        pairs += [(x, i) for i, x in enumerate(plain) if x not in used and unit_of(x) is not None]
        for key, i in pairs:
            title, unit, named = self._titles[i], unit_of(key) or "", titles.get(key, "")
            if key in self.columns:
                pair = f"'{self._titles[self.columns[key][0]]}' and '{title}'"
                fix = "remove all but one" + ", or choose by --columns" * self._has_option
                raise InputError(f"{name} has several columns for {key}, {pair}: {fix}.")
            suffix = named.rpartition("_")[2]
            suffix = suffix if _plain_unit(suffix) in _UNITS.get(unit, ()) else unit
            file_unit = _split(named)[1] or _split(title)[1] or suffix
            kind, plain_unit = f"unit of the column '{title}' in {name}:", _plain_unit(file_unit)
            scale = _UNITS[unit][check_name(kind, plain_unit, _UNITS[unit])] if unit else 1.0
            self.columns[key] = i, unit, scale
            if scale != 1:
                self.conversions.append(f"{key} from {file_unit} to {unit}")

    def require(self, names: Iterable[str]) -> None:
        """Raise InputError with all names that the table lacks, and with similar titles."""
        missing = [name for name in names if name not in self.columns]
        used = {i for i, _, _ in self.columns.values()}
        unused = rest = [title for i, title in enumerate(self._titles) if title and i not in used]
        similar = dict[str, str]()
        for name in sorted(missing, key=len, reverse=True):  # v_x before x
            similar[name] = next((x for x in rest if _is_similar(x, name)), "TITLE")
            rest = [x for x in rest if x != similar[name]]
        if missing:
            noun = "columns" if len(missing) > 1 else "column"
            pairs = ",".join(f"{name}={similar[name]}" for name in missing)
            listing = textwrap.shorten(", ".join(unused) or "no other", 500, placeholder=" ...")
            fix = f", or write --columns '{pairs}' with its titles, as {listing}"
            fix = "add what is missing" + fix * self._has_option
            raise InputError(f"{self.name} lacks the {noun} {', '.join(missing)}: {fix}.")

    def values_of(self, name: str, unused: np.ndarray | bool = False) -> np.ndarray:
        """Return the numbers (N,) of a column in its unit, date-times from their start.

        Empty cells of `unused` rows (N,) are 0.

        Raises:
          InputError: a cell is empty or no finite number; the sentence has its row and column.
        """
        i, unit, scale = self.columns[name]
        cells = self._table.iloc[:, i]
        is_text = cells.dtype.kind not in "iuf"
        plain = cells.astype(str).str.replace(self._decimal, ".") if is_text else cells
        values = np.asarray(pd.to_numeric(plain, errors="coerce"), float)
        values = scale * np.where(cells.isna() & unused, 0.0, values)
        fix = "a number as 1234.5, or remove the row"
        if unit == "s" and is_text and np.isnan(values).mean() > 0.5:
            texts, fix = plain.str.replace(",", "."), "seconds as 1234.5, or ISO date-times"
            stamps = pd.to_datetime(texts, utc=True, format="ISO8601", errors="coerce")
            moments = max(stamps, pd.to_timedelta(texts, errors="coerce"), key=pd.Series.count)
            values = (moments - moments.min()).dt.total_seconds().to_numpy()
        if len(bad := np.flatnonzero(~np.isfinite(values))):
            cell = cells.iloc[bad[0]]
            words = "an empty cell" if pd.isna(cell) else f"'{cell}'"
            words += f" and {len(bad) - 1} more" if len(bad) > 1 else ""
            where = f"row {self.rows[bad[0]]}, column {self._titles[i]}"
            raise InputError(f"{self.name} has no number in {where}, but {words}: write {fix}.")
        return values


def _split(title: str) -> tuple[str, str]:
    """Return a title in lower case without its unit, and its unit, as of `Time [ms]`."""
    match = _BRACKETS.fullmatch(title.strip())
    base, unit = match.groups() if match else (title.strip(), "")
    return re.sub(r"[\s.-]+", "_", base.casefold()), unit


def _plain_unit(unit: str) -> str:
    """Return a unit as `_UNITS` has it, as m/s of `Meters s^-1`."""
    text = re.sub(r"[µμ]", "u", re.sub(r"[\s()]", "", unit.casefold())).replace("º", "°")
    text = re.sub(r"[*·.]?s(\^?-1|⁻¹)$", "/s", text)
    return re.sub(r"[a-z]+", lambda word: _WORDS.get(word[0].rstrip("s"), word[0]), text)


def _matches(title: str, titles: Sequence[str]) -> list[int]:
    """Return the indices of a title."""
    return [i for i, x in enumerate(titles) if x == title]


def _is_similar(title: str, name: str) -> bool:
    """Return whether a title may be that of a column, as `cmd_v_x`, `vx` or `v_x_mps` of `v_x`."""
    text = _split(title)[0]
    return f"_{name}_" in f"_{text}_" or text in (name.replace("_", ""), name[:1])
