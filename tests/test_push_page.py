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
from rps_jax.trials import pushes
from rps_jax.trials.case import Case
from rps_jax.trials.setting import Setting

MAKE = runpy.run_path(str(ROOT / "docs" / "push" / "make.py"))
RUN = """
const push = new Push({ law: arguments[0], target: arguments[1] });
while (push.step()) {}
const rows = push.past.map((s) => [s.twist.v_x, s.twist.v_y, s.twist.omega]);
return { rows, success: push.trial.success };
"""


@contextlib.contextmanager
def chromium(profile):
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (binary and driver):
        lacking = "there is no Chromium: run `apt-get install -y chromium chromium-driver`"
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(lacking)
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}"):
        options.add_argument(flag)
    with webdriver.Chrome(options=options, service=Service(driver)) as browser:
        yield browser


def test_the_page_commands_every_twist_that_python_commands(tmp_path):
    page = tmp_path / "push.html"
    page.write_text(MAKE["page"]())
    assert page.stat().st_size < 3e6
    with jax.enable_x64(True):
        case, setting = Case("box", "S1", (-2.0, 0.0), "rps"), Setting("quasistatic")
        period = setting.physics.control_period
        (followed,) = pushes.follow([case], setting, interval=period)
    wanted = np.stack(followed.snapshots.twist, axis=-1)
    assert wanted.dtype == np.float64
    with chromium(tmp_path / "profile") as browser:
        browser.get(page.as_uri())
        found = browser.execute_script(RUN, "rps", [-2, 0])
        loads = browser.execute_script("return performance.getEntriesByType('resource').length")
        assert not browser.get_log("browser")
    assert found["success"]
    assert loads == 0  # it asks nobody for anything
    assert wanted.shape == (len(found["rows"]), 3)
    assert len(wanted) > 3000
    np.testing.assert_allclose(found["rows"], wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("corners", [1, 4, 6])
def test_an_object_is_borne_as_in_the_package(corners):
    """The page computes centre of mass and arm anew, when one slides what they depend on."""
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
        com, arm = jax.vmap(MAKE["borne"])(outlines)
    np.testing.assert_allclose(com, wanted.p_object_com, atol=1e-12)
    np.testing.assert_allclose(arm, wanted.arm, atol=1e-9)
