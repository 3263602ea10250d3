"""Worlds at points of the unit cube: they and their runs are bit-identical to drawn ones."""

import json
import shutil
from dataclasses import asdict, replace

import jax
import numpy as np
import pytest
import xarray as xr
from helpers import (
    CYLINDERS,
    PAPER,
    SHORT,
    SLOTS,
    refusal,
    refusing,
    rps,
    same,
)
from numpy.testing import assert_allclose, assert_array_equal

import rps_jax
from rps_jax.record import files
from rps_jax.runs.plan import load_plan
from rps_jax.runs.sweep import Sweep
from rps_jax.world import draws, points
from rps_jax.world.domain import DOMAINS, quantities_of

SWEPT = {"setting": SHORT, "slots": SLOTS}
# Quantities that the solid, friction, target and robot of a world contain.
SHOWN = (*quantities_of("object", "robot"), "distance", "bearing")


def without_drawn_values(drawn):
    """Return a draw without the values that its solid, friction, target and robot contain."""
    return drawn._replace(values={k: v for k, v in drawn.values.items() if k not in SHOWN})


@pytest.mark.parametrize("name", DOMAINS)
def test_a_drawn_world_equals_the_world_at_its_point_bit_for_bit(name):
    domain, index = DOMAINS[name], np.arange(7, 300)
    at = points.check_points(domain, points.points_of(name, index, seed=5))
    kinds = domain.object_of(points.cases(domain, at, np.arange(293)))
    assert_array_equal(kinds, domain.object_of(index))
    for rows, again in points.draw_by_object(domain, 0, at, np.arange(293)):
        drawn = without_drawn_values(draws.draw(domain, 5, index[rows]))
        again = without_drawn_values(again)
        same(drawn, again._replace(indices=index[rows], cases=drawn.cases))


@pytest.mark.parametrize("name", ["wide", "real", "paper", "hostile", "hardware", "prisms"])
def test_every_coordinate_of_a_domain_changes_some_world(name):
    domain = DOMAINS[name]
    u = points.points_of(domain, np.arange(144))
    for column, quantity in enumerate(points.coordinates(domain)):
        shifted = u.copy()
        shifted[:, column] = (shifted[:, column] + 0.5) % 1
        a, b = (_leaves(domain, rows) for rows in (u, shifted))
        assert not np.array_equal(a, b), quantity.name


def _leaves(domain, u):
    at = points.check_points(domain, u)
    by_object = points.draw_by_object(domain, 0, at, np.arange(len(u)))
    drawn = [without_drawn_values(drawn) for _, drawn in by_object]
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(drawn)])


def test_a_coordinate_maps_to_the_range_of_its_quantity():
    u = points.points_of("wide", [0, 1, 2])
    names = points.names(DOMAINS["wide"])
    u[:, names.index("mass")] = 0.5  # evenly in the logarithm from 3 to 60 kg
    u[:, names.index("distance")] = 0.25  # evenly from 1 to 3 m
    u[:, names.index("object")] = 0.99
    worlds = points.worlds_at("wide", u)
    assert_allclose(worlds.mass, np.sqrt(3 * 60))
    assert_allclose(worlds.distance, 1.5)
    assert set(worlds.object.values) == {"random_prism"}
    assert worlds.low.sel(quantity="mass") == 3
    assert worlds.unit.sel(quantity="distance") == "m"
    kinds = worlds.kind.sel(quantity=["object", "mass", "turn", "key_0"]).values
    assert kinds.tolist() == ["choice", "range", "shape", "noise"]


