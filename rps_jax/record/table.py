"""Tables of numbers that users write: CSV in the usual dialects, or Parquet, with units in titles.

A file may be compressed, and in UTF-8, UTF-16 or Latin-1. Cells are separated by commas,
semicolons, tabs, bars or blanks; decimals have a point or a comma. Lines that start with # or % are
comments; the last comment before the first row is the header if no other line is. Titles are
compared without regard to case, blanks and units: `Time [ms]` is `time`, in milliseconds.
"""

from __future__ import annotations

import bz2
import csv
import difflib
import gzip
import importlib.util
import io
import lzma
import re
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from rps_jax.errors import InputError, not_allowed, suggest
from rps_jax.record import files

SUFFIXES = (".csv", ".tsv", ".txt", ".dat", ".parquet", ".pq", ".xlsx")
_MAX_BYTES = 2**28  # of an unpacked file
_OPENERS = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ": lzma.open}
_ENCODINGS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_DELIMITERS = ";\t|,"
_BRACKETS = re.compile(r"(.*?)\s*[\[({]\s*([^\])}]*?)\s*[\])}]")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_COMMENT = re.compile(r"[#%](?!(N/A|DIV/0!|[A-Z]+[!?])(\W|$))")  # no error of Excel
_NUM_TITLES = 20  # in an error, at most

_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "in": 0.0254, "ft": 0.3048}
_LENGTHS |= {"meter": 1.0, "metre": 1.0}
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "sec": 1.0, "second": 1.0, "min": 60.0}
_TIMES |= {"msec": 1e-3, "h": 3600.0, "hour": 3600.0}
_ANGLES = {"rad": 1.0, "deg": np.pi / 180, "radian": 1.0, "degree": np.pi / 180, "°": np.pi / 180}


def _rates(units: Mapping[str, float]) -> dict[str, float]:
    return {f"{unit}/{t}": a / b for unit, a in units.items() for t, b in _TIMES.items()}


# Units that a title may name, by that of the values: their size in it.
_UNITS: dict[str, dict[str, float]] = {
    "s": _TIMES,
    "m": _LENGTHS,
    "rad": _ANGLES,
    "m/s": _rates(_LENGTHS),
    "rad/s": _rates(_ANGLES) | {"rpm": np.pi / 30, "dps": np.pi / 180},
    "N": {"n": 1.0, "kn": 1000.0, "newton": 1.0},
    "1": {"1": 1.0, "-": 1.0, "%": 0.01},
}
_COMMON = ("s", "ms", "ns", "m", "cm", "mm", "rad", "deg", "m/s", "mm/s", "km/h", "rad/s", "deg/s")


def is_table(path: Path) -> bool:
    """Return whether the name of a file, perhaps a compressed one, is that of a table."""
    return files.suffix_of(files.unpacked(path)) in SUFFIXES


def check_parquet(name: str, path: Path) -> None:
    """Raise InputError for a Parquet file unless pyarrow is installed."""
    is_parquet = files.suffix_of(path) in (".parquet", ".pq")
    if is_parquet and not importlib.util.find_spec("pyarrow"):
        rule = "it needs pyarrow: run pip install pyarrow, or name a .csv file"
        raise not_allowed(name, path, rule)


def read(path: Path, name: str) -> pd.DataFrame:
    """Return the cells of a table by the titles in the file; the index has the rows in the file.

    Cells of a text are texts. Errors start with the `name`.

    Raises:
      InputError: the file cannot be read, is no table, or has rows of different lengths.
    """
    check_parquet("log", path)
    content = _unpack(files.read_regular(path, "table"), name)
    if content[:4] == b"PAR1":
        try:
            table = pd.read_parquet(io.BytesIO(content))
        except Exception as error:  # of any kind, by pyarrow on damaged files
            raise InputError(f"{name} is no Parquet table ({error}): write it again.") from error
        table = table.reset_index() if any(table.index.names) else table
        for title in table.select_dtypes(["object", "string"]):
            table[title] = table[title].astype(object).fillna("").astype(str).astype(object)
        return table.set_axis(pd.RangeIndex(1, len(table) + 1)).rename(columns=str)
    return _parse(_decode(content), name)


