"""A run's report: Markdown beside its pictures, and one HTML file that holds everything."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import markdown

from rps_jax.analysis import tables
from rps_jax.record import files

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px; }
th, td { border: 1px solid #ccc; padding: .2em .6em; text-align: left; }
th { background: #f2f2f2; }
img { max-width: 100%; display: block; margin: 1em 0; }
code { background: #f5f5f5; }
"""


class Section(NamedTuple):
    """One heading of a report."""

    title: str
    text: str = ""  # Markdown
    table: Sequence[Sequence[str]] = ()  # header and rows
    picture: Path | None = None


def write_report(folder: Path, title: str, intro: str, sections: Sequence[Section]) -> Path:
    """`report.md` and `report.html` in the folder; the latter needs no other file."""
    texts = [f"# {title}", intro]
    for section in sections:
        texts.append(f"## {section.title}")
        if section.text:
            texts.append(section.text)
        if section.table:
            texts.append(tables.markdown(section.table))
        if section.picture:
            texts.append(f"![{section.title}]({section.picture.relative_to(folder)})")
    text = "\n\n".join(texts) + "\n"
    files.write_text(folder / "report.md", text)
    body = markdown.markdown(text, extensions=["tables"])
    for section in sections:
        if section.picture:
            data = base64.b64encode(section.picture.read_bytes()).decode()
            source = f'src="{section.picture.relative_to(folder)}"'
            body = body.replace(source, f'src="data:image/png;base64,{data}"')
    page = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style>{body}</html>\n"
    )
    return files.write_text(folder / "report.html", page)
