"""The site: tabs of all pages, links, equations, and reports of errors."""

import re
import runpy

import pytest
from helpers import ROOT

pytest.importorskip("mkdocs", reason="the extra docs is not installed")
pytest.importorskip("latex2mathml", reason="the extra docs is not installed")
HOOKS = runpy.run_path(str(ROOT / "docs" / "hooks.py"))


class Files:
    src_uris = ("notebooks/03_paper.md",)


def test_every_study_and_notebook_is_in_one_tab():
    pages = [page for tab in HOOKS["nav"]() for entries in tab.values() for page in entries]
    texts = [page for page in pages if isinstance(page, str)]
    assert len(texts) == len(set(texts))
    studies = {f"sweeps/{path.parent.name}/README.md" for path in ROOT.glob("sweeps/*/README.md")}
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("[0-9]*.ipynb")}
    assert studies | notebooks <= set(texts)
    known = {*HOOKS["texts"](), *notebooks, *(f"reference/{name}" for name in HOOKS["reference"]())}
    assert set(texts) <= known


LINKS = [
    ("sweeps/table/README.md", "README.md", "sweeps/table/README.md"),
    ("engines/mjx.py", "rps_jax/README.md", "../reference/engines.md#rps_jax.engines.mjx"),
    ("push/page.html", "docs/gallery.md", "../push.html"),
    ("rps_jax/record", "README.md", "reference/record.md"),
    ("notebooks/03_paper.ipynb", "README.md", "notebooks/03_paper.md"),
    ("../notebooks/03_paper.py", "rps_jax/README.md", "../notebooks/03_paper.md"),
    ("../study_base.py", "sweeps/table/README.md", "../study_base.py.md"),
    ("results/table.json", "sweeps/table/README.md", "results/table.json"),
]


@pytest.mark.parametrize(("link", "page", "expected"), LINKS)
def test_a_link_of_the_repository_works_in_the_site(link, page, expected):
    assert HOOKS["site_link"](link, page, Files) == expected


def test_a_notebook_keeps_its_words_code_tables_and_pictures():
    text, pictures = HOOKS["notebook"](ROOT / "notebooks" / "04_robustness.ipynb")
    assert text.startswith("# ")
    assert "```python\n" in text
    assert re.search(r"^\| *paper *\|", text, re.MULTILINE)
    assert len(pictures) == 2
    for name, content in pictures.items():
        assert content.startswith(b"\x89PNG")
        assert f"]({name})" in text


def test_an_equation_becomes_mathml():
    html = r'<p><span class="arithmatex">\(v^\* &lt; 1\)</span></p>'
    output = HOOKS["on_page_content"](html, None, None, None)
    assert "<math" in output
    assert "<mo>&#x0002A;</mo>" in output
    assert "\\" not in output


def test_dead_links_and_loads_from_other_hosts_are_reported(tmp_path):
    (tmp_path / "a").mkdir()
    good = '<a href="https://example.org">x</a> <a href="../b.html#c">b</a> <img src="c.png">'
    (tmp_path / "a" / "good.html").write_text(good)
    (tmp_path / "a" / "c.png").write_bytes(b"")
    (tmp_path / "b.html").write_text("<p>b</p>")
    assert HOOKS["faults"](tmp_path) == []
    bad = '<a href="gone.html">x</a> <script src="https://example.org/x.js"></script>'
    (tmp_path / "b.html").write_text(bad)
    (tmp_path / "x.css").write_text("a { background: url(//example.org/y.png) }")
    assert HOOKS["faults"](tmp_path) == [
        "b.html loads https://example.org/x.js from another host",
        "b.html has a dead link to gone.html",
        "x.css loads //example.org/y.png from another host",
    ]
