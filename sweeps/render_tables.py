"""Write the published tables of the data files into the Markdown pages.

    python sweeps/render_tables.py [--check]

`NAME.json` in `sweeps/results`, or in the `results` of a folder of `sweeps`, has one table: its
commands, device, versions, commit, date, columns and rows. A page shows the table between
`<!-- table: NAME -->` and `<!-- end -->`, and its commands between `<!-- command: NAME -->` and
`<!-- end -->`. Within a sentence `<!-- cell: NAME | ROW | COLUMN -->...<!-- end -->` is a cell
without its interval. ROW has the first cells of its row, separated by bars. A COLUMN whose name
occurs twice follows a column to its left, as `both / 90 %`. With `--check` nothing is written, and
the exit code is 1 if a page differs from the data, or if a sentence has a measured number that no
cell renders. Only the standard library is needed.

A cell is a text, a number, a list of numbers (a rate and the limits of its interval), or null. The
`format` of a column applies to a number and to the first of a list, its `rest` to the others. A
column with `merge` leaves repeated texts out. A cell `{"from": NAME, "row": [...], "column": ...}`
shows a cell of another table, in the row that starts with these values. A table of such cells has
columns and rows only.

A number counts as measured by its form: a share, a time, a size in mm, a ratio, a count of a count,
an interval, or a power of ten. `publish/numbers.json` has the exceptions of each page, with their
words: definitions and settings, and results that have no data file.

`STALE` names the data files that are older than a change of their inputs and wait for their
computation. The note under their tables says so.
"""

import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SWEEPS = ROOT / "sweeps"
KEYS = ("command", "device", "versions", "commit", "date", "columns", "rows")
_BLOCK = re.compile(r"(<!-- (table|command): (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)
_CELL = re.compile(r"(<!-- cell: ([^>]*?) -->).*?(<!-- end -->)", re.DOTALL)
_TEXT_CELL = re.compile(r"^(# %% \[markdown\]\n)((?:#.*\n)*)", re.MULTILINE)  # of notebooks' texts
# The change since each stale data file: what follows "Computed before".
STALE: dict[str, str] = {}
NUMBERS = SWEEPS / "publish" / "numbers.json"
_NUMBER = r"(?<![\w.,/^#-])[-+±]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?"
_UNIT = (
    r"(?: ?%| ?(?:s|ms|µs|us|ns|min|h|x|kB|MB|GB|Hz|kHz|mm)\b"
    r"|[ -](?:times|fold|seconds?|minutes?|hours?|milliseconds?|microseconds?|percent)\b)"
)
_MEASURED = re.compile(
    rf"(?:{_NUMBER}(?: to | and |, |-))*{_NUMBER}{_UNIT}|{_NUMBER} (?:of|out of) {_NUMBER}"
    rf"|(?:factor|factors) of {_NUMBER}|\bp [=<] {_NUMBER}|\[{_NUMBER}, {_NUMBER}\]"
    rf"|\+\d[\d,]* -\d[\d,]*|(?<![\w.])\d[\d.]*e[-+]?\d+"
)
# Levels of intervals, and settings that many pages name.
_DEFINED = re.compile(
    rf"Wilson 95 %|(?:{_NUMBER} and )?{_NUMBER} % (?:[\w-]+ )?(?:intervals?|quantiles?)"
    rf"|(?:steps|period) of {_NUMBER} ms|at {_NUMBER} k?Hz|20\d\d"
)
_UNREAD = (  # parts of a page that are no prose
    r"<!-- (table|command): (\S+) -->\n.*?<!-- end -->",
    r"<!-- cell: [^>]*? -->.*?<!-- end -->",
    r"```.*?```",
    r"`[^`]*`",
    r"\$\$.*?\$\$|\$[^$]*?\$",
    r"\]\([^)]*\)",
    r"<[^>]*>",
    r"https?://\S+",
)
_SKIPPED = {"runs", "build", "dist"}  # folders of the root that hold no pages of the repository


def data_files(root: Path = SWEEPS) -> dict[str, Path]:
    """Return the data files of all tables by name; raises ValueError if a name occurs twice."""
    paths: dict[str, Path] = {}
    for path in sorted(root.glob("**/results/*.json")):
        if (other := paths.setdefault(path.stem, path)) != path:
            raise ValueError(f"{path} and {other} have the same name: rename one of them.")
    return paths


def load(name: str, root: Path = SWEEPS) -> dict[str, Any]:
    """Return the data of a table; raises ValueError if the file is missing or invalid."""
    path = path_of(name, root)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} cannot be read as JSON: {error}.") from error
    if any(isinstance(cell, dict) for row in data.get("rows", ()) for cell in row):
        data = dict.fromkeys(KEYS) | data
    missing = [key for key in KEYS if key not in data]
    if missing:
        raise ValueError(f"{path} lacks {', '.join(missing)}.")
    for row in data["rows"]:
        if len(row) != len(data["columns"]):
            raise ValueError(f"{path}: row {row[:2]} does not have a cell for each column.")
    return data


