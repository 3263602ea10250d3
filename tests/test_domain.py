"""Random worlds: each depends only on its seed and index, and equals MuJoCo's compilation."""

import dataclasses
import json
import math
from dataclasses import replace

import jax
import mujoco
import numpy as np
import pytest
from helpers import same

from rps_jax import engines
from rps_jax.engines import mjx as mjx_engine
from rps_jax.engines.fused import step as fused
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.errors import InputError
from rps_jax.geometry import solid
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import domain, draws, paper, scene
from rps_jax.world.domain import DOMAINS, RANDOM, Domain, Range
from rps_jax.world.objects import PAPER_OBJECTS
from rps_jax.world.physics import preset
from rps_jax.world.scene import FRICTION

WIDE = DOMAINS["wide"]
COUNT = 12


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
        if name == "hardware" and quantity in ("mass", "size", "height", "com_offset"):
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
        for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(a, b, rtol=3e-6, atol=3e-6)


@pytest.mark.parametrize("name", ["random_box", "random_cylinder"])
def test_fused_bodies_equal_those_of_recompiled_models(name):
    worlds, family = drawn(name), RANDOM[name]
    _, bodies = engines.get("fused").stage(family, worlds.solid, worlds.friction, preset())
    for i in range(COUNT):
        row = scene.compile_row(family, worlds.solid, worlds.friction, preset(), i)
        compiled = fused.body(row.physics, np.asarray(row.footprint.vertices, float))
        for field, a, b in zip(compiled._fields, bodies, compiled, strict=True):
            if b is None:  # these solids have no custom feet
                assert a is None
                continue
            np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-7, err_msg=field)


@pytest.mark.parametrize("name", list(RANDOM))
def test_applied_domain_equals_the_recompiled_model_in_every_field(name):
    worlds, family = drawn(name), RANDOM[name]
    _, fields = engines.get("mjx").stage(family, worlds.solid, worlds.friction, preset())
    assert set(fields) <= set(mjx_engine.FIELDS)
    for i in range(COUNT):
        row = scene.compile_row(family, worlds.solid, worlds.friction, preset(), i)
        compiled = mjx.put_model(row.physics)
        # Only C MuJoCo has the mesh of a prism: MJX reads the corners from its feet.
        real = row.physics.geom_type != mujoco.mjtGeom.mjGEOM_MESH
        leaves = jax.tree_util.tree_flatten_with_path(compiled)[0]
        values = {jax.tree_util.keystr(path): np.asarray(leaf, float) for path, leaf in leaves}
        for field in mjx_engine.FIELDS:
            mine, theirs = fields[field][i], values[field]
            if field.startswith(".geom"):
                mine, theirs = mine[real], theirs[real]
            scale = np.abs(theirs).max() + 1e-12
            np.testing.assert_allclose(mine / scale, theirs / scale, atol=1e-6, err_msg=field)


def test_models_of_a_family_differ_in_nothing_but_these_fields():
    for name, family in RANDOM.items():
        worlds = drawn(name, 2)
        models = [
            scene.compile_row(family, worlds.solid, worlds.friction, preset(), i).physics
            for i in range(2)
        ]
        if family != "prism":  # whose meshes differ, and are not read
            mjx_engine.stack(models)


@pytest.mark.parametrize("name", list(RANDOM))
def test_mass_properties_are_those_that_mujoco_finds(name):
    """The solid has uniform density and a small load in it."""
    worlds = drawn(name, 6, seed=1)
    for i in range(6):
        row = jax.tree.map(lambda leaf, i=i: leaf[i], worlds.solid)
        share = np.linalg.norm(row.p_object_com) / (
            0.8 * _reach(row, np.arctan2(*row.p_object_com[1::-1]))
        )
        load = row.p_object_com / share
        spec = mujoco.MjSpec()
        body = spec.worldbody.add_body()
        body.add_geom(**_even(spec, row), mass=(1 - share) * row.mass)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-4] * 3, pos=load, mass=share * row.mass
        )
        model = spec.compile()
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[1])
        theirs = turn.reshape(3, 3) @ np.diag(model.body_inertia[1]) @ turn.reshape(3, 3).T
        axes = solid.axes(jax.tree.map(lambda leaf: leaf[None], row))[0]
        np.testing.assert_allclose(row.p_object_com, model.body_ipos[1], atol=1e-6)
        np.testing.assert_allclose(axes @ np.diag(row.inertia) @ axes.T, theirs, rtol=1e-4,
                                   atol=1e-4 * row.inertia.max())  # fmt: skip


def _reach(row, bearing):
    direction = np.array([[np.cos(bearing), np.sin(bearing)]])
    return solid.reach(row.vertices[None], row.radius[None], direction)[0]


