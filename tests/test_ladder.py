"""The ladder of laws: the same worlds for all laws, their senses, and comparisons."""

import re

import numpy as np
import pytest
import xarray as xr
from helpers import (
    CYLINDERS,
    ROOT,
    printed,
    refusals,
    refusing,
    results_of,
    rps,
    setting_of,
)
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax import ladder as climb
from rps_jax.analysis import statistics, tables
from rps_jax.control import registry
from rps_jax.control.laws.rps import RPSParams
from rps_jax.control.learned import policy
from rps_jax.runs.results import load
from rps_jax.studies import ladder
from rps_jax.trials.setting import seed_of
from rps_jax.world import draws

QUASISTATIC = "--engine quasistatic --slots 8 --workers 1"


def test_holms_adjustment_by_hand():
    # Sorted 0.01, 0.03, 0.04 times 3, 2, 1: 0.03, 0.06, 0.04, which is raised to 0.06.
    assert_allclose(statistics.holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    assert_allclose(statistics.holm([0.6, 0.9]), [1.0, 1.0])
    assert statistics.holm([]).size == 0


def test_laws_are_compared_with_a_reference_world_by_world():
    success = [[1] * 12 + [0] * 8, [1] * 20, [0] * 12 + [1] + [0] * 7]
    results = results_of(["base", "better", "worse"], success=success)
    header, better, base, worse = tables.against_table(results, "base")
    assert header[-1] == "successes in the 8 failures of base"
    # Exact McNemar: 8 to 0 is 2 / 2^8; 1 to 12 is 2 (1 + 13) / 2^13, doubled as the smaller one.
    assert (better[0], *better[2:]) == (
        "better",
        "+40.00 % [+14.38, +58.35] (+8 -0)",
        "0.0078",
        "8",
    )
    assert (base[0], *base[2:]) == ("base", "", "", "")
    assert (worse[0], *worse[2:]) == ("worse", "-55.00 % [-75.97, -24.03] (+1 -12)", "0.0068", "1")


def test_the_default_laws_are_all_laws_in_the_order_of_their_senses():
    senses = {name: registry.law_of(registry.LAWS[name]).senses for name in ladder.all_laws()}
    assert set(senses) == set(registry.LAWS)
    assert set(ladder.Ladder().chosen) == set(registry.laws_for("omni")) < set(registry.LAWS)
    order = ["touch", "taxels", "ends", "force", "pose"]
    assert list(dict.fromkeys(senses.values())) == order  # from the fewest senses on
    learned = {name for name in senses if senses[name] == "taxels"}
    # Policies that other tests of this process have read are named by a digest.
    assert {x for x in learned if not re.search("_[0-9a-f]{8}$", x)} == set(policy.SHIPPED)
    assert [name for name in senses if senses[name] == "force"] == ["force_push_published"]
    assert {name for name in senses if senses[name] == "pose"} == {"aps", "dipole"}
    for params in registry.LAWS.values():
        assert registry.law_of(params).check(params) is params
    assert registry.LAWS[ladder.REFERENCE] == RPSParams.tuned()


test_unknown_laws_are_refused = refusals(
    lambda laws: ladder.Ladder(laws).chosen,
    (({},), "name at least one law"),
)


def test_a_law_may_have_the_values_of_a_file(tmp_path):
    path = tmp_path / "eager.json"
    path.write_text('{"press": 0.5}')
    laws = ladder.Ladder(("pursuit", f"pursuit,{path}")).chosen
    assert list(laws) == ["pursuit", "pursuit,eager"]
    assert laws["pursuit,eager"] == registry.LAWS["pursuit"]._replace(press=0.5)
    with refusing("eager"):
        _ = ladder.Ladder((f"pursuit,{path}",) * 2).chosen
    path.write_text('{"presses": 0.5}')
    with refusing("presses"):
        _ = ladder.Ladder(f"pursuit,{path}").chosen


def test_all_laws_meet_the_same_test_worlds():
    laws = ("rps_tuned", "dipole")
    options = {"setting": setting_of(20.0), "slots": 8}
    results = climb(laws, CYLINDERS, 8, **options)
    assert results.success.dims == ("law", "world")
    assert results.law.values.tolist() == list(laws)
    assert results.senses.values.tolist() == ["touch", "pose"]
    assert results.mass.dims == ("world",)
    drawn = draws.table(draws.draw(CYLINDERS, seed_of(0, "test"), np.arange(8)))
    assert_allclose(results.mass, drawn["mass"][0], rtol=1e-6)
    renamed = climb({"mine": RPSParams.tuned()}, CYLINDERS, 8, **options)
    assert_array_equal(renamed.time.sel(law="mine"), results.time.sel(law="rps_tuned"))
    assert_array_equal(renamed.mass, results.mass)


def test_several_domains_are_several_ladders(tmp_path, capsys):
    setting = setting_of(2.0)
    domains = ("wide,objects=random_cylinder", "wide,objects=random_cylinder,gap=0.01")
    tree = climb(("rps", "dipole"), domains, 8, setting=setting, slots=8, out=tmp_path)
    assert list(tree.children) == list(domains)
    for domain in domains:
        alone = climb(("rps", "dipole"), domain, 8, setting=setting, slots=8)
        xr.testing.assert_identical(tree[domain].to_dataset(), alone)
        assert_array_equal(load(tmp_path / domain).success, alone.success)
    command = f"ladder --laws rps dipole --worlds 8 {QUASISTATIC} --horizon 2 --out {tmp_path}"
    assert rps(command, "--domain", *domains) == 0  # reads the finished sweeps
    text = capsys.readouterr().out
    for domain in domains:
        assert f"## Success, {domain}" in text
        assert f"## Differences, world by world, {domain}" in text
        assert (tmp_path / f"ladder_{domain}.png").stat().st_size > 10_000
    full = ladder.Ladder("rps", ("paper", "wide"), 1000)
    assert [sweep.plan.worlds for sweep in full.sweeps.values()] == [144, 1000]


@pytest.mark.slow
def test_the_command_reports_information_against_success(tmp_path, capsys):
    command = f"ladder --domain wide,objects=random_cylinder --worlds 8 {QUASISTATIC}"
    command += " --laws rps_tuned dipole --horizon 20 --out"
    text = printed(capsys, command, tmp_path)
    assert "## Models" not in text
    for heading in ("Information against success", "Against rps_tuned, world by world"):
        assert f"## {heading}" in text
    assert (tmp_path / "ladder.png").stat().st_size > 10_000
    assert load(tmp_path).success.sizes == {"law": 2, "world": 8}


LAW = ROOT / "notebooks" / "examples" / "custom_law.py"


def test_a_custom_law_is_scored_in_the_worlds_of_the_ladder(tmp_path, capsys, registries):
    options = "--laws rps nps --domain wide,objects=random_cylinder --worlds 8 --horizon 20"
    options += f" {QUASISTATIC} --out"
    assert rps(f"score {LAW},v=0.04 {options}", tmp_path / "score") == 0
    text, results = capsys.readouterr().out, load(tmp_path / "score")
    assert results.law.values.tolist() == ["p_control,v=0.04", "rps", "nps"]
    success = results.success.values > 0
    rates = [tables.share(int(n), 8) for n in success.sum(axis=1)]
    median = f"{np.median(results.time.values[0][success[0]]):.1f} s" if success[0].any() else "-"
    worlds = "8 test worlds of wide,objects=random_cylinder, seed 0, quasistatic"
    cells = ["p_control,v=0.04", rates[0], median, *rates[1:], worlds]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    at = rows.index(cells)
    assert rows[at - 2] == ["law", "success", "median time", "rps", "nps", "worlds"]
    assert rps(f"ladder {options}", tmp_path / "ladder") == 0
    same = load(tmp_path / "ladder")
    assert_array_equal(same.mass, results.mass)
    assert_array_equal(same.time, results.time.sel(law=same.law))


def test_a_file_of_one_law_is_named_without_its_class(tmp_path, registries):
    for name in (LAW, f"{LAW}:PParams"):
        assert registry.parse_law(str(name))[0] == "p_control"
    assert list(ladder.Score("rps", ("rps", "rps_plus")).chosen) == ["rps", "rps_plus"]
    text, two = LAW.read_text(), tmp_path / "two.py"
    two.write_text(text + text.replace("PParams", "Slow").replace("p_control", "slow"))
    assert registry.parse_law(f"{two}:Slow")[0] == "slow"
    with refusing("must define one class of parameters"):
        registry.parse_law(str(two))