def path_of(name: str, root: Path = SWEEPS) -> Path:
    """Return the data file of a table; raises ValueError if there is none."""
    files = data_files(root)
    if name not in files:
        raise ValueError(f"{name}.json is in no folder `results` of {root}.")
    return files[name]


def table(data: dict[str, Any], root: Path = SWEEPS) -> str:
    """Return the Markdown table of some data."""
    lines = [[column["name"] for column in data["columns"]]]
    previous: list[Any] = [None] * len(data["columns"])
    for row in data["rows"]:
        texts = []
        for cell, column, above in zip(row, data["columns"], previous, strict=True):
            merged = column.get("merge") and cell == above
            texts.append("" if merged else text(cell, column, root))
        lines.append(texts)
        previous = row
    lines.insert(1, ["---"] * len(data["columns"]))
    return "".join(f"| {' | '.join(map(_escaped, texts))} |\n" for texts in lines)


def _escaped(text: str) -> str:
    """Return a cell with escaped bars, as in |l|."""
    return re.sub(r"(?<!\\)\|", r"\|", text)


def text(cell: Any, column: Mapping[str, Any], root: Path = SWEEPS) -> str:
    """Return the text of a cell in the format of its column."""
    if cell is None:
        return ""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, dict):
        return _cited(cell, root)
    first, *rest = cell if isinstance(cell, list) else [cell]
    shown = column.get("format", "{}").format(first)
    return shown + column.get("rest", "").format(*rest) if rest else shown


def _cited(cell: dict[str, Any], root: Path) -> str:
    """Return the text of a cell of another table."""
    data, first = load(cell["from"], root), cell["row"]
    names = [column["name"] for column in data["columns"]]
    rows = [row for row in data["rows"] if row[: len(first)] == first]
    *left_columns, column = cell["column"].split(" / ")
    first_column = names.index(left_columns[0]) if left_columns and left_columns[0] in names else 0
    if len(rows) != 1 or column not in names[first_column:]:
        raise ValueError(f"{cell} does not name one cell of {cell['from']}.json.")
    i = names.index(column, first_column)
    return text(rows[0][i], data["columns"][i], root)


def cell(words: str, root: Path = SWEEPS) -> str:
    """Return the text of the cell `NAME | ROW | COLUMN` without its interval."""
    name, *row, column = (word.strip() for word in words.split("|"))
    return _cited({"from": name, "row": row, "column": column}, root).split(" [")[0]


def caption(name: str, data: dict[str, Any], link: str) -> str:
    """Return one line: what is stale, device and date, and a link to the data file."""
    if data["command"] is None:
        cited = {cell["from"] for row in data["rows"] for cell in row if isinstance(cell, dict)}
        sources: dict[str, list[str]] = {}
        for source in sorted(cited & STALE.keys()):
            sources.setdefault(STALE[source], []).append(f"`{source}`")
        notes = [f"{', '.join(of)}: computed before {change}" for change, of in sources.items()]
        last = f"Every number is cited: [from which table]({link})"
    else:
        notes = []
        if name in STALE:
            notes = [f"Computed before {STALE[name]}"]
        parts = [f"Device: {data['device']}"] if data["device"] else []
        parts += [f"date: {data['date']}"] if data["date"] else []
        last = "; ".join([*parts, f"[command, versions and values]({link})"])
    return f"\n<sub>{'. '.join([*notes, last])}.</sub>\n"


def commands(data: dict[str, Any]) -> str:
    """Return the commands of some data as a shell block."""
    lines = data["command"] if isinstance(data["command"], list) else [data["command"]]
    return "```bash\n" + "".join(f"{line}\n" for line in lines) + "```\n"


