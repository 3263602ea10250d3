"""Write the page with an interactive push, and open it: python docs/push/make.py --open.

The laws, the skin, the rules of a trial and the quasi-static engine are traced from the functions
of the package, and emitted as JavaScript as by `rps export js`. The order of the three calls of a
control step, the outlines and the drawing are written by hand. The page also shows a push in C
MuJoCo in 3-D; `--record` records it again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import webbrowser
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import __version__
from rps_jax.control import registry, validation
from rps_jax.control.learned import features
from rps_jax.control.observation import Twist, with_base
from rps_jax.engines import quasistatic
from rps_jax.engines.base import ControlPeriod
from rps_jax.geometry.polyline import Polyline
from rps_jax.lowering import js
from rps_jax.lowering.builder import GraphBuilder
from rps_jax.lowering.graph import Array, Gather, Node
from rps_jax.lowering.js import JsWriter
from rps_jax.lowering.routine import Group, Routine, fields_of, identifier, routine
from rps_jax.lowering.scalar import ScalarBuilder
from rps_jax.robot.robot import Robot
from rps_jax.robot.skin import NONE
from rps_jax.runs.push import push
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import draws, quantity, scene, tasks
from rps_jax.world.scene import FRICTION
from rps_jax.world.tasks import corridor, path, reach
from rps_jax.world.tasks.base import CourseInputs
from rps_jax.world.tasks.corridor import CorridorCourse
from rps_jax.world.tasks.pose import PoseCourse

HERE = Path(__file__).parent
RECORDED = HERE / "recorded.json"
SITE = HERE.parents[1] / "site"
# Bases with their titles and texts, and their laws with titles.
BASES = {
    "omni": ("omnidirectional", "ideal"),
    "differential": ("differential", "ideal,drive=differential,axle=0.15"),
    "car": ("car", "ideal,drive=car,axle=0.15,turning_radius=0.5"),
}
LAWS = {
    "omni": {
        "rps": "RPS, the paper's",
        "rps_tuned": "RPS, tuned by evolution",
        "rps_plus": "RPS+",
        "learned": "a network that learned from touch",
        "pose": "deliver to a pose",
    },
    "differential": {"unicycle": "push and reposition", "pose_drive": "deliver to a pose"},
    "car": {"unicycle_car": "push and reposition, for cars"},
}
NUM_CORNERS = {"cylinder": 1, "prism": 6}  # by family; a box repeats two corners
# Tasks of the page, with their names in words.
TASKS = {
    "reach": "reach the target",
    "path": "follow a path",
    "corridor": "follow a corridor",
    "pose": "reach the target with a heading",
}
TOLERANCES = tasks.TASKS["pose"].d_success, tasks.TASKS["pose"].yaw_success
NUM_VERTICES = 17  # of each path on the page
ENDLESS = Rules(horizon=1e5, max_lost=1e5)
SETTING = Setting("quasistatic", rules=ENDLESS)
# Bounds of parameters of the robot and the task, for which a law has none.
TASK = {
    "v_max": (0.01, 0.1),
    "omega_max": (0.03, 0.5),
    "d_success": (0.02, 0.2),
    "v_free": (0.05, 0.3),
    "omega_free": (0.1, 1.0),
}
UNTRACED: dict[str, Any] = {
    "skin": None,
    "poses": None,
    "twists": None,
    "law_state": None,
    "task": None,
}


class Arrival(NamedTuple):
    """The law parameter that the rules of a trial need."""

    d_success: Any = 0.05  # [m]


class Route(NamedTuple):
    """Path, corridor and heading, as users choose them."""

    vertices: Any  # (NUM_VERTICES, 2) [m]; the last may be repeated, and is the goal
    lookahead: Any  # () [m]
    width: Any  # () [m]
    door: Any  # () [1] width of the door, of the corridor's
    heading: Any  # () [rad] of the goal


ROUTE = Route(np.linspace((0.4, 0.0), (5.0, 0.0), NUM_VERTICES), *np.array([1.0, 1.6, 1.0, 0.0]))


class Outline(NamedTuple):
    """Outline and load of an object, as users choose them."""

    vertices: Any  # (N, 2) [m]
    radius: Any  # () [m]
    com_offset: Any  # () [1] relative to the distance of the outline
    com_bearing: Any  # () [rad]


class Support(NamedTuple):
    """Centre of mass and ground friction of an object."""

    p_object_com: Any  # (2,) [m]
    arm: Any  # () [m] c = m_max / f_max


def support(outline: Outline) -> Support:
    """Return centre of mass and arm of the ground friction, as `geometry.solid` does."""
    corners, radius = jnp.asarray(outline.vertices), outline.radius
    c, s = jnp.cos(outline.com_bearing), jnp.sin(outline.com_bearing)
    if corners.shape[0] == 1:
        reach, share = radius, jnp.ones(3)
        lean = jnp.where(outline.com_offset > 0, jnp.arctan2(s, c), 0.0)
        feet = lean + jnp.array([0, 2, 4]) * jnp.pi / 3
        corners = radius * jnp.stack([jnp.cos(feet), jnp.sin(feet)], axis=-1)
    else:
        edge = jnp.roll(corners, -1, axis=0) - corners
        outward = jnp.stack([edge[:, 1], -edge[:, 0]], axis=-1)
        pace = outward[:, 0] * c + outward[:, 1] * s
        away = jnp.sum(outward * corners, axis=-1)
        reach = jnp.min(jnp.where(pace > 1e-12, away / jnp.where(pace > 0, pace, 1), jnp.inf))
        share = jnp.any(corners != jnp.roll(corners, 1, axis=0), axis=1) * 1.0
    com = outline.com_offset * reach * jnp.stack([c, s])
    x, y = (corners - com).T
    load, bears = share, jnp.ones(share.shape)
    for _ in range(len(share)):
        w = bears * share
        h = [jnp.sum(w * term) for term in (jnp.ones_like(x), x, y, x * x, x * y, y * y)]
        p = quasistatic.solved((1.0, 0.0, 0.0), h)
        load = w * (p[0] + p[1] * x + p[2] * y)
        bears = bears * (load >= 0)
    return Support(com, jnp.sum(load * jnp.sqrt(x * x + y * y)))


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), jnp.asarray(x).dtype), tree)


def course(kind: str, route: Route) -> Any:
    """Return the course of a task along a route."""
    line = Polyline.through(route.vertices[None])
    follow = path.PathCourse(line, jnp.reshape(route.lookahead, 1))
    half = jnp.reshape(route.width, 1) / 2
    courses = {
        "reach": lambda: reach.Nothing(),
        "path": lambda: follow,
        "corridor": lambda: CorridorCourse.around(follow, half, half * route.door, 1),
        "pose": lambda: PoseCourse(
            route.vertices[None, -1], *(jnp.reshape(x, 1) for x in (route.heading, *TOLERANCES))
        ),
    }
    return jax.tree.map(lambda x: x[0], courses[kind]())


def task_routines(kind: str) -> list[Routine]:
    """Return the routines for course and outcomes of a task, and for the room of its corners."""
    shapes = _shapes(ROUTE)
    progress = _shapes(course(kind, ROUTE).start())

    def spare(route: Route) -> Any:
        return ({"length": corridor.spare(route.vertices[None], route.width / 2)[0]},)

    return [
        routine("spare", spare, {"route": shapes}, ["spare"]),
        routine(f"course_{kind}", lambda r: (course(kind, r),), {"route": shapes}, ["course"]),
        routine(
            f"outcomes_{kind}", lambda p: (p.outcomes(),), {"progress": progress}, ["outcomes"]
        ),
    ]


def world_of(family: str) -> tuple[Any, Any, Any]:
    """Return stage, world and trial of a family: the paper's, but for the number of corners."""
    case = Case("cylinder" if family == "cylinder" else "box", "S1", (-2.0, 0.0))
    part = pushes.build([case], SETTING)
    world = jax.tree.map(lambda x: jnp.asarray(x[0]), part.worlds)
    corners = jnp.zeros((NUM_CORNERS[family], 2))
    world = world._replace(
        footprint=world.footprint._replace(vertices=corners),
        fields=world.fields._replace(vertices=corners),
    )
    law = replace(registry.law_of(case.params), init=lambda _: ())
    return part.stage, world, trial.start(world, Arrival(), law)


