"""Tests of the examples, and of the laws and objects that they register."""

import re
import runpy
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    observation,
    refusal,
    refusals,
    refusing,
    rps,
    same,
    setting_of,
)
from numpy.testing import assert_allclose
from staging import recompiled

import rps_jax
from rps_jax import engines
from rps_jax.control import registry
from rps_jax.control.base import Bound, Law
from rps_jax.control.laws import rps as rps_law
from rps_jax.control.laws.rps import RPSParams, RPSState, step
from rps_jax.control.learned import policy
from rps_jax.control.observation import Details, Twist
from rps_jax.control.registry import register_law
from rps_jax.geometry.footprint import Footprint, circle, polygon, rectangle
from rps_jax.record import files
from rps_jax.robot.robot import parse_robot
from rps_jax.robot.skin import CapacitiveSkin
from rps_jax.runs.plan import Plan, load_plan, open_run, scene_of
from rps_jax.runs.push import Push
from rps_jax.studies.table import Table
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.tuning.space import Space
from rps_jax.world import draws, objects, scene
from rps_jax.world.domain import Domain, Range, from_json, parse_domain, to_json
from rps_jax.world.scene import FRICTION, Friction, WorldInputs
from sweeps.speed import robot as on_a_robot

EXAMPLES = Path(__file__).parents[1] / "notebooks" / "examples"
BOX = objects.mjcf_folder() / "box.xml"


def example(name):
    """Return the names that an example defines."""
    return runpy.run_path(str(EXAMPLES / f"{name}.py"))


pytestmark = pytest.mark.usefixtures("registries")


# --- custom objects ----------------------------------------------------------------------


def test_a_custom_hexagon_is_pushed(capsys):
    # C MuJoCo compiles least; the other engines are compared below.
    outcome = example("custom_object")["main"](horizon=8.0, engine="mujoco").squeeze()
    assert "[0 0]" in capsys.readouterr().out
    # The base touches within 2 s, at 1 cm/s, and then pushes at 5 cm/s.
    assert outcome.min_distance[0] < 1.3
    assert outcome.object_pose.sel(target=0, pose="x") > 0.3625 + 0.02 + 0.1732 + 0.1


@pytest.fixture
def hexagon(tmp_path):
    names, path = example("custom_object"), tmp_path / "hexagon.xml"
    path.write_text(names["MJCF"])
    objects.register_object("hexagon", path, names["OUTLINE"])
    return scene.load("hexagon")


def test_a_hexagon_has_the_mass_of_its_geoms_and_its_registered_outline(hexagon):
    body = hexagon.physics.body("object")
    assert body.mass[0] == pytest.approx(12.0)
    # Three boxes of 4 kg about one axis.
    assert body.inertia[2] == pytest.approx(12 * (0.3464**2 + 0.2**2) / 12, rel=1e-4)
    assert hexagon.family == "prism"
    assert float(jnp.linalg.norm(hexagon.footprint.vertices, axis=1).max()) == pytest.approx(0.2)
    assert 2 * body.pos[2] == pytest.approx(0.5)
    assert hexagon.model.ngeom > hexagon.physics.ngeom  # with visual geoms
    heavy = scene.load("hexagon", mass=24.0).physics.body("object")
    assert_allclose(heavy.inertia, 2 * body.inertia, rtol=1e-6)


def test_all_engines_have_an_equal_hexagon(hexagon):
    solids, friction = scene.solid_of(hexagon), Friction(np.array([0.3]), np.array([0.35]))
    physics = Setting(engine="mjx").physics
    for engine in ("fused", "mjx"):
        alone = recompiled(engine, [hexagon])
        _, drawn = engines.get(engine).stage(WorldInputs("prism", solids, friction, physics))
        if engine == "mjx":
            assert set(alone) == set(drawn)
        same(alone, drawn, rtol=3e-6, atol=3e-6)


@pytest.mark.parametrize("name", ["box", "cylinder"])
def test_a_registered_object_of_the_paper_gives_an_equal_world(name):
    """Both can share a batch."""
    objects.register_object("mine", objects.mjcf_folder() / f"{name}.xml")
    cases = [Case(n, FRICTION["S2"], (2.0, 1.0), mass=m) for n in (name, "mine") for m in (None, 9)]
    for engine in ("fused", "mjx"):
        worlds = pushes.build(cases, Setting(engine=engine)).worlds
        for leaf in jax.tree.leaves(worlds._replace(key=None, shift=None)):
            leaf = np.asarray(leaf)
            assert_allclose(leaf[:2], leaf[2:], rtol=1e-6, atol=1e-6)


