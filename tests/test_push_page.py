"""The page on which one pushes oneself does what Python does, twist by twist."""

import contextlib
import os
import runpy
import shutil

import jax
import numpy as np
import pytest
from helpers import ROOT
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from rps_jax.engines.quasistatic import sliders
from rps_jax.geometry import solid
from rps_jax.lowering.routine import fields_of
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.stepper import Live

MAKE = runpy.run_path(str(ROOT / "docs" / "push" / "make.py"))
WHOLE = """
const push = new Push({ law: arguments[0], shape: arguments[1], target: [-2, 0] });
while (push.step()) {}
return [push.trial.success, push.past.map((s) => [s.twist.v_x, s.twist.v_y, s.twist.omega])];
"""
EACH = """
const push = new Push({ law: arguments[0], target: [-2, 0] });
return arguments[1].map(([trial, memory]) => {
  Object.assign(push, { trial, memory });
  push.step();
  const { twist } = push.seen;
  return [twist.v_x, twist.v_y, twist.omega, ...push.trial.qpos];
});
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (binary and driver):
        lacking = "there is no Chromium: run `apt-get install -y chromium chromium-driver`"
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(lacking)
    folder = tmp_path_factory.mktemp("push")
    page = folder / "push.html"
    page.write_text(MAKE["page"]())
    assert page.stat().st_size < 3e6
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}/p"):
        options.add_argument(flag)
    with webdriver.Chrome(options=options, service=Service(driver)) as browser:
        browser.get(page.as_uri())
        yield browser
        resources = "return performance.getEntriesByType('resource').length"
        assert browser.execute_script(resources) == 0  # it asks nobody for anything
        assert not browser.get_log("browser")


@contextlib.contextmanager
def python_push(law):
    """The paper's push to (-2, 0), in double precision."""
    with jax.enable_x64(True):
        live = Live.of_case(Case("box", "S1", (-2.0, 0.0), law), Setting("quasistatic"))
        live.step(20_000)
        assert live.done
        yield live


def twists(live):
    return np.array([np.stack(one.seen.twist) for one in live.past])


@pytest.mark.parametrize("law", ["rps_plus", pytest.param("rps_tuned", marks=pytest.mark.slow)])
def test_a_whole_push_has_the_twists_of_python(law, browser):
    with python_push(law) as live:
        wanted = twists(live)
    assert wanted.dtype == np.float64
    success, found = browser.execute_script(WHOLE, law, "box")
    assert success
    assert len(found) == len(wanted) > 5000
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("law", ["rps", pytest.param("learned_gru", marks=pytest.mark.slow)])
def test_from_every_state_of_a_push_comes_the_twist_of_python(law, browser):
    """Where tan(gamma) is at its bound, the paper's law enlarges a difference fourfold a step.

    So its pushes part from the last bit of a sine; what a step does with a state does not.
    """
    with python_push(law) as live:
        wanted, every = twists(live), max(1, len(live.past) // 6000)
        shown = range(0, len(live.past) - 1, every)
        before = [live.past[i].before for i in shown]
        own = named([one._replace(**MAKE["UNTRACED"]) for one in before])
        states = list(zip(own, named([one.law_state for one in before]), strict=True))
        after = np.array([live.past[i + 1].seen.qpos for i in shown])
    found = np.concatenate(
        [browser.execute_script(EACH, law, states[i : i + 500]) for i in range(0, len(states), 500)]
    )
    np.testing.assert_allclose(found[:, :3], wanted[list(shown)], rtol=0, atol=1e-5)
    np.testing.assert_allclose(found[:, 3:], after, rtol=0, atol=1e-7)


def named(trees):
    """Leaves of pytrees by the names that the page gives them."""
    names = [one.name for one in fields_of(trees[0])]
    rows = [[np.asarray(x).tolist() for x in jax.tree.leaves(tree)] for tree in trees]
    finite = [[1e300 if x == np.inf else x for x in row] for row in rows]  # as JSON has them
    return [dict(zip(names, row, strict=True)) for row in finite]


@pytest.mark.parametrize("corners", [1, 4, 6])
def test_an_object_is_borne_as_in_the_package(corners):
    """The page computes centre of mass and arm anew when one slides what they depend on."""
    rng = np.random.default_rng(0)
    offset, bearing = rng.uniform(0, 0.4, 20), rng.uniform(-3, 3, 20)
    size = rng.uniform(0.1, 0.4, 20)
    if corners == 1:
        vertices, radius = np.zeros((20, 1, 2)), size
    else:
        vertices, radius = solid.rectangles(size, rng.uniform(0.1, 0.4, 20)), np.zeros(20)
        vertices = np.concatenate([vertices, vertices[:, -1:].repeat(corners - 4, 1)], axis=1)
    one = np.ones(20)
    solids = solid.build(vertices, radius, one, one, offset, bearing)
    wanted = sliders(solids, one, np.array([0.3625, 0.29]))
    with jax.enable_x64(True):
        outlines = MAKE["Outline"](vertices, radius, offset, bearing)
        com, arm = jax.vmap(MAKE["support"])(outlines)
    np.testing.assert_allclose(com, wanted.p_object_com, atol=1e-12)
    np.testing.assert_allclose(arm, wanted.arm, atol=1e-9)


def test_the_recorded_push_stands_on_the_floor_and_is_seen_from_any_side(browser):
    """It ends at its target, upright; a drag turns the eye, and other pixels are drawn."""
    ends = "const q = RECORDED.qpos.at(-1); return [q[3], q[4], q[5], q[7], q[8]]"
    x, y, z, *tilt = browser.execute_script(ends)
    assert np.hypot(x + 2, y) < 0.2  # the contact is at the target, the middle beside it
    assert abs(z - 0.4) < 2e-3
    np.testing.assert_allclose(tilt, 0, atol=2e-3)
    look = """
    eye.playing = false; eye.at = 100; eye.turn = arguments[0]; drawRecorded();
    return by("view").toDataURL();
    """
    assert browser.execute_script(look, 0.5) != browser.execute_script(look, 1.5)
