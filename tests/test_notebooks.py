"""Tests of the notebooks: they run, and the stored notebooks match their texts."""

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
all_notebooks = pytest.mark.parametrize("name", TEXTS)


def stored(name):
    return nbformat.read(TEXTS[name].with_suffix(".ipynb"), as_version=4)


def cells(notebook):
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def outputs(notebook):
    """Yield type of output, media type and content of each output, without base64 data."""
    for cell in notebook.cells:
        for output in cell.get("outputs", ()):
            content = output.get("data") or {"text/plain": output.get("text", "")}
            for kind, value in sorted(content.items()):
                yield output.output_type, kind, re.sub(r"base64,[\w+/=\s]+", "", value)


def printed(notebook):
    """Return the tables and lines that a notebook prints."""
    shown = ("text/markdown", "text/plain")
    return [value for _, kind, value in outputs(notebook) if kind in shown]


@all_notebooks
def test_notebooks_import_only_public_names(name):
    assert "rps_jax" in imported(TEXTS[name])
    assert set(imported(TEXTS[name])) <= {"rps_jax", *dict(addresses())}


@all_notebooks
def test_text_and_notebook_have_the_same_cells(name):
    assert cells(stored(name)) == cells(jupytext.read(TEXTS[name]))


@all_notebooks
def test_stored_notebooks_have_figures_and_no_errors_or_local_paths(name):
    assert TEXTS[name].with_suffix(".ipynb").stat().st_size < 2_000_000
    results = list(outputs(stored(name)))
    assert any(kind == "image/png" for _, kind, _ in results)
    for output, kind, value in results:
        assert output in ("display_data", "execute_result", "stream")
        if not kind.startswith("image/"):
            assert not re.search(r"/(home|root|tmp|work|Users|usr|opt|var|mnt)/|[A-Z]:\\", value)
    assert not any("execution" in cell.metadata for cell in stored(name).cells)


# These run for minutes; other tests call the same functions.
LONG = ("02", "05", "06")
EXECUTED = [pytest.param(n, marks=[pytest.mark.slow] if n[:2] in LONG else []) for n in TEXTS]


@pytest.mark.parametrize("name", EXECUTED)
def test_it_runs_and_if_it_only_reads_prints_the_stored_output(name, pytestconfig, monkeypatch):
    """The notebook is executed with the compiled programs of other tests."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(pytestconfig.rootpath / ".jax_cache"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    (notebook,) = RUNNER["execute"]([TEXTS[name]])
    expected = stored(name)
    assert [kind for _, kind, _ in outputs(notebook)] == [kind for _, kind, _ in outputs(expected)]
    if name[:2] in ("03", "04"):
        assert printed(notebook) == printed(expected)
