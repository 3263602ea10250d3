"""Hooks of mkdocs, which build the site from pages, notebooks and docstrings.

Nothing is copied by hand. A page keeps its path in the repository, so that its links remain valid.
A link to a module leads to the reference, and a link to another file leads to that file.
"""

from __future__ import annotations

import ast
import base64
import importlib
import inspect
import os
import posixpath
import re
import runpy
import subprocess
import tomllib
from collections.abc import Mapping
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import nbformat
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

import rps_jax

ROOT = Path(__file__).parents[1]
_PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
_LAYERS = _PROJECT["tool"]["importlinter"]["contracts"][0]["layers"]
# Pages of the reference, from the lowest layer to the highest.
PAGES = [
    module.removeprefix("rps_jax.") for layer in reversed(_LAYERS) for module in layer.split(" | ")
]
# Sections of a page that are separate pages: title of the section, by path.
SECTIONS = {"rps_jax/law.md": "The law", "rps_jax/adding.md": "How to add"}
# Pages by tab; studies that no tab names are in `Studies`.
TABS: dict[str, list[Any]] = {
    "Start": [
        "README.md",
        "docs/start.md",
        {"Push it yourself": "push.html"},
        "docs/gallery.md",
        "docs/not_supported.md",
        "CHANGELOG.md",
    ],
    "Tutorials": [
        "notebooks/README.md",
        "notebooks/07_custom_law.md",
        "notebooks/08_analysis.md",
        "notebooks/09_gymnasium.md",
        "notebooks/11_rooms.md",
    ],
    "The law": ["rps_jax/law.md", "notebooks/01_the_law.md", "notebooks/02_one_push.md"],
    "The paper": [
        "notebooks/03_paper.md",
        "table",
        "hardware",
        "paper_reading",
        "ambiguities",
    ],
    "Random worlds": ["notebooks/04_robustness.md", "random_worlds", "models"],
    "Tuning": [
        "notebooks/05_tuning.md",
        "notebooks/10_gradients.md",
        "tuned",
        "gradients",
    ],
    "Laws": ["ladder", "rps_plus", "learned", "force_push_grid", "failures"],
    "Robots": [
        "docs/my_robot.md",
        "docs/on_a_robot.md",
        "robots",
        "drives",
        "pose",
        "limits",
        "export",
        "notebooks/examples/ros2/rps_push/README.md",
    ],
    "Physics": [
        "docs/my_object.md",
        "mjcf/README.md",
        "ground",
        "real_pushes",
        "notebooks/06_fitting.md",
        "fit",
        "engines",
        "fidelity",
        "docs/environments.md",
        "docs/mjx_gradients.md",
    ],
    "Studies": ["sweeps/README.md"],
    "Make it yours": ["rps_jax/README.md", "rps_jax/adding.md", "CONTRIBUTING.md"],
}
# Documentation of types of other packages.
_XARRAY = "https://docs.xarray.dev/en/stable/generated/{}.html"
_MUJOCO = "https://mujoco.readthedocs.io/en/stable/APIreference/APItypes.html#"
TYPE_URLS = {
    "jax.Array": "https://docs.jax.dev/en/latest/_autosummary/jax.Array.html",
    "numpy.ndarray": "https://numpy.org/doc/stable/reference/generated/numpy.ndarray.html",
    "pathlib.Path": "https://docs.python.org/3/library/pathlib.html#pathlib.Path",
    **{f"xarray.{x}": _XARRAY.format(f"xarray.{x}") for x in ("Dataset", "DataArray", "DataTree")},
    **{f"mujoco.{x}": _MUJOCO + x.lower() for x in ("MjModel", "MjData", "MjSpec")},
}
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
# Source code, signatures and lists of members, whose sentences are at the members.
_UNSEARCHED = re.compile(
    r'<details(?= class="mkdocstrings-source")|<div(?= class="doc-signature)'
    r'|(?<=doc-section-title">)(?:Methods|Functions|Classes|Modules):</span></p>\s*<table'
)
# Space between a number and its unit, in cells of tables.
_UNBROKEN = re.compile(r"(?<=\d) (?=(?:%|[smhN]|[mµun]s|[cm]m|kg|min|[kMG]B|m/s|rad/s)(?![\w/]))")
FENCE = re.compile(r"^( *)(```|~~~).*?^\1\2`*~* *$", re.MULTILINE | re.DOTALL)


# --- paths ---------------------------------------------------------------------------------