def _unpack(content: bytes, name: str) -> bytes:
    """Return the content of a file that may be compressed."""
    try:
        for magic, opener in _OPENERS.items():
            if content.startswith(magic):
                with opener(io.BytesIO(content)) as file:
                    content = file.read(_MAX_BYTES + 1)
        if content.startswith(b"PK\x03\x04"):
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                members = archive.namelist()
                if len(members) != 1:
                    fix = "save its sheet as CSV" if "xl/workbook.xml" in members else "unpack it"
                    raise ValueError(f"it holds {len(members)} files: {fix}")
                with archive.open(members[0]) as file:
                    content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise ValueError(f"it has more than {_MAX_BYTES // 2**20} MiB: cut it")
    except (OSError, EOFError, ValueError, lzma.LZMAError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{name} cannot be unpacked ({error}).") from error
    return content


def _decode(content: bytes) -> str:
    """Return the text of a file in UTF-8, UTF-16 or Latin-1."""
    for mark, encoding in _ENCODINGS.items():
        if content.startswith(mark):
            return content.decode(encoding, "replace")
    for start, encoding in enumerate(("utf-16-be", "utf-16-le")):
        if content[start : start + 64 : 2].count(0) > 24:
            return content.decode(encoding, "replace")
    try:
        return content.decode()
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


def _parse(text: str, name: str) -> pd.DataFrame:
    """Return the cells of a text."""
    text = text.replace("\N{MINUS SIGN}", "-").replace("\N{NO-BREAK SPACE}", " ")
    lines = [(i, line.strip(" ")) for i, line in enumerate(re.split(r"\r\n|\n|\r", text), 1)]
    lines = [(i, line) for i, line in lines if line.strip()]
    delimiter = ""
    if lines and (match := re.fullmatch(r'"?sep=(.)"?', lines[0][1])):  # of Excel
        delimiter, lines = match[1], lines[1:]
    comments = [(i, line.lstrip("#% ")) for i, line in lines if _COMMENT.match(line)]
    rows = [(i, line) for i, line in lines if not _COMMENT.match(line)]
    delimiter = delimiter or (_delimiter_of(rows[0][1]) if rows else ",")
    cells = [(i, row) for i, row in _split(rows, delimiter, name) if any(row)]
    if not cells:
        raise InputError(f"{name} is empty: give a header and at least two rows.")
    if all(_is_number(cell) for cell in cells[0][1]):
        headers = [_split([line], delimiter, name)[0] for line in comments if line[0] < rows[0][0]]
        headers = [x for x in headers if len(x[1]) == len(cells[0][1])]
        if not headers:
            first = ", ".join(cells[0][1][:3])
            raise InputError(f"{name} has no header: name the columns above the row {first}, ....")
        cells = [headers[-1], *cells]
    (start, titles), *body = cells
    while titles and not titles[-1]:
        titles = titles[:-1]
    shift = _index_column(titles, [row for _, row in body])
    for i, row in body:
        if len(row) < shift + len(titles) or any(row[shift + len(titles) :]):
            raise InputError(
                f"{name} has {len(row)} cells in row {i}, and {len(titles)} in the header, row "
                f"{start}: correct the row, quote cells that contain '{delimiter}', or write # "
                "before lines of text."
            )
    columns = [row[shift : shift + len(titles)] for _, row in body]
    return pd.DataFrame(columns, [i for i, _ in body], titles, dtype=object)


def _delimiter_of(line: str) -> str:
    """Return the delimiter of a header, or of a row of numbers, which may have decimal commas."""
    is_header = re.search(r"[^\W\deE]", line) is not None
    counts = [line.count(x) if is_header else x in line for x in _DELIMITERS]
    return _DELIMITERS[counts.index(max(counts))] if any(counts) else " "


def _split(
    lines: Sequence[tuple[int, str]], delimiter: str, name: str
) -> list[tuple[int, list[str]]]:
    """Return the cells of lines, with the numbers of the lines."""
    line_numbers, texts = [i for i, _ in lines], [text for _, text in lines]
    if delimiter == " ":  # units are not separate cells
        texts = [re.sub(r"\s+(?=[\[({])", "", text) for text in texts]
    reader = csv.reader(texts, delimiter=delimiter, skipinitialspace=True)
    try:
        return [
            (line_numbers[reader.line_num - 1], [x.strip(" '\t") for x in row]) for row in reader
        ]
    except csv.Error as error:
        row = line_numbers[reader.line_num - 1]
        raise InputError(f"{name} is no table ({error} in row {row}): write CSV.") from error


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"[-+\d.,eE]*\d[-+\d.,eE]*|nan|", cell, re.IGNORECASE) is not None


def _index_column(titles: list[str], rows: list[list[str]]) -> int:
    """Return 1 if the rows start with their number, for which the header has no title, else 0."""
    counts = [[str(i) for i in range(start, start + len(rows))] for start in (0, 1)]
    is_longer = all(len(row) == len(titles) + 1 for row in rows)
    return int(bool(rows) and is_longer and [row[0] for row in rows] in counts)


# --- titles and numbers -----------------------------------------------------------------------


class Column(NamedTuple):
    """Column of a table whose name is known."""

    cells: pd.Series  # by the row in the file
    title: str  # in the file
    unit: str  # of the values, as m/s; or empty
    file_unit: str  # explicit in the title; or empty
    scale: float  # of the file's unit, in `unit`


