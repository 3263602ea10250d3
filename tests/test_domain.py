"""Random worlds: each depends only on its seed and index, and equals MuJoCo's compilation."""

import dataclasses
import json
import math
from dataclasses import replace
from functools import partial

import jax
import mujoco
import numpy as np
import pytest
from helpers import refusals, refusing, row, same
from numpy.testing import assert_allclose
from staging import recompiled

from rps_jax import engines
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import polygon
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import domain, draws, paper, scene
from rps_jax.world.domain import DOMAINS, RANDOM, Range
from rps_jax.world.objects import PAPER_OBJECTS
from rps_jax.world.physics import preset
from rps_jax.world.scene import FRICTION, Friction, WorldInputs
from rps_jax.world.tasks.corridor import Corridor
from rps_jax.world.tasks.path import Path

WIDE = DOMAINS["wide"]
COUNT = 12
OF_SCENES = ("mass", "size", "height", "com_offset", "load_size")
NO_RANGE = r"domain mass = .* give a Range, as Range\(3, 10\)"


def drawn(name, count=COUNT, seed=3, **changes):
    return draws.draw(replace(WIDE, objects=(name,), **changes), seed, np.arange(count))


def test_a_world_is_equal_alone_and_among_others():
    """The order of the requested worlds does not matter either."""
    worlds_again = draws.draw(WIDE, 7, np.arange(1, 3000, 3))
    for i in (0, 17, 999):
        alone = draws.draw(WIDE, 7, [1 + 3 * i])
        same(alone, jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], worlds_again))
    backwards = draws.draw(WIDE, 7, np.arange(1, 3000, 3)[::-1])
    same(jax.tree.map(lambda leaf: leaf[::-1], backwards), worlds_again)


def test_other_indices_and_other_seeds_give_other_worlds():
    masses = np.concatenate([drawn("random_box", seed=seed).solid.mass for seed in range(4)])
    assert np.unique(masses).size == 4 * COUNT


def test_a_change_of_one_range_leaves_all_else_as_it_was():
    a, b = drawn("random_box"), drawn("random_box", friction_ground=Range(0.9, 1.0))
    assert (b.friction.ground >= 0.9).all()
    same(a.solid, b.solid)
    same(a.p_world_target, b.p_world_target)


@pytest.mark.parametrize("name", ["wide", "hostile", "hardware"])
def test_everything_lies_in_its_range_and_fills_it(name):
    chosen = DOMAINS[name]
    index = np.arange(0, 600 * len(chosen.objects), len(chosen.objects))
    columns = draws.table(draws.draw(chosen, 0, index))
    for quantity in set(columns) & set(domain.QUANTITIES):
        values = columns[quantity][0]
        low, high, log = getattr(chosen, quantity)
        if name == "hardware" and quantity in OF_SCENES:
            continue  # these belong to the objects
        assert low - 1e-9 <= values.min() <= values.max() <= high + 1e-9, quantity
        if high > low:
            at = np.log(values / low) / np.log(high / low) if log else (values - low) / (high - low)
            assert abs(at.mean() - 0.5) < 5 * 0.29 / math.sqrt(values.size), quantity


def test_objects_alternate_by_index():
    objects = WIDE.object_of(np.arange(9))
    assert objects.tolist() == [0, 1, 2] * 3
    assert [WIDE.family_of(i) for i in range(3)] == ["box", "cylinder", "prism"]
    with pytest.raises(ValueError, match="several objects"):
        draws.draw(WIDE, 0, [0, 1])


@pytest.mark.parametrize("engine", ["fused", "mjx"])
def test_the_paper_domain_is_the_papers_grid(engine):
    chosen, setting = DOMAINS["paper"], Setting(engine=engine)
    assert chosen.combinations == 144
    for kind, name in enumerate(PAPER_OBJECTS):
        index = np.flatnonzero(chosen.object_of(np.arange(144)) == kind)
        part = drawn_worlds(chosen, draws.draw(chosen, 0, index), setting)
        cases = [Case(name, f, t) for f in FRICTION.values() for t in paper.TARGETS]
        worlds = pushes.build(cases, setting).worlds
        mine, theirs = (w._replace(key=0, odometry=0) for w in (part.worlds, worlds))
        for world in (mine, theirs) if engine == "mjx" else ():
            for field in (".body_pos", ".qpos0", ".qpos_spring"):  # of a body that is free
                world.fields.pop(field)
        same(mine, theirs, rtol=3e-6, atol=3e-6)


def compiled_rows(worlds, family, count=COUNT):
    """Return scenes of the worlds that MuJoCo compiles one by one."""
    inputs = WorldInputs(family, worlds.solid, worlds.friction, preset())
    return [scene.compile_row(inputs, i) for i in range(count)]