@cache
def texts() -> dict[str, str]:
    """Return the pages of the repository by their path in the site."""
    paths = [
        *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
        *(ROOT / name for name in ("rps_jax/README.md", "mjcf/README.md")),
        *ROOT.glob("sweeps/**/README.md"),
        *ROOT.glob("notebooks/**/README.md"),
        *ROOT.glob("docs/*.md"),
    ]
    pages = {str(path.relative_to(ROOT)): path.read_text("utf-8") for path in paths}
    for path, title in SECTIONS.items():
        whole = pages[f"{posixpath.dirname(path)}/README.md"]
        part = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", whole, re.M | re.S)
        assert part, f"{path}: no section {title}"
        raised = re.sub(r"^#(#+ )", r"\1", part[1], flags=re.M)
        pages[path] = f"# {title}\n{raised}"
    return pages


def nav() -> list[Any]:
    """Return the tabs with their pages; a new study is found by its page."""
    studies = {path.parent.name for path in ROOT.glob("sweeps/*/README.md")}
    named = {name for tab in TABS.values() for name in tab if isinstance(name, str)}
    tabs = {
        title: [
            f"sweeps/{name}/README.md" if str(name) in studies else name
            for name in pages
            if isinstance(name, dict) or "." in name or name in studies
        ]
        for title, pages in TABS.items()
    }
    tabs["Studies"] += [f"sweeps/{name}/README.md" for name in sorted(studies - named)]
    tabs["Reference"] = ["reference/README.md", *(f"reference/{room}.md" for room in PAGES)]
    return [{title: pages} for title, pages in tabs.items()]


def site_link(link: str, page: str, files: Any) -> str:
    """Return a link of a page, relative to that page of the site."""
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    source = ROOT / path
    if path in ("docs/push", "docs/push/README.md", "docs/push/page.html"):
        path = "push.html"
    elif path.startswith("rps_jax/") and (source.is_dir() or source.suffix == ".py"):
        parts = path.removesuffix(".py").removesuffix("/__init__").split("/")
        if len(parts) > 1 and parts[1] in PAGES:
            path = f"reference/{parts[1]}.md"
            path += f"#{'.'.join(parts)}" if len(parts) > 2 else ""
        else:
            path = "reference/README.md"
    elif source.is_dir():
        path += "/README.md"
    elif source.suffix in (".ipynb", ".py") and f"notebooks/{source.stem}.md" in files.src_uris:
        path = f"notebooks/{source.stem}.md"
    elif source.suffix == ".py":
        path += ".md"
    return posixpath.relpath(path, posixpath.dirname(page) or ".")


def file_links(text: str) -> list[str]:
    """Return the links of a page to files of the repository."""
    links = LINK.findall(FENCE.sub("", text))
    return [link for _, link, _, _ in links if not re.match(r"[a-z]+:", link)]


# --- generated pages -----------------------------------------------------------------------


def notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its images by name."""
    blocks, images = [], {}
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            blocks.append(cell.source)
            continue
        blocks.append(f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "text/markdown" in data:
                blocks.append(data["text/markdown"])
            elif "image/png" in data:
                name = f"{path.stem}_{len(images)}.png"
                images[name] = base64.b64decode(data["image/png"])
                blocks.append(f"![A figure of this notebook]({name})")
            else:
                blocks.append(f"```text\n{data['text/plain'].rstrip()}\n```")
    return "\n\n".join(blocks), images


def code(path: Path) -> str:
    """Return a Python file as a page."""
    head = "---\nsearch:\n  exclude: true\n---\n"
    return f"{head}# {path.name}\n\n```python\n{path.read_text('utf-8')}\n```\n"


def about(path: Path) -> str:
    """Return the summary of a Python file, or an empty text."""
    return (
        summary(ast.get_docstring(ast.parse(path.read_text("utf-8"))))
        if path.suffix == ".py"
        else ""
    )


def summary(docstring: str | None) -> str:
    """Return the first paragraph of a docstring on one line, as a sentence without a colon."""
    text = " ".join((docstring or "").partition("\n\n")[0].split())
    return re.sub(r":?$", "", text).replace("|", "\\|")


def listing(path: Path) -> str:
    """Return a page that lists the files of a folder without one."""
    folders = [
        f"[{inner.name}]({inner.name})"
        for inner in path.iterdir()
        if (inner / "README.md").exists()
    ]
    suffixes = (".py", ".json", ".ipynb")
    files = sorted(inner for inner in path.iterdir() if inner.suffix in suffixes)
    links = [*(f"[{x.name}]({x.name}) {about(x)}".strip() for x in files), *folders]
    return f"# {path.relative_to(ROOT)}\n\n" + "".join(f"- {link}\n" for link in links)


def gathered(module: str) -> dict[str, str]:
    """Return the modules that define the names of the top level, or of a module of public names."""
    path = ROOT / "rps_jax" / module
    path = path / "__init__.pyi" if path.is_dir() else path.with_suffix(".py")
    text = path.read_text("utf-8")
    homes = {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as", text, re.M)}
    renamed = re.findall(r"^(\w+) = (\w+)\.\w+$", text, re.M)
    return homes | {name: f"rps_jax.{home}" for name, home in renamed}


def name_table(module: str, homes: Mapping[str, str]) -> str:
    """Return a table of public names, each with a link to its definition and a sentence."""
    rows = ["| name | description |", "|---|---|"]
    for name, home in sorted(homes.items()):
        value = getattr(importlib.import_module(module), name)
        source = inspect.unwrap(value) if callable(value) else value  # the class of a command
        described = inspect.isclass(source) or inspect.isfunction(source)
        page, anchor = home.split(".")[1], f"#{home}" if home.count(".") > 1 else ""
        if described:
            page = source.__module__.split(".")[1]
            anchor = f"#{source.__module__}.{source.__qualname__}"
        text = summary(inspect.getdoc(value)) if described else f"Defined in `{home}`."
        rows += [f"| [`{module}.{name}`]({page}.md{anchor}) | {text} |"]
    return "\n".join(rows)


def module_table() -> str:
    """Return a table of all modules of the package, each with the summary of its docstring."""
    rows = ["| module | description |", "|---|---|"]
    for page in PAGES:
        folder = ROOT / "rps_jax" / page
        for path in (
            sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]
        ):
            parts = path.relative_to(ROOT).with_suffix("").parts
            name = ".".join(part for part in parts if part != "__init__")
            anchor = f"#{name}" if name.count(".") > 1 else ""
            rows += [f"| [`{name}`]({page}.md{anchor}) | {about(path)} |"]
    return "\n".join(rows)


def reference() -> dict[str, str]:
    """Return an index with one sentence for each name, and a page for each module of PAGES."""
    index = f"""# Reference