class Table:
    """Known columns of a table.

    Args:
      path: of the file.
      name: start of the sentence of errors.
      unit_of: the unit of a known name, which may be empty; None of all others.
      titles: titles in the file of some names, perhaps with a unit, as {"yaw": "heading [deg]"}.

    Raises:
      InputError: the file is no table, or a column is repeated or has an unknown unit.
    """

    def __init__(
        self,
        path: Path,
        name: str,
        unit_of: Callable[[str], str | None],
        titles: Mapping[str, str],
    ) -> None:
        cells = read(path, name)
        self.name, self.rows = name, cells.index.to_numpy()
        self._titles = [str(title) for title in cells.columns]
        indices = {key: self._indices(key, title) for key, title in titles.items()}
        renamed = {i for group in indices.values() for i in group}
        for i, title in enumerate(self._titles):
            key = _plain(title)
            if i not in renamed and key not in titles and unit_of(key) is not None:
                indices.setdefault(key, []).append(i)
        self.columns = dict[str, Column]()
        for key, group in indices.items():
            if len(group) > 1:
                first, second = (self._titles[i] for i in group[:2])
                choice = f", or write --columns '{key}={first}'" if first != second else ""
                raise InputError(
                    f"{name} has several columns for {key}, '{first}' and '{second}': remove all "
                    f"but one{choice}."
                )
            title, unit = self._titles[group[0]], unit_of(key) or ""
            file_unit = _unit_of(titles.get(key, ""), unit, key in titles)
            file_unit = file_unit or _unit_of(title, unit, key in titles)
            if unit and file_unit and _scale(unit, file_unit) is None:
                known = ", ".join(u for u in _UNITS[unit] if u in _COMMON) or unit
                raise InputError(
                    f"{name} has the column '{title}' in [{file_unit}], which is no known unit of "
                    f"{key}: name one as {known}."
                )
            scale = _scale(unit, file_unit) or 1.0
            column = cells.iloc[:, group[0]]
            self.columns[key] = Column(column, title, unit, file_unit, scale)
        self._comma = self._has_decimal_commas()

    def _indices(self, key: str, title: str) -> list[int]:
        """Return the columns with a title, by that or else without case and unit."""
        base = _split_title(title)[0]
        for matches in (
            [i for i, x in enumerate(self._titles) if x == title],
            [i for i, x in enumerate(self._titles) if x == base],
            [i for i, x in enumerate(self._titles) if _plain(x) == _plain(title)],
        ):
            if matches:
                return matches
        rest = f"it has {_listing(self._titles)}{suggest(title, self._titles)}"
        raise InputError(f"{self.name} has no column '{title}' for {key}: {rest}.")

    @property
    def conversions(self) -> list[str]:
        """Columns that are converted from another unit, in words."""
        return [
            f"{name} from {x.file_unit} to {x.unit}"
            for name, x in self.columns.items()
            if x.scale != 1
        ]

    def require(self, names: Iterable[str]) -> None:
        """Raise InputError with all names that the table lacks, and with similar titles."""
        if not (missing := [name for name in names if name not in self.columns]):
            return
        used = {column.title for column in self.columns.values()}
        unused = [title for title in self._titles if title and title not in used]
        simple = [title for title in unused if not re.search("[,=]", title)]
        similar = dict[str, str]()
        for name in sorted(missing, key=len, reverse=True):  # v_x before x
            rest = [title for title in simple if title not in similar.values()]
            if title := _most_similar(name, rest):
                similar[name] = title
        pairs = {name: similar[name] for name in missing if name in similar}
        fix = "add what is missing"
        if unused:
            fix = f"write --columns '{missing[0]}=TITLE' with a TITLE of {_listing(unused)}"
        if pairs:
            words = ",".join(f"{name}={title}" for name, title in pairs.items())
            fix = f"it has {_listing(list(pairs.values()))}: write --columns '{words}'"
        noun = "columns" if len(missing) > 1 else "column"
        raise InputError(f"{self.name} lacks the {noun} {', '.join(missing)}: {fix}.")

    def values_of(self, name: str, unused: np.ndarray | bool = False) -> np.ndarray:
        """Return the numbers (N,) of a column in its unit, date-times from their start.

        Empty cells of `unused` rows (N,) are 0.

        Raises:
          InputError: a cell is empty or no finite number; the sentence has its row and column.
        """
        column = self.columns[name]
        values, cells = self._parsed(column), column.cells
        values = np.where((cells.isna() | (cells == "")) & unused, 0.0, values)
        bad = ~np.isfinite(values)
        if column.unit == "s" and len(bad) and bad.mean() > 0.5:
            for convert in (partial(pd.to_datetime, utc=True, format="ISO8601"), pd.to_timedelta):
                moments = convert(cells.astype(str).str.replace(",", "."), errors="coerce")
                if moments.notna().sum() > len(moments) / 2:
                    values = (moments - moments.min()).dt.total_seconds().to_numpy()
                    bad, column = np.isnan(values), column._replace(scale=1.0)
        if bad.any():
            first, more = int(bad.argmax()), int(bad.sum()) - 1
            cell = str(cells.iloc[first])
            text = (
                f"'{cell}'" if cell and cells.iloc[first] == cells.iloc[first] else "an empty cell"
            )
            rest = f" and {more} more" if more else ""
            fix = "a number, or remove the row" if more + 1 < len(bad) else "numbers"
            fix = "seconds or ISO date-times" if column.unit == "s" else fix
            raise InputError(
                f"{self.name} has no number in row {self.rows[first]}, column {column.title}, but "
                f"{text}{rest}: write {fix}."
            )
        return values * column.scale

    def _parsed(self, column: Column) -> np.ndarray:
        """Return the numbers (N,) of the cells of a column, NaN for other cells."""
        cells = column.cells
        if pd.api.types.is_bool_dtype(cells) or pd.api.types.is_datetime64_any_dtype(cells):
            return np.full(len(cells), np.nan)
        if self._comma and cells.dtype == object:
            cells = cells.str.replace(",", ".", n=1)
        return pd.to_numeric(cells, errors="coerce").to_numpy(float)

    def _has_decimal_commas(self) -> bool:
        """Return whether decimals have a comma; InputError for thousands separators."""
        texts = [x for x in self.columns.values() if x.cells.dtype == object]
        if not any("," in cell for x in texts for cell in x.cells.to_numpy()):
            return False
        # Without date-times.
        cells = [(x.title, c, row) for x in texts for row, c in x.cells.items() if ":" not in c]
        if not (commas := [cell for cell in cells if "," in cell[1]]):
            return False
        has_points = any("." in cell for _, cell, _ in cells)
        if has_points or all(_THOUSANDS.fullmatch(cell) for _, cell, _ in commas):
            title, cell, row = commas[0]
            raise InputError(
                f"{self.name} has '{cell}' in row {row}, column {title}: write numbers without "
                "separators of thousands, and all decimals with a point, or all with a comma."
            )
        return True