@pytest.mark.parametrize("name", ["random_box", "random_cylinder"])
def test_fused_bodies_equal_those_of_recompiled_models(name):
    worlds, family = drawn(name), RANDOM[name]
    _, bodies = engines.get("fused").stage(
        WorldInputs(family, worlds.solid, worlds.friction, preset())
    )
    compiled = recompiled("fused", compiled_rows(worlds, family))
    same(bodies, compiled, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", list(RANDOM))
def test_mass_properties_are_those_that_mujoco_finds(name):
    """A solid is two bodies of uniform density: its whole, and a scaled copy that touches it."""
    worlds = drawn(name, 6, seed=1)
    for i in range(6):
        drawn_solid, size = row(worlds.solid, i), worlds.values["load_size"][i]
        edge, share = edge_and_share(worlds, i)
        area = solid.area(row(worlds.solid, slice(i, i + 1)))[0]
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body()
        for scale, part in ((1.0, 1 - share), (size, share)):
            density = part * drawn_solid.mass / (scale**2 * area * drawn_solid.height)
            at = [*(1 - scale) * edge, 0]
            body.add_geom(**_even(spec, drawn_solid, scale), pos=at, density=density)
        model = spec.compile()
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[1])
        theirs = turn.reshape(3, 3) @ np.diag(model.body_inertia[1]) @ turn.reshape(3, 3).T
        assert_allclose(drawn_solid.mass, model.body_mass[1], rtol=1e-5)
        assert_allclose(drawn_solid.p_object_com, model.body_ipos[1], atol=1e-6)
        mine = inertia_in_object(worlds, i)
        assert_allclose(mine, theirs, rtol=1e-4, atol=1e-5 * drawn_solid.inertia.max())


@pytest.mark.parametrize("name", ["random_cylinder", "random_prism"])
def test_mass_properties_are_integrals_over_both_bodies(name):
    worlds = drawn(name, 4, seed=2, com_offset=Range(0.3, 0.7))
    for i in range(4):
        shape, size = row(worlds.solid, i), worlds.values["load_size"][i]
        edge, share = edge_and_share(worlds, i)
        ticks = np.linspace(-1, 1, 1200) * (np.abs(shape.vertices).max() + shape.radius)
        x, y = np.meshgrid(ticks, ticks)
        local = [(z - (1 - size) * p) / size for z, p in zip((x, y), edge, strict=True)]
        whole, load = inside(shape, x, y), inside(shape, *local)
        assert not (load & ~whole).any()
        weight = shape.mass * ((1 - share) * whole / whole.sum() + share * load / load.sum())
        com = np.array([(weight * z).sum() for z in (x, y)]) / shape.mass
        assert_allclose(shape.p_object_com, [*com, 0], atol=1e-4)
        x, y = x - com[0], y - com[1]
        upright = shape.mass * shape.height**2 / 12
        xx, yy, xy = ((weight * z).sum() for z in (x * x, y * y, x * y))
        theirs = [[yy + upright, -xy, 0], [-xy, xx + upright, 0], [0, 0, xx + yy]]
        assert_allclose(inertia_in_object(worlds, i), theirs, rtol=4e-3, atol=2e-3 * xx)


def edge_and_share(worlds, i):
    """Return the point (2,) [m] where the load touches the outline, and its share of the mass."""
    alone = row(worlds.solid, slice(i, i + 1))
    offset = np.linalg.norm(alone.p_object_com)
    along = alone.p_object_com[:, :2] / offset
    reach = solid.reach(alone.vertices, alone.radius, along)[0]
    return reach * along[0], offset / ((1 - worlds.values["load_size"][i]) * reach)


def inertia_in_object(worlds, i):
    axes = solid.axes(row(worlds.solid, slice(i, i + 1)))[0]
    return axes @ np.diag(worlds.solid.inertia[i]) @ axes.T


def inside(shape, x, y):
    """Whether points lie in an outline."""
    if len(shape.vertices) == 1:
        return np.hypot(x, y) <= shape.radius
    ahead = np.roll(shape.vertices, -1, axis=0) - shape.vertices
    sides = zip(shape.vertices, ahead, strict=True)
    return np.all([e[0] * (y - v[1]) >= e[1] * (x - v[0]) for v, e in sides], axis=0)


def _even(spec, row, scale):
    """Return the geom of a solid of uniform density, its outline scaled about the origin."""
    half = row.height / 2
    if len(row.vertices) == 1:
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [scale * row.radius, half, 0]}
    corners = scale * np.unique(row.vertices, axis=0)
    points = [[*corner, z] for z in (-half, half) for corner in corners]
    mesh = spec.add_mesh(name=f"solid_{scale}", uservert=np.ravel(points))
    return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name}