def test_sweeps_and_evaluations_take_points_as_they_take_drawn_worlds(tmp_path):
    u = points.points_of(CYLINDERS, np.arange(SLOTS), seed=3)
    drawn = rps_jax.sweep("rps", CYLINDERS, SLOTS, setting=replace(SHORT, seed=3), slots=SLOTS)
    folder = tmp_path / "run"
    swept = rps_jax.sweep("rps", CYLINDERS, points=u, out=folder, **SWEPT)
    xr.testing.assert_identical(swept.assign_attrs(seed=3), drawn)
    assert load_plan(folder).points == points.Points(u)
    again = rps_jax.replay(folder, 4)
    assert int(again.outcome.success) == int(drawn.success[0, 4])
    reversed_ = points.worlds_at(CYLINDERS, u[::-1])
    params = jax.tree.map(lambda value: np.full(1, value), PAPER)
    tried = rps_jax.evaluate(params, CYLINDERS, points=reversed_, **SWEPT)
    assert_allclose(tried.mass, drawn.mass.values[::-1], rtol=1e-6)
    assert_allclose(tried.time[0], drawn.time[0, ::-1], atol=0.5)
    quick = Sweep("rps", CYLINDERS, points=u, quick=True).with_quick_values()
    quick.validate()
    assert quick.plan.worlds == SLOTS
    # A folder of other points, and a folder with damaged points.
    with refusing("holds another run"):
        rps_jax.sweep("rps", CYLINDERS, points=u[::-1], out=folder, **SWEPT)
    shutil.copy(folder / "points.nc", tmp_path / "good.nc")
    (folder / "points.nc").write_bytes(b"noise")
    with refusing(r"points\.nc is corrupt"):
        rps_jax.replay(folder, 4)
    again = rps_jax.sweep("rps", CYLINDERS, points=u, out=folder, **SWEPT)
    xr.testing.assert_identical(again, swept)
    assert (folder / "points.nc").read_bytes() == (tmp_path / "good.nc").read_bytes()


BOTH = replace(CYLINDERS, objects=("random_box", "random_cylinder"))


def some_points():
    """Return points (5, q) of one box among cylinders."""
    u = points.points_of(BOTH, np.arange(5))
    u[:, 0] = [0.9, 0.9, 0.9, 0.9, 0.1]
    return u


def test_points_that_are_none_are_refused(tmp_path, capsys):
    u = points.points_of("wide", np.arange(2))
    for wrong, words in (
        (u[:, 1:], r"shape of u = \(2, 36\) is not allowed: it must be \(n, 37\)"),
        (u[:0], "is not allowed"),
        (u + 1, r"u\[0, 0\] = 1\.1.* \(object\) is not allowed: it must be at least 0 and below 1"),
        (np.where(u == u[1, 3], np.nan, u), r"u\[1, 3\] = nan"),
        (points.worlds_at("hostile", u), "of another domain"),
        (points.worlds_at("wide", u).assign_attrs(domain="no JSON"), "of another domain"),
        (points.worlds_at("wide", u).assign_attrs(domain="[3]"), "of another domain"),
        (xr.Dataset(), "has no u"),
        ([["a"]], "give an array"),
    ):
        with refusing(words):
            rps_jax.sweep("rps", "wide", points=wrong)
    files.write_results(tmp_path / "some.nc", points.worlds_at("wide", u))
    for options, words in (
        ("--domain hostile --points some.nc", "of another domain"),
        ("--worlds 3 --points some.nc", "worlds is not allowed with points"),
        ("--points none.nc", "cannot be read"),
    ):
        *rest, name = options.split()
        assert words in refusal(capsys, "sweep", *rest, tmp_path / name)


def test_the_command_sweeps_points_and_can_be_continued(tmp_path, capsys):
    domain, file = tmp_path / "both.json", tmp_path / "some.nc"
    domain.write_text(json.dumps(asdict(BOTH)))
    files.write_results(file, points.worlds_at(BOTH, some_points()))
    words = f"sweep --laws rps --engine mujoco --horizon 1 --slots {SLOTS}"
    command = [*words.split(), "--part", 2, "--domain", domain, "--points", file]
    command += ["--out", tmp_path / "r"]
    assert rps(*command) == 0
    assert "5 worlds, points of the unit cube" in capsys.readouterr().out
    assert rps(*command) == 0
    objects = rps_jax.load(tmp_path / "r").object.values.tolist()
    assert objects == ["random_cylinder"] * 4 + ["random_box"]
