"""Pushes by one round finger, and objects that are fitted to them."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from helpers import refusal, refusing, rps
from numpy.testing import assert_allclose

import rps_jax
from rps_jax.engines import finger
from rps_jax.engines.finger import Slider
from rps_jax.tuning import objects
from rps_jax.tuning.objects import ObjectFit, Pushes

RADIUS, FRICTION = 0.005, 0.3
SQUARE = np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])
ANGLES = np.pi / 4 * np.arange(8)
STAR = np.where(np.arange(8) % 2, 0.035, 0.06)[:, None] * np.stack(
    [np.cos(ANGLES), np.sin(ANGLES)], 1
)
WEDGE = np.array([[0.0, 0.0], [0.12, 0.0], [0.0, 0.04]])


def slider_of(outline, friction=FRICTION, pads=None):
    pads = finger.uniform_pads(outline) if pads is None else pads
    return Slider(*map(jnp.asarray, (outline, pads, friction, RADIUS)))


def random_pushes(outline, count, seed=0, length=0.04):
    """Return straight pushes (n, 2, 2) onto the sides of an outline, and poses (n, 3)."""
    rng = np.random.default_rng(seed)
    side = rng.integers(len(outline), size=count)
    way = np.roll(outline, -1, axis=0)[side] - outline[side]
    at = outline[side] + rng.uniform(0.2, 0.8, (count, 1)) * way
    normal = np.stack([way[:, 1], -way[:, 0]], axis=1) / np.linalg.norm(way, axis=1)[:, None]
    angle = rng.uniform(-0.8, 0.8, count)[:, None]
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    start = at + (RADIUS + 5e-4) * normal
    move = length * (np.sin(angle) * tangent - np.cos(angle) * normal)
    return np.stack([start, start + move], axis=1), np.zeros((count, 3))


def test_a_push_through_the_centre_does_not_turn():
    """The object moves by what the finger does beyond the gap of 5 mm."""
    path = jnp.array([[[-0.06, 0.0], [-0.02, 0.0]]])
    pushed = finger.push(slider_of(SQUARE), path, jnp.zeros((1, 3)))
    assert_allclose(pushed.pose[0, -1], [0.035, 0.0, 0.0], atol=2e-5)
    assert_allclose(pushed.gap[0, [0, -1]], [0.005, 0.0], atol=2e-5)


def test_the_finger_stays_on_outlines_of_any_shape():
    for outline in (SQUARE, STAR, WEDGE):
        path, pose = random_pushes(outline, 64)
        corners, pads, _ = objects._fixed(outline, finger.uniform_pads(outline), RADIUS)
        slider = slider_of(corners, pads=pads)  # all of one shape
        pushed = finger.push(slider, jnp.asarray(path), jnp.asarray(pose))
        gap = np.asarray(pushed.gap)
        assert np.isfinite(pushed.pose).all()
        assert gap.min() > -4e-4
        assert np.median(np.abs(gap[:, -1])) < 5e-5


def test_a_stuck_contact_turns_the_object_with_the_least_power():
    """A two-pad bar that is pushed at right angles turns about the far pad's side (exact)."""
    pads = np.array([[-0.04, 0.0, 0.5, 1e-5], [0.04, 0.0, 0.5, 1e-5]])
    bar = np.array([[-0.06, -0.01], [0.06, -0.01], [0.06, 0.01], [-0.06, 0.01]])
    start = np.array([[0.05, -0.01 - RADIUS]])
    path = jnp.asarray(np.stack([start, start + np.array([0.0, 0.001])], axis=1))
    pushed = finger.push(slider_of(bar, 1.0, pads), path, jnp.zeros((1, 3)), 10)
    # Two equal pads: the force is beyond the near one, so the bar turns about the far pad.
    assert_allclose(pushed.pose[0, -1, 2], 0.001 / 0.09, rtol=0.02)


@jax.jit
def moved_ends(s, slider, direction, path, pose):
    """Return the ends (n, 3) of pushes of a slider moved by `s` along a direction, and slopes."""

    def ends(s):
        moved = jax.tree.map(lambda x, way: x + s * way, slider, direction)
        return finger.push(moved, path, pose, 20).pose[:, -1]

    return jax.jvp(ends, (s,), (jnp.ones_like(s),))


