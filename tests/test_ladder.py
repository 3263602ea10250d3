"""The ladder of laws: equal worlds, what each senses, and how they compare."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from helpers import CYLINDERS, refusal, rps

from rps_jax import ladder as climb
from rps_jax.analysis import statistics, tables
from rps_jax.control import registry
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.learned import policy
from rps_jax.errors import InputError
from rps_jax.runs.question import seed_of
from rps_jax.runs.results import load, write_table
from rps_jax.studies import ladder
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import draws


def test_holms_adjustment_by_hand():
    # Sorted 0.01, 0.03, 0.04 by 3, 2, 1: 0.03, 0.06, 0.04, which must not fall below 0.06.
    np.testing.assert_allclose(statistics.holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    np.testing.assert_allclose(statistics.holm([0.6, 0.9]), [1.0, 1.0])
    assert statistics.holm([]).size == 0


def results(**won):
    success = xr.DataArray(
        np.array(list(won.values()), np.int8), dims=("law", "world"), coords={"law": list(won)}
    )
    return xr.Dataset({"success": success})


def test_laws_are_compared_with_one_of_them_world_by_world():
    found = results(base=[1] * 12 + [0] * 8, better=[1] * 20, worse=[0] * 12 + [1] + [0] * 7)
    header, *rows = tables.against_table(found, "base")
    assert [row[0] for row in rows] == ["better", "base", "worse"]  # best first
    assert header[-1] == "successes in the 8 failures of base"
    better, base, worse = rows
    # Exact McNemar: 8 to 0 is 2 / 2^8; 1 to 12 is 2 (1 + 13) / 2^13, doubled as the smaller one.
    assert better[2:] == ["+40.00 % (+8 -0)", "0.0078", "8"]
    assert worse[3:] == ["0.0068", "1"]
    assert worse[2] == "-55.00 % (+1 -12)"
    assert base[2:] == ["", "", ""]


def test_every_rung_is_a_law_of_the_package_with_what_it_senses():
    senses = {name: registry.law_of(registry.LAWS[name]).senses for name in ladder.all_laws()}
    assert set(senses) == set(registry.LAWS) == set(ladder.Ladder().chosen)
    order = ["touch", "taxels", "force", "pose"]
    assert list(dict.fromkeys(senses.values())) == order  # from what senses least
    assert {name for name in senses if senses[name] == "taxels"} == set(policy.SHIPPED)
    assert [name for name in senses if senses[name] == "force"] == ["force_push_published"]
    assert {name for name in senses if senses[name] == "pose"} == {"aps", "dipole"}
    for params in registry.LAWS.values():
        assert registry.law_of(params).check(params) is params
    assert registry.LAWS[ladder.REFERENCE] == RPSParams.tuned()


@pytest.mark.parametrize(
    ("laws", "words"),
    [
        (("rsp",), "unknown law 'rsp': choose from .* rps_tuned"),
        (("pursuit", "pursuit"), "pursuit"),
        ([], "name each once, at least one"),
        ({}, "name at least one law"),
        (("none.py:MyParams",), "none.py cannot be read"),
        (("pursuit,none.json",), "none.json"),
        (("persuit,none.json",), "unknown law 'persuit'"),
    ],
)
def test_laws_that_are_not_there_are_refused(laws, words):
    with pytest.raises(InputError, match=words):
        _ = ladder.Ladder(laws).chosen


def test_a_law_may_have_the_values_of_a_file(tmp_path):
    mine = tmp_path / "eager.json"
    mine.write_text('{"press": 0.5}')
    found = ladder.Ladder(("pursuit", f"pursuit,{mine}")).chosen
    assert list(found) == ["pursuit", "pursuit,eager"]
    assert found["pursuit,eager"] == registry.LAWS["pursuit"]._replace(press=0.5)
    with pytest.raises(InputError, match="eager"):
        _ = ladder.Ladder((f"pursuit,{mine}",) * 2).chosen
    mine.write_text('{"presses": 0.5}')
    with pytest.raises(InputError, match="presses"):
        _ = ladder.Ladder(f"pursuit,{mine}").chosen


def test_every_law_meets_the_same_worlds_which_no_tuner_has_seen():
    some = ("rps_tuned", "pursuit", "dipole")
    asked = {"setting": Setting("quasistatic", rules=Rules(horizon=20.0)), "slots": 6}
    found = climb(some, CYLINDERS, 6, **asked)
    assert found.success.dims == ("law", "world")
    assert found.law.values.tolist() == list(some)
    assert found.senses.values.tolist() == ["touch", "touch", "pose"]
    assert found.mass.dims == ("world",)
    index = np.arange(6)
    drawn = draws.table(draws.draw(CYLINDERS, seed_of(0, "test"), index))
    np.testing.assert_allclose(found.mass, drawn["mass"][0], rtol=1e-6)
    again = climb({"mine": RPSParams.tuned()}, CYLINDERS, 6, **asked)
    np.testing.assert_array_equal(again.time.sel(law="mine"), found.time.sel(law="rps_tuned"))
    np.testing.assert_array_equal(again.mass, found.mass)


def test_several_domains_are_several_ladders(tmp_path, capsys):
    setting = Setting("quasistatic", rules=Rules(horizon=2.0))
    domains = ("wide,objects=random_cylinder", "paper")
    tree = climb(("rps", "dipole"), domains, 3, setting=setting, slots=6, out=tmp_path / "run")
    assert list(tree.children) == list(domains)
    for domain in domains:
        alone = climb(("rps", "dipole"), domain, 3, setting=setting, slots=6)
        xr.testing.assert_identical(tree[domain].to_dataset(), alone)
        np.testing.assert_array_equal(load(tmp_path / "run" / domain).success, alone.success)
    asked = ["ladder", "--laws", "rps", "dipole", "--domain", *domains, "--worlds", 3]
    asked += ["--engine", "quasistatic", "--horizon", 2, "--slots", 6, "--out", tmp_path / "run"]
    assert rps(*asked) == 0  # reads the finished sweeps
    text = capsys.readouterr().out
    for domain in domains:
        assert f"## Success, {domain}" in text
        assert f"## Differences, world by world, {domain}" in text
        assert (tmp_path / "run" / f"ladder_{domain}.png").stat().st_size > 10_000
    full = ladder.Ladder("rps", ("paper", "wide"), 1000)
    assert [sweep.plan.worlds for sweep in full.sweeps.values()] == [144, 1000]


def test_the_command_reports_information_against_success(tmp_path, capsys):
    out = tmp_path / "run"
    asked = ["ladder", "--domain", "paper", "--worlds", 6, "--engine", "quasistatic"]
    asked += ["--laws", "rps_tuned", "pursuit", "--slots", 6, "--workers", 1, "--out", out]
    assert rps(*asked) == 0
    text = capsys.readouterr().out
    assert "## Models" not in text
    for heading in ("Information against success", "Against rps_tuned, world by world"):
        assert f"## {heading}" in text
    assert "no law succeeds in" in text
    assert (out / "ladder.png").stat().st_size > 10_000
    assert load(out).success.sizes == {"law": 2, "world": 6}


def test_outcomes_are_a_long_table_for_others(tmp_path, monkeypatch):
    setting = Setting("quasistatic", rules=Rules(horizon=2.0))
    path = tmp_path / "results.csv"
    found = climb(("rps", "dipole"), CYLINDERS, 3, setting=setting, table=path)
    table = pd.read_csv(path)
    assert table.law.tolist() == ["rps"] * 3 + ["dipole"] * 3
    assert table.world.tolist() == [0, 1, 2] * 2
    assert set(table.object) == {"random_cylinder"}
    for (law, world), row in table.set_index(["law", "world"]).iterrows():
        one = found.sel(law=law, world=world)
        for name in ("success", "time", "path_length", "mass", "friction_ground", "omega_error"):
            assert row[name] == pytest.approx(float(one[name]), rel=1e-6), name
        poses = row[["base_x", "base_y", "base_yaw", "object_x", "object_y", "object_yaw"]]
        wanted = np.concatenate([one.base_pose, one.object_pose])
        np.testing.assert_allclose(poses.astype(float), wanted, rtol=1e-5)
        assert row.senses == str(one.senses.values)
    told = pd.read_csv(tmp_path / "results.columns.csv", keep_default_na=False)
    assert told.column.tolist() == list(table)
    units = dict(zip(told.column, told.unit, strict=True))
    assert (units["time"], units["mass"], units["base_yaw"], units["law"]) == ("s", "kg", "rad", "")
    assert all(told.meaning)
    # Without pyarrow, pandas is asked to write text in the place of Parquet.
    monkeypatch.setattr(pd.DataFrame, "to_parquet", pd.DataFrame.to_csv)
    write_table(found, tmp_path / "other.parquet")
    assert (tmp_path / "other.parquet").read_text() == path.read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"table": "results.xls"}, "name a file NAME.csv or NAME.parquet"),
        ({"table": "nowhere/results.csv"}, "nowhere is no folder"),
        ({"table": "r.csv", "shard": "1/2", "out": "run"}, "table is not allowed with a shard"),
        ({"table": "results.parquet"}, "run pip install pyarrow, or name a .csv file"),
    ],
)
def test_tables_that_cannot_be_written_are_refused(options, words, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=words):
        climb("rps", **options)


MINE = """
from typing import NamedTuple
import rps_jax

