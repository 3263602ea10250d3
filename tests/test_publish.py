"""Published numbers are made anew by one command, which says what each takes and goes on."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from fnmatch import fnmatch

import numpy as np
import pytest
from helpers import ROOT, rps

from rps_jax import sweep
from rps_jax.app.cli import flags, names
from rps_jax.record import files
from rps_jax.runs.question import seed_of
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from sweeps.million import study as million
from sweeps.publish import study
from sweeps.publish.recipes import BY_HAND, RECIPES, Recipe

SWEEPS = ROOT / "sweeps"
PUSH = "rps sweep --domain wide,objects=random_cylinder --worlds 3 --engine quasistatic --horizon 1"
COMMANDS = [one for recipe in RECIPES.values() for one in recipe.commands if one[:4] == "rps "]


@pytest.mark.parametrize("path", study.published(), ids=lambda path: path.stem)
def test_a_data_file_is_made_by_one_recipe_or_says_why_by_none(path):
    ways = [name for name in RECIPES if fnmatch(path.stem, name)]
    assert len(ways) + (path.stem in BY_HAND) == 1


@pytest.mark.parametrize("command", sorted(set(COMMANDS)))
def test_the_command_of_a_recipe_can_be_asked(command):
    name, rest = names.split(shlex.split(command)[1:])
    assert flags.parse(names.question_of(name), name, rest)[0].name


def test_a_recipe_says_on_what_it_is_made():
    assert Recipe((), 5, None).device == "cpu"
    assert Recipe((), 5, 4).device == "cpu"  # no GPU for so little
    assert Recipe((), 90, 4).device == Recipe((), None, 30).device == "gpu"


@pytest.fixture
def few(tmp_path, monkeypatch):
    """Three recipes, of which the second fails, in a folder of data files of their own."""
    shutil.copytree(SWEEPS / "table" / "results", tmp_path / "study" / "results")
    recipes = {
        "first": Recipe((f"{PUSH} --laws rps --out runs/one",), 1, None, "Success", ("drums",),
                        ("", "all"), folder="study"),
        "broken": Recipe((f"{PUSH} --laws none",), 1, None, "Success"),
        "second": Recipe((f"{PUSH} --laws rps --out runs/one",), 1, None,
                         lambda found: [["worlds"], [str(found.sizes["world"])]], folder="study"),
    }  # fmt: skip
    monkeypatch.setattr(study, "RECIPES", recipes)
    monkeypatch.setattr(study, "_SWEEPS", tmp_path)
    return tmp_path


def test_what_fails_is_named_and_the_others_are_made(few, capsys):
    words = (SWEEPS / "publish", "--only", "*", "--needs", "cpu", "--machine", "a core")
    assert rps(*words, "--out", few / "run") == 2
    said = capsys.readouterr()
    assert "1 of the files could not be made: broken." in said.err
    assert "unknown law 'none'" in said.out
    first, second = (json.loads((few / f"study/results/{n}.json").read_text())
                     for n in ("first", "second"))  # fmt: skip
    assert [column["name"] for column in first["columns"]] == ["", "law", "all"]
    assert first["rows"][0][:2] == ["drums", "rps"]
    assert second["rows"] == [["3"]]
    assert first["command"] == second["command"] == [f"{PUSH} --laws rps"]
    assert first["device"] == "a core"
    assert len(first["digest"]) == 16
    assert [path.name for path in (few / "run" / "runs").iterdir()] == ["one"]  # run once


def test_only_what_needs_such_a_device_is_made(few, capsys):
    assert rps(SWEEPS / "publish", "--only", "first", "--needs", "gpu", "--out", few / "run") == 0
    assert "Published numbers" in capsys.readouterr().out
    assert not (few / "study" / "results" / "first.json").exists()


def test_a_million_outcomes_are_kept_small_and_read_as_the_page_says(tmp_path, monkeypatch, capsys):
    setting = Setting("quasistatic", rules=Rules(horizon=16.0), seed=37)
    near = "wide,objects=random_cylinder,distance=0.7:0.8,bearing=0:0.1"
    asked = million.Million(("rps", "nps"), near, 19, setting=setting, out=tmp_path / "run")
    found = asked()
    files.write_results(tmp_path / "million.nc", million.packed(found))
    seeded = replace(setting, seed=seed_of(37, "test"))
    usual = sweep(("rps", "nps"), near, 19, setting=seeded)
    bits = np.unpackbits(found.success.values, axis=1, count=19)
    np.testing.assert_array_equal(bits, usual.success)
    np.testing.assert_array_equal(found.how == 0, usual.success)
    assert 0 < bits.sum() < bits.size
    period = found.attrs["control_period"]
    np.testing.assert_allclose(found.steps * period, usual.time, atol=1e-4)
    touched = np.isfinite(usual.min_distance.values)
    np.testing.assert_array_equal(found.missed.values < million.UNTOUCHED, touched)
    off = 1000 * usual.min_distance.values
    np.testing.assert_allclose(found.missed.values[touched], off[touched], atol=0.51)
    page = (SWEEPS / "million" / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(code.replace("slice(100_000)", "slice(19)"), "page", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["rps", "nps"]
