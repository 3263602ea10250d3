"""The notebooks run, and what is kept of them is what their texts say."""

import re
import runpy
from pathlib import Path

import jupytext
import nbformat
import pytest
from helpers import addresses, imported

FOLDER = Path(__file__).parents[1] / "notebooks"
RUNNER = runpy.run_path(str(FOLDER / "execute.py"))
TEXTS = {text.stem: text for text in RUNNER["TEXTS"]}
every_notebook = pytest.mark.parametrize("name", TEXTS)


def kept(name):
    return nbformat.read(TEXTS[name].with_suffix(".ipynb"), as_version=4)


def cells(notebook):
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def outputs(notebook):
    """Kind of output, type of its content, and the content; without what is encoded in it."""
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            content = output.get("data") or {"text/plain": output.get("text", "")}
            for kind, value in sorted(content.items()):
                yield output.output_type, kind, re.sub(r"base64,[\w+/=\s]+", "", value)


def told(notebook):
    """The tables and lines that a notebook prints."""
    return [
        value for _, kind, value in outputs(notebook) if kind in ("text/markdown", "text/plain")
    ]


def test_there_are_six_of_them():
    assert [name[:2] for name in TEXTS] == ["01", "02", "03", "04", "05", "06"]


@pytest.mark.parametrize("path", TEXTS.values(), ids=lambda path: path.stem)
def test_notebooks_import_what_the_table_of_public_names_has(path):
    assert "rps_jax" in imported(path)
    assert set(imported(path)) <= {"rps_jax", *dict(addresses())}


@every_notebook
def test_text_and_notebook_have_the_same_cells(name):
    assert cells(kept(name)) == cells(jupytext.read(TEXTS[name]))


@every_notebook
def test_what_is_kept_has_figures_and_no_error_and_names_no_machine(name):
    assert TEXTS[name].with_suffix(".ipynb").stat().st_size < 2_000_000
    found = list(outputs(kept(name)))
    assert any(kind == "image/png" for _, kind, _ in found)
    for output, kind, value in found:
        assert output in ("display_data", "execute_result", "stream")
        if not kind.startswith("image/"):
            assert not re.search(r"/(home|root|tmp|work|Users|usr|opt|var|mnt)/|[A-Z]:\\", value)
    assert not any("execution" in cell.metadata for cell in kept(name).cells)


# A push, a tuner and a fit for minutes: what they call, other tests call.
LONG = ("02", "05", "06")
ANEW = [pytest.param(n, marks=[pytest.mark.slow] if n[:2] in LONG else []) for n in TEXTS]


@pytest.mark.parametrize("name", ANEW)
def test_it_runs_and_where_it_only_reads_says_what_is_kept(name, pytestconfig, monkeypatch):
    """Executed anew, with the compiled programs of other tests."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(pytestconfig.rootpath / ".jax_cache"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    (again,) = RUNNER["execute"]([TEXTS[name]])
    before = kept(name)
    assert [kind for _, kind, _ in outputs(again)] == [kind for _, kind, _ in outputs(before)]
    if name[:2] in ("03", "04"):
        assert told(again) == told(before)
