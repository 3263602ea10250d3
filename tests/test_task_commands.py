"""Tasks in commands, environments and bags, and bad tasks on the command line."""

import json
import sys
import types
from dataclasses import replace

import bad_bags
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers import ROOT, refusal, refusing, row, rps, setting_of
from numpy.testing import assert_allclose, assert_array_equal

import rps_jax
from rps_jax.analysis import statistics, tables
from rps_jax.app.shadow import Shadow, pursued, shadow
from rps_jax.geometry.polyline import Polyline
from rps_jax.record import bag, files
from rps_jax.runs.plan import load_plan
from rps_jax.runs.push import Push
from rps_jax.runs.sweep import Sweep, plan_sections
from rps_jax.studies.sensitivity import Sensitivity
from rps_jax.trials import env, gym
from rps_jax.trials.case import Case
from rps_jax.trials.trial import Rules
from rps_jax.tuning.collection import ease
from rps_jax.tuning.evolution import TuneES
from rps_jax.world import draws, points, quantity, tasks
from rps_jax.world.domain import DOMAINS, from_json, parse_domain, to_json
from rps_jax.world.tasks.base import CourseInputs, Positions, Task
from rps_jax.world.tasks.path import Path, PathCourse
from rps_jax.world.tasks.reach import Nothing

DRUMS = "wide,objects=random_cylinder"
TASK = "corridor,turns=1,width=1.4,turn_angle=0.8,length=4"
SETTING = setting_of(80.0)
OPTIONS = f"--task {TASK} --domain {DRUMS} --engine quasistatic --horizon 80 --laws rps"
TEXTS = (
    "reach",
    "path,lookahead=0.7:0.7",
    "path,waypoints=0.4:0.0:2.0:1.0,spline=True",
    "corridor,width=1.4:1.6,doors=1",
)


# --- declarations ------------------------------------------------------------------------------


@pytest.mark.parametrize("text", TEXTS)
def test_a_task_has_a_text_and_a_json(text):
    task = tasks.parse_task(text)
    assert str(task) == text
    domain = parse_domain(DRUMS, task=task)
    assert from_json(json.loads(json.dumps(to_json(domain)))) == domain


def test_the_json_of_a_domain_with_a_target_is_that_of_earlier_versions():
    assert "task" not in to_json(DOMAINS["wide"])
    assert "task" not in Push().configuration()
    assert Push(task="path").configuration()["task"]["lookahead"] == (1.6, 1.6, False)


@pytest.mark.parametrize("task", ["path", "corridor", "path,turn_angle=0.5", "corridor,doors=2"])
def test_worlds_with_paths_are_points_of_the_cube(task):
    for name in (DRUMS, "prisms"):
        domain, index = parse_domain(name, task=task), np.arange(6)
        at = points.check_points(domain, points.points_of(domain, index))
        drawn, again = (points.draw(domain, 0, x, index).course for x in (None, at))
        for a, b in zip(jax.tree.leaves(drawn), jax.tree.leaves(again), strict=True):
            assert_array_equal(a, b)


def test_a_table_of_worlds_has_the_measures_of_their_paths():
    drawn = draws.draw(parse_domain(DRUMS, task="path,turns=0:3"), 1, np.arange(40))
    table = {name: values for name, (values, _) in draws.table(drawn).items()}
    headings = np.diff(drawn.course.line.vertices, axis=1)
    assert table["turns"].tolist() == [
        np.count_nonzero(np.abs(np.diff(np.arctan2(y[n], x[n]))) > 1e-9)
        for x, y in np.moveaxis(headings, -1, 1)
        for n in [np.hypot(x, y) > 0]
    ]
    assert_allclose(table["length"], np.hypot(*np.moveaxis(headings, -1, 0)).sum(axis=1))
    turned = table["turns"] > 0
    assert (table["turn_angle"][turned] > 0.29).all()
    assert (table["turn_angle"] < 0.81).all()
    assert not table["turn_angle"][~turned].any()


