"""Write the published tables, which live as data, into the Markdown pages that show them.

    python sweeps/render_tables.py [--check]

`NAME.json` in `sweeps/results`, or in the `results` of a folder of `sweeps`, holds one table: the
command, device, versions, commit and date that made it, its columns and its rows. A page shows it
between `<!-- table: NAME -->` and `<!-- end -->`, and its commands between `<!-- command: NAME -->`
and `<!-- end -->`. Within a sentence `<!-- cell: NAME | ROW | COLUMN -->...<!-- end -->` is a cell
without its interval; ROW are the first cells of its row, also divided by bars, and a COLUMN whose
name others have, too, follows one to its left, as `both / 90 %`. With `--check` nothing is written,
and the exit code is 1 if a page differs from the data. Only the standard library is needed.

A cell is a text, a number, a list of numbers (a rate and the ends of its interval), or null. The
`format` of a column is applied to a number and to the first of a list, its `rest` to those that
follow. A column with `merge` shows no text twice below itself. A cell `{"from": NAME, "row": [...],
"column": ...}` shows a cell of another table, in the row that begins with the values given. A table
of such cells alone was made by no command, and has no more than columns and rows.
"""

import json
import os
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SWEEPS = ROOT / "sweeps"
KEYS = ("command", "device", "versions", "commit", "date", "columns", "rows")
_BLOCK = re.compile(r"(<!-- (table|command): (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
_CELL = re.compile(r"(<!-- cell: ([^>]*?) -->).*?(<!-- end -->)", re.DOTALL)
_SKIPPED = {"runs", "build", "dist"}  # folders of the root that hold no pages of the repository


def data_files(root: Path = SWEEPS) -> dict[str, Path]:
    """The data files of all tables by name; raises ValueError if two have the same name."""
    found: dict[str, Path] = {}
    for path in sorted(root.glob("**/results/*.json")):
        if path.stem in found:
            raise ValueError(f"{path} has the name of {found[path.stem]}: rename one of them.")
        found[path.stem] = path
    return found


def load(name: str, root: Path = SWEEPS) -> dict[str, Any]:
    """The data of a table; raises ValueError, with one sentence, if there is no such file."""
    path = path_of(name, root)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}.") from error
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not JSON: {error}.") from error
    if any(isinstance(cell, dict) for row in data.get("rows", ()) for cell in row):
        data = dict.fromkeys(KEYS) | data
    missing = [key for key in KEYS if key not in data]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}.")
    for row in data["rows"]:
        if len(row) != len(data["columns"]):
            raise ValueError(f"{path}: the row {row[:2]} has not one cell for each column.")
    return data


def path_of(name: str, root: Path = SWEEPS) -> Path:
    """The data file of a table; raises ValueError if there is none."""
    files = data_files(root)
    if name not in files:
        raise ValueError(f"{name}.json is in no folder `results` of {root}.")
    return files[name]


def table(data: dict[str, Any], root: Path = SWEEPS) -> str:
    """The Markdown table of some data."""
    lines = [[column["name"] for column in data["columns"]]]
    before: list[Any] = [None] * len(data["columns"])
    for row in data["rows"]:
        texts = []
        for cell, column, above in zip(row, data["columns"], before, strict=True):
            merged = column.get("merge") and cell == above
            texts.append("" if merged else _text(cell, column, root))
        lines.append(texts)
        before = row
    lines.insert(1, ["---"] * len(data["columns"]))
    return "".join(f"| {' | '.join(map(_escaped, texts))} |\n" for texts in lines)


def _escaped(text: str) -> str:
    """A cell whose bars, as of |l|, do not end it."""
    return re.sub(r"(?<!\\)\|", r"\|", text)


def _text(cell: Any, column: dict[str, Any], root: Path) -> str:
    if cell is None:
        return ""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, dict):
        return _cited(cell, root)
    first, *rest = cell if isinstance(cell, list) else [cell]
    text = column.get("format", "{}").format(first)
    return text + column.get("rest", "").format(*rest) if rest else text


def _cited(cell: dict[str, Any], root: Path) -> str:
    """The text of a cell of another table."""
    data, first = load(cell["from"], root), cell["row"]
    names = [column["name"] for column in data["columns"]]
    rows = [row for row in data["rows"] if row[: len(first)] == first]
    *left, column = cell["column"].split(" / ")
    begin = names.index(left[0]) if left and left[0] in names else 0
    if len(rows) != 1 or column not in names[begin:]:
        raise ValueError(f"{cell} does not name one cell of {cell['from']}.json.")
    i = names.index(column, begin)
    return _text(rows[0][i], data["columns"][i], root)


def caption(data: dict[str, Any], link: str) -> str:
    """One line that says where the numbers were made and links to all that is known of them."""
    if data["command"] is None:
        return f"\n<sub>Every number is cited: [from which table]({link}).</sub>\n"
    known = [f"Device: {data['device']}"] if data["device"] else []
    known += [f"date: {data['date']}"] if data["date"] else []
    return f"\n<sub>{'; '.join([*known, f'[command, versions and values]({link})'])}.</sub>\n"


def commands(data: dict[str, Any]) -> str:
    """The commands of some data, to be copied into a shell."""
    lines = data["command"] if isinstance(data["command"], list) else [data["command"]]
    return "```bash\n" + "".join(f"{line}\n" for line in lines) + "```\n"


def render(page: Path, root: Path = SWEEPS) -> str:
    """The text of a page with all its blocks made anew from the data."""

    def block(found: re.Match[str]) -> str:
        begin, kind, name, end = found.groups()
        data = load(name, root)
        if kind == "command":
            return begin + commands(data) + end
        link = Path(os.path.relpath(path_of(name, root), page.parent)).as_posix()
        return begin + table(data, root) + caption(data, link) + end

    def cell(found: re.Match[str]) -> str:
        begin, words, end = found.groups()
        name, *row, column = (word.strip() for word in words.split("|"))
        return (
            begin + _cited({"from": name, "row": row, "column": column}, root).split(" [")[0] + end
        )

    return _CELL.sub(cell, _BLOCK.sub(block, page.read_text(encoding="utf-8")))


def pages(root: Path = ROOT) -> list[Path]:
    """Every Markdown page of the repository."""
    found = []
    for folder, folders, files in os.walk(root):
        skipped = _SKIPPED if Path(folder) == root else ()
        folders[:] = [name for name in folders if name[0] != "." and name not in skipped]
        found += [Path(folder) / name for name in files if name.endswith(".md")]
    return sorted(found)


def main(arguments: list[str]) -> int:
    """Render every page, or check that each is as the data say; returns the exit code."""
    if arguments not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    stale = []
    try:
        for name in data_files():
            table(load(name))
        for page in pages():
            text = render(page)
            if text != page.read_text(encoding="utf-8"):
                stale.append(page)
                if not arguments:
                    page.write_text(text, encoding="utf-8")
    except ValueError as error:
        print(f"render_tables: error: {error}", file=sys.stderr)
        return 1
    for page in stale:
        what = "differs from its data; run this without --check" if arguments else "was rendered"
        print(f"{page.relative_to(ROOT)} {what}.")
    return 1 if stale and arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
