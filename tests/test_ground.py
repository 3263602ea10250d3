"""The rigid limit agrees with solutions by hand; the study of grounds measures pushes."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import xarray as xr
from helpers import slow
from numpy.random import default_rng
from numpy.testing import assert_allclose

from rps_jax.geometry import solid
from rps_jax.questions import Run
from rps_jax.robot.shell import HALF_WIDTH
from rps_jax.trials.progress import no_progress
from rps_jax.world import draws, paper
from rps_jax.world.domain import DOMAINS
from sweeps.ground import grounds, pushes, rigid, straight, support
from sweeps.ground.rigid import Pushed, Rounding

MU, MU_ROBOT = 0.3, 0.35
STEP = 1e-3  # [m] of the first step, which most tests check
DRY = Rounding(slip=1e-5, depth=1e-7)


def blocks(half_x, half_y, offset=0.0, bearing=0.0):
    """Return boxes by half length and width [m]; the load moves the centre of mass."""
    half_x, half_y = np.broadcast_arrays(np.atleast_1d(half_x), half_y)
    unit = np.ones(len(half_x))
    outline = solid.rectangles(half_x, half_y)
    load = offset * unit, bearing * unit, 0.1 * unit
    return solid.build(outline, 0 * unit, 0.8 * unit, 20 * unit, *load)


def drums(count=1, radius=0.25):
    unit = np.ones(count)
    return solid.build(
        np.zeros((count, 1, 2)), radius * unit, 0.7 * unit, 25 * unit, *np.zeros((3, count))
    )


def pushed(solids, robot=MU_ROBOT, height=0.0):
    unit = np.ones(solids.mass.size)
    return Pushed(solids, MU * unit, robot * unit, height * unit)


def poses_at_front(solids, y=0.0, yaw=0.0):
    """Return poses of solids that touch the base's front."""
    unit = np.ones(solids.mass.size)
    return np.column_stack([solid.extent(solids, yaw * unit), y * unit, yaw * unit])


def first_step(target, pose, direction=(1.0, 0.0), rounding=DRY):
    """Return the first step of a push."""
    touching = rigid.contacts(target.solids, pose)
    pose = pose - np.array([1.0, 0, 0]) * touching.gap.min(axis=1)[:, None]  # so that it touches
    start = np.zeros((len(pose), 3)), np.zeros((len(pose), 2))
    return rigid.solve(target, pose, np.array(direction), STEP, *start, rounding)


@pytest.mark.parametrize("height", [0.0, 0.2])
def test_a_push_through_the_middle_moves_straight_on_with_mu_m_g(height):
    for solids in (blocks(0.2, [0.2, 0.3]), drums()):
        step = first_step(pushed(solids, height=height), poses_at_front(solids))
        assert_allclose(step.twist - [1, 0, 0], 0, atol=1e-4)
        assert_allclose(step.force[:, 0], MU, rtol=1e-6)
        assert_allclose(step.force[:, 1], 0, atol=1e-6)


def test_the_push_shifts_the_load_ahead_by_its_moment():
    """Four springs at x = +-a bear 1/4 +- mu z / (4 a); three bear what the moments leave them."""
    a, z = 0.2, 0.25
    box = first_step(pushed(blocks(a, a), height=z), poses_at_front(blocks(a, a)))
    ahead = 0.25 + MU * z / (4 * a)
    assert_allclose(box.loads, [[ahead, 0.5 - ahead, 0.5 - ahead, ahead]], rtol=1e-5)
    drum = first_step(pushed(drums(radius=a), height=z), poses_at_front(drums(radius=a)))
    first = 1 / 3 + 2 / 3 * MU * z / a  # the point where it leans to
    assert_allclose(drum.loads, [[first, *[(1 - first) / 2] * 2]], rtol=1e-5)


def test_points_that_would_have_to_pull_lift_off():
    feet = blocks(0.2, 0.2).vertices
    load = rigid.supported_load(feet, np.array([[0.12, 0.12]]), np.zeros((1, 1)))
    assert load[0, 2] == 0  # the corner behind
    assert_allclose(load.sum(), 1)
    assert_allclose(load[0] @ feet[0], [0.12, 0.12])


@pytest.mark.parametrize("offset_share", [0.25, 0.5, 0.9])
def test_a_rod_turns_about_its_far_end(offset_share):
    """Two feet at -a and a, pushed at d: the far one stays, and F = mu m g a / (a + d).

    The friction's power, mu m g / 2 (|1 + w (d - a)| + |1 + w (d + a)|) at the turn w, is least
    where the far foot rests, at w = -1 / (a + d), for it falls until there and rises from there.
    """
    a, d = 0.25, offset_share * 0.25
    rod = blocks(1e-9, a)  # four feet, in pairs
    pose = np.array([[1e-3, 0.0, 0.0]])
    feet = rigid.supports(rod, pose[:, 2], np.zeros((1, 2)))
    touching = rigid.Contacts(np.array([[[1.0, 0.0]]]), np.array([[[0.0, d]]]), np.zeros((1, 1)))
    problem = rigid._problem(feet, touching, np.array([1.0, 0.0]), STEP)
    weights = np.array([[*[MU / 4] * 4, 0.0]])
    twist = rigid.minimise(problem, weights, np.zeros((1, 3)), DRY, first=True)
    assert_allclose(twist, [[a / (a + d), 0, -1 / (a + d)]], atol=3e-4)
    pushing = -rigid._gaps(problem, twist) / DRY.depth
    assert_allclose(pushing, [[MU * a / (a + d)]], rtol=1e-3)


