"""What mkdocs builds the site of: pages, notebooks and docstrings where they stand.

Nothing is copied by hand. A page keeps its place in the repository, so that its links hold; one to
a module leads to the reference, and one to another file of the repository to that file.
"""

from __future__ import annotations

import base64
import posixpath
import re
import runpy
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import nbformat
from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]
ROOMS = (
    *("record", "geometry", "robot", "control", "world", "engines"),
    *("analysis", "trials", "runs", "tuning", "studies", "app"),
)
# Parts of a page as pages of their own: title of the part, by place.
PARTS = {"rps_jax/law.md": "The law", "rps_jax/adding.md": "How to add ..."}
# Pages by the tab they stand in; studies that no tab names stand in `Studies`.
TABS: dict[str, list[Any]] = {
    "Start": ["README.md", {"Push it yourself": "push.html"}, "docs/gallery.md", "CHANGELOG.md"],
    "The law": ["rps_jax/law.md", "notebooks/01_the_law.md", "notebooks/02_one_push.md"],
    "The paper": [
        *("notebooks/03_paper.md", "table", "hardware", "ambiguities"),
    ],
    "Random worlds": ["notebooks/04_robustness.md", "random_worlds", "models"],
    "Tuning": [
        *("notebooks/05_tuning.md", "tuned", "landscape", "gradients"),
    ],
    "Laws": ["ladder", "rps_plus", "mends", "learned", "force_push_grid", "failures"],
    "Robots": [
        *("docs/on_a_robot.md", "robots", "limits", "export"),
        "notebooks/examples/ros2/rps_push/README.md",
    ],
    "Physics": [
        *("mjcf/README.md", "ground", "real_pushes", "notebooks/06_fitting.md", "fit"),
        *("engines", "fidelity"),
    ],
    "Studies": ["sweeps/README.md"],
    "Make it yours": ["rps_jax/README.md", "rps_jax/adding.md", "CONTRIBUTING.md"],
}
# Where types of other packages are explained.
_XARRAY = "https://docs.xarray.dev/en/stable/generated/{}.html"
_MUJOCO = "https://mujoco.readthedocs.io/en/stable/APIreference/APItypes.html#"
ELSEWHERE = {
    "jax.Array": "https://docs.jax.dev/en/latest/_autosummary/jax.Array.html",
    "numpy.ndarray": "https://numpy.org/doc/stable/reference/generated/numpy.ndarray.html",
    "pathlib.Path": "https://docs.python.org/3/library/pathlib.html#pathlib.Path",
    **{f"xarray.{x}": _XARRAY.format(f"xarray.{x}") for x in ("Dataset", "DataArray", "DataTree")},
    **{f"mujoco.{x}": _MUJOCO + x.lower() for x in ("MjModel", "MjData", "MjSpec")},
}
LINK = re.compile(r"(\]\()([^)\s#]+)(#[^)\s]*)?(\))")
FENCE = re.compile(r"^( *)(```|~~~).*?^\1\2`*~* *$", re.MULTILINE | re.DOTALL)


# --- where everything is -------------------------------------------------------------------


@cache
def texts() -> dict[str, str]:
    """Pages of the repository by the place that they have in the site."""
    paths = [
        *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
        *(ROOT / name for name in ("rps_jax/README.md", "mjcf/README.md")),
        *ROOT.glob("sweeps/**/README.md"),
        *ROOT.glob("notebooks/**/README.md"),
        *ROOT.glob("docs/*.md"),
    ]
    found = {str(path.relative_to(ROOT)): path.read_text("utf-8") for path in paths}
    for place, title in PARTS.items():
        whole = found[f"{posixpath.dirname(place)}/README.md"]
        part = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", whole, re.M | re.S)
        assert part, f"{place}: no part {title}"
        raised = re.sub(r"^#(#+ )", r"\1", part[1], flags=re.M)
        found[place] = f"# {title.removesuffix(' ...')} {'anything' * ('...' in title)}\n{raised}"
    return found