def render(page: Path, root: Path = SWEEPS) -> str:
    """Return the text of a page or notebook with all blocks and cells rendered from the data."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        notebook = json.loads(text)
        for cell in notebook["cells"]:
            if cell["cell_type"] == "markdown":
                source = _rendered("".join(cell["source"]), page, root)
                cell["source"] = source.splitlines(keepends=True)
        return json.dumps(notebook, indent=1, ensure_ascii=False, sort_keys=True) + "\n"
    if page.suffix == ".py":

        def commented(match: re.Match[str]) -> str:
            source = re.sub(r"^# ?", "", match[2], flags=re.MULTILINE)
            lines = _rendered(source, page, root).splitlines()
            return match[1] + "".join(f"# {line}".rstrip() + "\n" for line in lines)

        return _TEXT_CELL.sub(commented, text)
    return _rendered(text, page, root)


def _rendered(text: str, page: Path, root: Path) -> str:
    """Return a text of a page with all blocks and cells rendered."""

    def block(match: re.Match[str]) -> str:
        start, kind, name, end = match.groups()
        data = load(name, root)
        if kind == "command":
            return start + commands(data) + end
        link = Path(os.path.relpath(path_of(name, root), page.parent)).as_posix()
        return start + table(data, root) + caption(name, data, link) + end

    def cited(match: re.Match[str]) -> str:
        start, words, end = match.groups()
        return start + cell(words, root) + end

    return _CELL.sub(cited, _BLOCK.sub(block, text))


def pages(root: Path = ROOT) -> list[Path]:
    """Return the Markdown pages of the repository."""
    paths = []
    for folder, folders, files in os.walk(root):
        skipped = _SKIPPED if Path(folder) == root else ()
        folders[:] = [name for name in folders if name[0] != "." and name not in skipped]
        paths += [Path(folder) / name for name in files if name.endswith(".md")]
    return sorted(paths)


def notebooks(root: Path = ROOT) -> list[Path]:
    """Return the notebooks and their texts, whose sentences have cells of tables."""
    paths = (root / "notebooks").glob("[0-9]*")
    return sorted(path for path in paths if path.suffix in (".py", ".ipynb"))


def prose(page: Path) -> str:
    """Return the sentences of a page or of a notebook's text, with # for cells, code and links."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".py":
        text = "\n".join(re.findall(r"^# (?!%%)(.*)$", text, re.MULTILINE))
    for pattern in _UNREAD:
        text = re.sub(pattern, "#", text, flags=re.DOTALL)
    return re.sub(r"\s+", " ", text)


def loose_numbers(text: str, exceptions: Sequence[str] = ()) -> list[str]:
    """Return the measured numbers of sentences that no cell renders, with the words before them.

    `exceptions` are words of the sentences, with their numbers.
    """
    allowed = [match.span() for match in _DEFINED.finditer(text)]
    for words in exceptions:
        allowed += [match.span() for match in re.finditer(re.escape(words), text)]
    loose = [
        match
        for match in _MEASURED.finditer(text)
        if not any(start <= match.start() and match.end() <= end for start, end in allowed)
    ]
    return [text[max(0, match.start() - 30) : match.end()] for match in loose]


def number_problems(root: Path = ROOT) -> list[str]:
    """Return sentences on pages with measured numbers that have neither a cell nor an exception."""
    declared, problems = json.loads(NUMBERS.read_text(encoding="utf-8")), []
    texts = [path for path in notebooks(root) if path.suffix == ".py"]
    for page in (*pages(root), *texts):
        name, text = page.relative_to(root).as_posix(), prose(page)
        if name in declared["unchecked"]:
            continue
        kinds = (declared[kind].get(name, ()) for kind in ("definitions", "without data"))
        exceptions = [words for kind in kinds for words in kind]
        if numbers := loose_numbers(text, exceptions):
            problems.append(
                f"{name} has measured numbers that no cell renders: {'; '.join(numbers)}. Write "
                f"them as cells, or list them with their words in {NUMBERS.relative_to(ROOT)}."
            )
        unused = [words for words in exceptions if words not in text]
        problems += [f"{NUMBERS.relative_to(ROOT)}: {name} lacks {words!r}." for words in unused]
    return problems


def main(arguments: list[str]) -> int:
    """Render all pages, or check that they match the data; return the exit code."""
    if arguments not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    stale = []
    try:
        for name in data_files():
            table(load(name))
        for page in (*pages(), *notebooks()):
            rendered = render(page)
            if rendered != page.read_text(encoding="utf-8"):
                stale.append(page)
                if not arguments:
                    page.write_text(rendered, encoding="utf-8")
    except ValueError as error:
        print(f"render_tables: error: {error}", file=sys.stderr)
        return 1
    problems = number_problems() if arguments else []
    print("".join(f"{problem}\n" for problem in problems), end="")
    for page in stale:
        state = "differs from its data: run without --check" if arguments else "was rendered"
        print(f"{page.relative_to(ROOT)} {state}.")
    return 1 if (stale or problems) and arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