def test_an_object_slides_along_the_base_beyond_the_cone_of_friction():
    """A base that drives askew takes a box along if tan(angle) <= mu_r, and else drags it along.

    Then the box follows the force, (1, mu_r), which is against its velocity's friction.
    """
    box = blocks(0.2, 0.2)
    for slope in (0.2, 0.34, 0.36, 0.8):
        u = np.array([1.0, slope]) / math.hypot(1.0, slope)
        step = first_step(pushed(box), poses_at_front(box), direction=tuple(u))
        share = min(slope, MU_ROBOT)
        assert_allclose(step.twist, [[u[0], u[0] * share, 0]], atol=5e-4)
        assert_allclose(np.hypot(*step.force.T), MU, rtol=1e-4)
        assert_allclose(step.force[0, 1] / step.force[0, 0], share, rtol=1e-3)


def test_cone_edges_and_push_direction_decide_the_sense_of_rotation():
    """Mason: the sense is that in which most of three lines pass the centre of friction.

    They are the two edges of the contact's cone and the line in which the base moves there.
    """
    rng = default_rng(0)
    count = 40
    half = rng.uniform(0.1, 0.25, (2, count))
    solids = blocks(*half)
    pose = poses_at_front(solids, rng.uniform(-0.15, 0.15, count), rng.uniform(-0.7, 0.7, count))
    slope = rng.uniform(-0.6, 0.6, count)
    touching = rigid.contacts(solids, pose)
    first = touching.gap.argmin(axis=1)
    at, normal = (x[np.arange(count), first] for x in (touching.at, touching.normal))
    for i in range(count):
        u = np.array([1.0, slope[i]]) / math.hypot(1.0, slope[i])
        block = pushed(blocks(*half[:, i : i + 1]))
        step = first_step(block, pose[i : i + 1], direction=tuple(u))
        tangent = np.array([-normal[i, 1], normal[i, 0]])
        lines = [normal[i] + s * MU_ROBOT * tangent for s in (-1, 1)] + [u]
        votes = np.sign([at[i, 0] * v[1] - at[i, 1] * v[0] for v in lines])
        turn = step.twist[0, 2]
        assert np.sign(turn) == np.sign(votes.sum()) or abs(turn) < 1e-3


def test_pushes_mirror_balance_and_converge():
    """Mirrored pushes end mirrored; the base does the work of friction; steps have converged."""
    solids = blocks([0.2, 0.2, 0.3, 0.3], [0.2, 0.2, 0.3, 0.3])
    sign = np.array([1, -1, 1, -1])
    target = pushed(solids, height=0.2)
    pose = poses_at_front(solids, 0.1 * sign, 0.3 * sign)
    coarse, fine = (rigid.push(target, pose, 0.1, steps) for steps in (15, 30))
    assert_allclose(fine.pose[:, 0] * [1, -1, -1], fine.pose[:, 1], atol=1e-6)
    assert_allclose(fine.pose[:, 2] * [1, -1, -1], fine.pose[:, 3], atol=1e-6)
    assert max(coarse.rounds, fine.rounds) < rigid.ROUNDS
    assert np.abs(coarse.pose[-1] - fine.pose[-1])[:, :2].max() < 1e-3
    assert_allclose(fine.force[5:, :, 0], fine.power[5:], atol=2e-3)
    softer = rigid.push(target, pose, 0.1, 15, rounding=Rounding(slip=1e-3, depth=1e-5))
    assert np.abs(coarse.pose[-1] - softer.pose[-1])[:, :2].max() < 5e-4


@pytest.mark.parametrize(("name", "bound"), [slow("box", 3e-3), ("cylinder", 1e-9)])
def test_a_constant_lift_of_a_sliding_object_barely_changes_its_final_pose(name, bound):
    """It moves load between the diagonals of four points, and none between three points."""
    limit = partial(pushes.in_the_limit, pushes.targets()[name], [0.08], 0.06, steps=60)
    lateral = [limit(rounding=Rounding(lift=lift)).lateral for lift in (0.0, 1.2)]
    assert abs(lateral[0] - lateral[1])[0] < bound


def test_a_box_touches_with_its_corners_and_at_the_ends_of_the_front():
    box = blocks(0.2, 0.2)
    flush = rigid.contacts(box, np.array([[0.21, 0.0, 0.0]]))
    assert (flush.gap[0] < 0.011).sum() == 2  # its two rear corners
    shifted = rigid.contacts(box, np.array([[0.21, 0.2, 0.0]]))  # one corner beyond the front
    near = shifted.gap[0] < 0.5
    assert_allclose(shifted.gap[0][near].min(), 0.01)
    end = shifted.at[0, -1]
    assert_allclose(end, [-0.21, HALF_WIDTH - 0.2])
    assert_allclose(shifted.gap[0, -1], 0.01)
    assert shifted.gap[0, -2] == 1.0  # the other end meets nothing


