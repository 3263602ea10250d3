"""Published numbers are made anew by one command, which says what each takes and goes on."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from fnmatch import fnmatch

import numpy as np
import pytest
import xarray as xr
from helpers import ROOT, rps

from rps_jax import sweep
from rps_jax.app.cli import flags, names
from rps_jax.record import files
from rps_jax.runs.question import seed_of
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world.domain import DOMAINS, Range
from sweeps import study_base
from sweeps.publish import dependencies, rows, study
from sweeps.publish.recipes import HISTORY, RECIPES, Recipe
from sweeps.random_worlds import million

SWEEPS = ROOT / "sweeps"
PUSH = "rps sweep --domain wide,objects=random_cylinder --worlds 3 --engine quasistatic --horizon 1"
COMMANDS = [one for recipe in RECIPES.values() for one in recipe.commands if one[:4] == "rps "]


@pytest.mark.parametrize("path", study.published(), ids=lambda path: path.stem)
def test_a_data_file_is_made_by_one_recipe_or_cites_others_or_is_history(path):
    ways = [name for name in RECIPES if fnmatch(path.stem, name)]
    cites = "command" not in json.loads(path.read_text())
    assert len(ways) + cites + (path.stem in HISTORY) == 1


@pytest.mark.parametrize("command", sorted(set(COMMANDS)))
def test_the_command_of_a_recipe_can_be_asked(command):
    name, rest = names.split(shlex.split(command)[1:])
    assert flags.parse(names.question_type(name), name, rest)[0].name


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


def test_a_run_that_another_command_reads_keeps_its_name_and_is_hung_upon(tmp_path):
    tuned = "rps tune es --worlds 16 --law pursuit --out runs/tuned"
    ladder = "rps ladder --worlds 9 --laws pursuit pursuit,runs/tuned/tuned.json --out runs/other"
    commands = [shlex.split(one) for one in (tuned, ladder)]
    signed = {
        "packages": dict.fromkeys(study_base._PACKAGES, "1"),
        "commit": "",
        "time": "2026-01-01",
    }
    made = [signed | {"command": words} for words in commands]
    path = study_base.write_table(
        tmp_path / "results" / "one.json", made, "a core", study_base.Table([["x"]])
    )
    data = json.loads(path.read_text())
    assert data["command"] == [tuned, ladder.removesuffix(" --out runs/other")]
    assert data["digest"] == study_base.digest([shlex.split(one) for one in data["command"]])
    other = tuned.replace("16", "17"), ladder
    assert data["digest"] != study_base.digest([shlex.split(one) for one in other])


def test_a_law_is_beside_itself_as_it_was_tuned():
    laws = ["rps", "rps,tuned", "pursuit", "pursuit,tuned"]
    won = np.repeat([[1, 0], [1, 1], [0, 1], [0, 1]], [8, 8], axis=1)
    found = xr.Dataset({"success": (("law", "world"), won)}, {"law": laws})
    head, *body = rows.default_beside_tuned(found)
    assert head[0] == "law"
    assert [row[0] for row in body] == ["rps", "pursuit"]
    assert body[0][1].startswith("50.0 %")
    assert body[0][2].startswith("100.0 %")
    assert [row[3] for row in body] == ["+8 -0", "+0 -0"]
    assert rows.default_beside_tuned({"a": "tuner's"}) == []


def test_a_comparison_names_laws_by_the_runs_that_tuned_them():
    near = DOMAINS["wide"]
    domain = replace(near, objects=("random_cylinder", "random_box"), distance=Range(0.7, 0.8))
    setting = Setting("quasistatic", rules=Rules(horizon=20.0))
    laws = {"rps": "rps", "rps,a/runs/gradient/tuned.json": "rps_tuned"}
    found = xr.DataTree.from_dict({"near": sweep(laws, domain, 12, setting=setting)})
    head, first, second = rows.comparison(found)
    assert (first[0], first[1], second[1]) == ("`near`, 12", "rps", "gradient")
    by_object = first[head.index("by object [%]")].split(", ")
    assert len(by_object) == 2
    assert first[-2:] == ["", ""]
    assert re.fullmatch(r"\+\d+ -\d+", second[-2])
    lost = 12 - sum(map(int, first[5].split(", ")))
    assert first[2].startswith(f"{100 * lost / 12:.1f} %")


def test_worlds_of_robots_are_told_by_force_lag_and_acceleration():
    rng = np.random.default_rng(3)
    many = {
        "robot_force": (150, 800),
        "robot_traction": (0.3, 0.8),
        "robot_lag": (0, 0.5),
        "robot_acceleration": (0.1, 1),
        "friction_ground": (0.1, 0.7),
        "mass": (3, 60),
    }
    drawn = {name: ("world", rng.uniform(*ends, 4000)) for name, ends in many.items()}
    found = xr.Dataset(drawn, {"law": ["rps"]})
    force = np.minimum(found.robot_force, found.robot_traction * 130 * 9.81)
    margin = force / (found.friction_ground * found.mass * 9.81)
    found["success"] = ("law", "world"), (margin.values[None] >= 1).astype(np.int8)
    _, *body = rows.by_robot(found)
    count = {what: int(of.replace(",", "")) for what, of, _ in body}
    told = {what: rate.split(" [")[0] for what, _, rate in body}
    assert told["0.8 to 1"] == "0.0 %"
    assert told["1 to 1.25"] == "100.0 %"
    margins = [what for what in count if "enough" not in what]
    assert sum(count[what] for what in margins) == int((margin >= 0.5).sum())
    for what in ("lag", "acceleration"):
        parts = [n for name, n in count.items() if name.startswith(what)]
        assert len(parts) == 5
        assert sum(parts) == int((margin >= 1.5).sum())


def test_speeds_stand_by_engine_and_batch_beside_c():
    measured = [("C in closed loop", 64, "box", 100.0), ("C in closed loop", 64, "prism", 50.0),
                ("fused", 4096, "box", 200_000.0), ("fused", 8, "box", 50.0),
                ("fused", 8, "prism", 25.0)]  # fmt: skip
    fields = zip(("name", "worlds", "family", "rate"), zip(*measured, strict=True), strict=True)
    found = xr.Dataset({name: ("measurement", list(values)) for name, values in fields})
    assert rows.speeds(found) == [
        ["engine", "worlds", "box", "prism", "against C in closed loop"],
        ["C in closed loop", "64", "100", "50", "1, 1"],
        ["fused", "4,096", "200,000", "", "2,000"],
        ["fused", "8", "50", "25", "0.5, 0.5"],
    ]


def test_a_rare_failure_is_told_by_its_median_and_all_of_it():
    each = {"p": [0.1, 0.2, 0.6], "low": [0.0, 0.1, 0.3], "high": [0.2, 0.3, 0.9],
            "variation": [0.5, 0.4, 0.3], "trials": [100, 200, 300]}  # fmt: skip
    found = xr.Dataset({name: ("repetition", values) for name, values in each.items()})
    drawn = {"p": 0.25, "low": 0.2, "high": 0.3, "variation": 0.1, "trials": 400}
    beside = found.assign({f"drawn_{name}": value for name, value in drawn.items()})
    head, middle, together, last = rows.rare_failures(beside)
    assert head[1:] == ["probability of failure", "95 %", "variation", "worlds"]
    assert middle == ["splitting, median of 3", "0.2", "[0.1, 0.3]", "0.40", "200"]
    assert together[1] == "0.3"
    assert together[-1] == "600"
    assert last == ["drawn worlds", "0.25", "[0.2, 0.3]", "0.10", "400"]
    assert len(rows.rare_failures(found)) == 3


def test_cosines_stand_under_the_time_simulated():
    cosine = xr.DataArray([[0.5, -0.25]], dims=("estimator", "horizon"))
    found = xr.Dataset({"cosine": cosine, "doubt": ("horizon", [0.1, 0.2])},
                       {"estimator": ["forward"], "horizon": [2.0, 30.0]})  # fmt: skip
    assert rows.cosines(found)[1:] == [["forward", "", "0.50", "", "-0.25", "", ""]]


def test_what_only_a_dependency_brings_goes_with_it():
    needs = {"a": ["b", "c"], "b": ["d"], "c": [], "d": ["b"], "e": ["c", "not there"]}
    assert dependencies.with_dependencies(needs, ["a", "e"]) == {*"abcde"}
    assert dependencies.with_dependencies(needs, ["e"]) == {"c", "e"}


def test_every_dependency_and_extra_says_what_it_is_for():
    declared = dependencies.declared()
    needed = [re.match(r"[\w-]+", one).group() for one in declared["dependencies"]]
    assert set(needed) == set(dependencies.PURPOSE)
    assert set(declared["optional-dependencies"]) == set(dependencies.EXTRAS)


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
    page = (SWEEPS / "random_worlds" / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(code.replace("slice(100_000)", "slice(19)"), "page", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["rps", "nps"]