def test_the_example_of_a_task_is_complete(registries, monkeypatch):
    page = (ROOT / "rps_jax" / "README.md").read_text().partition("### A task\n")[2]
    band = types.ModuleType("band")
    monkeypatch.setitem(sys.modules, "band", band)  # whose annotations are evaluated
    exec(page.partition("```python\n")[2].partition("```")[0], vars(band))
    task: Task = tasks.TASKS["band"](half_width=0.2)  # pyright: ignore[reportCallIssue]
    targets = 1 + quantity.random_numbers(0, np.arange(2))[:, :2]
    goals, course = task.courses(CourseInputs({}, targets, np.full(2, 0.36)))
    world = jax.tree.map(lambda x: jnp.asarray(x[0]), course)
    off, point = jnp.zeros(2), jnp.array([1.0, 0.0])
    touch = Positions(jnp.array([2.0, 0.0]), point + 0.1, jnp.asarray(True), *[off] * 5)  # pyright: ignore[reportArgumentType]
    progress, aim = world.step(world.start(), touch)
    assert float(progress.outcomes()["off_line"]) == pytest.approx(0.1)
    assert not aim.failed
    assert world.step(progress, touch._replace(p_world_contact=point + 0.3))[1].failed
    assert set(progress.outcomes()) == set(task.OUTCOMES)
    assert float(world.remaining(progress, touch.p_world_goal, point)) == 1.0
    assert_array_equal(goals, targets)


# --- runs --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Folder of a sweep in a corridor."""
    folder = tmp_path_factory.mktemp("corridor")
    assert rps(f"sweep {OPTIONS} --worlds 12 --part 4 --out {folder}/run") == 0
    return folder


def test_a_sweep_records_and_reports_the_outcomes_of_its_task(run):
    results = rps_jax.load(run / "run")
    assert results.attrs["task"] == str(tasks.parse_task(TASK))
    trials = results.sel(law="rps")
    modes = np.array([*statistics.modes(), ""])[statistics.failure_modes(trials, 150.0)]
    touched = trials.wall_touch.values > 0
    assert 0 < touched.sum() < 12
    assert ((modes == "touched a wall") == touched).all()
    header, row = tables.success_table(results, 150.0)
    assert int(row[header.index("touched a wall")]) == touched.sum()
    report = (run / "run" / "report.md").read_text()
    section = report.partition("## Outcomes of the task")[2].partition("##")[0]
    cells = [
        line.split(" | ")[1].strip() for line in section.splitlines() if "| wall touch" in line
    ]
    assert sum(int(cell.partition(": ")[2]) for cell in cells[0].split(", ")) == touched.sum()
    assert f"{np.median(trials.progress):.3g} [" in section
    assert "fail at once" not in section
    plan = load_plan(run / "run")
    sections = {
        x.title: x.text for x in plan_sections(plan, results.assign(time=0 * results.time), None)
    }
    assert "12 trials fail at once: a wall" in sections["Outcomes of the task"]
    reach = results.drop_vars(list(tasks.OUTCOMES), errors="ignore")
    assert tables.task_table(reach) == []


@pytest.mark.slow
def test_a_corridor_is_resumed_sharded_merged_and_replayed(run, capsys):
    results = rps_jax.load(run / "run")
    next((run / "run" / "parts").iterdir()).unlink()
    assert rps(f"sweep {OPTIONS} --worlds 12 --part 4 --out {run}/run") == 0
    for i in (1, 2):
        shard = f"--shard {i}/2 --out {run}/{i}"
        assert rps(f"sweep {OPTIONS} --worlds 12 --part 4 {shard}") == 0
    assert rps(f"merge {run}/1 {run}/2 --out {run}/merged") == 0
    for again in ("run", "merged"):
        for name in ("progress", "wall_touch", "touch_x", "success"):
            assert_array_equal(rps_jax.load(run / again)[name], results[name])
    assert load_plan(run / "run").domain.task == tasks.parse_task(TASK)
    touched = int(np.flatnonzero(results.wall_touch[0])[0])
    trace = rps_jax.replay(run / "run", touched)
    assert trace.data.outcome_wall_touch == results.wall_touch[0, touched]
    assert trace.data.walls.shape[1:] == (2, 2)
    body = ("base", "object")[int(results.wall_touch[0, touched]) - 1]
    assert trace.summary.endswith(f", the {body} touched a wall")
    shown = rps_jax.gallery(run / "run", law="rps")
    assert ((shown.kind == "touched a wall") == (results.wall_touch[0] > 0)).all()
    assert "the run has its own" in refusal(capsys, f"ceiling {run}/run --task path")