def _even(spec, row):
    """Return the geom of a solid of uniform density."""
    half = row.height / 2
    if len(row.vertices) == 1:
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [row.radius, half, 0]}
    corners = np.unique(row.vertices, axis=0)
    points = [[*corner, z] for z in (-half, half) for corner in corners]
    spec.add_mesh(name="solid", uservert=np.ravel(points))
    return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "solid"}


def test_prisms_are_convex_of_three_to_eight_sides_and_centred():
    solids = drawn("random_prism", 300).solid
    sides = solid.corners(solids)
    assert set(sides) == set(range(3, 9))
    centre = solid.centred(solids.vertices)
    np.testing.assert_allclose(centre, solids.vertices, atol=1e-12)
    for vertices, count in zip(solids.vertices, sides, strict=True):
        corners = vertices[: int(count)]
        edge = np.roll(corners, -1, axis=0) - corners
        following = np.roll(edge, -1, axis=0)
        assert (edge[:, 0] * following[:, 1] - edge[:, 1] * following[:, 0] > 0).all()
    assert (solid.area(solids) > 0).all()


def test_a_square_prism_has_a_boxs_mass_properties():
    square = solid.rectangles(np.array([0.2]), np.array([0.3]))
    (height, mass, offset) = (np.array([x]) for x in (0.6, 12.0, 0.0))
    row = solid.build(square, np.zeros(1), height, mass, offset, offset)
    ixx, iyy, izz = 12 / 3 * (0.3**2 + 0.3**2), 12 / 3 * (0.2**2 + 0.3**2), 12 / 3 * 0.13
    axes = solid.axes(row)[0]
    moments = np.diag(axes @ np.diag(row.inertia[0]) @ axes.T)
    np.testing.assert_allclose(moments, [ixx, iyy, izz])
    padded = np.concatenate([square, np.repeat(square[:, -1:], 4, axis=1)], axis=1)
    assert solid.build(padded, np.zeros(1), height, mass, offset, offset).inertia == pytest.approx(
        row.inertia
    )


def test_a_load_moves_the_centre_of_mass_by_the_requested_share():
    worlds = drawn("random_prism", 50, com_offset=Range(0.3, 0.3))
    np.testing.assert_allclose(draws.table(worlds)["com_offset"][0], 0.3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": Range(-1, 3)}, "domain mass .low. = -1"),
        ({"mass": Range(5, 3)}, "mass = 5 to 3"),
        ({"mass": Range(math.nan, 3)}, "domain mass"),
        ({"friction_ground": Range(0, 1)}, "friction_ground"),
        ({"com_offset": Range(0, 0.9)}, "com_offset"),
        ({"distance": Range(0.1, 1)}, "distance"),
        ({"pose_latency": Range(0, 5)}, "pose_latency"),
        ({"objects": ("ball",)}, "unknown domain object 'ball'"),
        ({"objects": ()}, "name each once, at least one"),
        ({"skin": "fur"}, "unknown domain skin"),
    ],
)
def test_ranges_that_mean_nothing_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        Domain(**changes)


def test_a_domain_survives_json():
    for chosen in DOMAINS.values():
        text = json.dumps(dataclasses.asdict(chosen))
        assert domain.from_json(json.loads(text)) == chosen
    with pytest.raises(InputError, match=r"unknown domain quantity 'masss'.*did you mean 'mass'"):
        domain.from_json({"masss": [1, 2]})
    with pytest.raises(InputError, match="write low and high"):
        domain.from_json({"mass": "heavy"})
    assert domain.from_json({"mass": 3}).mass == Range(3, 3, log=True)
    assert domain.from_json({"mass": [3, 10]}).mass == Range(3, 10, log=True)  # as in `wide`
    assert domain.from_json({"mass": [3, 10, False]}).mass == Range(3, 10)


def test_undrawn_quantities_are_constant_and_not_labelled_as_drawn():
    assert not DOMAINS["wide"].idle
    assert {"mass", "com_offset", "friction_robot", "bearing", "noise"} < DOMAINS["paper"].idle
    assert not {"gap", "yaw", "pose_noise"} & DOMAINS["paper"].idle
    ideal = dataclasses.replace(DOMAINS["wide"], objects=("random_box",), skin="ideal")
    assert ideal.idle == {"noise", "gain_spread", "dead_share"}
    table = draws.table(draws.draw(ideal, 0, np.arange(9)))
    assert {name for name, (values, _) in table.items() if not values.any()} == ideal.idle


@pytest.mark.parametrize("mass", [(3, 10), 5.0, [3, 10, True]])
def test_a_quantity_that_is_no_range_is_refused(mass):
    with pytest.raises(InputError, match=r"domain mass = .* give a Range, as Range\(3, 10\)"):
        replace(DOMAINS["wide"], mass=mass)