def family_routines(family: str) -> list[Routine]:
    """Return the routines for support, sensing and motion of an object of a family."""
    stage, world, start = world_of(family)
    physics, n = SETTING.physics, NUM_CORNERS[family]
    constants = {name: getattr(world, name) for name in ("skin", "odometry", "key", "qpos")}
    live = {**dict.fromkeys(constants), "fields": None, "task": None}
    blank = {name: getattr(start, name) for name in UNTRACED}

    def sense(world: Any, params: Any, state: Any, course: Any, progress: Any, *memory: Any) -> Any:
        """Sense, and judge a law that declares that it is done by its `memory`."""
        full = world._replace(**constants, task=course)
        loop, sense, done = trial.ControlLoop(physics, SETTING.rules), "taxels", {}
        if memory:
            loop = replace(loop, law=replace(loop.law, is_done=lambda state: state))
            sense, done = "ends", {"law_state": memory[0]["done"]}
        state = state._replace(**blank | done | {"task": progress})
        state, sensing = trial.observe(full, params, state, loop)
        outline = trial.outline(full, state.qpos)
        touch = sensing.observation._replace(in_contact=sensing.reading.contact_type != NONE)
        skin = full.skin, state.skin, outline
        observation = features.OBSERVATIONS[sense](touch, sensing.reading, *skin)
        contact = {"contact_type": sensing.reading.contact_type}
        return state._replace(**UNTRACED), observation, contact, state.task

    def drive(fields: Any, previous: Any, state: Any, twist: Any) -> Any:
        # Without noise the key is unused; JavaScript has no number for it.
        untraced = blank | {"skin": start.skin._replace(key=jnp.zeros(2))}
        previous, state = previous._replace(**untraced), state._replace(**untraced)
        arguments = fields, trial.motion(state), ControlPeriod(twist, physics)
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], arguments)
        driven = jax.tree.map(lambda x: x[0], stage.drive(*batch))
        return (trial.settle(world, previous, state, driven)._replace(**UNTRACED),)

    shape = _shapes(start._replace(**UNTRACED))
    twist = Twist(*(jnp.zeros(()),) * 3)
    outline = Outline(jnp.zeros((n, 2)), *(jnp.zeros(()),) * 3)
    sense_shapes = {
        "world": _shapes(world._replace(**live)),
        "params": _shapes(Arrival()),
        "trial": shape,
    }
    courses = {kind: course(kind, ROUTE) for kind in TASKS}
    drive_shapes = {"fields": _shapes(world.fields), "previous": shape, "state": shape}
    return [
        routine(
            f"support_{family}", lambda o: (support(o),), {"outline": _shapes(outline)}, ["support"]
        ),
        *(
            routine(
                f"sense_{family}_{kind}",
                sense,
                {
                    **sense_shapes,
                    "course": _shapes(item),
                    "progress": _shapes(item.start()),
                    **({"memory": {"done": _shapes(False)}} if kind == "pose" else {}),
                },
                ["sensed", "observation", "reading", "progress"],
            )
            for kind, item in courses.items()
        ),
        routine(f"drive_{family}", drive, {**drive_shapes, "twist": _shapes(twist)}, ["trial"]),
    ]


