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

_DPI = 300  # of a PNG file, for a paper; the page shows it at half of this
_STYLE = Path(__file__).with_suffix(".css").read_text("utf-8")


class Picture(NamedTuple):
    """Figure of a report, drawn on demand."""

    name: str  # file name of the PNG without its suffix
    draw: Callable[[], Figure]

    def png(self) -> bytes:
        """Return the PNG file; equal figures have equal files."""
        file = io.BytesIO()
        self.draw().savefig(file, dpi=_DPI, metadata={"Software": None})
        return file.getvalue()

    _repr_png_ = png  # for Jupyter


class Section(NamedTuple):
    """Section of a report."""

    title: str
    text: str = ""  # Markdown
    table: Sequence[Sequence[str]] = ()  # header and rows; without rows the report says "None."
    picture: Picture | None = None
    film: Path | None = None  # MP4 in the folder of the report

    def _repr_markdown_(self) -> str:
        """Return heading, text and table as Markdown, also for Jupyter."""
        table = tables.markdown(self.table) if len(self.table) > 1 else "None." * len(self.table)
        return "\n\n".join(filter(None, (f"## {self.title}", self.text, table)))


def write_report(folder: Path, title: str, intro: str, sections: Sequence[Section]) -> Path:
    """Write `report.md` and the self-contained `report.html`; return the path of the first."""
    import markdown  # imported late: it takes as long as all other imports of this module

    texts, media = [f"# {title}", intro], {}
    for section in sections:
        texts.append(section._repr_markdown_())
        if section.film:
            name = section.film.name
            media[name] = "video/mp4", section.film.read_bytes()
            texts.append(f'<video src="{name}" controls loop muted playsinline></video>')
            texts.append(f"Film: [{name}]({name})")
        if section.picture:
            name, content = f"{section.picture.name}.png", section.picture.png()
            media[name] = "image/png", content
            files.write_bytes(folder / name, content)
            texts.append(f"![{section.title}]({name})")
    text = "\n\n".join(text for text in texts if text) + "\n"
    files.write_text(folder / "report.md", text)
    body = markdown.markdown(text, extensions=["tables"])
    for name, (kind, content) in media.items():
        data = base64.b64encode(content).decode()
        width = f'width="{int.from_bytes(content[16:20]) // 2}" ' if kind == "image/png" else ""
        body = body.replace(f'src="{name}"', f'{width}src="data:{kind};base64,{data}"')
    page = (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style><body>{body}</html>\n"
    )
    files.write_text(folder / "report.html", page)
    return folder / "report.md"


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as a PNG file atomically."""
    return files.write_bytes(path, Picture(path.stem, lambda: figure).png())
