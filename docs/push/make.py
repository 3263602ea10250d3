"""Write the page on which one pushes oneself: python docs/push/make.py [FILE.html] [--record].

Law, skin, rules of a trial and the quasi-static engine are traced here from the package's own
functions, and printed as JavaScript by the emitter of `rps export js`. Written by hand are the
order of the three calls of a control step, the outlines that one may choose, and what is seen.
Beside it stands a push in C MuJoCo, to be looked at from all sides; `--record` records it anew.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import __version__
from rps_jax.control import registry, validation
from rps_jax.control.learned import features
from rps_jax.control.observation import TaxelObservation, Twist
from rps_jax.engines import quasistatic
from rps_jax.engines.base import ControlPeriod
from rps_jax.lowering import js
from rps_jax.lowering.routine import Group, Routine, fields_of, identifier, routine
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import NONE
from rps_jax.runs.push import push
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import scene
from rps_jax.world.scene import FRICTION

HERE = Path(__file__).parent
RECORDED = HERE / "recorded.json"
LAWS = {
    "rps": "RPS, the paper's",
    "rps_tuned": "RPS, tuned by evolution",
    "rps_plus": "RPS+",
    "learned_gru": "a network that learned from touch",
}
FAMILIES = {"cylinder": 1, "prism": 6}  # with how many corners; a box repeats two
ENDLESS = Rules(horizon=1e5, max_lost=1e5)
SETTING = Setting("quasistatic", rules=ENDLESS)
# Of the robot and the task, beside the law's own bounds: least, greatest.
TASK = {"v_max": (0.01, 0.1), "omega_max": (0.03, 0.5), "d_success": (0.02, 0.2)}
BY_HAND: dict[str, Any] = {"skin": None, "poses": None, "twists": None, "law_state": None}


class Arrival(NamedTuple):
    """What judging a trial needs of the law's parameters."""

    d_success: Any = 0.05  # [m]


class Outline(NamedTuple):
    """What is chosen of an object."""

    vertices: Any  # (N, 2) [m]
    radius: Any  # () [m]
    com_offset: Any  # () [1] of the way to the outline
    com_bearing: Any  # () [rad]


class Borne(NamedTuple):
    """What follows from it."""

    p_object_com: Any  # (2,) [m]
    arm: Any  # () [m] c = m_max / f_max


def borne(outline: Outline) -> Borne:
    """Centre of mass and arm of the ground's friction, as `geometry.solid` computes them."""
    at, radius = jnp.asarray(outline.vertices), outline.radius
    c, s = jnp.cos(outline.com_bearing), jnp.sin(outline.com_bearing)
    if at.shape[0] == 1:
        reach, share = radius, jnp.ones(3)
        lean = jnp.where(outline.com_offset > 0, jnp.arctan2(s, c), 0.0)
        feet = lean + jnp.array([0, 2, 4]) * jnp.pi / 3
        at = radius * jnp.stack([jnp.cos(feet), jnp.sin(feet)], axis=-1)
    else:
        edge = jnp.roll(at, -1, axis=0) - at
        outward = jnp.stack([edge[:, 1], -edge[:, 0]], axis=-1)
        pace = outward[:, 0] * c + outward[:, 1] * s
        away = jnp.sum(outward * at, axis=-1)
        reach = jnp.min(jnp.where(pace > 1e-12, away / jnp.where(pace > 0, pace, 1), jnp.inf))
        share = jnp.any(at != jnp.roll(at, 1, axis=0), axis=1) * 1.0
    com = outline.com_offset * reach * jnp.stack([c, s])
    x, y = (at - com).T
    load, bears = share, jnp.ones(share.shape)
    for _ in range(len(share)):
        w = bears * share
        h = [jnp.sum(w * one) for one in (jnp.ones_like(x), x, y, x * x, x * y, y * y)]
        p = quasistatic.solved((1.0, 0.0, 0.0), h)
        load = w * (p[0] + p[1] * x + p[2] * y)
        bears = bears * (load >= 0)
    return Borne(com, jnp.sum(load * jnp.sqrt(x * x + y * y)))


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), jnp.asarray(x).dtype), tree)


def world_of(family: str) -> tuple[Any, Any, Any]:
    """Stage, world and trial of a family, all of the paper's but the number of corners."""
    case = Case("cylinder" if family == "cylinder" else "box", "S1", (-2.0, 0.0))
    part = pushes.build([case], SETTING)
    world = jax.tree.map(lambda x: jnp.asarray(x[0]), part.worlds)
    corners = jnp.zeros((FAMILIES[family], 2))
    world = world._replace(
        footprint=world.footprint._replace(vertices=corners),
        fields=world.fields._replace(vertices=corners),
    )
    law = replace(registry.law_of(case.params), init=lambda _: ())
    return part.stage, world, trial.start(world, Arrival(), law)


