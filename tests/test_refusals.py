"""Values that a constructor refuses with an error that names the field."""

import math

import pytest
from helpers import ROOT, case, refusing

from rps_jax.app.cli import names
from rps_jax.control import registry
from rps_jax.control.laws import rps
from rps_jax.control.laws.rps import RPSParams, Temperatures
from rps_jax.record import options as record_options
from rps_jax.robot.robot import Robot, parse_robot
from rps_jax.robot.shell import Boards
from rps_jax.robot.skin import CapacitiveSkin, IdealSkin
from rps_jax.spec import specs_of
from rps_jax.trials.score import Objective
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules, Shift
from rps_jax.tuning.space import Space
from rps_jax.world import scene
from rps_jax.world.physics import Physics, preset

NAN, INF = math.nan, math.inf
BOARDS = Boards("front", 2, 0.05)


def each(**values):
    """Return a case for each field, whose name the error must have."""
    return [({name: value}, rf"\b{name}\b") for name, value in values.items()]


def all_fields(sensor):
    """Return cases in which each field of a sensor has each of three bad values."""
    names = [name for name in sensor._fields if name != "shell"]
    return [error for bad in (NAN, -0.01, INF) for error in each(**dict.fromkeys(names, bad))]


def then(method, build):
    """Return a function that builds a value and calls one of its methods."""
    return lambda **options: getattr(build(**options), method)()


# Bad fields and patterns of their errors, by the function that refuses them.
REFUSED = {
    lambda target=(0.7, 0.0), **changes: case(target, **changes): [
        ({"target": (NAN, 0.0)}, "target x"),
        ({"target": (0.1, 0.1)}, "outside the robot"),
        ({"name": "chair"}, "object"),
        *each(k=INF, v_max=-0.05, gap=-0.1, rear="left", bearing=NAN),
        ({"skin": CapacitiveSkin(noise=-1.0)}, "noise"),
        ({"robot": Robot(half_length=0.0)}, "half_length"),
        ({"shift": Shift(NAN)}, "shift time"),
        ({"shift": Shift(3.0, (0.0, INF))}, "shift y"),
    ],
    lambda **changes: Setting(rules=Rules(**changes)): each(horizon=0.0, max_lost=NAN),
    Setting: [
        *each(engine="ode", seed=-1),
        ({"physics": preset("paper_gazebo"), "engine": "quasistatic"}, "cone"),
    ],
    Physics: [
        *each(timestep=0.0, control_period=0.0, cone="square", impratio=-1.0, iterations=0),
        *(each(timestep=-0.01) + each(timestep=NAN)),
        ({"timestep": 0.005, "control_period": 0.012}, "control_period"),
        ({"timestep": 0.02, "control_period": 0.01}, "control_period"),
    ],
    scene.load: [
        ({"name": "sphere"}, "object"),
        ({"name": "box", "friction": scene.Friction(-0.1, 0.3)}, "friction ground"),
        ({"name": "box", "friction": scene.Friction(0.1, NAN)}, "friction robot"),
        ({"name": "box", "mass": -1.0}, "mass"),
        ({"name": "box", "rear": "left"}, "rear"),
    ],
    then("check", Robot): [
        *each(half_length=-0.3, bandwidth=0.0),
        ({"half_width": 5.0}, "robot half_width = 5.0 is not allowed: .* at most 2"),
        ({"boards": ()}, "robot boards = .* name at least one"),
        ({"boards": (Boards("back", 2),)}, "unknown robot boards' side 'back'"),
        ({"boards": (Boards("front", 0),)}, "robot boards' count = 0 is not allowed"),
        ({"boards": (Boards("front", 5, 0.05),)}, "front side = .*: they leave the base"),
        ({"boards": (Boards("front", 2, 0.05, 0.2),)}, "= 0.34 to 0.64 m .* ends at 0.58"),
        ({"boards": (BOARDS, Boards("front", 2, 0.05, 0.1))}, "overlap the previous row"),
        ({"boards": (Boards("front", 2), BOARDS)}, "overlap the previous row"),
        ({"boards": (Boards("right", 2), BOARDS)}, "in the order left, front, right"),
        ({"boards": (Boards("front", 2, middle=0.1),)}, "without a pitch"),
        ({"v_max": (1.0, 0.0)}, "robot v_max = 0.0 is not allowed"),
        ({"v_max": (1.0, 0.5, 0.2)}, "give one number, or two"),
    ],
    lambda **values: parse_robot(values): [
        *each(force_max=-1, lag=NAN, mass=0, slip=0.95, slip_sideways=-0.1, slip_yaw=1.0),
        *each(slip=[0.1, 0.2, 0.3], slip_yaw="0.1:0.4", mass=[100.0], half_length=[0.3, 0.4]),
        ({"acceleration_max": [0.5]}, "give two numbers"),
        ({"force_max": 20, "resistance": 0.05}, "rolling resistance takes 64 N"),
        ({"speed": 1}, "unknown robot quantity 'speed'"),
    ],
    then("check", IdealSkin): [
        *all_fields(IdealSkin),
        *each(tolerance=-1.0),
    ],
    then("check", CapacitiveSkin): [
        *all_fields(CapacitiveSkin),
        *each(foam=0.0, time_constant=0.0, max_compression=1.0, dead_share=1.1, temperature=0.0),
    ],
    lambda **changes: registry.smooth_law(rps.LAW, Temperatures(**changes)): [
        ({name: bad}, f"temperature {name} = ")
        for name in Temperatures._fields
        for bad in (0.0, -0.01, NAN, INF, "warm")
    ],
    Space: [
        *(({"names": names}, "tuned") for names in ((), ("L", "L"), ("mass",), ("v_max",))),
        ({"names": ("gamma_max",), "base": RPSParams(gamma_max=INF)}, "gamma_max"),
    ],
    Objective: each(time=-1.0, miss=NAN),
}


@pytest.mark.parametrize(
    ("build", "options", "message"),
    [(build, *refused) for build, cases in REFUSED.items() for refused in cases],
)
def test_a_bad_value_is_refused_with_its_field(build, options, message):
    with refusing(message):
        build(**options)


COMMANDS = [*names.known()]
COMMANDS += [str(x) for x in (ROOT / "sweeps").rglob("*.py") if "= call_of(" in x.read_text()]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_number_beyond_the_limits_of_an_option_is_refused(name):
    kind = names.question_type(name)
    for field, spec in specs_of(kind).items():
        for bad in (spec.low - 1, spec.high + 1, NAN):
            if not math.isinf(bad):
                value = int(bad) if bad == bad // 1 else bad
                with refusing(rf"\b{field}.* = {value}"):
                    record_options.check_fields(kind(**{field: value}))