def law_routines(base: str, name: str, title: str) -> tuple[list[Routine], dict[str, Any]]:
    """Return the routines `init` and `step` of a law on a base, and its parameters with bounds."""
    label, params = registry.resolve_law(name)
    law, kind = registry.law_of(params), f"{type(params).__name__}_{base}"
    robot = Robot.parse(BASES[base][1])
    observation = validation.observation_shapes(law.senses, Robot().shell.count, law.heading)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x), np.float64), params)
    memory = jax.eval_shape(law.init, shapes)
    arguments = {"params": shapes, "memory": memory, "observation": observation}

    def step(params: Any, memory: Any, observation: Any) -> Any:
        memory, twist, details = law.step(params, memory, with_base(observation, None, robot))
        return memory, Twist(*twist), details

    routines = [
        routine(f"init_{kind}", lambda p: (law.init(p),), {"params": shapes}, ["memory"]),
        routine(f"step_{kind}", step, arguments, ["memory", "twist", "details"]),
    ]
    fields: Group = fields_of(params, values=params)
    values = {field.name: np.asarray(field.value, float).tolist() for field in fields}
    bounds = dict(law.bounds)
    sliders = {}
    for field in fields:
        last = field.name.removeprefix("law_")
        if last in TASK:
            sliders[field.name] = [*TASK[last], False, field.about]
    for parameter, bound in bounds.items():
        name_in_js = identifier(parameter)
        scale = bounds[bound.relative_to].high if bound.relative_to else 1.0
        about = next(field.about for field in fields if field.name == name_in_js)
        sliders[name_in_js] = [bound.low * scale, bound.high * scale, bound.log, about]
    description = {"title": title, "base": base, "kind": kind, "heading": law.heading}
    description |= {"room": law.room, "params": values, "sliders": sliders}
    return routines, {label: description}


