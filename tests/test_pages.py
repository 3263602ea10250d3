"""Tests of the pages: tables match their data, links work, and the front page is short."""

import json
import re
import runpy

import pytest
from helpers import ROOT

TABLES = runpy.run_path(str(ROOT / "sweeps" / "render_tables.py"))
PAGES = TABLES["pages"]()
TEXTS = sorted((ROOT / "notebooks").glob("[0-9]*.py"))


def relative(path):
    return str(path.relative_to(ROOT))


def anchors(page):
    """Return the link anchors of the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings
    }


@pytest.mark.parametrize("page", [*PAGES, *TABLES["notebooks"]()], ids=relative)
def test_tables_match_their_data(page):
    assert TABLES["render"](page) == page.read_text()


def test_every_table_is_on_a_page():
    shown = set(re.findall(r"<!-- table: (\S+) -->", "".join(p.read_text() for p in PAGES)))
    assert shown == set(TABLES["data_files"]())


@pytest.fixture
def rendered(tmp_path):
    """Function that renders a page beside data files with columns and rows."""

    def render(text, **tables):
        for name, data in tables.items():
            folder = tmp_path / name / "results"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{name}.json").write_text(json.dumps(data))
        (tmp_path / "page.md").write_text(text)
        return TABLES["render"](tmp_path / "page.md", tmp_path)

    return render


def table(columns, rows):
    return dict.fromkeys(TABLES["KEYS"], "") | {"columns": columns, "rows": rows}


def test_a_table_follows_its_data_and_those_it_cites(rendered, tmp_path):
    columns = [
        {"name": "what", "merge": True},
        {"name": "rate", "format": "{:.1f} %", "rest": " [{}]"},
    ]
    citation = {"from": "one", "row": ["a", 1.0], "column": "rate"}
    derived = {"columns": columns, "rows": [["b", citation]]}  # without a command

    def page(rows):
        one = table(columns, rows) | {"device": "a core"}
        text = "<!-- table: one -->\n<!-- end -->\n<!-- table: two -->\n<!-- end -->\n"
        return rendered(text, one=one, two=derived)

    text = page([["a", 1.0], ["a", [2.26, 3]]])
    for part in (
        "| a | 1.0 % |\n|  | 2.3 % [3] |\n",
        "| b | 1.0 % |",
        "Device: a core",
        "[from which table](two/results/two.json)",
        "(one/results/one.json)",
    ):
        assert part in text
    with pytest.raises(ValueError, match=r"does not name one cell of one\.json"):
        page([["a", 1.5]])
    with pytest.raises(ValueError, match="does not have a cell for each column"):
        page([["a"]])
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "one.json").write_text("{}")
    with pytest.raises(ValueError, match=r"one\.json and .*one\.json have the same name"):
        page([["a", 1.0]])


def test_a_number_in_a_sentence_follows_its_data(rendered):
    columns = [{"name": "domain", "merge": True}]
    columns += [{"name": x} for x in ("law", "rate", "time", "90 %", "way", "90 %")]
    rest = ("9 s", "11 s", "2 m [1, 3]", "4 m")
    rows = [["wide", "rps", "93.1 % [92.6, 93.6]", *rest], ["wide", "nps", "16.7 %", *rest]]

    def sentence(*numbers, cells=("rps | rate", "nps | rate", "nps | 90 %", "nps | way / 90 %")):
        filled = [
            f"<!-- cell: one | wide | {at} -->{x}<!-- end -->"
            for at, x in zip(cells, numbers, strict=True)
        ]
        return f"It wins {', and '.join(filled)}."

    text = rendered(sentence("9 %", "", "", ""), one=table(columns, rows))
    assert text == sentence("93.1 %", "16.7 %", "11 s", "4 m")
    with pytest.raises(ValueError, match="does not name one cell"):
        rendered(sentence("", cells=["none | rate"]))
    text = "".join(page.read_text() for page in PAGES)
    assert "<!-- cell: headline" in text
    assert not re.search(r"^\s*<!-- cell", text, re.MULTILINE)  # it would start a paragraph


def test_no_page_has_a_measured_number_without_a_cell_or_an_exception():
    assert TABLES["number_problems"]() == []


@pytest.mark.parametrize(
    "number",
    [
        "99.34 %",
        "0.7 to 1.1 mm",
        "12 s",
        "26 µs",
        "1.7x",
        "1.7 x",
        "4.6 times",
        "30-fold",
        "93 of 100",
        "140 out of 144",
        "3 minutes",
        "[92.6, 93.6]",
        "p = 0.003",
        "p < 1e-9",
        "+12 -3",
        "3e-13",
        "a factor of 3.1",
        "1,525 kB",
        "2 hours",
        "93 percent",
        "1 %, 2 % and 3 %",
    ],
)
def test_a_measured_number_in_a_sentence_needs_a_cell(number, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"# Result\n\nThe law reaches\n{number} here.\n")
    assert TABLES["loose_numbers"](TABLES["prose"](page))
    assert not TABLES["loose_numbers"](TABLES["prose"](page), [number, "1 %", "2 % and 3 %"])
    for shown in (
        f"<!-- cell: a | b -->{number}<!-- end -->",
        f"`{number}`",
        f"```\n{number}\n```",
        f"[page](x_{number.replace(' ', '_')}.md)",
        f"<!-- table: x -->\n| {number} |\n<!-- end -->",
    ):
        page.write_text(f"It is\n{shown}\n here.\n")
        assert not TABLES["loose_numbers"](TABLES["prose"](page))


@pytest.mark.parametrize(
    "text",
    [
        "in 2024",
        "Eq. 5, Fig. 6, Table 2 and Sec. 3",
        "MuJoCo 3.17, Python 3.11 to 3.14, ROS 2 and C99",
        "Wilson 95 % intervals",
        "90 % intervals",
        "5 and 95 % quantiles",
        "steps of 10 ms",
        "at 50 Hz",
        "the 432 trials of three laws",
        "1. Choose the law",
        "a mass of 3 to 60 kg, 0.5 m ahead",
    ],
)
def test_a_definition_needs_no_cell(text, tmp_path):
    (tmp_path / "page.md").write_text(f"It is {text}.\n")
    assert not TABLES["loose_numbers"](TABLES["prose"](tmp_path / "page.md"))


def test_an_exception_must_be_on_its_page(tmp_path, monkeypatch):
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "page.md").write_text("It takes 3 s.\n")
    (tmp_path / "notebooks" / "1_a.py").write_text("# %% [markdown]\n# Half of\n# it: 50 %.\n")
    declared = {"unchecked": [], "definitions": {"page.md": ["takes 3 s"]}, "without data": {}}
    globals_of = TABLES["number_problems"].__globals__

    def problems(**changes):
        path = tmp_path / "numbers.json"
        path.write_text(json.dumps(declared | changes))
        monkeypatch.setitem(globals_of, "NUMBERS", path)
        monkeypatch.setitem(globals_of, "ROOT", tmp_path)
        return TABLES["number_problems"](tmp_path)

    (notebook,) = problems()
    assert "notebooks/1_a.py has measured numbers" in notebook
    assert "Half of it: 50 %" in notebook
    half = {"notebooks/1_a.py": ["it: 50 %"]}
    assert problems(**{"without data": half}) == []
    assert problems(unchecked=["notebooks/1_a.py"]) == []
    (missing,) = problems(**{"without data": half | {"page.md": ["in 4 s"]}})
    assert "page.md lacks 'in 4 s'" in missing


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_have_targets(page):
    for link in re.findall(r"\]\(((?!https://)[^)\s]+)\)", page.read_text()):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", [*PAGES, *TEXTS], ids=relative)
def test_no_sentence_names_a_commit(page):
    assert not re.search(r"\b(?=\d*[a-f])(?=[a-f]*\d)[0-9a-f]{7,40}\b", page.read_text())


def test_the_front_page_is_short():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 130
    (rows,) = re.findall(r"<!-- table: front_page -->\n(.*?)\n\n", "\n".join(lines), re.DOTALL)
    assert len(rows.splitlines()) <= 2 + 15
    for question in ("What is it", "Does it work", "How fast", "On my robot", "How do I change it"):
        assert any(line.startswith(f"- **{question}?**") for line in lines[:40])