def nav() -> list[Any]:
    """The tabs, each with its pages; a study that is new is found by its page."""
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
    tabs["Reference"] = ["reference/README.md", *(f"reference/{room}.md" for room in ROOMS)]
    return [{title: pages} for title, pages in tabs.items()]


def led(link: str, page: str, files: Any) -> str:
    """Where a link of a page leads in the site, as seen from there."""
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    place = ROOT / path
    if path == "docs/push/page.html":
        path = "push.html"
    elif path.startswith("rps_jax/") and (place.is_dir() or place.suffix == ".py"):
        parts = path.removesuffix(".py").removesuffix("/__init__").split("/")
        if len(parts) > 1 and parts[1] in ROOMS:
            path = f"reference/{parts[1]}.md"
            path += f"#{'.'.join(parts)}" if len(parts) > 2 else ""
        else:
            path = "reference/README.md"
    elif place.is_dir():
        path += "/README.md"
    elif place.suffix in (".ipynb", ".py") and f"notebooks/{place.stem}.md" in files.src_uris:
        path = f"notebooks/{place.stem}.md"
    elif place.suffix == ".py":
        path += ".md"
    return posixpath.relpath(path, posixpath.dirname(page) or ".")


def linked(text: str) -> list[str]:
    """Links of a page to files of the repository."""
    found = LINK.findall(FENCE.sub("", text))
    return [link for _, link, _, _ in found if not re.match(r"[a-z]+:", link)]


# --- what is made --------------------------------------------------------------------------


def notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and its pictures by name."""
    found, pictures = [], {}
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            found.append(cell.source)
            continue
        found.append(f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "text/markdown" in data:
                found.append(data["text/markdown"])
            elif "image/png" in data:
                name = f"{path.stem}_{len(pictures)}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                found.append(f"![A figure of this notebook]({name})")
            else:
                found.append(f"```text\n{data['text/plain'].rstrip()}\n```")
    return "\n\n".join(found), pictures


def code(path: Path) -> str:
    """A file of Python as a page."""
    head = "---\nsearch:\n  exclude: true\n---\n"
    return f"{head}# {path.name}\n\n```python\n{path.read_text('utf-8')}\n```\n"


def listing(path: Path) -> str:
    """What is in a folder that has no page."""
    folders = [
        f"[{one.name}]({one.name})" for one in path.iterdir() if (one / "README.md").exists()
    ]
    names = sorted({one.name for one in path.iterdir() if one.suffix in (".py", ".json", ".ipynb")})
    links = [*(f"[{name}]({name})" for name in names), *folders]
    return f"# {path.relative_to(ROOT)}\n\n" + "".join(f"- {link}\n" for link in links)


def reference() -> dict[str, str]:
    """Pages made from docstrings and signatures, one a room."""
    rows = [f"- [`rps_jax.{room}`]({room}.md)" for room in ROOMS]
    names = "[table of all public names](../rps_jax/README.md#public-names)"
    head = "Made from docstrings and signatures. A user needs what stands in the"
    first = f"# Reference\n\n{head} {names}; all else, by room:\n\n" + "\n".join(rows)
    pages = {f"{room}.md": f"# rps_jax.{room}\n\n::: rps_jax.{room}\n" for room in ROOMS}
    return {"README.md": first} | pages


# --- hooks of mkdocs -----------------------------------------------------------------------


def on_config(config: Any) -> Any:
    """Hand in the tabs."""
    config.nav = nav()
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add what does not stand in docs."""

    def add(place: str, content: str | bytes) -> None:
        if place not in files.src_uris:
            files.append(File.generated(config, place, content=content))

    for place, text in texts().items():
        add(place, text)
    for place, text in reference().items():
        add(f"reference/{place}", text)
    for path in sorted((ROOT / "notebooks").glob("[0-9]*.ipynb")):
        text, pictures = notebook(path)
        add(f"notebooks/{path.stem}.md", text)
        for name, content in pictures.items():
            add(f"notebooks/{name}", content)
    add("push.html", runpy.run_path(str(ROOT / "docs" / "push" / "make.py"))["page"]())
    pages = [one for one in files.documentation_pages() if not one.src_uri.startswith("reference/")]
    for page in pages:  # to which listings are added
        for link in linked(page.content_string):
            path = ROOT / posixpath.normpath(posixpath.join(posixpath.dirname(page.src_uri), link))
            place = posixpath.join(
                posixpath.dirname(page.src_uri), led(link, page.src_uri, files).partition("#")[0]
            )
            place = posixpath.normpath(place)
            if path.is_file():
                add(place, code(path) if place.endswith(".py.md") else path.read_bytes())
            elif (
                path.is_dir() and not place.startswith("reference/") and place not in files.src_uris
            ):
                add(place, listing(path))
                pages.append(files.get_file_from_path(place))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Lead the links to where things are in the site."""
    fences: list[str] = []

    def kept(found: re.Match[str]) -> str:
        fences.append(found[0])
        return f"\0{len(fences) - 1}\0"

    def turned(found: re.Match[str]) -> str:
        start, link, anchor, end = found.groups()
        if re.match(r"[a-z]+:", link):
            return found[0]
        return start + led(link, page.file.src_uri, files) + (anchor or "") + end

    text = LINK.sub(turned, FENCE.sub(kept, markdown))
    return re.sub("\0(\\d+)\0", lambda found: fences[int(found[1])], text)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    r"""Write equations as MathML, which needs no script: \(...\) in lines and \[...\] between."""

    def math(found: re.Match[str]) -> str:
        text = found[2].replace("\\*", "*")  # as GitHub wants a star in an equation
        return convert(unescape(text), display="block" if found[1] == "div" else "inline")

    def type_of(found: re.Match[str]) -> str:
        there = ELSEWHERE.get(found[1])
        return f'<a href="{there}" title="{found[1]}">{found[2]}</a>' if there else found[0]

    html = re.sub(r'<span title="([\w.]+)">(\w+)</span>', type_of, html)
    marked = r'<(div|span) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>'
    return re.sub(marked, math, html, flags=re.DOTALL)


def on_post_build(config: Any) -> None:
    """Refuse a site with a dead link, or one that asks another host for anything."""
    if wrong := faults(Path(config.site_dir)):
        raise PluginError("\n".join(wrong))


LOADS = re.compile(r"<(?:script|img|iframe|source|video|link)\b[^>]*?\b(?:src|href)=\"?([^\s\">]+)")
LEADS = re.compile(r"\b(?:src|href)=\"?([^\s\">]+)")


def faults(site: Path) -> list[str]:
    """Sentences about loads from other hosts and dead links in the pages of a site."""
    found = []
    for path in sorted(site.rglob("*.html")):
        text, page = path.read_text("utf-8"), path.relative_to(site)
        text = re.sub(r"<(script|pre)\b([^>]*)>.*?</\1>", r"<\1\2>", text, flags=re.DOTALL)
        loads = [one for one in LOADS.findall(text) if re.match(r"(https?:)?//", one)]
        found += [f"{page} loads {one} from another host" for one in loads]
        for one in LEADS.findall(text):
            there = unquote(re.split(r"[?#]", one)[0])
            if there and not re.match(r"[a-z]+:|/", one) and not (path.parent / there).exists():
                found.append(f"{page} leads to {one}, which is not there")
    for path in sorted(site.rglob("*.css")):
        if there := re.findall(
            r"(?:url\(|@import )[\"']?((?:https?:)?//[^)\"']*)", path.read_text("utf-8")
        ):
            found.append(f"{path.relative_to(site)} loads {there[0]} from another host")
    return found