def test_a_run_of_an_earlier_version_goes_on(tmp_path):
    sweep = Sweep("rps", DRUMS, worlds=4, setting=SETTING, out=tmp_path / "run")
    record = sweep.configuration()
    assert "task" not in record["domain"]
    assert from_json(record["domain"]) == parse_domain(DRUMS)


def test_other_questions_take_a_task():
    brief = replace(SETTING, rules=Rules(horizon=2.0))
    options = {"task": TASK, "setting": brief, "worlds": 12, "slots": 12}  # as of `run`
    trees = rps_jax.ladder("rps", (DRUMS, "wide,objects=random_cylinder,mass=3"), **options)
    assert all("wall_touch" in trees[name] for name in trees)
    assert rps_jax.evaluate("rps", DRUMS, **options).progress.sizes["world"] == 12
    assert Sensitivity("rps", DRUMS, worlds=400, task=TASK).factors.count("path") == 1
    tuned = {"tuned": ("K_h",), "objects": ("random_cylinder",), "domain": DRUMS, "task": TASK}
    assert all(d.task.kind == "corridor" for d in TuneES("rps", **tuned).domains)
    assert rps_jax.draw_worlds(DRUMS, task=TASK).worlds.task.walls.shape[2:] == (2, 2)
    for wrt in ("width", "target"):
        with refusing(rf"wrt = {wrt} is not allowed"):
            rps_jax.value_and_grad(lambda s: s.qpos[-1, 0], "rps", DRUMS, 1, wrt, task=TASK)
    with refusing("give a function as score"):
        rps_jax.value_and_grad(domain=DRUMS, wrt="K_h", task=TASK)


# --- bad input ---------------------------------------------------------------------------------

WAYPOINTS = {
    "one": ([[0.4, 0]], "a path has two points or more"),
    "nan": ([[0.4, 0], [float("nan"), 1]], "must be finite numbers"),
    "infinite": ([[0.4, 0], [float("inf"), 1]], "must be finite numbers"),
    "repeated": (
        [[0.4, 0], [1, 0], [1, 0]],
        "[[1.0, 0.0], [1.0, 0.0]] is not allowed: consecutive",
    ),
    "3-D": ([[0.4, 0, 0], [1, 0, 0]], "write pairs of x, y"),
    "ragged": ([[0.4, 0], [1]], "write pairs of x, y"),
    "texts": ([["a", "b"], [1, 2]], "write pairs of x, y"),
    "dict": ({"x": [1, 2], "y": [1, 2]}, "write pairs of x, y"),
    "centimetres": (
        [[36, 0], [200, 0]],
        "[200.0, 0.0] is not allowed: give coordinates from -50 to 50, in metres",
    ),
    "far": ([[2, 0], [3, 0]], "within 0.5 m of the base's front"),
    "many": ([[0.4 + 0.1 * i, 0] for i in range(101)], "at most 100 waypoints"),
}


@pytest.mark.parametrize("name", WAYPOINTS)
def test_bad_waypoints_are_one_sentence(name, tmp_path, capsys):
    waypoints, message = WAYPOINTS[name]
    path = files.write_json(tmp_path / "route.json", {"waypoints": waypoints})
    for command in ("push", f"sweep --domain {DRUMS}", "view"):
        for task in (path, f"corridor,{path}"):
            assert message in refusal(capsys, f"{command} --task {task}")


WALLS = {
    "a wall beside them crosses the base": {
        "kind": "corridor",
        "waypoints": [[0.4, 0], [0.4, 3]],
        "width": 0.7,
    },
    "a wall crosses base or object at the start": {
        "kind": "corridor",
        "waypoints": [[-0.1, 0], [0.4, 0], [0.4, 3]],
        "width": 0.62,
    },
}


@pytest.mark.parametrize("message", WALLS)
def test_a_wall_across_the_start_is_refused(message, tmp_path, capsys):
    path = files.write_json(tmp_path / "walls.json", WALLS[message])
    assert message in refusal(capsys, f"push --object box --task {path}")