def values_of(tree: Any) -> dict[str, Any]:
    """Return the numbers of a pytree by their names on the page."""
    return {x.name: np.asarray(x.value).tolist() for x in fields_of(tree, values=tree)}


def routes(count: int = 6) -> list[list[list[float]]]:
    """Return the vertices of paths that the package draws."""
    u = draws.numbers(0, np.arange(count))
    front = np.full(count, float(Robot().half_length))
    vertices = path.Path().vertices(CourseInputs(u, np.zeros((count, 2)), front)).round(3)
    return [[p for p, q in zip(x, [None, *x], strict=False) if p != q] for x in vertices.tolist()]


# --- JavaScript ----------------------------------------------------------------------------

_LISTED = 12  # elements of an array that is printed as a list, at most


class _LoopBuilder(ScalarBuilder):
    """Target whose loops may run until a condition fails: a page has no deadline."""

    loops = GraphBuilder.loops


class PageWriter(JsWriter):
    """Printer of a routine of a page."""

    builder = _LoopBuilder
    leave = "if (!goes) break;"

    def single(self, node: Node) -> list[str]:
        """Return the statements of a node; many numbers of one array are picked by a table."""
        views = [a for a in node.operands if isinstance(a, Array)]
        sources, is_gather = {view.node for view in views}, isinstance(node.op, Gather)
        if not is_gather or not _LISTED < node.size == len(views) or len(sources) > 1:
            return super().single(node)
        first = min(view.first for view in views)
        table = self.table(np.array([view.first - first for view in views]))
        item = self.item(views[0].node, f"k + {first}" if first else "k")
        return [f"const {node.name} = {table}.map((k) => {item});"]


def function(name: str, routine: Routine, tables: dict[str, str]) -> str:
    """Return a routine of a page as a function of its groups of fields."""
    groups = {group: f"{group}." for group in routine.inputs}
    lines = js.statements(routine, groups, tables, PageWriter)
    results = ", ".join(
        f"{group}: {js.object_of(group, routine.outputs)}" for group in routine.outputs
    )
    head = f"function {name}({', '.join(routine.inputs)}) {{"
    return f"{head}\n{lines}\n  return {{ {results} }};\n}}\n"


