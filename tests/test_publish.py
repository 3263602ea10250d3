"""The studies that compute published numbers again, and the tables that they derive."""

import json
import re
import shlex
import shutil
import tomllib
from dataclasses import replace
from fnmatch import fnmatch
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from helpers import ROOT, rps
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax import sweep
from rps_jax.app.cli import names
from rps_jax.record import files
from rps_jax.trials.setting import Setting, seed_of
from rps_jax.trials.trial import Rules
from sweeps import probes, render_tables
from sweeps.publish import rows, study
from sweeps.publish.recipes import HISTORY, RECIPES, Recipe
from sweeps.random_worlds import million
from sweeps.speed import study as speed

SWEEPS = ROOT / "sweeps"
PUSH = "rps sweep --domain wide,objects=random_cylinder --worlds 8 --engine quasistatic --horizon 1"


@pytest.mark.parametrize("path", study.published(), ids=lambda path: path.stem)
def test_a_data_file_has_one_recipe_or_cites_others_or_is_history(path):
    ways = [name for name in RECIPES if fnmatch(path.stem, name)]
    cites = "command" not in json.loads(path.read_text())
    assert len(ways) + cites + (path.stem in HISTORY) == 1


def test_a_recipe_chooses_its_device():
    """Short runs need no GPU."""
    minutes = {(5, None): "cpu", (5, 4): "cpu", (90, 4): "gpu", (None, 30): "gpu"}
    assert {pair: Recipe((), *pair).device for pair in minutes} == minutes


@pytest.fixture
def recipe_folder(tmp_path, monkeypatch):
    """Folder with the data files of three recipes; the second recipe fails."""
    shutil.copytree(SWEEPS / "table" / "results", tmp_path / "study" / "results")
    recipes = {
        "first": Recipe(
            (f"{PUSH} --laws rps --out runs/one",), 1, None, "Success", ("drums",), ("", "all")
        ),
        "broken": Recipe((f"{PUSH} --laws none",), 1, None, "Success"),
        "second": Recipe(
            (f"{PUSH} --laws rps --out runs/one",),
            1,
            None,
            lambda results: [["worlds"], [str(results.sizes["world"])]],
        ),
    }
    monkeypatch.setattr(study, "RECIPES", recipes)
    monkeypatch.setattr(study, "_SWEEPS", tmp_path)
    monkeypatch.setattr(probes, "FILE", tmp_path / "publish" / "probes.json")
    return tmp_path


def test_failed_recipes_are_named_and_the_others_are_run(recipe_folder, capsys):
    words = (SWEEPS / "publish", "--only", "*", "--needs", "cpu", "--machine", "a core")
    assert rps(*words, "--out", recipe_folder / "run") == 2
    output = capsys.readouterr()
    assert "1 of the files could not be computed: broken." in output.err
    assert "unknown law 'none'" in output.out
    first, second = (
        json.loads((recipe_folder / f"results/{n}.json").read_text()) for n in ("first", "second")
    )
    assert [column["name"] for column in first["columns"]] == ["", "law", "all"]
    assert first["rows"][0][:2] == ["drums", "rps"]
    assert second["rows"] == [["8"]]
    assert first["command"] == second["command"] == [f"{PUSH} --laws rps"]
    assert first["device"] == "a core"
    assert first["probes"] == {}
    runs = (recipe_folder / "run" / "runs").iterdir()
    assert [path.name for path in runs] == ["one"]  # one run for both recipes


@pytest.mark.parametrize("path", study.published(), ids=lambda path: path.stem)
def test_the_code_of_a_data_file_left_a_record_of_each_of_its_probes(path):
    data = json.loads(path.read_text())
    if "command" in data and path.stem not in HISTORY:
        assert any(fnmatch(path.stem, pattern) for pattern in probes.PROBES_OF)
        assert data.get("probes", {}).keys() == probes.probes_of(path.stem)
        assert all(id in probes.stored()[probe] for probe, id in data.get("probes", {}).items())


