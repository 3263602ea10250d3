"""Tests of the notebooks: they run, and the stored notebooks match their texts."""

import ast
import importlib.util
import os
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import jupytext
import nbformat
import pytest
from helpers import imported, inner_names, output_of, rps

from rps_jax.app import notebooks
from sweeps import render_tables

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


@all_notebooks
def test_notebooks_import_only_public_names(name):
    assert "rps_jax" in imported(TEXTS[name])
    assert inner_names(TEXTS[name]) == set()


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


def test_the_code_of_the_first_notebook_runs(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    names = {}
    for kind, source in cells(stored("01_the_law")):
        if kind == "code":
            exec(source, names)


@pytest.mark.slow
@all_notebooks
def test_it_runs(name, pytestconfig, monkeypatch, tmp_path):
    """It runs with the compiled programs of other tests, and a tutorial in `tmp_path`."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(pytestconfig.rootpath / ".jax_cache"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    folder = tmp_path if TEXTS[name] in RUNNER["TUTORIALS"] else FOLDER
    (notebook,) = RUNNER["execute"]([TEXTS[name]], folder)
    expected = stored(name)
    assert [kind for _, kind, _ in outputs(notebook)] == [kind for _, kind, _ in outputs(expected)]


@pytest.mark.parametrize("name", notebooks.NAMES)
def test_a_notebook_of_the_package_needs_the_package_alone(name):
    modules = set(re.findall(r"^(?:import|from) (\w+)", TEXTS[name].read_text(), re.MULTILINE))
    dependencies = {"IPython", "drawing", "jax", "matplotlib", "numpy", "pandas", "pathlib"}
    dependencies |= {"scipy", "tempfile", "typing", "xarray"}
    assert modules - dependencies - ({"gymnasium"} if name.startswith("09") else set()) == {
        "rps_jax"
    }


def test_notebooks_are_copied_without_outputs_and_overwrite_nothing(tmp_path, capsys):
    folder = tmp_path / "mine"
    assert rps("notebooks", folder) == 0
    assert capsys.readouterr().out.strip() == f"notebooks: {folder}"
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted([*(f"{name}.ipynb" for name in notebooks.NAMES), "drawing.py"])
    for name in notebooks.NAMES:
        copy = nbformat.read(folder / f"{name}.ipynb", as_version=4)
        nbformat.validate(copy)
        code, expected = (
            [c.source for c in x.cells if c.cell_type == "code"] for x in (copy, stored(name))
        )
        assert code == expected
        assert not any(cell.get("outputs") for cell in copy.cells)
        assert "](../" not in "".join(cell.source for cell in copy.cells)
    assert rps("notebooks", folder) == 2
    assert re.search(r"out = .* already has 01_the_law\.ipynb", capsys.readouterr().err)


def test_a_wheel_has_the_texts_of_the_notebooks():
    project = tomllib.loads((FOLDER.parent / "pyproject.toml").read_text())
    included = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    names = [*notebooks.NAMES, "drawing"]
    expected = {f"notebooks/{name}.py": f"rps_jax/notebooks/{name}.py" for name in names}
    assert included == {"mjcf": "rps_jax/mjcf"} | expected


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", ["01_the_law", "03_paper", "04_robustness"])
def test_a_notebook_runs_from_an_installed_package(name, tmp_path):
    """The package is a copy without the repository, in the layout of a wheel."""
    package = tmp_path / "site" / "rps_jax"
    shutil.copytree(FOLDER.parent / "rps_jax", package)
    shutil.copytree(FOLDER.parent / "mjcf", package / "mjcf")
    (package / "notebooks").mkdir()
    for stem in (*notebooks.NAMES, "drawing"):
        shutil.copy(FOLDER / f"{stem}.py", package / "notebooks")
    script = (
        "import nbformat, sys; from nbclient import NotebookClient; import rps_jax\n"
        "from rps_jax.app.notebooks import notebooks\n"
        f"notebooks({str(tmp_path / 'mine')!r})\n"
        f"book = nbformat.read({str(tmp_path / 'mine' / f'{name}.ipynb')!r}, 4)\n"
        f"options = dict(resources=dict(metadata=dict(path={str(tmp_path / 'mine')!r})))\n"
        "NotebookClient(book, timeout=600, kernel_name='python3', **options).execute()\n"
        "print(rps_jax.__file__)"
    )
    environment = os.environ | {"PYTHONPATH": str(package.parent)}
    words = [sys.executable, "-c", script]
    assert output_of(*words, cwd=tmp_path, env=environment).strip() == str(package / "__init__.py")


def test_the_first_page_lists_all_notebooks_and_examples():
    page = (FOLDER / "README.md").read_text()
    files = [f"{stem}.ipynb" for stem in TEXTS]
    files += [f"examples/{path.name}" for path in (FOLDER / "examples").glob("*.py")]
    assert [file for file in files if f"]({file})" not in page] == []


SCRIPTS = ("execute", *(f"examples/{path.stem}" for path in (FOLDER / "examples").glob("[ct]*.py")))


@pytest.mark.usefixtures("registries")
@pytest.mark.parametrize("script", SCRIPTS)
def test_help_runs_nothing(script, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [script, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(FOLDER / f"{script}.py"), run_name="__main__")
    assert not end.value.code
    assert "--help" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_the_sentences_on_random_worlds_are_computed():
    """Their text has no number of the results."""
    cells = stored("04_robustness").cells
    prose = "".join(cell.source for cell in cells[2:] if cell.cell_type == "markdown")
    constants = ("95 % intervals", "1 m", "0.05", "90 deg", "29 cm", "240,000 worlds", "02_one")
    for text in constants:  # of definitions, and of another study
        prose = prose.replace(text, "")
    assert not re.search(r"\d|\b(one|two|three|four|five|six|ten) (of|drawn|most|worlds)\b", prose)


def test_notebooks_show_the_cells_of_tables_that_they_cite():
    """Their texts cite no table by a copied number."""
    cited = []
    for name in TEXTS:
        for cell in stored(name).cells:
            if cell.cell_type == "code" and re.search(r"render_tables\.(cell|load)\(", cell.source):
                (output,) = cell.outputs
                names = {"render_tables": render_tables, "Markdown": str}
                *lines, last = ast.parse(cell.source).body
                exec(compile(ast.Module(lines, []), name, "exec"), names)
                expected = eval(compile(ast.Expression(last.value), name, "eval"), names)
                assert output.data["text/markdown"] == expected
                cited.append(name)
    assert cited == ["05_tuning"]


def test_training_by_stable_baselines3_as_the_tutorial_shows_it(tmp_path):
    if not importlib.util.find_spec("stable_baselines3"):
        pytest.skip("stable_baselines3 is not installed: run `pip install stable-baselines3`")
    text = TEXTS["09_gymnasium"].read_text()
    block = re.search(r"^# ```python\n(.*?)^# ```$", text, re.MULTILINE | re.DOTALL)
    code = re.sub(r"^# ?", "", block[1], flags=re.MULTILINE)
    short = code.replace("1_000_000", "16_384")
    assert short != code
    subprocess.run([sys.executable, "-c", short], cwd=tmp_path, check=True, env=dict(os.environ))
    assert (tmp_path / "policy_sb3.zip").exists()