class {name}(NamedTuple):
    v: float = 0.05
    d_success: float = 0.05

def step(params, state, obs):
    details = rps_jax.Details.from_obs(obs)
    return state, rps_jax.Twist(params.v, 0.0, 0.0), details

rps_jax.register_law("{name}", rps_jax.Law(lambda params: (), step), {name}())
"""


def test_a_law_of_ones_own_is_scored_in_the_ladders_worlds(tmp_path, capsys, registries):
    mine, out = tmp_path / "mine.py", tmp_path / "score"
    mine.write_text(MINE.format(name="Straight"))
    asked = ["--domain", "wide,objects=random_cylinder", "--worlds", 6, "--engine", "quasistatic"]
    asked += ["--slots", 6, "--workers", 1, "--horizon", 80]
    assert rps("score", f"{mine},v=0.04", *asked, "--out", out) == 0
    text, found = capsys.readouterr().out, load(out)
    assert found.law.values.tolist() == ["Straight,v=0.04", "rps", "rps_plus"]
    won = found.success.values > 0
    rates = [tables.share(int(one.sum()), 6) for one in won]
    median = f"{np.median(found.time.values[0][won[0]]):.1f} s" if won[0].any() else "-"
    place = "6 test worlds of wide,objects=random_cylinder, seed 0, quasistatic"
    cells = ["Straight,v=0.04", rates[0], median, *rates[1:], place]
    (line,) = (line for line in text.splitlines() if line.startswith("    | Straight"))
    assert line.strip() == f"| {' | '.join(cells)} |"
    header = text.splitlines()[text.splitlines().index(line) - 2]
    assert header.strip() == "| law | success | median time | rps | rps_plus | worlds |"
    assert rps("ladder", "--laws", "rps", "rps_plus", *asked, "--out", tmp_path / "ladder") == 0
    same = load(tmp_path / "ladder")
    np.testing.assert_array_equal(same.mass, found.mass)
    np.testing.assert_array_equal(same.time, found.time.sel(law=same.law))


def test_a_file_of_one_law_is_named_without_its_class(tmp_path, registries):
    mine = tmp_path / "mine.py"
    mine.write_text(MINE.format(name="Straight"))
    assert (
        registry.parse_law(str(mine))[0] == registry.parse_law(f"{mine}:Straight")[0] == "Straight"
    )
    assert list(ladder.Score("rps", ("rps", "rps_plus")).chosen) == ["rps", "rps_plus"]
    mine.write_text(MINE.format(name="Straight") + MINE.format(name="Slow"))
    assert registry.parse_law(f"{mine}:Slow")[0] == "Slow"
    with pytest.raises(InputError, match=r"name one as FILE.py:CLASS"):
        registry.parse_law(str(mine))


def test_the_command_refuses_an_unknown_law(capsys):
    assert "unknown law 'rsp'" in refusal(capsys, "ladder", "--laws", "rsp")
    said = refusal(capsys, "tune", "es", "--law", "aps")
    assert "it has no bounds to tune within" in said