def test_a_custom_object_can_be_in_a_domain(hexagon):
    """Its mass and outline are those of all worlds, and a replay shows its visual geoms."""
    assert Case("hexagon", FRICTION["S1"], (2.0, 0.0)).title.startswith("hexagon, ")
    domain = Domain(objects=("hexagon",), friction_robot=Range(0.4, 0.5))
    drawn = draws.draw(domain, 0, np.arange(5))
    assert (drawn.solid.mass == 12.0).all()
    part = drawn_worlds(domain, drawn, Setting(engine="fused"))
    assert part.worlds.footprint.vertices.shape == (5, 8, 2)
    plan = Plan(domain, 5, {"rps": RPSParams.paper()})
    assert scene_of(plan, 3).model.ngeom == hexagon.model.ngeom


# Patterns in the file of the box and their replacements, by the message.
INNER = '<geom size="0.1" mass="1"/></body></body>'
BAD_FILES = {
    "MuJoCo cannot compile .*mine.xml": ("</body>", "<wheel/></body>"),
    "lacks the body 'base': include base.xml": (
        '<include[^>]*>|class="object"|<contact>.*</contact>',
        "",
    ),
    "lacks the joint 'object'": ("<freejoint[^>]*>", "<freejoint/>"),
    "lacks the geom 'object'": ('(?<=<geom) name="object"|<contact>.*</contact>', ""),
    "joints .* no other body a joint": ("</body>", f"<body><joint/>{INNER}"),
    "no other body within it": ("</body>", f"<body>{INNER}"),
    "0 to 0.8 m is .* in the middle of its height": ("<geom", '<geom pos="0 0 0.4"'),
    "height = 0.02": ('(?<= size=)"[^"]*"', '"0.2 0.2 0.01"'),
    "footprint = None is not allowed": ("<geom", '<geom euler="0 0 1"'),
}


@pytest.mark.parametrize("message", BAD_FILES)
def test_an_invalid_object_file_is_rejected_with_the_reason(message, tmp_path):
    path = tmp_path / "mine.xml"
    path.write_text(re.sub(*BAD_FILES[message], BOX.read_text(), flags=re.DOTALL))
    with refusing(f"object 'mine': .*{message}"):
        objects.register_object("mine", path)
    assert "mine" not in objects.OBJECTS


LEG = '<geom class="object" type="box" size="0.1 0.3 0.4" pos="0.3 0.2 0"/></body>'
L_CORNERS = "-0.2 -0.2 0.2 -0.2 0.4 -0.1 0.4 0.5 0.2 0.5 -0.2 0.2"  # convex hull, about
CONCAVE = "-0.2 -0.2 0.2 -0.2 0.2 0.1 0.4 0.1 0.4 0.5 -0.2 0.5"
OUTLINES = {
    "geoms reach 0.36 m beyond the geom object, .* convex hull.*register_object": "",
    r"vertices = .* is not allowed: the outline must be strictly convex": CONCAVE,
    "numeric footprint = .* give a radius, or x and y": "0.1 0.2 0.3",
}


def l_shape(tmp_path, corners):
    """Write the file of an L-shaped object, with an outline if there are corners."""
    custom = f'<custom><numeric name="footprint" data="{corners}"/></custom>' if corners else ""
    text = BOX.read_text().replace("</body>", LEG, 1).replace("<worldbody>", f"{custom}<worldbody>")
    path = tmp_path / "l_shape.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("message", OUTLINES)
def test_a_concave_object_is_refused_with_the_way_to_give_an_outline(message, tmp_path, capsys):
    path = l_shape(tmp_path, OUTLINES[message])
    assert re.search(message, refusal(capsys, "push --engine quasistatic --object", path))