def scripts() -> str:
    """Return the generated JavaScript: functions, laws and constants of the first trial."""
    with jax.enable_x64(True):
        tables: dict[str, str] = {}
        routines, laws = {}, {}
        for family in NUM_CORNERS:
            routines |= {item.name: item for item in family_routines(family)}
        for kind in TASKS:
            routines |= {item.name: item for item in task_routines(kind)}
        for base, names in LAWS.items():
            for name, title in names.items():
                of_law, description = law_routines(base, name, title)
                routines |= {item.name: item for item in of_law}
                laws |= description
        functions = [function(name, item, tables) for name, item in routines.items()]
        start = world_of("prism")[2]._replace(**UNTRACED)
    shell = Robot().shell
    taxels = np.asarray(shell.taxels(2)).tolist()  # two points of each, a quarter from its ends
    constants = {
        "VERSION": __version__,
        "LAWS": laws,
        "START": values_of(start),
        "PERIOD": SETTING.physics.control_period,
        "BASE": [float(x) for x in shell.half],
        "BASES": {
            name: {
                "title": title,
                "robot": text,
                "axle": robot.axle,
                "half_track": float(robot.half_track),
            }
            for name, (title, text) in BASES.items()
            for robot in [Robot.parse(text)]
        },
        "TAXELS": taxels,
        "FRICTION": {name: list(friction) for name, friction in FRICTION.items()},
        "GAP": Case().gap,
        "TASKS": {
            kind: {
                "title": title,
                "lookahead": getattr(tasks.TASKS[kind], "lookahead", path.Path.lookahead).low,
                "start": values_of(course(kind, ROUTE).start()),
            }
            for kind, title in TASKS.items()
        },
        "ROUTES": routes(),
        "NUM_VERTICES": NUM_VERTICES,
        "NEAR": path.NEAR,
        "SHORTEST": quantity.declared(path.Path)["length"].low,
        "RECORDED": json.loads(RECORDED.read_text("utf-8")),
    }
    lines = [f"const {name} = {json.dumps(value)};" for name, value in constants.items()]
    return "\n".join([*lines, js.HELPERS, *tables.values(), *functions])


def record(stride: int = 3) -> dict[str, Any]:
    """Return the qpos of the paper's push to (-2, 0) in C MuJoCo, and the sizes of its boxes."""
    trace = push("box", target=(-2.0, 0.0)).data
    model = scene.load("box").model
    boxes = {
        name: {"half": model.geom_size[i].tolist(), "at": model.geom_pos[i].tolist()}
        for name in ("base", "object")
        for i in [model.geom(name).id]
    }
    qpos = np.round(trace.qpos.values[::stride].astype(float), 3)
    period = float(trace.time[stride] - trace.time[0])
    target = trace.p_world_target.values.tolist()
    return {"period": round(period, 4), "target": target, "boxes": boxes, "qpos": qpos.tolist()}


def page(back: str) -> str:
    """Return the page, with a link back to another page."""
    text = (HERE / "page.html").read_text("utf-8").replace("<!-- BACK -->", back)
    return text.replace("/* GENERATED */", scripts())


def main() -> None:
    """Write the page of the command line, and open or record it on request."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0] + ".")
    parser.add_argument(
        "file", nargs="?", type=Path, default=SITE / "push.html", help="default: site/push.html"
    )
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    parser.add_argument("--record", action="store_true", help="record the 3-D push again")
    options = parser.parse_args()
    if options.file.suffix != ".html":
        parser.error(f"file = {options.file}: its name must end with .html")
    if options.record:
        RECORDED.write_text(json.dumps(record(), separators=(",", ":")) + "\n", "utf-8")
    path = options.file.resolve()
    home = path.with_name("index.html")  # of the site, if the page lies in it
    back = home.name if home.exists() else os.path.relpath(SITE.with_name("README.md"), path.parent)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page(back), "utf-8")
    sys.stdout.write(f"{options.file}: {path.stat().st_size / 1e6:.2f} MB\n")
    if options.open and not webbrowser.open(path.as_uri()):
        sys.stdout.write(f"no browser was found: open {path.as_uri()}\n")


if __name__ == "__main__":
    main()