def test_a_probe_is_a_command_and_is_used():
    used = {name for names in probes.PROBES_OF.values() for name in names}
    read = {"gallery", "push_quasistatic", "replay", "score"}  # of no table, but of the library
    assert used | read == probes.PROBES.keys()
    for command in probes.PROBES.values():
        name, _ = names.split(shlex.split(command))
        assert names.question_type(name)


RECORD = {"processor": "a core", "versions": {"jax": "1"}, "variables": {"x": ["ab", 1.0, 2.0]}}


@pytest.mark.parametrize(
    ("today", "equal"),
    [
        ({}, True),
        ({"variables": {"renamed": ["ab", 1.0, 2.0], "more": ["cd", 0.0, 0.0]}}, True),
        ({"variables": {"x": ["cd", 1.0, 2.0]}}, False),
        ({"processor": "other", "variables": {"x": ["cd", 1.3, 2.3]}}, True),
        ({"processor": "other", "variables": {"x": ["cd", 1.5, 2.0]}}, False),
        ({"versions": {"jax": "2"}, "variables": {"x": ["cd", 1.0, 2.5]}}, False),
        ({"processor": "other", "variables": {}}, False),
    ],
)
def test_numbers_are_the_same_bit_for_bit_or_on_another_device_within_a_share(today, equal):
    assert probes.same(RECORD, RECORD | today) == equal


@pytest.mark.parametrize(
    ("result", "listed", "message"),
    [
        ("ab", (), ""),
        ("cd", (), r"stale: small runs of table give other numbers; .*--only table, or list them"),
        ("cd", ("table",), ""),
        ("ab", ("table",), r"lists table, whose small runs give the same numbers: remove these"),
        ("ab", ("gone",), r"lists gone, no file"),
    ],
)
def test_a_stale_file_must_be_listed_and_a_current_one_must_not(
    result, listed, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(probes, "FILE", tmp_path / "probes.json")
    monkeypatch.setattr(
        probes, "run", lambda probe: RECORD | {"variables": {"x": [result, 1.0, 2.0]}}
    )
    data = json.loads((SWEEPS / "table" / "results" / "table.json").read_text())
    data["probes"] = {"table": probes.store("table", RECORD)}
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "table.json").write_text(json.dumps(data))
    monkeypatch.setattr(study, "_SWEEPS", tmp_path)
    for name in tuple(render_tables.STALE):
        monkeypatch.delitem(render_tables.STALE, name)
    for name in listed:
        monkeypatch.setitem(render_tables.STALE, name, "the box had a lid")
    words = (SWEEPS / "publish", "--check-probes", "--out", tmp_path / "run")
    assert rps(*words) == (2 if message else 0)
    output = capsys.readouterr()
    assert re.search(message, output.err) if message else not output.err
    state = "today's table differ" if result == "cd" else "still current"
    assert state in output.out


def in_this_process(command, **_):
    return SimpleNamespace(returncode=rps(*command[3:]))