This index and its pages are generated from docstrings and signatures. The [table of public
names](../rps_jax/README.md#public-names) groups the names by purpose.

## Public names

{name_table("rps_jax", gathered(""))}

## Modules

Names that the tables of public names do not list may move between versions.

{module_table()}
"""
    pages = {"README.md": index}
    for page in PAGES:
        module = f"rps_jax.{page}"
        path = ROOT / "rps_jax" / f"{page}.py"
        text = f"::: {module}"
        if path.exists() and (names := gathered(page)):
            text = f"{about(path)}\n\n{name_table(module, names)}"
        pages[f"{page}.md"] = f"# {module}\n\n{text}\n"
    return pages


# --- hooks of mkdocs -----------------------------------------------------------------------


def repository() -> str | None:
    """Return the web address of the repository: of pyproject, GitHub's runner or git's `origin`."""
    if url := _PROJECT["project"].get("urls", {}).get("Repository"):
        return url
    if name := os.environ.get("GITHUB_REPOSITORY"):
        return f"{os.environ.get('GITHUB_SERVER_URL', 'https://github.com')}/{name}"
    command = ["git", "-C", str(ROOT), "remote", "get-url", "origin"]
    try:
        origin = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    except FileNotFoundError:  # no git: a source distribution
        return None
    return web_address(origin.strip())


def web_address(origin: str) -> str | None:
    """Return the web address of a git remote, or None for a folder."""
    remote = re.fullmatch(
        r"(?:https?://|ssh://|git://)?(?:[^/@]+@)?([\w.-]+\.\w+)(?::\d+)?[:/](.+?)(?:\.git)?/?",
        origin,
    )
    return f"https://{remote[1]}/{remote[2]}" if remote and not origin.startswith("/") else None


def on_config(config: Any) -> Any:
    """Set the tabs, the version and the link to the repository."""
    config.nav = nav()
    config.site_name = f"rps_jax {rps_jax.__version__}"
    config.copyright = f"rps_jax {rps_jax.__version__}, Apache-2.0"
    config.repo_url, config.repo_name = config.repo_url or repository(), "Repository"
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages outside `docs`."""

    def add(uri: str, content: str | bytes) -> None:
        if uri not in files.src_uris:
            files.append(File.generated(config, uri, content=content))

    for uri, text in texts().items():
        add(uri, text)
    for name, text in reference().items():
        add(f"reference/{name}", text)
    for path in sorted((ROOT / "notebooks").glob("[0-9]*.ipynb")):
        text, images = notebook(path)
        add(f"notebooks/{path.stem}.md", text)
        for name, content in images.items():
            add(f"notebooks/{name}", content)
    add("push.html", runpy.run_path(str(ROOT / "docs" / "push" / "make.py"))["page"]("index.html"))
    pages = [
        page for page in files.documentation_pages() if not page.src_uri.startswith("reference/")
    ]
    for page in pages:  # the loop appends listings
        for link in file_links(page.content_string):
            folder = posixpath.dirname(page.src_uri)
            path = ROOT / posixpath.normpath(posixpath.join(folder, link))
            target = site_link(link, page.src_uri, files).partition("#")[0]
            uri = posixpath.normpath(posixpath.join(folder, target))
            if path.is_file():
                add(uri, code(path) if uri.endswith(".py.md") else path.read_bytes())
            elif path.is_dir() and not uri.startswith("reference/") and uri not in files.src_uris:
                add(uri, listing(path))
                pages.append(files.get_file_from_path(uri))
    return files


UNSEARCHED = (
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "sweeps/publish/README.md",
    *(f"reference/{x}.md" for x in ("app", "geometry", "lowering")),
)


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Point the links to pages of the site; leave history and inner matters out of the search."""
    if page.file.src_uri in UNSEARCHED:
        page.meta["search"] = {"exclude": True}
    fences: list[str] = []

    def store(match: re.Match[str]) -> str:
        fences.append(match[0])
        return f"\0{len(fences) - 1}\0"

    def relink(match: re.Match[str]) -> str:
        start, link, anchor, end = match.groups()
        if re.match(r"[a-z]+:", link):
            return match[0]
        return start + site_link(link, page.file.src_uri, files) + (anchor or "") + end

    text = LINK.sub(relink, FENCE.sub(store, markdown))
    return re.sub("\0(\\d+)\0", lambda match: fences[int(match[1])], text)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    r"""Write equations, \(...\) and \[...\], as MathML; leave source code out of the search.

    Numbers of tables stay with their units, and heads break at an underscore.
    """

    def math(match: re.Match[str]) -> str:
        text = match[2].replace("\\*", "*")  # GitHub needs the backslash
        return convert(unescape(text), display="block" if match[1] == "div" else "inline")

    def type_link(match: re.Match[str]) -> str:
        url = TYPE_URLS.get(match[1])
        return f'<a href="{url}" title="{match[1]}">{match[2]}</a>' if url else match[0]

    html = re.sub(r'<span title="([\w.]+)">(\w+)</span>', type_link, html)
    html = re.sub(_UNSEARCHED, lambda match: f"{match[0]} data-search-exclude", html)
    if re.match(r"sweeps/\w+/README", page.file.src_uri):
        html = html.replace("<table>", "<table data-search-exclude>")  # of numbers
    html = re.sub(r"<td>.*?</td>", lambda match: _UNBROKEN.sub("\u00a0", match[0]), html)
    html = re.sub(r"<th>\w+</th>", lambda match: match[0].replace("_", "_<wbr>"), html)
    marked = r'<(div|span) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>'
    return re.sub(marked, math, html, flags=re.DOTALL)


def on_post_build(config: Any) -> None:
    """Raise an error for dead links, loads from other hosts, and examples that are not code."""
    if sentences := faults(Path(config.site_dir)):
        raise PluginError("\n".join(sentences))


LOADS = re.compile(r"<(?:script|img|iframe|source|video|link)\b[^>]*?\b(?:src|href)=\"?([^\s\">]+)")
LEADS = re.compile(r"\b(?:src|href)=\"?([^\s\">]+)")


def faults(site: Path) -> list[str]:
    """Return sentences about loads from other hosts, dead links and broken examples of a site."""
    sentences = []
    for path in sorted(site.rglob("*.html")):
        text, page = path.read_text("utf-8"), path.relative_to(site)
        text = re.sub(r"<(script|pre)\b([^>]*)>.*?</\1>", r"<\1\2>", text, flags=re.DOTALL)
        if re.search(r"(<blockquote>\s*){3}", text):  # the prompt `>>>` as three quotes
            sentences.append(f"{page} has an example that is not code: head it `Examples:`")
        loads = [url for url in LOADS.findall(text) if re.match(r"(https?:)?//", url)]
        sentences += [f"{page} loads {url} from another host" for url in loads]
        for link in LEADS.findall(text):
            file = unquote(re.split(r"[?#]", link)[0])
            if file and not re.match(r"[a-z]+:|/", link) and not (path.parent / file).exists():
                sentences.append(f"{page} has a dead link to {link}")
    remote = re.compile(r"(?:url\(|@import )[\"']?((?:https?:)?//[^)\"']*)")
    for path in sorted(site.rglob("*.css")):
        if loads := remote.findall(path.read_text("utf-8")):
            sentences.append(f"{path.relative_to(site)} loads {loads[0]} from another host")
    return sentences
