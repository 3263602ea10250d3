"""The site: tabs of all pages, links, equations, and reports of errors."""

import functools
import http.server
import os
import pkgutil
import re
import runpy
import sys
import threading
import tomllib
from types import SimpleNamespace

import chromium
import pytest
from helpers import ROOT, addresses, docstrings, output_of

import rps_jax

pytest.importorskip("mkdocs", reason="the extra docs is not installed")
pytest.importorskip("latex2mathml", reason="the extra docs is not installed")
griffe = pytest.importorskip("griffe", reason="the extra docs is not installed")

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
    rows = re.findall(
        r"^\| \[`rps_jax\.(\w+)`\]\((\w+\.md)#rps_jax\.[\w.]+\) \| (.+) \|$",
        pages["README.md"].partition("## Modules")[0],
        re.MULTILINE,
    )
    assert {name for name, _, _ in rows} == set(rps_jax.__all__)
    for name, page, sentence in rows:
        assert page in pages
        assert re.fullmatch(r"[A-Z].{15,}\.", sentence), name


def test_the_index_has_one_line_for_each_module():
    index = HOOKS["reference"]()["README.md"].partition("## Modules")[2]
    rows = dict(re.findall(r"^\| \[`([\w.]+)`\]\(.*?\) \| ([A-Z`].*[.?]) \|$", index, re.MULTILINE))
    walked = pkgutil.walk_packages(rps_jax.__path__, "rps_jax.")
    modules = {x.name for x in walked if not x.name.endswith("__main__")}
    assert set(rows) == modules
    assert len(re.findall(r"^\| \[", index, re.MULTILINE)) == len(modules)


@pytest.mark.parametrize("name", ["questions", "laws", "worlds", "physics"])
def test_a_module_of_public_names_has_a_page(name):
    listed = {entry for module, entry in addresses() if module == f"rps_jax.{name}"}
    page = HOOKS["reference"]()[f"{name}.md"]
    assert set(re.findall(rf"^\| \[`rps_jax\.{name}\.(\w+)`\]", page, re.MULTILINE)) == listed


def test_each_way_to_add_something_has_a_heading():
    page = HOOKS["texts"]()["rps_jax/adding.md"]
    headings = re.findall(r"^## (.*)$", page, re.MULTILINE)
    assert {"A law", "An object", "An engine", "A learning loop"} <= set(headings)
    assert "**..." not in page


@pytest.mark.parametrize(
    ("origin", "address"),
    [
        ("git@github.com:lab/rps_jax.git", "https://github.com/lab/rps_jax"),
        (
            "https://user:secret@gitlab.example.org/a/b/rps_jax.git/",
            "https://gitlab.example.org/a/b/rps_jax",
        ),
        ("ssh://git@host.example:2222/lab/rps_jax", "https://host.example/lab/rps_jax"),
        ("/srv/git/rps_jax.git", None),
        ("../rps_jax", None),
        ("file:///srv/rps_jax", None),
        ("", None),
    ],
)
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


def page_of(path):
    return SimpleNamespace(file=SimpleNamespace(src_uri=path))


def test_the_search_leaves_out_code_lists_of_members_and_tables_of_numbers():
    source, signature = '<details class="mkdocstrings-source">', '<div class="doc-signature x">'
    members = '<span class="doc-section-title">Functions:</span></p>\n <table>'
    parameters = members.replace("Functions", "Parameters")
    html = "".join((source, signature, members, parameters))
    output = HOOKS["on_page_content"](html, page_of("reference/a.md"), None, None)
    assert output.count(" data-search-exclude") == 3
    assert parameters in output
    for path, count in (("sweeps/table/README.md", 1), ("sweeps/README.md", 0)):
        output = HOOKS["on_page_content"]("<table><tr>", page_of(path), None, None)
        assert output.count(" data-search-exclude") == count


def test_numbers_of_tables_stay_with_their_units_and_heads_break():
    cells = "<th>random_box</th><td>a 1 % [2, -3.5]</td><td>20 s of 1 GB, 3 of 4</td>"
    output = HOOKS["on_page_content"](f"{cells}<p>1 %</p>", page_of("a.md"), None, None)
    cells = "<th>random_<wbr>box</th><td>a 1_% [2, -3.5]</td><td>20_s of 1_GB, 3 of 4</td>"
    assert output == re.sub(r"(?<=\d)_", "\u00a0", cells) + "<p>1 %</p>"


def test_an_equation_becomes_mathml():
    html = r'<p><span class="arithmatex">\(v^\* &lt; 1\)</span></p>'
    output = HOOKS["on_page_content"](html, page_of("a.md"), None, None)
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


def test_an_example_that_is_not_code_is_an_error(tmp_path):
    page = tmp_path / "a.html"
    page.write_text("<blockquote>\n<blockquote>\n<blockquote>\n<p>import rps_jax</p>")
    [sentence] = HOOKS["faults"](tmp_path)
    assert sentence == "a.html has an example that is not code: head it `Examples:`"
    page.write_text("<pre><code>&gt;&gt;&gt; import rps_jax</code></pre><blockquote>A</blockquote>")
    assert HOOKS["faults"](tmp_path) == []


def test_every_example_of_a_docstring_is_a_section_of_code():
    """As mkdocstrings parses it; other headings make quotes of its prompts."""
    examples = [text for text in docstrings() if ">>>" in text]
    assert len(examples) > 30
    for text in examples:
        sections = griffe.Docstring(text).parse("google", warnings=False)
        prose = [str(x.value) for x in sections if x.kind.value != "examples"]
        assert ">>>" not in "".join(prose), text


def test_the_extra_of_the_site_has_the_formatter_of_its_signatures():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert any(x.startswith("ruff") for x in project["optional-dependencies"]["docs"])


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Folder and address of the built site."""
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    words = (sys.executable, "-m", "mkdocs", "build", "--strict", "-d", folder)
    output_of(*words, cwd=ROOT, env=environment)
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.mark.slow
def test_the_search_index_is_small(site):
    assert (site[0] / "search" / "search_index.json").stat().st_size < 1_000_000


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_are_readable_without_other_hosts_at_two_widths(site, scheme, tmp_path):
    """No error or request elsewhere; images and links have names; wide screens fit tables."""
    pages = sorted(path.relative_to(site[0]).as_posix() for path in site[0].rglob("*.html"))
    assert {"push.html", "docs/gallery.html", "reference/control.html"} < set(pages)
    script = (ROOT / "tests" / "page_faults.js").read_text()
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    with chromium.opened(tmp_path, "--headless=new") as browser:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        for width in (390, 1280):
            metrics = {"width": width, "height": 844, "deviceScaleFactor": 1, "mobile": width < 800}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
            for page in pages:
                browser.get(site[1] + page)
                faults = browser.execute_script(script)
                assert faults.pop("dark") == (scheme == "dark"), page
                assert faults.pop("scroll") <= 0, (page, width)
                assert not any(faults.values()), (page, width, faults)
                errors = [x["message"] for x in browser.get_log("browser")]
                assert errors == [], (page, width)


def test_a_declared_number_has_its_meaning_unit_and_limits_on_its_page():
    extensions = griffe.load_extensions(str(ROOT / "docs" / "specs.py"))
    where = {"extensions": extensions, "search_paths": [str(ROOT)]}
    pursuit = griffe.load("rps_jax.control.laws.pursuit", **where)
    gain = pursuit["PursuitParams.K_v"]
    assert gain.docstring.value == "Speed over distance [1/s]; above 0."
    assert str(gain.annotation) == "Parameter"
