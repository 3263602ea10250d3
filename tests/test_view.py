"""A push in the browser: the interactive trial, and the page in Chromium."""

import contextlib
import http.client
import io
import json
import math
import shutil
import socket
import time
from dataclasses import replace
from pathlib import Path

import chromium
import numpy as np
import pytest
import viser
from helpers import (
    ROOT,
    SHORT,
    case,
    refusal,
    refusing,
    setting_of,
    slow,
    still,
)
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from selenium.webdriver.common.by import By
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from rps_jax.app import viewer
from rps_jax.control import learned
from rps_jax.trials import pushes
from rps_jax.trials.live import Live
from rps_jax.trials.trial import Rules

SETTING = replace(SHORT, rules=Rules(horizon=12.0))
CASE = case((0.6, 0.0), "cylinder")
PERIOD = SETTING.physics.control_period


@pytest.fixture(scope="module")
def shared_push():
    return Live(pushes.build([CASE], SETTING), SETTING)


@pytest.fixture
def live(shared_push):
    shared_push.reset()
    return shared_push


def reach(live):
    """Drag the target to the last contact point, where the trial ends at once."""
    live.set_target(tuple(live.past[-1].p_world_contact))
    live.step(1)
    assert live.done


def p_robot_object(snapshot):
    """Return the position of the object (2,) [m] in the robot's frame."""
    c, s = math.cos(snapshot.qpos[2]), math.sin(snapshot.qpos[2])
    return np.array([[c, s], [-s, c]]) @ (snapshot.qpos[3:5] - snapshot.qpos[:2])