def test_an_object_file_has_the_outline_of_its_solid(tmp_path):
    assert objects.parse_object(str(l_shape(tmp_path, L_CORNERS))) == "l_shape"
    loaded = scene.load("l_shape")
    assert loaded.family == "prism"
    corners = np.unique(np.round(np.asarray(loaded.footprint.vertices), 6), axis=0)
    expected = np.array(L_CORNERS.split(), float).reshape(-1, 2)
    assert_allclose(corners, np.unique(expected, axis=0), atol=1e-6)
    with refusing(r"reach of the footprint = 0.7 m .* have the mass"):
        objects.parse_object(str(l_shape(tmp_path, "0.7").rename(tmp_path / "wide.xml")))
    text = (objects.mjcf_folder() / "cylinder.xml").read_text()
    custom = '<custom><numeric name="footprint" data="0.252"/></custom><worldbody>'
    (tmp_path / "round.xml").write_text(text.replace("<worldbody>", custom))
    assert objects.parse_object(str(tmp_path / "round.xml")) == "round"
    assert float(scene.load("round").footprint.radius) == pytest.approx(0.252)


def test_a_file_is_an_object_of_a_domain_also_in_another_process(tmp_path):
    path = tmp_path / "crate.xml"
    path.write_text(BOX.read_text())
    domain = parse_domain(f"wide,objects={path},yaw=0:0.1")
    assert domain.objects == ("crate",)
    record = to_json(domain)
    del objects.REGISTERED["crate"], objects.FAMILIES["crate"]
    assert from_json(record) == domain == Domain(objects=(str(path),), yaw=Range(0, 0.1))
    assert scene.load("crate").physics.body("object").mass[0] == 20.0
    with refusing(r"mass = 3 to 5 .* crate leave no mass to draw"):
        parse_domain(f"wide,objects={path},mass=3:5")
    with refusing("leave no mass to draw"):
        Domain(objects=("crate",), mass=Range(3, 5))
    assert parse_domain("paper,objects=random_box,mass=3:5").mass[:2] == (3, 5)


def test_a_run_is_refused_once_the_file_of_its_object_has_changed(tmp_path):
    path, run = tmp_path / "crate.xml", tmp_path / "run"

    def plan():
        for table in (objects.REGISTERED, objects.FAMILIES):  # as in another process
            table.pop("crate", None)
        return Plan(Domain((str(path),)), 1, {"rps": RPSParams()})

    path.write_text(BOX.read_text())
    open_run(run, plan())
    path.write_text(f"<!-- the same -->{BOX.read_text()}")
    assert load_plan(run) == plan()
    path.write_text(BOX.read_text().replace('mass="20"', 'mass="21"'))
    changed = r"solids.*crate.xml.mass = 20.0 there, 21.0 asked for"
    with refusing(f"another run .domain.{changed}"):
        open_run(run, plan())
    objects.REGISTERED.clear()
    with refusing(r"crate.xml.mass = 20.0 there, .* restore the files"):
        load_plan(run)
    for question in (Push(str(path)), Table(objects=[str(path)])):
        assert question.configuration()["solids"][str(path)]["mass"] == 21.0


class Ahead(NamedTuple):
    v: float = 0.05  # [m/s]
    d_success: float = 0.05  # [m]


NO_LAW = Law(lambda params: (), lambda *_: None)
SQUARE = [[0.1, 0.1], [-0.1, 0.1], [-0.1, -0.1], [0.1, -0.1]]


test_an_invalid_footprint_is_rejected = refusals(
    partial(objects.register_object, "mine", BOX),
    ((circle(-0.1),), "radius of the footprint = -0.1"),
    ((Footprint(jnp.array([[0.1, 0.0]]), jnp.array(0.2)),), "a circle about the origin"),
    ((Footprint(jnp.array(SQUARE), jnp.array(0.05)),), "with radius 0.05 m is not allowed"),
    ((Footprint(jnp.array(SQUARE[::-1]), jnp.array(0.0)),), "counter-clockwise"),
    ((SQUARE[::-1],), "counter-clockwise"),
    ((polygon(np.array(SQUARE) + 0.2),), "the origin must be inside"),
    ((polygon(0.2 * np.array([[np.cos(a), np.sin(a)] for a in np.arange(9) * 0.69])),), "3 to 8"),
    ((rectangle(5.0, 5.0),), "reach of the footprint"),
    (
        (SQUARE,),
        "footprint = 0.131 m is .* its geoms, .* reach 0.261 to 0.261 m",
    ),
    ((rectangle(0.205, 0.2),), "give both the same size, within 2%"),
)


