"""Reports of runs: sections of prose, tables and figures, as Markdown and as one HTML file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rps_jax.analysis import tables
from rps_jax.record import files

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px; }
th, td { border: 1px solid #ccc; padding: .2em .6em; text-align: left; }
th { background: #f2f2f2; }
img { max-width: 100%; display: block; margin: 1em 0; }
code { background: #f5f5f5; }
"""


class Picture(NamedTuple):
    """Figure of a report, drawn on demand."""

    name: str  # file name of the PNG without its suffix
    draw: Callable[[], Figure]

    def png(self) -> bytes:
        """Return the PNG file; equal figures have equal files."""
        file = io.BytesIO()
        self.draw().savefig(file, dpi=150, metadata={"Software": None})
        return file.getvalue()

    _repr_png_ = png  # for Jupyter


class Section(NamedTuple):
    """Section of a report."""

    title: str
    text: str = ""  # Markdown
    table: Sequence[Sequence[str]] = ()  # header and rows
    picture: Picture | None = None

    def _repr_markdown_(self) -> str:
        """Return heading, text and table as Markdown, also for Jupyter."""
        table = tables.markdown(self.table) if self.table else ""
        return "\n\n".join(filter(None, (f"## {self.title}", self.text, table)))


def write_report(folder: Path, title: str, intro: str, sections: Sequence[Section]) -> Path:
    """Write `report.md` and the self-contained `report.html`; return the path of the first."""
    import markdown  # imported late: it takes as long as all other imports of this module

    texts, pictures = [f"# {title}", intro], {}
    for section in sections:
        texts.append(section._repr_markdown_())
        if section.picture:
            name = f"{section.picture.name}.png"
            pictures[name] = section.picture.png()
            files.write_bytes(folder / name, pictures[name])
            texts.append(f"![{section.title}]({name})")
    text = "\n\n".join(text for text in texts if text) + "\n"
    files.write_text(folder / "report.md", text)
    body = markdown.markdown(text, extensions=["tables"])
    for name, content in pictures.items():
        data = base64.b64encode(content).decode()
        body = body.replace(f'src="{name}"', f'src="data:image/png;base64,{data}"')
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style>{body}</html>\n"
    )
    files.write_text(folder / "report.html", page)
    return folder / "report.md"


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as a PNG file atomically."""
    return files.write_bytes(path, Picture(path.stem, lambda: figure).png())