def test_a_bearing_and_points_in_space_are_refused_in_python():
    with refusing(r"bearing = 1.0 is not allowed: the task path has"):
        Case(task="path", bearing=1.0)
    with refusing("give several numbers"):
        Path(waypoints=((0.4, 0.0, 0.0), (1.0, 0.0, 0.0)))  # pyright: ignore[reportArgumentType]


# --- environments ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*A Box observation space (min|max)imum value is")
@pytest.mark.filterwarnings("error:.*WARN")
def test_an_environment_ends_at_a_wall_and_counts_the_way_along_the_path():
    options = {"object": "random_cylinder", "domain": DRUMS, "worlds": 3, "hold": 0.4}
    options |= {"setting": SETTING, "weights": env.Reward(success=0, no_contact=0)}
    options |= {"task": "corridor,turns=0,width=1.4,length=4,lookahead=0.8"}
    single = gymnasium.make(f"{gym.__name__}:rps_jax/Push-v0", **options)
    check_env(single.unwrapped, skip_render_check=True)
    obs, info = single.reset(seed=0)
    front = float(single.unwrapped.push_env.table.skin.shell.half[0][0])
    assert_allclose(obs[-2], front + 0.8, atol=0.1)
    assert "error_mean" not in info
    total, terminated = 0.0, False
    for i in range(300):
        action = np.float32([1.0, 0.0, 0.0] if i < 60 else [0.0, 1.0, 0.0])
        obs, reward, terminated, truncated, info = single.step(action)
        total += reward
        if i == 59:
            assert 0.2 < info["progress"] < 0.5
            assert total == pytest.approx(4 * info["progress"], abs=0.15)
            assert obs[-2] == pytest.approx(front + 0.8, abs=0.1)
        if terminated or truncated:
            break
    assert terminated
    assert not truncated
    assert info["wall_touch"] == 1
    assert abs(info["touch_y"]) == pytest.approx(0.7, abs=1e-3)


def test_the_curriculum_leaves_paths_alone():
    worlds = rps_jax.draw_worlds(DRUMS, task=TASK, setting=SETTING).worlds
    world = row(worlds, 0)
    assert ease(world, jnp.asarray(0.1)) is world
    eased = ease(world._replace(task=Nothing()), jnp.asarray(0.0)).p_world_target
    assert np.hypot(*eased) == pytest.approx(0.8)


# --- bags --------------------------------------------------------------------------------------

PATH = np.array([[0.3, 0.0], [1.0, 0.1], [1.2, 0.8]])


def test_shadow_follows_the_path_of_a_bag_without_a_target(tmp_path, monkeypatch, capsys):
    messages = bag._messages
    without_target = lambda steps: (x for x in messages(steps) if x[0] != "/target")  # noqa: E731
    monkeypatch.setattr(bag, "_messages", without_target)
    steps = [step._replace(path=PATH, walls=np.zeros((2, 2, 2))) for step in bad_bags.push()]
    path = bag.write(tmp_path / "push.mcap", steps, {})
    read = bag.read(path)
    assert "target" not in read
    assert_allclose(read["path"], np.tile(PATH, (len(read["time"]), 1, 1)), atol=1e-9)
    course = PathCourse(jax.tree.map(jnp.asarray, Polyline.through(PATH)), jnp.asarray(0.3))
    progress, targets = course.start(), []
    for (x, y, yaw), point, kind in zip(
        read["pose"], read["p_robot_contact"], read["contact_type"], strict=True
    ):
        c, s = np.cos(yaw), np.sin(yaw)
        contact = jnp.asarray([x + c * point[0] - s * point[1], y + s * point[0] + c * point[1]])
        progress, aim = course.follow(progress, contact, jnp.asarray(kind > 0))
        targets.append(aim.p_world_target)
    assert_allclose(pursued(read, 0.3), targets, atol=1e-5)
    assert np.isfinite(shadow(path, "rps", lookahead=0.3).v_x.values).all()
    with refusing("lookahead = 9 is not allowed"):
        Shadow(path, lookahead=9).validate()
    assert "has a path: fit needs a log with one target" in refusal(capsys, f"fit {path}")
