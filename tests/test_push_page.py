"""The interactive push page computes the same twists as Python."""

import itertools
import json
import math
import runpy

import chromium
import jax
import numpy as np
import pytest
from helpers import ROOT, row, slow
from numpy.random import default_rng
from numpy.testing import assert_allclose
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from shapely import LineString, Point

from rps_jax.geometry import solid
from rps_jax.lowering.routine import fields_of
from rps_jax.trials import pushes, trial
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import ControlLoop, Rules

MAKE = runpy.run_path(str(ROOT / "docs" / "push" / "make.py"))
SINGLE_STEPS = """
const push = new Push({ law: arguments[0], task: arguments[2], target: [-1, 0], heading: 0.8 });
return JSON.parse(arguments[1]).map(([trial, memory]) => {
  Object.assign(push, { trial, memory });
  push.step();
  const { twist } = push.sample;
  return [twist.v_x, twist.v_y, twist.omega, ...push.trial.qpos];
});
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    folder = tmp_path_factory.mktemp("push")
    page = folder / "push.html"
    page.write_text(MAKE["page"]("index.html"))
    assert page.stat().st_size < 3e6
    with chromium.opened(folder / "profile", "--headless=new") as browser:
        browser.get(page.as_uri())
        yield browser
        resources = "return performance.getEntriesByType('resource').length"
        assert browser.execute_script(resources) == 0  # the page loads nothing
        assert not browser.get_log("browser")


def python_push(law, target=(-1.0, 0.0), **options):
    """Return snapshots, states after steps and outcome of a push, in float64."""
    setting = Setting("quasistatic", rules=Rules(horizon=150.0 if law == "rps" else 300.0))
    count = round(setting.rules.horizon / setting.physics.control_period) + 1
    with jax.enable_x64(True):
        worlds = pushes.build([Case(target=target, law=law, **options)], setting)
        loop = ControlLoop(setting.physics, setting.rules, worlds.law)

        @jax.jit
        def run(inputs):
            start = trial.start_all(*inputs, law=loop.law)
            last, steps = trial.unroll(worlds.stage, *inputs, start, loop, count, states=True)
            return *steps, trial.outcome(last, inputs[0], loop)

        snapshots, trials, outcome = jax.device_get(run(worlds.inputs))
    assert trials.done[-1].all()
    count = 1 + int(np.argmax(trials.done))
    return *row((snapshots, trials), np.s_[:count, 0]), row(outcome, 0)


BASE_OF = {law: base for base, laws in MAKE["LAWS"].items() for law in laws}


def test_the_switch_of_the_base_offers_the_laws_that_it_can_follow(browser):
    switch = """
    by("base").value = arguments[0];
    by("base").dispatchEvent(new Event("change"));
    for (let i = 0; i < 50; i++) push.step();
    return [push.options.law, [...by("law").options].map((x) => x.value)];
    """
    for base in [*MAKE["BASES"], "omni"]:
        law, offered = browser.execute_script(switch, base)
        assert offered == [x for x in MAKE["LAWS"][base] if not x.startswith("pose")]
        assert law == offered[0]


ROUTE = [[0.4, 0.0], [1.5, 0.0], [2.5, 0.7], [4.0, 0.8]]
IN_A_TASK = """
const [task, route, corridor, door] = arguments;
const push = new Push({ law: "rps", task, route, corridor, door, lookahead: 1.6 });
while (push.step()) {}
const { twist } = push.sample;
return [push.trial.steps, push.touched(), push.outcomes, [twist.v_x, twist.v_y, twist.omega]];
"""


@pytest.mark.parametrize(
    ("kind", "width", "door", "touched"),
    [
        slow("corridor", 1.0, 0.9, "base"),
        slow("corridor", 1.8, 0.9, ""),
        slow("path", 2, 1, ""),
    ],
)
def test_a_task_has_the_outcomes_of_python(kind, width, door, touched, browser):
    task = {"kind": kind, "waypoints": ROUTE, "lookahead": 1.6}
    if kind == "corridor":
        task |= {"width": width, "doors": 1, "door_width": door}
    snapshots, trials, expected = python_push("rps", Case.target, task=task)
    count, who, outcomes, twist = browser.execute_script(IN_A_TASK, kind, ROUTE, width, door)
    assert (who, bool(expected.success)) == (touched, not touched)
    assert abs(count - trials.steps[-1]) <= 1
    assert_allclose(twist, np.stack(snapshots.twist, axis=-1)[-1], atol=1e-6)
    assert set(outcomes) == set(expected.task)
    for name, value in expected.task.items():
        computed = np.nan if outcomes[name] is None else outcomes[name]
        assert_allclose(computed, value, atol=1e-6, err_msg=name)


def drawn(browser, points):
    """Draw a line through points [m] with the mouse; return the waypoints and the status."""
    browser.execute_script("by('draw').click(); drawScene(0); scene.scrollIntoView()")
    at = (
        "return arguments[0].map((p) => toScreen(v, p)).map(([x, y]) => [x - v.w / 2, y - v.h / 2])"
    )
    pixels = np.round(browser.execute_script(at, points)).astype(int).tolist()
    mouse = ActionChains(browser, duration=0)
    mouse.move_to_element_with_offset(browser.find_element(By.ID, "scene"), *pixels[0])
    mouse.click_and_hold()
    for (x, y), (next_x, next_y) in itertools.pairwise(pixels):
        mouse.move_by_offset(next_x - x, next_y - y)
    mouse.release().perform()
    return browser.execute_script("return [by('json').value, push.fault]")


def test_a_drawn_path_is_a_task_of_the_command_line(paused, tmp_path):
    x = np.linspace(0.4, 5, 60)
    line = np.column_stack([x, 0.9 * np.sin(1.5 * x - 0.6)]).tolist()
    prepare = """
        by('base').value = arguments[0]; by('base').dispatchEvent(new Event('change'));
        by('task').value = arguments[1]; choose()"""
    # A pixel is 1 to 2 cm. The turns of a corridor leave room for its corners.
    kinds = (("omni", "path", 0.1), ("omni", "corridor", 0.45), ("differential", "corridor", 0.6))
    for base, kind, tolerance in kinds:
        paused.execute_script(prepare, base, kind)
        text, fault = drawn(paused, line)
        assert not fault
        (tmp_path / "path.json").write_text(text)
        words = paused.execute_script("return by('command').textContent").split()
        options = dict(zip(words[2::2], words[3::2], strict=True))
        task = options["--task"].replace("path.json", str(tmp_path / "path.json"))
        case = Case(task=task, robot=options["--robot"], law=options["--law"])
        assert (base == "omni") == (case.base.drive == "omni")
        points = case.challenge.waypoints
        assert points == tuple(map(tuple, json.loads(text)["waypoints"]))
        assert 2 < len(points) <= MAKE["NUM_VERTICES"]
        for p in line:
            assert LineString(points).distance(Point(p)) < tolerance


BAD_DRAWINGS = {
    "path starts inside the robot: start it at the front of the base, (0.36, 0.00) m.": [
        [0.1, 0.1],
        [2, 0],
    ],
    "start it within 0.5 m of the base's front": [[2, 2], [3, 2]],
    "draw at least 0.5 m.": [[0.5, 0], [0.6, 0]],
    "draw wider turns, or narrow the corridor.": [[0.5, 0], [3, 0], [1, 1]],
}


@pytest.mark.parametrize("sentence", BAD_DRAWINGS)
def test_a_bad_drawing_gets_one_sentence(sentence, paused):
    paused.execute_script("by('task').value = 'corridor'; choose()")
    text, fault = drawn(paused, BAD_DRAWINGS[sentence])
    assert text == ""
    assert sentence in fault
    assert fault.count(". ") == 0
    assert not paused.execute_script("return push.step()")


def test_a_hand_turns_the_heading_of_a_goal_and_the_object_arrives_there(paused):
    """In contact, in a detour, and after the end; no law brings a car to a pose."""
    prepare = """
    by("base").value = arguments[0]; by("base").dispatchEvent(new Event("change"));
    by("task").value = "pose"; choose(); play(false); push.setTarget([1.2, 0.3]);
    Object.assign(push.params, { v_free: 0.2, omega_free: 0.5 });
    for (let i = 0; i < arguments[1]; i++) push.step();
    for (let i = 0; i < 40; i++) drawScene(0.1);
    scene.scrollIntoView();
    const tail = turned([-ARROW, 0], arguments[2], push.goal);
    const pixels = [tailOf(), tail].map((p) => toScreen(v, p));
    return [push.options.law, pixels.map(([x, y]) => [x - v.w / 2, y - v.h / 2])];
    """
    finish = """
    while (push.step()) {}
    return [push.options.heading, push.trial.success, push.outcomes, push.remembered];
    """
    for base, law, *inputs in (
        ("omni", "pose", 300, -0.6),
        ("differential", "pose_drive", 30, 2.0),
    ):
        used, pixels = paused.execute_script(prepare, base, *inputs)
        assert used == law
        (x, y), (to_x, to_y) = np.round(pixels).astype(int).tolist()
        mouse = ActionChains(paused, duration=0)
        mouse.move_to_element_with_offset(paused.find_element(By.ID, "scene"), x, y)
        mouse.click_and_hold().move_by_offset(to_x - x, to_y - y).release().perform()
        heading, success, outcomes, middle = paused.execute_script(finish)
        assert heading == pytest.approx(inputs[1], abs=0.05)
        assert success
        assert outcomes["heading_error"] < 0.1
        assert np.hypot(*np.subtract(middle, [1.2, 0.3])) < 0.4
    turn = "push.setGoal({ heading: 0.3, target: [-1.2, 0.3] });"
    assert paused.execute_script(turn + finish)[1]
    used, _ = paused.execute_script(prepare, "car", 0, 0)
    assert used == "pose"


def test_a_corridor_that_is_too_narrow_is_refused(paused):
    script = """
    push.options.corridor = arguments[0]; by("task").value = "corridor"; choose();
    return [push.fault, push.step()];
    """
    fault, stepped = paused.execute_script(script, 0.55)
    assert fault == "A wall crosses the base at the start: widen the corridor."
    assert not stepped
    assert paused.execute_script(script, 1.6) == ["", True]


# Positions of `pose_drive` differ by up to 5e-7 m.
SLOW_LAWS = [slow(x) for x in BASE_OF if x not in ("rps", "pose_drive")]


@pytest.mark.parametrize("law", ["rps", *SLOW_LAWS])
def test_each_state_of_a_push_gives_the_twist_of_python(law, browser):
    """At the bound of tan(gamma), the paper's law amplifies a difference fourfold per step.

    So rounding lets whole pushes diverge, but single steps from equal states agree.
    """
    task = "pose" if law.startswith("pose") else "reach"
    options = {"task": "pose,heading=0.8"} if task == "pose" else {}
    snapshots, states, _ = python_push(law, robot=MAKE["BASES"][BASE_OF[law]][1], **options)
    shown = np.arange(0, len(states.done) - 2, 6)
    previous, expected = [row(states, i) for i in shown], np.stack(snapshots.twist, axis=-1)
    trials = leaves_by_name([step._replace(**MAKE["UNTRACED"]) for step in previous])
    memories = leaves_by_name([step.law_state for step in previous])
    states = list(zip(trials, memories, strict=True))
    # As text: the driver converts each number of an argument by itself.
    computed = np.array(browser.execute_script(SINGLE_STEPS, law, json.dumps(states), task))
    assert_allclose(computed[:, :3], expected[shown + 1], rtol=0, atol=1e-5)
    assert_allclose(computed[:, 3:], snapshots.qpos[shown + 2], rtol=0, atol=1e-7)


def leaves_by_name(trees):
    """Return the leaves of pytrees by their names on the page."""
    names = [field.name for field in fields_of(trees[0])]
    rows = [[np.asarray(x).tolist() for x in jax.tree.leaves(tree)] for tree in trees]
    finite = [[1e300 if x == np.inf else x for x in row] for row in rows]  # as JSON has them
    return [dict(zip(names, row, strict=True)) for row in finite]


@pytest.mark.parametrize("corners", [1, slow(4), 6])
def test_the_support_of_an_object_equals_that_of_the_package(corners):
    """The page recomputes centre of mass and arm when a slider changes their inputs."""
    rng = default_rng(0)
    offset, bearing = rng.uniform(0, 0.4, 20), rng.uniform(-3, 3, 20)
    size = rng.uniform(0.1, 0.4, 20)
    if corners == 1:
        vertices, radius = np.zeros((20, 1, 2)), size
    else:
        vertices, radius = solid.rectangles(size, rng.uniform(0.1, 0.4, 20)), np.zeros(20)
        vertices = np.concatenate([vertices, vertices[:, -1:].repeat(corners - 4, 1)], axis=1)
    unit = np.ones(20)
    solids = solid.build(vertices, radius, unit, unit, offset, bearing, 0.1 * unit)
    with jax.enable_x64(True):
        outlines = MAKE["Outline"](vertices, radius, offset, bearing)
        com, arm = jax.jit(jax.vmap(MAKE["support"]))(outlines)
    assert_allclose(com, solids.p_object_com[:, :2], atol=1e-12)
    assert_allclose(arm, solid.friction_arm(solids), atol=1e-9)


def test_the_recorded_push_is_upright_and_visible_from_any_side(browser):
    """It ends at its target, upright; turning the camera changes the picture."""
    final_pose = "const q = RECORDED.qpos.at(-1); return [q[3], q[4], q[5], q[7], q[8]]"
    x, y, z, *tilt = browser.execute_script(final_pose)
    # The contact is at the target, and the middle within half a diagonal.
    assert np.hypot(x + 2, y) < 0.05 + 0.2 * math.sqrt(2)
    assert abs(z - 0.4) < 4e-3
    assert_allclose(tilt, 0, atol=2e-3)
    look = """
    eye.playing = false; eye.at = 100; eye.turn = arguments[0]; drawRecorded();
    return by("view").toDataURL();
    """
    assert browser.execute_script(look, 0.5) != browser.execute_script(look, 1.5)


INSIDE = """
const [x, y, , a, b] = push.trial.qpos, of = (p) => toScreen(v, p);
return [[x, y], [a, b]].map(of).every(([p, q]) => p > 0 && p < v.w && q > 0 && q < v.h);
"""


@pytest.fixture
def paused(browser):
    """The page with a new push to a target that is paused."""
    reset = "Object.assign(push.options, { drawn: null, route: ROUTES[0], corridor: 1.6 });"
    reset += "by('base').value = 'omni'; by('task').value = 'reach'; choose(); play(false)"
    browser.execute_script(reset)
    yield browser
    browser.execute_script("by('task').value = 'reach'; choose()")


def test_the_view_follows_the_push_wherever_a_user_looks(paused):
    for moved in ([0, 0], [3, -2], [-40, 40]):
        for steps in (0, 1000, 3000):
            run = "moved = arguments[0]; for (let i = 0; i < arguments[1]; i++) push.step();"
            paused.execute_script(run + "drawScene(0)", moved, steps)
            assert paused.execute_script(INSIDE), (moved, steps)
        assert paused.execute_script("return by('follow').hidden") == (moved == [0, 0])
    paused.execute_script("by('follow').click(); drawScene(0)")
    assert paused.execute_script("return by('follow').hidden")


def test_a_shove_shows_while_the_push_is_paused(paused):
    state = "return [push.trial.qpos[3], push.trial.qpos[4], push.trial.steps]"
    x, y, steps = paused.execute_script(state)
    paused.execute_script("by('shove').click()")
    x_shoved, y_shoved, next_steps = paused.execute_script(state)
    assert np.hypot(x_shoved - x, y_shoved - y) > 0.1
    assert next_steps == steps + 1


LABELS = """
const boxes = [], canvas = CanvasRenderingContext2D.prototype, own = canvas.fillText;
canvas.fillText = function (text, x, y) {
  const w = this.measureText(text).width, left = this.textAlign === "right" ? x - w : x;
  boxes.push([text, left, y - 9, left + w, y]);
};
try { (new Function(arguments[0]))(); } finally { canvas.fillText = own; }
return boxes;
"""


def labels(browser, draw):
    """Return the labels that a drawing function writes, after a check that none overlap."""
    boxes = browser.execute_script(LABELS, draw)
    for i, (text, x0, y0, x1, y1) in enumerate(boxes):
        for name, *box in boxes[:i]:
            disjoint = x1 < box[0] or box[2] < x0 or y1 < box[1] or box[3] < y0
            assert disjoint, (text, name)
    return [text for text, *_ in boxes]


@pytest.mark.parametrize("width", [360, 390, 768, 1280])
def test_axis_labels_do_not_overlap(width, paused):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    paused.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    for x in (-0.3, -2, -19.75):
        paused.execute_script(f"push.setTarget([{x}, {-x}]); fitted = null")
        shown = labels(paused, "drawScene(0)")
        assert {"x [m]", "y [m]"} < set(shown)
        assert len(shown) >= 6
    assert paused.execute_script("return document.documentElement.scrollWidth") <= width
    for i in range(6):
        labels(paused, f"drawPlot(PLOTS[{i}])")
    paused.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.parametrize("omega", [3e-5, -4e-4, 0.012, 0.15])
def test_a_small_turning_rate_has_a_scale(omega, paused):
    script = "push.step(); push.past[0].twist.omega = arguments[0]"
    paused.execute_script(script, omega)
    *ticks, _, _ = labels(paused, "drawPlot(PLOTS[1])")  # then those of time
    values = [float(tick) for tick in ticks]
    assert len(set(values)) == len(values) >= 2
    assert 0.3 * abs(omega) < max(abs(value) for value in values) < 4 * max(abs(omega), 1e-4)


def test_a_link_leads_back_to_the_site(browser):
    assert browser.execute_script("return document.links[0].getAttribute('href')") == "index.html"


def test_the_template_says_how_to_build_the_page(tmp_path):
    with chromium.opened(tmp_path, "--headless=new") as browser:
        browser.get((ROOT / "docs" / "push" / "page.html").as_uri())
        text = browser.execute_script("return document.body.textContent")
    assert text.strip().endswith("python docs/push/make.py --open")


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--help"], "--record"),
        (["--hlp"], "unrecognized"),
        (["page"], "must end with .html"),
    ],
)
def test_options_of_the_builder_write_no_page(args, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["make.py", *args])
    with pytest.raises(SystemExit):
        MAKE["main"]()
    assert expected in "".join(capsys.readouterr())
    assert not list(tmp_path.iterdir())