@pytest.mark.parametrize("name", ["outline", "pads", "friction", "radius"])
def test_derivatives_are_those_of_differences(name):
    pushes = random_pushes(SQUARE, 12, seed=3)
    with jax.enable_x64(True):
        slider = jax.tree.map(np.asarray, slider_of(SQUARE))
        way = np.random.default_rng(1).normal(size=np.shape(getattr(slider, name)))
        way = way * (1e-3 if name != "friction" else 0.1)
        direction = jax.tree.map(np.zeros_like, slider)._replace(**{name: way})
        step = 1e-4
        run = [moved_ends(s, slider, direction, *pushes) for s in (0.0, step, -step)]
        exact, slope = np.array(run[0][1]), np.array(run[1][0] - run[2][0]) / (2 * step)
    assert_allclose(exact, slope, rtol=1e-3, atol=1e-3 * float(np.abs(slope).max()))


def test_outlines_without_sense_are_refused():
    with refusing("sides must not cross"):
        finger.check_outline([(0, 0), (0.1, 0.1), (0.1, 0), (0, 0.1)])
    with refusing("outline"):
        finger.check_outline([(0, 0), (90, 0), (90, 90)])
    with refusing("enclose an area"):
        finger.check_outline([(0, 0), (0.1, 0.0), (0.2, 0)])
    assert_allclose(finger.check_outline(SQUARE[::-1]), SQUARE[::-1][::-1])


TRUTH = {"log_friction": np.log(0.2), "ring": 0.8, "camera_x": 8e-4, "marker_yaw": 0.02}


@pytest.fixture(scope="module")
def measured(optimised):
    """Noisy pushes of a known object, whose camera and markers are misplaced.

    One program, of 16 pushes, simulates all batches.
    """
    path, pose = random_pushes(SQUARE, 40, seed=5)
    x = np.array([TRUTH.get(name, 0.0) for name in objects.PRIOR])
    fixed = objects._fixed(SQUARE, finger.uniform_pads(SQUARE), RADIUS)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("_SMALL_BATCH", "_BATCH"):
            patch.setattr(objects, name, 16)
        end = objects._batched(objects._simulate, x, fixed, Pushes(path, pose, pose))[0]
        noise = np.random.default_rng(0).normal(size=end.shape) * [2e-4, 2e-4, 2e-3]
        yield Pushes(path, pose, end + noise)


def test_a_fit_finds_the_object_and_predicts_other_pushes(measured):
    few = Pushes(*(x[:12] for x in measured))
    fitted = rps_jax.fit_object(SQUARE, few, RADIUS)
    data = fitted.data
    found = data.sel(parameter=list(TRUTH))
    off = (found["mean"].values - list(TRUTH.values())) / found.deviation.values
    assert np.sqrt(np.mean(off**2)) < 3
    assert "camera_x" in fitted.misplaced
    rest = Pushes(*(x[12:] for x in measured))
    predicted = fitted.predict(rest)
    off = objects.errors_of(predicted.pose.values, rest.end)
    assert np.median(off["place"]) < 1e-3
    assert np.mean(off["place"] < predicted.place.values) > 0.7
    assert fitted.feet.shape[1] == 5
    assert len(fitted.feet) <= 16


def test_what_the_model_leaves_corrects_pushes_nearby(measured):
    few = Pushes(*(x[:12].copy() for x in measured))
    few.end[0, 0] += 2e-3
    fitted = rps_jax.fit_object(SQUARE, few, RADIUS)
    without = replace(fitted, nearby=ObjectFit.nearby)
    change = (fitted.predict(few).pose - without.predict(few).pose).values
    assert change[0, 0] > 3 * np.median(np.abs(change[1:, 0]))
    far = Pushes(few.path + 1.0, few.start, few.end)
    assert_allclose(fitted.predict(far).pose, without.predict(far).pose, atol=1e-9)


def test_an_object_on_known_feet_is_fitted(measured):
    fitted = rps_jax.fit_object(
        SQUARE, Pushes(*(x[:6] for x in measured)), RADIUS, feet=0.8 * SQUARE[:3]
    )
    assert_allclose(fitted.feet[:, :2], 0.8 * SQUARE[:3])
    assert_allclose(fitted.feet[:, 2].sum(), 1.0, atol=1e-6)


def table_of(pushes):
    """Return pushes as a table of the command."""
    rows = []
    for i, (path, start, end) in enumerate(zip(*pushes, strict=True)):
        rows += [(i, 0.0, *start, *path[0]), (i, 1.0, *end, *path[-1])]
    return pd.DataFrame(rows, columns=list(objects._COLUMNS))