def test_the_largest_load_fits_and_a_larger_one_is_refused():
    """At the limit the load is the whole mass."""
    worlds = drawn("random_box", com_offset=Range(0.7, 0.7), load_size=Range(0.3, 0.3))
    x, y = 2 * worlds.solid.vertices[:, 0].T
    whole = np.sort(np.stack([x, y], -1), axis=1) * 0.3
    expected = np.sum(whole**2, axis=1) / 12 * worlds.solid.mass
    assert_allclose(worlds.solid.inertia[:, 2], expected)
    refused = (
        r"domain load_size \(high\) = 0.31 .* with com_offset up to 0.7 its high is at most 0.3"
    )
    with refusing(refused):
        replace(WIDE, com_offset=Range(0, 0.7), load_size=Range(0.1, 0.31))


def test_prisms_are_convex_of_three_to_eight_sides_and_centred():
    solids = drawn("random_prism", 300).solid
    sides = solid.corners(solids)
    assert set(sides) == set(range(3, 9))
    assert_allclose(solid.centred(solids.vertices), solids.vertices, atol=1e-12)
    for vertices, count in zip(solids.vertices, sides, strict=True):
        polygon(vertices[: int(count)])  # which refuses outlines that are not convex
    assert (solid.area(solids) > 0).all()


def test_a_load_moves_the_centre_of_mass_by_the_requested_share():
    worlds = drawn("random_prism", 50, com_offset=Range(0.3, 0.3))
    assert_allclose(draws.table(worlds)["com_offset"][0], 0.3)


test_ranges_that_mean_nothing_are_refused = refusals(
    partial(replace, WIDE),
    ({"mass": Range(-1, 3)}, "domain mass .low. = -1"),
    ({"friction_ground": Range(0, 1)}, "friction_ground"),
    ({"distance": Range(0.1, 1)}, "distance"),
    ({"pose_latency": Range(0, 5)}, "pose_latency"),
    ({"objects": ()}, "name each once, at least one"),
    *(({"mass": mass}, NO_RANGE) for mass in ((3, 10), 5.0, [3, 10, True])),
    *(
        ({"objects": PAPER_OBJECTS, name: Range(0.2, 0.3)}, f"{name} = 0.2 to 0.3 .* no {name} to")
        for name in ("mass", "size", "aspect", "height", "com_offset", "load_size")
    ),
    *(
        (changes, f"domain {name} = .* {cause} no {name} to draw")
        for name, cause, changes in (
            ("distance", "its targets leave", {"targets": ((2.0, 0.0),), "distance": Range(1, 2)}),
            ("bearing", "its task path leaves", {"task": Path(), "bearing": Range(0, 1)}),
            ("distance", "its task corridor leaves", {"task": Corridor(), "distance": Range(1, 2)}),
            (
                "friction_robot",
                "its frictions leave",
                {"frictions": (Friction(0.3, 0.4),), "friction_robot": Range(0.2, 0.3)},
            ),
            ("noise", "its ideal skin leaves", {"skin": "ideal", "noise": Range(0.01, 0.02)}),
            ("foam", "its ideal skin leaves", {"skin": "ideal", "foam": Range(0.01, 0.02)}),
        )
    ),
)


def test_unused_ranges_may_be_those_of_named_domains_or_no_error():
    for chosen in DOMAINS.values():
        for task in ("path", "corridor,width=2"):
            assert domain.parse_domain(replace(chosen, skin="ideal"), task=task).skin == "ideal"
    assert replace(WIDE, skin="ideal", noise=Range(0, 0)).noise == Range(0, 0)


def test_objects_of_files_may_replace_the_random_ones_of_a_named_domain():
    for name in DOMAINS:
        assert domain.parse_domain(f"{name},objects=box").objects == ("box",)
    assert replace(WIDE, objects=("box", "random_box"), mass=Range(3, 5)).mass == Range(3, 5)


def test_a_domain_survives_json():
    for chosen in DOMAINS.values():
        text = json.dumps(dataclasses.asdict(chosen))
        assert domain.from_json(json.loads(text)) == chosen
    assert domain.from_json({"mass": 3}).mass == Range(3, 3, log=True)
    assert domain.from_json({"mass": [3, 10]}).mass == Range(3, 10, log=True)  # as in `wide`
    assert domain.from_json({"mass": [3, 10, False]}).mass == Range(3, 10)


def test_undrawn_quantities_are_constant_and_not_labelled_as_drawn():
    assert not WIDE.idle
    idle = DOMAINS["paper"].idle.keys()
    assert {"mass", "com_offset", "friction_robot", "bearing", "noise"} < idle
    assert not {"gap", "yaw", "pose_noise"} & idle
    ideal = replace(WIDE, objects=("random_box",), skin="ideal")
    assert ideal.idle.keys() == {"noise", "gain_spread", "dead_share"}
    table = draws.table(draws.draw(ideal, 0, np.arange(9)))
    assert {name for name, (values, _) in table.items() if not values.any()} == ideal.idle.keys()