@pytest.mark.parametrize(
    "law", ["rps,K_h=0.3", "rps,tuned.json", "mine.py:PParams,v=0.04", slow("policy.npz")]
)
def test_every_kind_of_law_is_shown_live(law, tmp_path, monkeypatch, registries):
    """Laws are given by name with changes, as tuned parameters, as a user's file, or learned."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tuned.json").write_text(json.dumps({"L": 0.3, "saturate_first": 1}))
    shutil.copy(ROOT / "notebooks" / "examples" / "custom_law.py", tmp_path / "mine.py")
    shutil.copy(Path(learned.__file__).parent / "learned_small.npz", tmp_path / "policy.npz")
    shown = viewer.View("cylinder", target=(0.6, 0.0), law=law, setting=SETTING)
    shown.validate()
    push = shown.push()
    push.live.step(25)
    assert law in push.title
    assert push.live.past[-1].snapshot.qpos[0] > 0.002  # [m] it drives


# --- the trial -----------------------------------------------------------------------------


@pytest.mark.slow
def test_an_undisturbed_push_ends_like_any_other_trial(live):
    results, _ = pushes.run([CASE], SETTING, slots=1, workers=1)
    live.step(2 * round(SETTING.rules.horizon / PERIOD))
    assert live.done
    expected = results.columns()
    for name, value in live.outcome.columns().items():
        assert_allclose(value, expected[name][0], atol=1e-5, err_msg=name)
    assert live.past[-1].snapshot.time == pytest.approx(float(results.time[0]), abs=1e-4)


def test_a_dragged_target_is_the_current_target(live):
    """A target dragged to the contact is reached at once; one dragged away is not."""
    live.set_target((0.0, 3.0))
    live.step(150)
    assert not live.done
    reach(live)
    assert live.outcome.success
    ended = len(live.past)
    live.step(5)
    assert len(live.past) == ended
    live.set_target((0.0, 3.0))
    live.step(25)
    assert not live.done
    assert len(live.past) == ended + 25
    assert live.outcome.min_distance > 1.0  # of the target that it has now


def test_a_shove_moves_the_object_once_in_the_frame_of_the_robot(live):
    live.set_target((0.0, 3.0))
    live.step(250)
    previous = p_robot_object(live.past[-1].snapshot)
    assert abs(live.past[-1].snapshot.qpos[2]) > 0.05  # turned, so that the frames differ
    live.shove((0.3, -0.2))
    live.step(1)
    moved = p_robot_object(live.past[-1].snapshot) - previous
    assert_allclose(moved, (0.3, -0.2), atol=3e-3)
    shoved = live.past[-1].snapshot.qpos[3:5]
    live.step(2)
    assert math.dist(live.past[-1].snapshot.qpos[3:5], shoved) < 3e-3


def test_a_shove_after_the_end_happens_once(live):
    """Dragging the target afterwards does not repeat it."""
    live.set_target((0.0, 3.0))
    live.step(150)
    reach(live)
    live.shove((0.0, 0.02))
    live.step(1)
    shoved = live.past[-1].snapshot.qpos[3:5]
    for _ in range(3):  # the trial ends again at once, at the same step of its clock
        reach(live)
    assert math.dist(live.past[-1].snapshot.qpos[3:5], shoved) < 3e-3


def test_rewinding_discards_later_states(live):
    live.step(60)
    last = live.past[-1].snapshot.qpos
    live.rewind(20)
    assert len(live.past) == 21
    live.shove((0.1, 0.1))
    live.step(5)
    live.rewind(20)
    live.step(39)
    assert_array_equal(last, live.past[-1].snapshot.qpos)


def test_the_foam_is_compressed_only_at_the_contact(live):
    live.step(1)
    assert not live.past[0].compression.any()  # 2 cm before the robot
    live.step(150)
    pressed = live.past[-1].compression
    assert pressed.max() > 0.3
    assert not np.delete(pressed, np.arange(15, 27)).any()  # none beside the front
    assert np.argmax(pressed) in (20, 21)  # the middle of the front


@pytest.mark.parametrize("wrong", [(math.nan, 0.0), (0.0, 99.0)])
def test_an_invalid_disturbance_is_refused(live, wrong):
    with refusing("target"):
        live.set_target(wrong)
    with refusing("shove"):
        live.shove(wrong)


# --- the page ------------------------------------------------------------------------------

FLAGS = (
    "--headless",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=640,480",
)
SHOWN = viewer.View("cylinder", target=(0.0, 2.0), setting=replace(SETTING, rules=Rules()))


@pytest.fixture
def page():
    page = viewer.open_page(0)
    yield page
    page.close()


@pytest.fixture
def browser(tmp_path):
    with chromium.opened(tmp_path / "profile", *FLAGS) as browser:
        yield browser


def picture(browser):
    """Return a screenshot of the browser (height, width, 3) uint8."""
    return np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())))[..., :3]


def button(browser, name):
    return browser.find_element(By.XPATH, f"//button[normalize-space()='{name}']")


def test_the_page_plays_a_push(page, browser):
    def text():
        return browser.find_element(By.TAG_NAME, "body").text

    def close_buttons():
        return browser.find_elements(By.CSS_SELECTOR, "[class*=Notification-closeButton]")

    def until(condition):
        """Advance the page, slowly enough for rendering on a CPU, until a condition holds."""
        start_time = time.monotonic()
        while not condition():
            assert time.monotonic() - start_time < 90, text()
            page.tick(0.1)
            time.sleep(0.2)

    browser.get(page.url)
    page.start(SHOWN.push)
    until(lambda: "line contact" in text())
    close_buttons()[0].click()
    until(lambda: not close_buttons())
    first = picture(browser)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 300
    scenery = slice(0, first.shape[1] // 2)  # left of the panel
    until(lambda: np.any(np.abs(first.astype(int) - picture(browser))[:, scenery] > 60))

    button(browser, "Pause").click()
    until(lambda: "Play" in text())
    button(browser, "Shove").click()
    until(lambda: "Pause" in text())


@pytest.mark.parametrize(
    "task", ["reach", "pose", "pose,turn=1", "path", "path,heading=1", "corridor"]
)
def test_a_target_has_handles_where_it_can_be_moved(page, task, monkeypatch):
    monkeypatch.setattr("rps_jax.trials.live.stepper", still)
    push = viewer.View("box", task=task, setting=SETTING).push()
    monkeypatch.setattr(push.live, "step", lambda count=1: None)
    page._show_built(lambda: push)
    target, is_fixed = page._drawing.target, task.startswith(("path", "corridor"))
    with refusing("the task has its own end") if is_fixed else contextlib.nullcontext():
        push.live.set_target((1.0, 1.0), 0.5)
    assert target.disable_axes == target.disable_sliders == is_fixed
    assert target.disable_rotations == (task != "pose")


def test_the_panel_of_a_task_has_progress_and_touch(page):
    waypoints = [[0.4, 0.0], [1.0, 0.0], [2.2, 1.2]]
    task = {"kind": "corridor", "waypoints": waypoints, "width": 0.9, "lookahead": 3}
    setting = setting_of(60.0)
    live = viewer.View("cylinder", task=task, setting=setting).push().live
    live.step(100)
    page._cursor = 99.0
    assert "% of the path, 0.01 m off it in the mean, line contact" in page._state_text(live)
    live.step(3000)
    page._cursor = float(len(live.past) - 1)
    assert page._state_text(live).endswith("**not reached**, the base touched a wall")
    assert live.lines["walls"].shape == (4, 2, 2)


# --- access control ------------------------------------------------------------------------


def connected(page, **options):
    """Open a websocket to the page, by default as the page's own script does."""
    address = f"127.0.0.1:{page._server.get_port()}"
    defaults = {"origin": f"http://{address}", "subprotocols": [f"viser-v{viser.__version__}"]}
    return connect(f"ws://{address}", **defaults | options)


@pytest.mark.parametrize("origin", ["https://evil.example", "http://127.0.0.1:1", "null", None])
def test_other_pages_cannot_control_it(page, origin):
    with pytest.raises(InvalidStatus, match="403"):
        connected(page, origin=origin)
    connected(page).close()


HOSTS = {"{}": 200, "localhost:{1}": 200, "rebound.example": 403, "10.0.0.1:{1}": 403}


@pytest.mark.parametrize(("host", "status"), HOSTS.items())
def test_the_page_is_served_only_under_names_of_this_machine(page, host, status):
    """Names of other sites that resolve to this machine (DNS rebinding) are refused."""
    port = page._server.get_port()
    line = http.client.HTTPConnection("127.0.0.1", port)
    line.request("GET", "/", headers={"Host": host.format(f"127.0.0.1:{port}", port)})
    assert line.getresponse().status == status


def test_an_unguarded_viser_is_not_served(monkeypatch):
    monkeypatch.setattr(viewer, "guarding", contextlib.nullcontext)
    with refusing("this version of viser answers other pages"):
        viewer.open_page(0)


def test_a_used_port_is_refused_in_one_sentence(capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        error = refusal(capsys, "view", "--port", port)
    assert f"port = {port} cannot be served on: use another" in error


def test_a_setting_of_another_type_is_refused():
    with refusing("setting = .* is not allowed: give a Setting"):
        viewer.view(setting=[[1, 2]])
