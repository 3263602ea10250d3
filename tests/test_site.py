"""The site: tabs of all pages, links, equations, and reports of errors."""

import re
import runpy
import tomllib
from types import SimpleNamespace

import pytest
from helpers import ROOT

import rps_jax

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
    ("push/README.md", "docs/gallery.md", "../push.html"),
    ("docs/push", "README.md", "push.html"),
    ("errors.py", "rps_jax/README.md", "../reference/errors.md"),
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


def test_the_index_has_a_link_and_a_sentence_for_each_public_name():
    pages = HOOKS["reference"]()
    rows = re.findall(r"^\| \[`rps_jax\.(\w+)`\]\((\w+\.md)#rps_jax\.[\w.]+\) \| (.+) \|$",
                      pages["README.md"].partition("## Modules")[0], re.MULTILINE)  # fmt: skip
    assert {name for name, _, _ in rows} == set(rps_jax.__all__)
    for name, page, sentence in rows:
        assert page in pages
        assert re.fullmatch(r"[A-Z].{15,}\.", sentence), name


def test_each_way_to_add_something_has_a_heading():
    page = HOOKS["texts"]()["rps_jax/adding.md"]
    headings = re.findall(r"^## (.*)$", page, re.MULTILINE)
    assert {"A law", "An object", "An engine", "A learning loop"} <= set(headings)
    assert "**..." not in page


@pytest.mark.parametrize(("origin", "address"), [
    ("git@github.com:lab/rps_jax.git", "https://github.com/lab/rps_jax"),
    ("https://user:secret@gitlab.example.org/a/b/rps_jax.git/", "https://gitlab.example.org/a/b/rps_jax"),
    ("ssh://git@host.example:2222/lab/rps_jax", "https://host.example/lab/rps_jax"),
    ("/srv/git/rps_jax.git", None), ("../rps_jax", None), ("file:///srv/rps_jax", None), ("", None),
])  # fmt: skip
def test_the_site_links_the_web_address_of_a_remote(origin, address):
    assert HOOKS["web_address"](origin) == address


def test_the_site_names_version_and_repository(monkeypatch):
    monkeypatch.setenv("GITHUB_REPOSITORY", "lab/rps_jax")
    monkeypatch.setenv("GITHUB_SERVER_URL", "https://git.example.org")
    urls = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]
    assert all(url.startswith("https://") for url in urls.values())
    config = HOOKS["on_config"](SimpleNamespace(repo_url=None))
    assert config.repo_url == urls.get("Repository", "https://git.example.org/lab/rps_jax")
    assert rps_jax.__version__ in config.site_name
    link = (ROOT / "docs" / "theme" / "partials" / "source.html").read_text()
    assert "data-md-component" not in link  # which would load data of the repository
    assert "navigation.footer" in (ROOT / "mkdocs.yml").read_text()  # previous and next


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