test_invalid_objects_are_rejected = refusals(
    objects.register_object,
    (("box", BOX), "name of an object = box is not allowed"),
    (("prism", BOX), "name of an object = prism is not allowed"),
    (("mine", "nowhere.xml"), r"MuJoCo cannot compile .*nowhere.xml"),
)
test_invalid_laws_are_rejected = refusals(
    register_law,
    (("rps", rps_law.LAW, RPSParams()), "name of a law = rps is not allowed"),
    (("p", NO_LAW, Ahead(v=float("nan"))), "v = nan is not allowed"),
    (("p", replace(NO_LAW, bounds={"w": Bound(0, 1)}), Ahead()), "bound of law 'p' 'w': .* v,"),
    (("p", NO_LAW, (1.0, 2.0)), "a field or property d_success"),
    (("p", NO_LAW, RPSParams()), "the law 'rps' has a class of the same name RPSParams"),
)
test_params_of_no_law_are_rejected = refusals(
    Case,
    (("box", FRICTION["S1"], (2.0, 0.0), Ahead()), "params of class Ahead belong to no law"),
    (("box", FRICTION["S1"], (2.0, 0.0), RPSParams), r"the class RPSParams .*, as RPSParams\(\)"),
)


# --- custom laws ---------------------------------------------------------------------------


OBJECT = """<mujoco model="c"><include file="base.xml"/>{head}<worldbody><body name="object">
<freejoint name="object"/><geom name="object" class="object" type="box" size="0.2 0.3 0.25"
mass="12"{attribute}/></body>{world}</worldbody>{tail}</mujoco>"""


@pytest.mark.parametrize(
    ("place", "text", "message"),
    [
        ("world", '<geom type="box" size="1 0.1 0.1"/>', "geom of another body .* as a wall"),
        ("world", '<body pos="0 3 0"><geom size="0.1"/></body>', "a body"),
        ("tail", '<equality><joint joint1="base_x" joint2="base_y"/></equality>', "equality"),
        ("tail", '<actuator><motor joint="base_x"/></actuator>', "an actuator"),
        ("head", '<option wind="1 0 0"/>', "the option wind"),
        ("head", '<option timestep="0.002"/>', "the option timestep"),
        ("attribute", ' contype="1"', "collides by contype"),
    ],
)
def test_physics_of_an_object_file_that_no_trial_uses_is_refused(place, text, message, tmp_path):
    blank = dict.fromkeys(("head", "attribute", "world", "tail"), "")
    path = tmp_path / "crate.xml"
    path.write_text(OBJECT.format(**blank | {place: text}))
    with refusing(message):
        objects.register_object("crate", path)
    path.write_text(OBJECT.format(**blank | {"world": '<light name="l"/><site name="s"/>'}))
    objects.register_object("crate", path)


def test_a_custom_law_runs_in_the_same_worlds_as_rps(capsys):
    results = example("custom_law")["main"](worlds=1, horizon=3.0)
    assert "mine" in capsys.readouterr().out
    # Both have pushed by then, with different motions.
    moved = results.base_pose.sel(pose="x").values
    assert (moved > 0.01).all()
    assert not np.array_equal(moved[0], moved[1])


def test_a_custom_domain_draws_within_its_ranges(capsys):
    results = example("custom_domain")["main"](worlds=8, horizon=1.0)
    assert "tuned" in capsys.readouterr().out
    assert ((results.mass >= 30) & (results.mass <= 80)).all()
    assert set(results.object.values) == {"random_box"}


def test_a_custom_optimiser_needs_only_evaluate(capsys):
    names = example("custom_optimiser")
    best, tested = names["main"](worlds=1, generations=1, horizon=1.0)
    assert "K_h" in capsys.readouterr().out
    for value, (low, high) in zip(best, names["BOUNDS"].values(), strict=True):
        assert low <= value <= high
    assert dict(tested.success.sizes) == {"candidate": 2, "world": 8}


def test_the_command_line_accepts_registered_names(tmp_path, capsys, hexagon):
    example("custom_law")  # registers p_control
    out = tmp_path / "table"
    command = "table --objects hexagon --friction S1 --targets 2 0 --horizon 4 --engine mujoco"
    assert rps(f"{command} --laws p_control,v=0.02 --out", out) == 0
    assert "P_CONTROL" in capsys.readouterr().out
    results = files.read_results(out)
    assert results.object.values.tolist() == ["hexagon"]
    assert float(results.base_pose[0, 0, 0, 0, 0]) == pytest.approx(0.08, abs=0.002)
    assert "choose from v, gains.l" in refusal(capsys, f"{command} --laws p_control,w=1")


