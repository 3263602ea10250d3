"""Tests of the pages: tables match their data, links work, and the front page is short."""

import json
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
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


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_tables_match_their_data(page):
    assert TABLES["render"](page) == page.read_text()


def test_every_table_is_on_a_page():
    shown = set(re.findall(r"<!-- table: (\S+) -->", "".join(p.read_text() for p in PAGES)))
    assert shown == set(TABLES["data_files"]())


def test_a_table_follows_its_data_and_those_it_cites(tmp_path):
    columns = [
        {"name": "what", "merge": True},
        {"name": "rate", "format": "{:.1f} %", "rest": " [{}]"},
    ]
    table = dict.fromkeys(TABLES["KEYS"], "") | {"device": "a core", "columns": columns}
    citation = {"from": "one", "row": ["a", 1.0], "column": "rate"}
    derived = {"columns": columns, "rows": [["b", citation]]}  # without a command
    page = tmp_path / "page.md"
    page.write_text("<!-- table: one -->\n<!-- end -->\n<!-- table: two -->\n<!-- end -->\n")

    def rendered(rows):
        for name, data in (("one", table | {"rows": rows}), ("two", derived)):
            folder = tmp_path / name / "results"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{name}.json").write_text(json.dumps(data))
        return TABLES["render"](page, tmp_path)

    text = rendered([["a", 1.0], ["a", [2.26, 3]]])
    assert "| a | 1.0 % |\n|  | 2.3 % [3] |\n" in text
    assert "| b | 1.0 % |" in text
    assert "[from which table](two/results/two.json)" in text
    assert "Device: a core" in text
    assert "(one/results/one.json)" in text
    with pytest.raises(ValueError, match=r"does not name one cell of one\.json"):
        rendered([["a", 1.5]])
    with pytest.raises(ValueError, match="does not have a cell for each column"):
        rendered([["a"]])
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "one.json").write_text("{}")
    with pytest.raises(ValueError, match=r"one\.json and .*one\.json have the same name"):
        rendered([["a", 1.0]])


def test_a_number_in_a_sentence_follows_its_data(tmp_path):
    columns = [{"name": "domain", "merge": True}, {"name": "law"}, {"name": "rate"}]
    rows = [["wide", "rps", "93.1 % [92.6, 93.6]"], ["wide", "nps", "16.7 %"]]
    data = dict.fromkeys(TABLES["KEYS"], "") | {"columns": columns, "rows": rows}
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "one.json").write_text(json.dumps(data))
    page = tmp_path / "page.md"
    cell = "<!-- cell: one | wide | {} | rate -->{}<!-- end -->"
    page.write_text(f"It wins {cell.format('rps', '9 %')},\nand NPS {cell.format('nps', '')}.")
    rendered = TABLES["render"](page, tmp_path)
    assert (
        rendered
        == f"It wins {cell.format('rps', '93.1 %')},\nand NPS {cell.format('nps', '16.7 %')}."
    )
    columns += [{"name": name} for name in ("time", "90 %", "way", "90 %")]
    rows[:] = [[*row, "9 s", "11 s", "2 m [1, 3]", "4 m"] for row in rows]
    (tmp_path / "results" / "one.json").write_text(json.dumps(data))
    twice = "<!-- cell: one | wide | nps | {} -->{}<!-- end -->"
    page.write_text(f"{twice.format('90 %', '')} and {twice.format('way / 90 %', '')}")
    rendered = TABLES["render"](page, tmp_path)
    assert rendered == f"{twice.format('90 %', '11 s')} and {twice.format('way / 90 %', '4 m')}"
    text = "".join(page.read_text() for page in PAGES)
    assert "<!-- cell: headline" in text
    assert not re.search(r"^\s*<!-- cell", text, re.MULTILINE)  # it would start a paragraph
    page.write_text(cell.format("none", ""))
    with pytest.raises(ValueError, match="does not name one cell"):
        TABLES["render"](page, tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_links_have_targets(page):
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    for link in links:
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", [*PAGES, *TEXTS], ids=relative)
def test_no_sentence_names_a_commit(page):
    assert not re.search(r"\b(?=\d*[a-f])(?=[a-f]*\d)[0-9a-f]{7,40}\b", page.read_text())


def test_the_front_page_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150