def _split_title(title: str) -> tuple[str, str]:
    """Return a title without its unit, and its unit, as in `time [s]`, `x (m)` or `v / (m/s)`."""
    if match := _BRACKETS.fullmatch(title):
        return match[1].rstrip("/ "), match[2]
    base, _, unit = title.partition("/")
    known = any(_scale(si, unit) for si in _UNITS)
    return (base.strip(), unit.strip()) if base and known else (title.strip(), "")


def _plain(title: str) -> str:
    """Return a title in lower case, without its unit and with underscores for blanks."""
    return re.sub(r"[\s.-]+", "_", _split_title(title)[0].casefold())


def _unit_of(title: str, unit: str, with_suffix: bool) -> str:
    """Return the unit of a title, in brackets or, if requested, as in `yaw_deg`; or nothing."""
    words = re.split(r"[_\s]", title)
    suffixes = ("/".join(words[-2:]), words[-1]) if with_suffix and len(words) > 1 else ()
    known = (suffix for suffix in suffixes if _scale(unit, suffix))
    return _split_title(title)[1] or next(known, "")


def _scale(unit: str, file_unit: str) -> float | None:
    """Return the size of a unit of a file in another unit, or None if it is unknown."""
    text = re.sub(r"[\s*·.]*(s|sec|min|h)(\^?-1|⁻¹)$", r"/\1", file_unit.casefold().strip(" ()"))
    text = text.replace("μ", "u").replace("µ", "u").replace("º", "°").replace(" ", "")
    text = re.sub(r"(meter|metre|second|degree|radian|newton|hour|sec)s\b", r"\1", text)
    return _UNITS.get(unit, {}).get(text)


def _most_similar(name: str, titles: Sequence[str]) -> str:
    """Return the title that is most similar to a name, or nothing."""
    plain = {title: _plain(title) for title in titles}
    for title, text in plain.items():
        is_part = f"_{text}".endswith(f"_{name}") or text.startswith(f"{name}_")
        if is_part or text in (name.replace("_", ""), name[:1] if "_" not in name else name):
            return title
    matches = difflib.get_close_matches(name, plain.values(), 1, 0.7)
    return next((title for title, text in plain.items() if text in matches), "")


def _listing(titles: Sequence[str]) -> str:
    more = ", ..." if len(titles) > _NUM_TITLES else ""
    return ", ".join(f"'{title}'" for title in titles[:_NUM_TITLES]) + more