LAW = EXAMPLES / "custom_law.py"


def test_the_bounds_of_a_custom_law_are_a_mapping(registries):
    names = example("custom_law")
    law = Law(lambda params: (), names["step"], bounds={"v": Bound(0.01, 0.1)})
    register_law("p_control", law, names["PParams"]())
    candidates = Space(("v",), names["PParams"]()).params([[0.0]])
    setting = setting_of(1.0, "fused")
    results = rps_jax.evaluate(candidates, "wide,objects=box", 1, setting=setting)
    assert results.v.values == pytest.approx([0.055])


def test_a_run_detects_that_the_file_of_its_law_has_changed(tmp_path):
    law = tmp_path / "mine.py"
    law.write_text(LAW.read_text())
    _, params = registry.parse_law(f"{law}:PParams")
    stored = registry.params_to_json(params)
    assert registry.params_from_json(stored) == params
    law.write_text(LAW.read_text().replace("0.15, 0.15", "0.1, 0.1"))
    with refusing("has changed since the run"):
        registry.params_from_json(stored)


def test_a_file_is_run_again_if_another_law_has_taken_its_name():
    """The law without a file is stored without a file."""
    kinds = []
    for _ in range(2):
        _, params = registry.parse_law(f"{LAW}:PParams")
        kinds.append(type(params))
        in_a_notebook = example("custom_law")["PParams"]()  # registers p_control, too
        assert "file" not in registry.params_to_json(in_a_notebook)
    assert kinds[0] is not kinds[1]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        ("import nothing_of_this_name", "cannot be run"),
        ("x = 1", "must define the class PParams"),
        ("class PParams: pass", "call rps_jax.register_law"),
    ],
)
def test_a_file_without_a_law_is_rejected_in_one_sentence(content, message, tmp_path):
    law = tmp_path / "mine.py"
    _ = content is None or law.write_text(content)
    with refusing(message):
        registry.parse_law(f"{law}:PParams")


def test_a_plan_is_loaded_with_its_registered_law_and_nested_parameters(tmp_path):
    names = example("custom_law")
    weights = names["PParams"](gains=names["Gains"](np.ones((2, 3)), np.arange(2.0)))

    def step(params, state, obs):
        turn = jnp.sum(params.gains.l) + jnp.max(params.gains.heading)
        return state, Twist(params.v, 0.0, turn), Details.from_obs(obs)

    registry.register_law("p_control", Law(lambda params: (), step), weights)
    plan = Plan(Domain(), 3, {"p": weights._replace(v=0.03)})
    open_run(tmp_path, plan)
    params = load_plan(tmp_path).laws["p"]
    assert jax.tree.map(np.shape, params) == jax.tree.map(np.shape, weights)
    same(params, plan.laws["p"])
    registry.LAWS.pop("p_control")
    with refusing("unknown class of parameters 'PParams'"):
        load_plan(tmp_path)


def test_a_law_registered_again_replaces_the_old_one():
    """For example, if a notebook cell runs twice and defines its class of parameters again."""
    kinds = [example("custom_law")["PParams"] for _ in range(2)]
    assert kinds[0] not in registry._LAWS_BY_CLASS
    assert type(registry.LAWS["p_control"]) is kinds[1]
    registry.register_law("slow", rps_law.LAW, RPSParams(v_max=0.01))
    assert registry.law_of(registry.LAWS["slow"]) is rps_law.LAW


def test_details_of_an_observation_by_hand():
    obs = observation((0.0, 0.0), 0.0, (0.3, 0.1), True, (1.0, 1.0))
    details = Details.from_obs(obs)
    assert (details.l, details.distance) == pytest.approx((0.1, np.hypot(0.7, 0.9)))


# --- a policy and a robot ------------------------------------------------------------------


def test_a_policy_is_trained():
    names = example("train_policy")
    options = names["Options"](iterations=3, pairs=2, seconds=0.4)
    returns = names["main"](options)
    assert len(returns) == 3
    assert np.isfinite(returns).all()
    assert len(set(returns)) > 1


