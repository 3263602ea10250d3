"""The gallery of failures: failure modes, common quantities and maps."""

import re
from typing import NamedTuple

import numpy as np
import pytest
import xarray as xr
from helpers import printed, refusal, results_of, setting_of

import rps_jax
from rps_jax import Law
from rps_jax.control.observation import Details, Twist
from rps_jax.studies import gallery
from rps_jax.world.domain import parse_domain


def outcomes(**changes):
    """Four worlds: a success, a timeout near the target, one far from it, and no contact."""
    columns = dict.fromkeys(("diverged", "tipped", "stalled", "contact_lost_time"), [0] * 4)
    columns |= {"success": [1, 0, 0, 0], "min_distance": [0.04, 0.19, 0.21, np.inf]}
    return results_of(**columns | changes)


def test_each_failure_has_one_mode():
    modes = gallery.failure_modes(outcomes(), 150.0).tolist()
    far = "timeout far from the target"
    assert modes == ["", "timeout near the target", far, "never touched"]
    # A fall has precedence over lost contact, and a success over all failure modes.
    changes = {"tipped": [1, 1, 0, 0], "contact_lost_time": [0, 200, 200, 0]}
    fallen = gallery.failure_modes(outcomes(**changes), 150.0).tolist()
    assert fallen == ["", "fell over", "lost contact", "never touched"]


SQUARE = [[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]


def trace_of(seconds=60, outcomes=(), **columns):
    """Return the trace of a trial in which nothing happens, but for the given columns (time, ...).

    The base stands at the origin without contact, 2 m before the target.
    """
    time = np.arange(0, seconds + 1e-9, 0.1)
    zeros = np.zeros(time.size)
    qpos = np.tile([0, 0, 0, 0.6, 0, 0.2, 1, 0, 0, 0], (time.size, 1)).astype(float)
    for i, name in enumerate(("x", "y", "yaw")):
        qpos[:, i] = columns.pop(name, zeros)
    for name, axis in (("roll", 7), ("turn", 9)):
        half = columns.pop(name, zeros) / 2
        qpos[:, axis] = np.sin(half)
        qpos[:, 6] *= np.cos(half)
    contact = np.stack([columns.pop("ahead", zeros + 0.36), columns.pop("left", zeros)], axis=1)
    rest = {"contact_type": zeros, "realigning": zeros}
    results = {"time": seconds, "contact_lost_time": 0, "tilt": 0, "tipped": 0, "path_length": 0}
    results |= {"min_distance": np.inf, "nan_twist": 0} | dict(outcomes)
    variables = {name: ("time", values) for name, values in (rest | columns).items()}
    return xr.Dataset(
        variables
        | {f"outcome_{name}": value for name, value in results.items()}
        | {"qpos": (("time", "joint"), qpos), "p_robot_contact": (("time", "axis"), contact)}
        | {"p_world_contact": (("time", "axis"), contact + qpos[:, :2])}
        | {"p_world_target": ("axis", [2.0, 0.0]), "half_length": 0.36, "half_width": 0.29}
        | {"outline": (("corner", "axis"), 0.2 * np.array(SQUARE)), "d_success": 0.05},
        {"time": time},
    )


TIME = np.arange(0, 60 + 1e-9, 0.1)
MOVING = {"yaw": 0.01 * TIME}  # a slow turn on the spot
TOUCH = MOVING | {"contact_type": np.ones(TIME.size)}


def test_a_trial_has_its_end_and_its_path():
    row = {"path_length": 1.24, "min_distance": 0.5}
    still, end = trace_of(outcomes=row, **MOVING), trace_of(0)
    _, first, second = gallery.trials_table({3: still, 4: end})
    assert first == ["3", "60 s", "0.50 m left", "1.2 m"]
    assert second == ["4", "0 s", "untouched", "0.0 m"]


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_title_and_legend_of_the_maps_are_inside_of_the_figure(count):
    traces = dict.fromkeys(range(count), trace_of(**TOUCH))
    title = f"rps_tuned,K_h=0.3,alpha=10: timeout far from the target, {count} of 50 in 400 worlds"
    figure = gallery.maps_figure(traces, title)
    figure.draw_without_rendering()
    (legend,), page = figure.legends, figure.bbox
    assert [text.get_text() for text in legend.get_texts()] == [
        "base",
        "contact point",
        "object",
        "target",
    ]
    boxes = [figure._suptitle.get_window_extent(), legend.get_window_extent()]
    for box in boxes:
        assert page.x0 <= box.x0 < box.x1 <= page.x1
        assert page.y0 <= box.y0 < box.y1 <= page.y1
    panels = [ax.get_tightbbox() for ax in figure.axes if ax.axison]
    assert len(panels) == count
    assert not any(box.overlaps(panel) for box in boxes for panel in panels)
    assert figure.axes[0].get_window_extent().width >= 0.5 * page.width / min(count, 6)


class Backwards(NamedTuple):
    """Parameters of a law that drives away from its object and knows no realignment."""

    speed: float = 0.05
    d_success: float = 0.05


def step_backwards(params, state, obs):
    return state, Twist(-params.speed, 0.0, 0.0), Details.from_obs(obs)


@pytest.mark.usefixtures("registries")
def test_the_command_plots_each_mode_and_prints_a_replay_command(tmp_path, capsys):
    run = tmp_path / "run"
    brief = setting_of(10.0)
    rps_jax.register_law("backwards", Law(lambda params: (), step_backwards), Backwards())
    drums = parse_domain("wide,objects=random_cylinder,bearing=-0.5:0.5,gap=0.05:0.06")
    laws = {"mine law": "backwards"}
    rps_jax.sweep(laws, drums, 3, setting=brief, slots=8, out=run)
    text = printed(capsys, "gallery", run, "--each", 2)
    assert "never touched: 3 of 3" in text
    assert f"rps replay {run} 0 --law 'mine law'`" in text
    for world in (0, 1):
        row = rf"\| {world} +\| 10 s +\| untouched +\| 0.5 m +\|"
        assert re.search(rf"^{row}$", text, re.MULTILINE)
    picture = run / "gallery" / "never_touched.png"
    assert picture.stat().st_size > 10_000


def test_worlds_in_which_only_one_law_fails_are_listed(tmp_path, capsys):
    """With both outcomes and the replay command; the other law succeeds in each of them."""
    run, rules = tmp_path / "run", rps_jax.Rules(horizon=60.0)
    brief = rps_jax.Setting("quasistatic", rules=rules)
    drums = "wide,objects=random_cylinder,distance=1:1.5,bearing=-1:1"
    sweep = rps_jax.sweep(("nps", "rps"), drums, 16, setting=brief, slots=8, out=run)
    nps, rps_ = sweep.success.values > 0
    expected = np.flatnonzero(~nps & rps_)
    assert 0 < expected.size < (~nps).sum()
    results = rps_jax.gallery(run, law="nps", against="rps")
    assert np.flatnonzero(results.kind != "").tolist() == expected.tolist()
    text = printed(capsys, "gallery --law nps --against rps --each 1", run)
    assert text.startswith("# Failures of nps where rps succeeds")
    table = text.partition("## Worlds in which only nps fails")[2].partition("##")[0]
    worlds = re.findall(rf"^\| (\d+) .*`rps replay {run} \1 --law nps` +\|$", table, re.MULTILINE)
    assert list(map(int, worlds)) == expected.tolist()
    for name, rule in (("nps", "name another law"), ("pps", "nps, rps")):
        assert rule in refusal(capsys, f"gallery --law nps --against {name}", run)