def test_a_push_in_mujoco_agrees_with_the_rigid_limit():
    """On this project's ground, at 5 cm/s, pushed at the lower edge of the base."""
    box = pushes.targets()["box"]
    measured = pushes.in_mujoco(box, 0.08, 0.05, grounds.GROUNDS["standard"].physics)
    rigid_one = pushes.in_the_limit(box, [0.08], float(measured.height), steps=100)
    assert 0.059 < measured.height < 0.075
    assert abs(measured.lateral - rigid_one.lateral[0]) < 2e-3
    assert_allclose(measured.force, 1, atol=0.02)
    assert measured.spread < 0.02
    assert measured.aloft == 0
    assert 0 < measured.hop < 1e-3


def test_a_study_is_labelled_and_cached(tmp_path, monkeypatch):
    kinds = {name: replace(grounds.GROUNDS[name], speeds=(0.2,)) for name in ("fast", "standard")}
    monkeypatch.setattr(grounds, "GROUNDS", kinds)
    monkeypatch.setattr(grounds, "HEIGHTS", (0.06, 0.34))
    options = {"objects": ("box",), "offsets": (0.05, 0.12), "steps": 20}
    progress = []
    results = grounds.run(tuple(kinds), Run(tmp_path, progress.append), **options)
    sizes = {"ground": 2, "object": 1, "offset": 2, "speed": 1, "at_height": 2}
    assert dict(results.sizes) == sizes
    assert progress[-1].finished == 4
    assert np.isfinite(results.error).all()
    monkeypatch.setattr(pushes, "in_mujoco", None)  # nothing is run again
    again = grounds.run(tuple(kinds), Run(tmp_path, no_progress), **options)
    xr.testing.assert_equal(results, again)
    header, first, *rows = grounds.table(results, (0.2,))
    assert header[0] == "ground"
    assert first[0] == "rigid object"
    assert [row[0] for row in rows] == [kind.what for kind in kinds.values()]


def test_prisms_face_the_base_with_a_side_before_their_middle():
    drawn = draws.draw(DOMAINS["prisms"], 0, np.arange(40))
    yaw = straight.yaw_of_side(drawn.solid.vertices)
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = np.moveaxis(drawn.solid.vertices, -1, 0)
    x, y = c * x - s * y, s * x + c * y
    for row_x, row_y in zip(x, y, strict=True):
        side = row_y[np.isclose(row_x, row_x.min(), atol=1e-9)]
        assert side.min() < 0 < side.max()
    assert_allclose(straight.yaw_of_side(blocks(0.1, [0.3, 0.05]).vertices), 0, atol=1e-12)


def test_straight_pushes_on_low_friction_need_mu_m_g():
    results = straight.straight(kinds=("standard", "lower"), worlds=6)
    assert dict(results.sizes) == {"kind": 2, "world": 6}
    slippery = results.friction.values[0] < 0.4
    assert slippery.any()
    assert_allclose(results.force.values[:, slippery], 1, atol=0.05)
    assert (results.spread.values[:, slippery] < 0.05).all()
    header, *rows = straight.table(results)
    assert len(rows) == 2
    assert len(header) == len(rows[0])


def test_the_posterior_of_the_support_is_that_by_hand():
    """The box is as in the paper on its rim with the last slips; the cylinder tells nothing."""
    shape = (len(support.SLIPS), 2, len(support.SUPPORTS), len(support.FRICTIONS))
    printed = list(paper.HARDWARE_RESULTS.values())
    dims = ("slips", "object", "support", "friction")
    means = {
        "D": np.broadcast_to(np.array([x.mean_abs_l for x in printed])[:, None, None], shape),
        "time": np.broadcast_to(np.array([x.time for x in printed])[:, None, None], shape),
        "D_variance": np.zeros(shape),
        "time_variance": np.zeros(shape),
        "successes": np.ones(shape),
    }
    d = means["D"].copy()
    d[:, 0] += 0.02
    d[-1, 0, 1] -= 0.02
    d[:, 1, 2] = np.nan  # a cylinder has no corners
    coords = {"object": ["box", "cylinder"], "support": list(support.SUPPORTS)}
    coords["friction"] = list(support.FRICTIONS)
    columns = {name: (dims, x) for name, x in (means | {"D": d}).items()}
    results = xr.Dataset(columns, coords)
    p = support.posterior(results)
    assert_allclose(p.sum(("slips", "support", "friction")), 1)
    shares = support.marginals(results)
    assert shares["pressure under the box"]["rim"] > 0.99
    assert shares["pressure under the cylinder"] == pytest.approx(
        {"even": 0.5, "rim": 0.5, "corners": 0}, abs=1e-6
    )
    assert shares["slips"]["three"] > 0.99
    slips = len(support.SLIPS) - 1
    assert support.readings(results)["three slips"][0] == (slips, 1, 0)