def test_the_law_runs_on_a_robot_without_compilation_in_the_loop(compiled, capsys):
    names = example("on_a_robot")
    tick, states = names["controller"](RPSParams.paper(), CapacitiveSkin())
    robot, target = names["Robot"](), np.array([-2.0, 0.0], np.float32)
    inputs = target, np.float32(0.001)
    states, twist = tick(states, *robot.read(), *inputs)
    assert compiled
    count = len(compiled)
    for _ in range(200):
        states, twist = tick(states, *robot.read(), *inputs)
        robot.command(np.asarray(twist))
    assert len(compiled) == count
    # Taxels 17 to 20, left of the centre, are in contact after the filter's delay.
    contact = [0.3625, 0.29 - 0.58 * (1.5 + 4.5) / 2 / 12]
    obs = observation((0.0, 0.0), 0.0, contact, True, target)
    _, expected = step(RPSParams.paper(), RPSState.init(RPSParams.paper()), obs)
    assert_allclose(states[1].p_robot_contact, contact, atol=1e-6)
    assert float(expected.v_y) > 0.01
    assert_allclose(np.asarray(twist)[:2], [expected.v_x, expected.v_y], atol=2e-3)
    latency = names["main"](names["Options"](seconds=0.3))
    assert latency.shape == (300,)
    assert on_a_robot.PRINTED.search(capsys.readouterr().out)


def test_skin_and_law_on_a_robot_observe_the_time_since_the_last_step(monkeypatch):
    names, commands = example("on_a_robot"), []
    module = names["controller"].__globals__

    def law(params, state, obs):
        return state, Twist(obs.period, 0.0, 0.0)

    monkeypatch.setitem(module, "step", law)
    tick, states = names["controller"](RPSParams.paper(), CapacitiveSkin())
    taxels, pose = names["Robot"]().read()
    for period in (0.001, 0.02):
        (skin, _), twist = tick(states, taxels, pose, np.zeros(2, np.float32), np.float32(period))
        assert float(twist[0]) == pytest.approx(period)
        share = 1 - np.exp(-period / CapacitiveSkin().time_constant)
        assert float(skin.signal[17]) == pytest.approx(0.6 * share, rel=1e-4)

    class SlowRobot(names["Robot"]):
        def command(self, twist):
            commands.append(float(twist[0]))
            time.sleep(0.01)  # late

    names["run"](SlowRobot(), np.zeros(2, np.float32), 0.02)
    assert commands[0] < 0.01
    assert min(commands[1:]) > 0.01


def test_the_name_of_a_file_is_not_offered_as_an_object(tmp_path):
    """Its file may have failed for another reason."""
    path = tmp_path / "crate.xml"
    path.write_text(BOX.read_text())
    objects.register_object("mine", path)
    with refusing("mass = -1"):
        Case(str(path), mass=-1.0)
    for call in (lambda: Case("crat"), lambda: parse_domain("wide,objects=crat")):
        with refusing(r"object 'crat': choose from .*mine, or give FILE") as e:
            call()
        assert "crate" not in str(e.value)
    assert Case("crate").object_name == "crate"


def test_suffixes_of_files_have_any_case(tmp_path, registries):
    (tmp_path / "crate.xml").write_text(BOX.read_text())
    (tmp_path / "CRATE.XML").write_text(BOX.read_text())
    names = (objects.parse_object(str(tmp_path / x)) for x in ("crate.xml", "CRATE.XML"))
    lower, upper = (objects.REGISTERED[name].solid for name in names)
    same(lower, upper)
    (tmp_path / "R.JSON").write_text('{"mass": 77.0}')
    assert parse_robot(str(tmp_path / "R.JSON")).mass == 77.0
    (tmp_path / "D.JSON").write_text('{"mass": [7.0, 8.0]}')
    assert parse_domain(str(tmp_path / "D.JSON")).mass[:2] == (7.0, 8.0)
    (tmp_path / "L.JSON").write_text('{"K_h": 0.25}')
    assert registry.parse_law(f"rps_tuned,{tmp_path}/L.JSON")[1].K_h == 0.25
    (tmp_path / "LAW.PY").write_text((EXAMPLES / "custom_law.py").read_text())
    (tmp_path / "P.NPZ").write_bytes(next(iter(policy.SHIPPED.values())).read_bytes())
    for text in ("LAW.PY", "LAW.PY:PParams", "P.NPZ"):
        _, params = registry.parse_law(f"{tmp_path}/{text}")
        same(registry.params_from_json(registry.params_to_json(params)), params)