def test_the_command_reads_tables_and_refuses_what_makes_no_sense(measured, tmp_path, capsys):
    table = table_of(Pushes(*(x[:6] for x in measured)))
    table.to_csv(tmp_path / "pushes.csv", index=False)
    pd.DataFrame(SQUARE, columns=["x", "y"]).to_csv(tmp_path / "outline.csv", index=False)
    paths = str(tmp_path / "outline.csv"), str(tmp_path / "pushes.csv")
    fitted = rps_jax.fit_object(*paths, RADIUS)
    assert 0.1 < fitted.friction < 0.4
    assert len(repr(fitted)) < 500
    assert rps(f"fit object {' '.join(paths)} --radius {RADIUS} --out", tmp_path / "run") == 0
    assert f"{fitted.friction:.2f}" in (tmp_path / "run/report.md").read_text()
    swapped = table.assign(time=1 - table.time)
    with refusing("times increase"):
        rps_jax.fit_object(SQUARE, swapped, RADIUS)
    with refusing("in m and yaw in rad"):
        rps_jax.fit_object(SQUARE, table.assign(x=1000 * table.x + 900), RADIUS)
    with refusing("inside the object"):
        rps_jax.fit_object(2 * SQUARE, table, RADIUS)
    with refusing("gap at the end"):
        rps_jax.fit_object(0.9 * SQUARE, table, RADIUS)
    with refusing("without a contact at the end"):
        rps_jax.fit_object(SQUARE, table.assign(tip_x=1.0 + table.tip_x), RADIUS)
    with refusing("give 3 to 64 points"):
        rps_jax.fit_object(SQUARE, table, RADIUS, feet=SQUARE[:2])
    with refusing("feet = up to .* m from its middle"):
        rps_jax.fit_object(SQUARE, table, RADIUS, feet=1000 * SQUARE)
    with refusing("pushes = None is not allowed"):
        rps_jax.fit_object(SQUARE, None, RADIUS)
    with refusing("prior size deviation = 0.0 is not allowed: .* above 0"):
        rps_jax.fit_object(SQUARE, table, RADIUS, prior={"size": (0.0, 0.0)})
    with refusing("pushes .push, time, .* = nan at index .2, 4. is not allowed"):
        rps_jax.fit_object(SQUARE, table.assign(yaw=table.yaw.drop(2)), RADIUS)
    table.assign(tip_x=table.tip_x + 1e-6).to_csv(paths[1], index=False)
    with refusing("holds another run .inputs"):  # of the same paths
        rps_jax.fit_object(*paths, RADIUS, out=tmp_path / "run")
    with refusing("lacks "):
        rps_jax.fit_object(SQUARE, table.drop(columns="yaw"), RADIUS)
    table.drop(columns="yaw").to_csv(tmp_path / "pushes.csv")
    message = refusal(capsys, "fit object", *paths, "--out", tmp_path / "refused")
    assert "lacks yaw: rename its columns" in message
    assert not (tmp_path / "refused").exists()


WITH_UNIT = {name: unit for name, unit in objects._COLUMNS.items() if unit}


@pytest.mark.parametrize("names", [*map("{}".format, WITH_UNIT), "x y tip_x tip_y"])
def test_tables_in_other_units_are_refused_before_a_compilation(
    measured, tmp_path, capsys, compiled, names
):
    table, unit = table_of(Pushes(*(x[:6] for x in measured))), WITH_UNIT[names.split()[0]]
    table["time"] *= 50 if " " in names else 1  # so slow that the speed in mm/s is not refused
    for name in names.split():
        table[name] *= {"s": 1e3, "m": 1e3, "rad": 180 / np.pi}[unit]
    table.to_csv(tmp_path / "pushes.csv", index=False)
    pd.DataFrame(SQUARE, columns=["x", "y"]).to_csv(tmp_path / "outline.csv", index=False)
    paths, count = [tmp_path / "outline.csv", tmp_path / "pushes.csv"], len(compiled)
    message = refusal(capsys, "fit object", *map(str, paths), "--out", tmp_path / "run")
    assert re.search(rf"= .* is not allowed: .* give .*\b{unit}\b", message), message
    assert len(compiled) == count
    assert not (tmp_path / "run").exists()