def of_family(family: str) -> list[Routine]:
    """How an object of a family is borne, is sensed, and moves."""
    stage, world, start = world_of(family)
    physics, n = SETTING.physics, FAMILIES[family]
    own = {name: getattr(world, name) for name in ("skin", "odometry", "key", "qpos")}
    live = {**dict.fromkeys(own), "fields": None}
    blank = {name: getattr(start, name) for name in BY_HAND}

    def sense(world: Any, params: Any, told: Any) -> Any:
        full = world._replace(**own)
        told, seen = trial.observe(
            full, params, told._replace(**blank), physics=physics, rules=SETTING.rules
        )
        placed = trial.outline(full, told.qpos)
        touch = seen.observation._replace(in_contact=seen.reading.contact_type != NONE)
        taxels = features.taxel_observation(touch, seen.reading, full.skin, told.skin, placed)
        return told._replace(**BY_HAND), taxels, {"contact_type": seen.reading.contact_type}

    def drive(fields: Any, before: Any, told: Any, twist: Any) -> Any:
        # Noise is drawn by no one here, and its key is no number of JavaScript.
        unseen = blank | {"skin": start.skin._replace(key=jnp.zeros(2))}
        before, told = before._replace(**unseen), told._replace(**unseen)
        given = fields, trial.motion(told), ControlPeriod(twist, physics)
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], given)
        driven = jax.tree.map(lambda x: x[0], stage.drive(*batch))
        return (trial.settle(before, told, driven)._replace(**BY_HAND),)

    shape = _shapes(start._replace(**BY_HAND))
    twist = Twist(*(jnp.zeros(()),) * 3)
    outline = Outline(jnp.zeros((n, 2)), *(jnp.zeros(()),) * 3)
    seen = {"world": _shapes(world._replace(**live)), "params": _shapes(Arrival()), "trial": shape}
    driven = {"fields": _shapes(world.fields), "before": shape, "told": shape}
    return [
        routine(f"borne_{family}", lambda o: (borne(o),), {"outline": _shapes(outline)}, ["made"]),
        routine(f"sense_{family}", sense, seen, ["told", "observation", "reading"]),
        routine(f"drive_{family}", drive, {**driven, "twist": _shapes(twist)}, ["trial"]),
    ]


def of_law(name: str) -> tuple[list[Routine], dict[str, Any]]:
    """How a law begins and decides; and its parameters, with the bounds of those that can slide."""
    label, params = registry.resolve_law(name)
    law, kind = registry.law_of(params), type(params).__name__
    seen = validation.observation_shapes(law.senses)
    if isinstance(seen, TaxelObservation):
        count = Robot().shell.count
        seen = seen._replace(signal=jax.ShapeDtypeStruct((count,), np.float64))
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.float64), params)
    memory = jax.eval_shape(law.init, shapes)
    given = {"params": shapes, "memory": memory, "observation": seen}

    def step(*arguments: Any) -> Any:
        memory, twist, details = law.step(*arguments)
        return memory, Twist(*twist), details

    routines = [
        routine(f"init_{kind}", lambda p: (law.init(p),), {"params": shapes}, ["memory"]),
        routine(f"step_{kind}", step, given, ["memory", "twist", "details"]),
    ]
    fields: Group = fields_of(params, values=params)
    values = {one.name: np.asarray(one.value, float).tolist() for one in fields}
    bounds = dict(law.bounds)
    sliders = {}
    for one in fields:
        last = one.name.removeprefix("law_")
        if last in TASK:
            sliders[one.name] = [*TASK[last], False, one.about]
    for field, bound in bounds.items():
        scale = bounds[bound.of].high if bound.of else 1.0
        about = next(one.about for one in fields if one.name == identifier(field))
        sliders[identifier(field)] = [bound.low * scale, bound.high * scale, bound.log, about]
    told = {"title": LAWS[name], "kind": kind, "params": values, "sliders": sliders}
    return routines, {label: told}


def scripts() -> str:
    """All that is generated: functions, laws and the numbers of the paper's first trial."""
    with jax.enable_x64(True):
        tables: dict[str, str] = {}
        routines, laws = {}, {}
        for family in FAMILIES:
            routines |= {one.name: one for one in of_family(family)}
        for name in LAWS:
            own, told = of_law(name)
            routines |= {one.name: one for one in own}
            laws |= told
        functions = [js.function(name, one, tables) for name, one in routines.items()]
        start = world_of("prism")[2]._replace(**BY_HAND)
    group = fields_of(start, values=start)
    blank = {one.name: np.asarray(one.value).tolist() for one in group}
    base = Robot().shell
    taxels = np.asarray(base.taxels(2)).tolist()  # two points of each, a quarter from its ends
    numbers = {
        "VERSION": __version__,
        "LAWS": laws,
        "START": blank,
        "PERIOD": SETTING.physics.control_period,
        "BASE": [float(x) for x in base.half],
        "TAXELS": taxels,
        "FRICTION": {name: list(one) for name, one in FRICTION.items()},
        "GAP": Case().gap,
        "RECORDED": json.loads(RECORDED.read_text("utf-8")),
    }
    told = [f"const {name} = {js.text_of(value)};" for name, value in numbers.items()]
    return "\n".join([*told, js.HELPERS, *tables.values(), *functions])


def recorded(every: int = 3) -> dict[str, Any]:
    """The paper's push to (-2, 0) in C MuJoCo: places of base and object, and their sizes [m]."""
    trace = push("box", target=(-2.0, 0.0)).data
    model = scene.load("box").model
    boxes = {
        name: {"half": model.geom_size[i].tolist(), "at": model.geom_pos[i].tolist()}
        for name in ("base", "object")
        for i in [model.geom(name).id]
    }
    qpos = np.round(trace.qpos.values[::every].astype(float), 3)
    period = float(trace.time[every] - trace.time[0])
    target = trace.p_world_target.values.tolist()
    return {"period": round(period, 4), "target": target, "boxes": boxes, "qpos": qpos.tolist()}


def page() -> str:
    """The whole page."""
    return (HERE / "page.html").read_text("utf-8").replace("/* GENERATED */", scripts())


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word != "--record"]
    if "--record" in sys.argv:
        RECORDED.write_text(json.dumps(recorded(), separators=(",", ":")) + "\n", "utf-8")
    path = Path(words[0] if words else "push.html")
    path.write_text(page(), "utf-8")
    sys.stdout.write(f"{path}: {path.stat().st_size / 1e6:.2f} MB\n")