def test_a_small_run_gives_its_record_again_and_unused_records_are_removed(tmp_path, monkeypatch):
    for name in ("publish", "results"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(probes, "FILE", tmp_path / "publish" / "probes.json")
    probe = "export_js"
    with monkeypatch.context() as patch:  # the first run, in this process
        patch.setattr(probes.subprocess, "run", in_this_process)
        id = probes.store(probe, probes.run(probe))
    probes.run.cache_clear()
    assert probes.differences({probe: id}) == []
    (row,) = probes.stored()[probe][id]["variables"].values()
    assert row[2] > abs(row[1]) > 0  # root mean square, and mean
    table = files.write_json(tmp_path / "results" / "js.json", {"probes": {probe: id}})
    probes.store(probe, RECORD)
    probes.remove_unused()
    assert [*probes.stored()[probe]] == [id]
    table.unlink()
    probes.remove_unused()
    assert probes.stored() == {}


def test_the_note_of_a_table_says_that_its_numbers_are_stale(monkeypatch):
    data = {
        "command": ["rps table"],
        "versions": {"rps_jax": "0.3.0"},
        "device": "",
        "date": "",
        "rows": [["x"]],
    }
    cited = {"command": None, "rows": [["x", {"from": "table"}], ["y", {"from": "ladder"}]]}
    monkeypatch.setattr(render_tables, "STALE", {})
    assert render_tables.caption("table", data, "t.json") == (
        "\n<sub>[command, versions and values](t.json).</sub>\n"
    )
    monkeypatch.setitem(render_tables.STALE, "table", "the box had a lid")
    note = render_tables.caption("table", data, "t.json")
    assert "<sub>Computed before the box had a lid. [command" in note
    assert "<sub>[command" in render_tables.caption("ladder", data, "l.json")
    note = render_tables.caption("summary", cited, "s.json")
    assert "<sub>`table`: computed before the box had a lid. Every number is cited" in note


def test_laws_with_default_and_tuned_parameters_are_compared():
    laws = ["rps", "rps,tuned", "pursuit", "pursuit,tuned"]
    success = np.repeat([[1, 0], [1, 1], [0, 1], [0, 1]], [8, 8], axis=1)
    results = xr.Dataset({"success": (("law", "world"), success)}, {"law": laws})
    head, *body = rows.default_beside_tuned(results)
    assert head[0] == "law"
    assert [(row[0], row[3]) for row in body] == [("rps", "+8 -0"), ("pursuit", "+0 -0")]
    assert [rate.split(" [")[0] for rate in body[0][1:3]] == ["50.0 %", "100.0 %"]
    assert rows.default_beside_tuned({"a": "tuner's"}) == []


def test_a_comparison_names_laws_by_the_runs_that_tuned_them():
    zero, laws = np.zeros((2, 3)), ["rps", "rps,a/runs/gradient/tuned.json"]
    columns = dict.fromkeys(("diverged", "tipped", "contact_lost_time", "min_distance"), zero)
    columns |= {"success": np.array([[1, 0, 0], [1, 1, 0]]), "time": zero + 50}
    variables = {name: (("law", "world"), values) for name, values in columns.items()}
    results = xr.Dataset(variables, {"law": laws, "object": ("world", ["a", "a", "b"])})
    head, first, second = rows.comparison(xr.DataTree.from_dict({"near": results}))
    assert (first[0], first[1], second[1]) == ("`near`, 3", "rps", "gradient")
    assert first[head.index("by object [%]")] == "50.0, 0.0"
    assert (first[2][:6], second[2][:6]) == ("33.3 %", "66.7 %")
    assert (first[-2:], second[-2]) == (["", ""], "+1 -0")


def test_success_is_grouped_by_force_lag_and_acceleration():
    rng = default_rng(3)
    limits = {
        "robot_force": (150, 800),
        "robot_traction": (0.3, 0.8),
        "robot_lag": (0, 0.5),
        "robot_acceleration": (0.1, 1),
        "friction_ground": (0.1, 0.7),
        "mass": (3, 60),
    }
    drawn = {name: ("world", rng.uniform(*interval, 4000)) for name, interval in limits.items()}
    results = xr.Dataset(drawn, {"law": ["rps"]})
    force = np.minimum(results.robot_force, results.robot_traction * 130 * 9.81)
    margin = force / (results.friction_ground * results.mass * 9.81)
    results["success"] = ("law", "world"), (margin.values[None] >= 1).astype(np.int8)
    _, *body = rows.by_robot(results)
    count = {label: int(worlds.replace(",", "")) for label, worlds, _ in body}
    rate_of = {label: rate.split(" [")[0] for label, _, rate in body}
    assert (rate_of["0.8 to 1"], rate_of["1 to 1.25"]) == ("0.0 %", "100.0 %")
    margins = [label for label in count if "enough" not in label]
    assert sum(count[label] for label in margins) == int((margin >= 0.5).sum())
    for label in ("lag", "acceleration"):
        parts = [n for name, n in count.items() if name.startswith(label)]
        assert len(parts) == 5
        assert sum(parts) == int((margin >= 1.5).sum())


def test_speeds_are_grouped_by_engine_and_batch():
    measured = [
        ("C in closed loop", 64, "box", 100.0),
        ("C in closed loop", 64, "prism", 50.0),
        ("fused", 4096, "box", 200_000.0),
        ("fused", 8, "box", 50.0),
        ("fused", 8, "prism", 25.0),
    ]
    fields = zip(("name", "worlds", "family", "rate"), zip(*measured, strict=True), strict=True)
    results = xr.Dataset({name: ("measurement", list(values)) for name, values in fields})
    assert speed.table(results) == [
        ["engine", "worlds", "box", "prism", "against C in closed loop"],
        ["C in closed loop", "64", "100", "50", "1, 1"],
        ["fused", "4,096", "200,000", "", "2,000"],
        ["fused", "8", "50", "25", "0.5, 0.5"],
    ]


def test_rare_failures_have_rows_of_the_median_and_of_all_repetitions():
    repetitions = {
        "p": [0.1, 0.2, 0.6],
        "low": [0.0, 0.1, 0.3],
        "high": [0.2, 0.3, 0.9],
        "variation": [0.5, 0.4, 0.3],
        "trials": [100, 200, 300],
    }
    results = xr.Dataset({name: ("repetition", values) for name, values in repetitions.items()})
    drawn = {"p": 0.25, "low": 0.2, "high": 0.3, "variation": 0.1, "trials": 400}
    with_drawn = results.assign({f"drawn_{name}": value for name, value in drawn.items()})
    head, middle, together, last = rows.rare_failures(with_drawn)
    assert head[1:] == ["probability of failure", "95 %", "variation", "worlds"]
    assert middle == ["splitting, median of 3", "0.2", "[0.1, 0.3]", "0.40", "200"]
    assert (together[1], together[-1]) == ("0.3", "600")
    assert last == ["drawn worlds", "0.25", "[0.2, 0.3]", "0.10", "400"]
    assert len(rows.rare_failures(results)) == 3


def test_every_dependency_and_extra_has_a_purpose():
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {re.match(r"[\w-]+", text).group() for text in declared["dependencies"]}
    page = (ROOT / "CONTRIBUTING.md").read_text().partition("## Dependencies")[2]
    listed = re.findall(r"^\| ([\w-]+) \| [^-]", page.partition("###")[0], re.M)
    extras = declared["optional-dependencies"].keys()
    assert {*listed} - {"dependency", "extra"} == needed | extras


def test_recipes_are_selected_by_device(recipe_folder, capsys):
    words = ("--only", "first", "--needs", "gpu", "--out", recipe_folder / "run")
    assert rps(SWEEPS / "publish", *words) == 0
    assert "Published numbers" in capsys.readouterr().out
    assert not (recipe_folder / "results" / "first.json").exists()


def test_the_code_of_the_page_reads_a_million_outcomes(tmp_path, monkeypatch, capsys):
    setting = Setting("quasistatic", rules=Rules(horizon=16.0), seed=37)
    near = "wide,objects=random_cylinder,distance=0.7:0.8,bearing=0:0.1"
    laws, out = ("rps", "nps"), tmp_path / "run"
    study = million.Million(laws, near, 19, setting=setting, slots=8, out=out)
    results = study()
    files.write_results(tmp_path / "million.nc", million.packed(results))
    seeded = replace(setting, seed=seed_of(37, "test"))
    assert results.attrs["seed"] == seeded.seed  # with which the page draws the worlds again
    swept = sweep(laws, near, 19, setting=seeded, slots=8)
    bits = np.unpackbits(results.success.values, axis=1, count=19)
    assert_array_equal(bits, swept.success)
    assert_array_equal(results.how == 0, swept.success)
    assert 0 < bits.sum() < bits.size
    period = results.attrs["control_period"]
    assert_allclose(results.steps * period, swept.time, atol=1e-4)
    distance = 1000 * swept.min_distance.values
    touched = np.isfinite(distance)
    assert_array_equal(results.missed.values < million.UNTOUCHED, touched)
    assert_allclose(results.missed.values[touched], distance[touched], atol=0.51)
    page = (SWEEPS / "random_worlds" / "README.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(compile(code.replace("slice(100_000)", "slice(19)"), "page", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["rps", "nps"]
