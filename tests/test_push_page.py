"""The interactive push page computes the same twists as Python."""

import contextlib
import runpy

import chromium
import jax
import numpy as np
import pytest
from helpers import ROOT

from rps_jax.geometry import solid
from rps_jax.lowering.routine import fields_of
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.stepper import Live

MAKE = runpy.run_path(str(ROOT / "docs" / "push" / "make.py"))
WHOLE_PUSH = """
const push = new Push({ law: arguments[0], shape: arguments[1], target: [-2, 0] });
while (push.step()) {}
return [push.trial.success, push.past.map((s) => [s.twist.v_x, s.twist.v_y, s.twist.omega])];
"""
SINGLE_STEPS = """
const push = new Push({ law: arguments[0], target: [-2, 0] });
return arguments[1].map(([trial, memory]) => {
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
    page.write_text(MAKE["page"]())
    assert page.stat().st_size < 3e6
    with chromium.opened(folder / "profile", "--headless=new") as browser:
        browser.get(page.as_uri())
        yield browser
        resources = "return performance.getEntriesByType('resource').length"
        assert browser.execute_script(resources) == 0  # the page loads nothing
        assert not browser.get_log("browser")


@contextlib.contextmanager
def python_push(law):
    """The paper's push to (-2, 0), in double precision."""
    with jax.enable_x64(True):
        setting = Setting("quasistatic")
        live = Live(pushes.build([Case("box", "S1", (-2.0, 0.0), law)], setting), setting)
        live.step(20_000)
        assert live.done
        yield live


def twists(live):
    return np.array([np.stack(step.snapshot.twist) for step in live.past])


@pytest.mark.parametrize("law", ["rps_plus", pytest.param("rps_tuned", marks=pytest.mark.slow)])
def test_a_whole_push_has_the_twists_of_python(law, browser):
    with python_push(law) as live:
        expected = twists(live)
    assert expected.dtype == np.float64
    success, computed = browser.execute_script(WHOLE_PUSH, law, "box")
    assert success
    assert len(computed) == len(expected) > 5000
    np.testing.assert_allclose(computed, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("law", ["rps", pytest.param("learned_gru", marks=pytest.mark.slow)])
def test_each_state_of_a_push_gives_the_twist_of_python(law, browser):
    """At the bound of tan(gamma), the paper's law amplifies a difference fourfold per step.

    So rounding lets whole pushes diverge, but single steps from equal states agree.
    """
    with python_push(law) as live:
        expected, stride = twists(live), max(1, len(live.past) // 6000)
        shown = range(0, len(live.past) - 1, stride)
        previous = [live.past[i].trial for i in shown]
        trials = leaves_by_name([step._replace(**MAKE["UNTRACED"]) for step in previous])
        memories = leaves_by_name([step.law_state for step in previous])
        states = list(zip(trials, memories, strict=True))
        next_qpos = np.array([live.past[i + 1].snapshot.qpos for i in shown])
    batches = [states[i : i + 500] for i in range(0, len(states), 500)]
    computed = np.concatenate([browser.execute_script(SINGLE_STEPS, law, x) for x in batches])
    np.testing.assert_allclose(computed[:, :3], expected[list(shown)], rtol=0, atol=1e-5)
    np.testing.assert_allclose(computed[:, 3:], next_qpos, rtol=0, atol=1e-7)


def leaves_by_name(trees):
    """Return the leaves of pytrees by their names on the page."""
    names = [field.name for field in fields_of(trees[0])]
    rows = [[np.asarray(x).tolist() for x in jax.tree.leaves(tree)] for tree in trees]
    finite = [[1e300 if x == np.inf else x for x in row] for row in rows]  # as JSON has them
    return [dict(zip(names, row, strict=True)) for row in finite]


@pytest.mark.parametrize("corners", [1, 4, 6])
def test_the_support_of_an_object_equals_that_of_the_package(corners):
    """The page recomputes centre of mass and arm when a slider changes their inputs."""
    rng = np.random.default_rng(0)
    offset, bearing = rng.uniform(0, 0.4, 20), rng.uniform(-3, 3, 20)
    size = rng.uniform(0.1, 0.4, 20)
    if corners == 1:
        vertices, radius = np.zeros((20, 1, 2)), size
    else:
        vertices, radius = solid.rectangles(size, rng.uniform(0.1, 0.4, 20)), np.zeros(20)
        vertices = np.concatenate([vertices, vertices[:, -1:].repeat(corners - 4, 1)], axis=1)
    unit = np.ones(20)
    solids = solid.build(vertices, radius, unit, unit, offset, bearing)
    with jax.enable_x64(True):
        outlines = MAKE["Outline"](vertices, radius, offset, bearing)
        com, arm = jax.vmap(MAKE["support"])(outlines)
    np.testing.assert_allclose(com, solids.p_object_com[:, :2], atol=1e-12)
    np.testing.assert_allclose(arm, solid.friction_arm(solids), atol=1e-9)


def test_the_recorded_push_is_upright_and_visible_from_any_side(browser):
    """It ends at its target, upright; turning the camera changes the picture."""
    final_pose = "const q = RECORDED.qpos.at(-1); return [q[3], q[4], q[5], q[7], q[8]]"
    x, y, z, *tilt = browser.execute_script(final_pose)
    assert np.hypot(x + 2, y) < 0.2  # the contact is at the target, the middle next to it
    assert abs(z - 0.4) < 2e-3
    np.testing.assert_allclose(tilt, 0, atol=2e-3)
    look = """
    eye.playing = false; eye.at = 100; eye.turn = arguments[0]; drawRecorded();
    return by("view").toDataURL();
    """
    assert browser.execute_script(look, 0.5) != browser.execute_script(look, 1.5)
