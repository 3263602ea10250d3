"""Positions of the taxels of the skin, and type and position of its contacts.

The base is 0.725 m by 0.58 m: its front face is the line x = 0.3625, its sides are y = +-0.29.
"""

from __future__ import annotations

import itertools
import math

import chex
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

from rps_jax import errors
from rps_jax.geometry import footprint as fp
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot import shell
from rps_jax.robot.shell import Shell
from rps_jax.robot.skin import LINE, NONE, POINT, CapacitiveSkin, IdealSkin

FRONT, SIDE = 0.3625, 0.29  # [m]
PITCH = 0.58 / 12  # [m] from taxel to taxel
FACES = dict(zip(shell.SIDES, Shell().rows(), strict=True))
TAXELS = np.asarray(Shell().taxels()[:, 0])  # (42, 2) [m] their middles
TAXEL_SAMPLES = np.asarray(Shell().taxels(5))  # (42, 5, 2) [m]
SETTLED = 1e3  # [s] a period after which the low-pass filter has forgotten its past

property_test = hypothesis.settings(max_examples=100, deadline=None)
seeds = st.integers(0, 2**32 - 1)

IDEAL, CAPACITIVE = IdealSkin(), CapacitiveSkin()


@jax.jit
def sense_one(sensor, state, footprint, period):
    return sensor.sense(state, footprint, period)


@jax.jit
def sense_all(sensor, footprints):
    """Settled readings of a batch of footprints, each by a fresh sensor."""
    state = sensor.init(jax.random.key(0))
    return jax.vmap(lambda shape: sensor.sense(state, shape, SETTLED)[1])(footprints)


@jax.jit
def place_before_the_front(shape: Footprint, yaw, y, gap) -> Footprint:
    """`shape` turned by `yaw`, its origin at `y`, its nearest point `gap` before the front."""
    turned = fp.place(shape, jnp.zeros(2), yaw)
    x = FRONT + gap + fp.extent(turned, jnp.array([-1.0, 0.0]))
    return fp.place(turned, jnp.stack([x, jnp.asarray(y, x.dtype)]), 0.0)


place_all = jax.jit(jax.vmap(place_before_the_front))


def box(x: float, y: float, half: float = 0.2, yaw: float = 0.0) -> Footprint:
    return fp.place(fp.rectangle(half, half), jnp.array([x, y]), jnp.float32(yaw))


def ball(x: float, y: float, radius: float = 0.25) -> Footprint:
    return fp.place(fp.circle(radius), jnp.array([x, y]), 0.0)


def read(sensor, footprint: Footprint) -> tuple[int, float, float]:
    """Return (contact type, x, y) of a settled reading."""
    _, reading = sense_one(sensor, sensor.init(jax.random.key(0)), footprint, SETTLED)
    assert bool(reading.in_contact) == (reading.contact_type != NONE)
    return int(reading.contact_type), *map(float, reading.p_robot_contact)


def approx_reading(kind: int, x: float, y: float, abs=1e-6):
    return kind, pytest.approx(x, abs=abs), pytest.approx(y, abs=abs)


def random_placements(seed: int, n: int = 64, gap=(-0.004, 0.012)) -> dict[str, Footprint]:
    """Boxes and circles about the front: any yaw, some flush, any place along it."""
    rng = np.random.default_rng(seed)
    yaw = rng.choice([0.0, 1.0], n, p=[0.2, 0.8]) * rng.uniform(-4, 4, n)
    where = (yaw, rng.uniform(-0.35, 0.35, n), rng.uniform(*gap, n))
    where = [v.astype(np.float32) for v in where]
    half = rng.uniform(0.1, 0.35, (2, n)).astype(np.float32)
    shapes = {"box": jax.vmap(fp.rectangle)(*half), "circle": jax.vmap(fp.circle)(half[0])}
    return {kind: place_all(shape, *where) for kind, shape in shapes.items()}


# The layout


def test_there_are_42_taxels_on_14_boards_of_three_electrodes():
    assert TAXELS.shape == (42, 2)
    assert sum(row.count for row in shell.BOARDS) == 14
    assert {row.electrodes for row in shell.BOARDS} == {3}


def test_15_taxels_lie_on_each_side_and_12_on_the_front():
    left_face, front_face, right_face = np.split(TAXELS, [15, 27])
    np.testing.assert_allclose(left_face[:, 1], SIDE)
    np.testing.assert_allclose(front_face[:, 0], FRONT)
    np.testing.assert_allclose(right_face[:, 1], -SIDE)
    for face in (left_face, front_face, right_face):
        assert (np.abs(face) <= np.array([FRONT, SIDE]) + 1e-7).all()


def test_the_critical_region_ends_5_cm_beyond_l_cr():
    assert pytest.approx(0.24 + 0.05) == shell.HALF_WIDTH


def test_the_taxels_of_every_face_have_the_pitch_of_48_3_mm_and_fill_it():
    for face in np.split(TAXELS, [15, 27]):
        steps = np.linalg.norm(np.diff(face, axis=0), axis=1)
        np.testing.assert_allclose(steps, 0.0483, atol=1e-4)
    lengths = [face.length for face in FACES.values()]
    np.testing.assert_allclose(lengths, np.array([15, 12, 15]) * PITCH, atol=1e-12)


def test_the_strip_runs_from_left_rear_across_the_front_to_right_rear():
    left_face, front_face, right_face = np.split(TAXELS, [15, 27])
    assert (np.diff(left_face[:, 0]) > 0).all()
    assert (np.diff(front_face[:, 1]) < 0).all()
    assert (np.diff(right_face[:, 0]) < 0).all()


def test_the_strip_is_continuous_around_the_corners():
    faces = list(FACES.values())
    for face, following in itertools.pairwise(faces):
        np.testing.assert_allclose(face.start + face.length * face.along, following.start)
    # Each taxel beside a corner is half a pitch from it.
    np.testing.assert_allclose(
        TAXELS[[14, 15]], [[FRONT - PITCH / 2, SIDE], [FRONT, SIDE - PITCH / 2]]
    )
    np.testing.assert_allclose(
        TAXELS[[26, 27]], [[FRONT, PITCH / 2 - SIDE], [FRONT - PITCH / 2, -SIDE]]
    )


def test_the_samples_of_a_taxel_are_spread_evenly_about_its_middle():
    np.testing.assert_allclose(TAXEL_SAMPLES.mean(axis=1), TAXELS, atol=1e-7)
    steps = np.linalg.norm(np.diff(TAXEL_SAMPLES, axis=1), axis=-1)
    np.testing.assert_allclose(steps, PITCH / TAXEL_SAMPLES.shape[1], rtol=1e-4)


# The ideal sensor


@pytest.mark.parametrize("y", [0.0, 0.05, -0.07])
@pytest.mark.parametrize("gap", [0.0, 0.004, -0.003])
def test_a_flush_box_is_a_line_contact_at_its_middle(y, gap):
    assert read(IDEAL, box(FRONT + 0.2 + gap, y)) == approx_reading(LINE, FRONT, y)


def test_a_box_at_45_degrees_is_a_point_contact_at_its_corner():
    x = FRONT + 0.2 * math.sqrt(2)
    for y in (0.0, 0.1, -0.2):
        for gap in (0.0, 0.004):
            got = read(IDEAL, box(x + gap, y, yaw=math.pi / 4))
            assert got == approx_reading(POINT, FRONT, y)


@pytest.mark.parametrize(
    ("gap", "kind"),
    [
        (0.0, LINE),  # half the chord is sqrt(0.256^2 - 0.25^2) = 55 mm
        (0.0055, POINT),  # sqrt(0.256^2 - 0.2555^2) = 16 mm: less than one taxel in all
    ],
)
def test_a_circle_touches_beside_its_middle(gap, kind):
    for y in (0.0, 0.12, -0.2):
        assert read(IDEAL, ball(FRONT + 0.25 + gap, y)) == approx_reading(kind, FRONT, y)


def test_a_contact_longer_than_one_taxel_is_a_line():
    # A flush box of half width h, at no gap, is within 6 mm of 2 h + 12 mm of the front.
    for margin, kind in [(-1e-4, POINT), (1e-4, LINE)]:
        half = (PITCH - 0.012 + margin) / 2
        assert read(IDEAL, box(FRONT + half, 0.03, half))[0] == kind
    assert read(IDEAL._replace(point_length=1.0), box(FRONT + 0.2, 0.0))[0] == POINT


def test_a_tilted_corner_is_felt_as_far_as_the_tolerance_reaches():
    """Both sides of the corner are within the tolerance."""
    # The corner (-h, h) of a box turned by the angle of (4, 3) is at (-1.4, 0.2) h. From it one
    # side leaves along (4, 3) / 5, above, and one along (3, -4) / 5. Shifted outward by 6 mm they
    # meet the front 6 / 0.8 = 7.5 mm above and 6 / 0.6 = 10 mm below the corner.
    shape = box(FRONT + 1.4 * 0.2, -0.1 - 0.2 * 0.2, yaw=math.atan2(3, 4))
    assert read(IDEAL, shape) == approx_reading(POINT, FRONT, -0.1 - 0.00125)


def test_a_contact_around_the_corner_ends_on_the_side_and_on_the_front():
    # A flush box over y = 0.05 ... 0.45: the left face is within 6 mm of it from x = FRONT - 6 mm,
    # the front down to y = 0.05 - 6 mm.
    expected = (FRONT - 0.003, 0.5 * (SIDE + 0.044))
    assert read(IDEAL, box(FRONT + 0.2, 0.25)) == approx_reading(LINE, *expected)
    assert read(IDEAL, box(FRONT + 0.2, -0.25)) == approx_reading(LINE, expected[0], -expected[1])


@pytest.mark.parametrize("x", [0.0, 0.1, -0.15])
def test_a_flush_box_beside_the_base_touches_its_side(x):
    for side in (1, -1):
        assert read(IDEAL, box(x, side * (SIDE + 0.2))) == approx_reading(LINE, x, side * SIDE)
        # A box of half width 0.2 covers 8 whole taxels and some of two more.
        kind, got_x, got_y = read(CAPACITIVE, box(x, side * (SIDE + 0.2)))
        assert (kind, got_y) == (LINE, pytest.approx(side * SIDE))
        assert abs(got_x - x) <= PITCH / 2


def test_an_object_that_overhangs_the_rear_touches_only_the_side():
    # Over x = -0.5625 ... -0.1625: from the end at -0.3625 to 6 mm beyond -0.1625.
    for side in (1, -1):
        expected = approx_reading(LINE, 0.5 * (-FRONT - 0.1565), side * SIDE)
        assert read(IDEAL, box(-FRONT, side * (SIDE + 0.2))) == expected


def test_there_is_no_skin_on_the_rear():
    for sensor in (IDEAL, CAPACITIVE):
        assert read(sensor, box(-FRONT - 0.2, 0.0)) == (NONE, 0.0, 0.0)


SHAPES = {
    "box": lambda gap: box(FRONT + 0.2 + gap, 0.05),
    "corner": lambda gap: box(FRONT + 0.2 * math.sqrt(2) + gap, 0.0, yaw=math.pi / 4),
    "circle": lambda gap: ball(FRONT + 0.25 + gap, -0.1),
    "box on the left": lambda gap: box(0.1, SIDE + 0.2 + gap),
    "circle on the right": lambda gap: ball(-0.1, -SIDE - 0.25 - gap),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("tolerance", [0.006, 0.02])
def test_an_object_is_felt_up_to_the_tolerance_and_not_beyond(shape, tolerance):
    sensor = IDEAL._replace(tolerance=tolerance)
    assert read(sensor, SHAPES[shape](tolerance - 1e-5))[0] != NONE
    assert read(sensor, SHAPES[shape](tolerance + 1e-5)) == (NONE, 0.0, 0.0)


def test_an_object_past_the_end_of_a_face_is_felt_only_near_it():
    # In line with the front, but 7 mm past the corner at y = 0.29; then 5 mm.
    assert read(IDEAL, box(FRONT + 0.2, SIDE + 0.207))[0] == NONE
    assert read(IDEAL, box(FRONT + 0.2, SIDE + 0.205))[0] == POINT


def test_the_ideal_sensor_has_no_memory():
    state = IDEAL.init(jax.random.key(0))
    next_state, _ = sense_one(IDEAL, state, box(FRONT + 0.2, 0.0), 0.02)
    chex.assert_trees_all_equal(next_state, state)


@property_test
@hypothesis.given(seeds)
def test_an_ideal_contact_is_on_the_skin_and_near_the_object(seed):
    """Or between two points of the skin, if the object touches around a corner."""
    for shapes in random_placements(seed).values():
        reading = sense_all(IDEAL, shapes)
        touch, at = np.asarray(reading.in_contact), np.asarray(reading.p_robot_contact)
        assert touch.any()
        assert (~touch).any()
        assert (np.abs(at) <= np.array([FRONT, SIDE]) + 1e-6).all()
        assert (at[~touch] == 0).all()
        # The object and its surroundings are convex, so no mean of two of their points is outside.
        distance = np.asarray(jax.vmap(fp.signed_distance)(shapes, at))
        assert (distance[touch] <= 0.006 + 1e-5).all()


def test_derivatives_of_a_reading_are_finite_even_if_nothing_is_felt():
    state = IDEAL.init(jax.random.key(0)), CAPACITIVE.init(jax.random.key(0))

    @jax.jit
    @jax.vmap
    def slope(pose):
        def location(pose, i):
            shape = fp.place(fp.rectangle(0.2, 0.2), pose[:2], pose[2])
            return (IDEAL, CAPACITIVE)[i].sense(state[i], shape, SETTLED)[1].p_robot_contact

        return [jax.jacrev(location)(pose, i) for i in range(2)]

    poses = [[FRONT + 0.2, 0.05, 0.0], [FRONT + 0.206, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    ideal, capacitive = slope(jnp.array(poses))
    assert np.isfinite(ideal).all()
    assert np.isfinite(capacitive).all()
    # A flush box that moves to the left moves its contact as far.
    np.testing.assert_allclose(ideal[0, :, 1], [0.0, 1.0], atol=1e-5)


# Both sensors


def clear_cut(less_sensitive, more_sensitive, shapes: Footprint) -> np.ndarray:
    """Return whether (n,) a slightly different sensor gives the same: rounding decides nothing."""
    less, more = sense_all(less_sensitive, shapes), sense_all(more_sensitive, shapes)
    moved = np.abs(less.p_robot_contact - more.p_robot_contact).max(axis=1)
    return (moved < 2e-5) & np.asarray(less.contact_type == more.contact_type)


@pytest.mark.parametrize(
    ("sensor", "less", "more"),
    [
        (IDEAL, IDEAL._replace(tolerance=0.006 - 1e-6), IDEAL._replace(tolerance=0.006 + 1e-6)),
        (CAPACITIVE, CAPACITIVE._replace(threshold=0.2501), CAPACITIVE._replace(threshold=0.2499)),
    ],
    ids=["ideal", "capacitive"],
)
@property_test
@hypothesis.given(seeds)
def test_a_mirrored_object_gives_the_mirrored_reading(sensor, less, more, seed):
    for shapes in random_placements(seed).values():
        # Mirrored vertices are counter-clockwise again in reverse.
        mirrored = shapes._replace(vertices=(shapes.vertices * jnp.array([1.0, -1.0]))[:, ::-1])
        readings, mirrored_readings = sense_all(sensor, shapes), sense_all(sensor, mirrored)
        sure = clear_cut(less, more, shapes)
        assert sure.mean() > 0.5
        np.testing.assert_array_equal(
            mirrored_readings.contact_type[sure], readings.contact_type[sure]
        )
        np.testing.assert_allclose(
            mirrored_readings.p_robot_contact[sure],
            (readings.p_robot_contact * np.array([1, -1]))[sure],
            atol=1e-5,
        )


@property_test
@hypothesis.given(seeds)
def test_in_firm_contact_both_sensors_agree_within_one_taxel(seed):
    """Firm: against the rigid base. `tolerance` is where a flush box passes the threshold."""
    ideal = IDEAL._replace(tolerance=0.008)  # 10 mm / 1.25
    for shapes in random_placements(seed, gap=(-0.004, 0.0005)).values():
        exact, felt = sense_all(ideal, shapes), sense_all(CAPACITIVE, shapes)
        is_front = np.abs(exact.p_robot_contact[:, 1]) < SIDE - PITCH  # not on a corner of the base
        is_front &= np.asarray(exact.in_contact)
        assert is_front.sum() > 16
        assert felt.in_contact[is_front].all()
        distance = np.linalg.norm(exact.p_robot_contact - felt.p_robot_contact, axis=1)
        assert distance[is_front].max() <= PITCH


@pytest.mark.parametrize(("gap", "kind"), [(1.4e-3, LINE), (1.5e-3, NONE)])
def test_a_corner_between_two_taxels_must_press_deeper_than_a_flush_box(gap, kind):
    # A corner at 45 degrees, 4.83 mm beside the nearest sample of each of the two taxels, is
    # (gap + 4.83 mm) / sqrt(2) from it; the other samples feel nothing. The mean of five changes
    # is 1/4 if this one is 5/4: 10 mm / 2.25 = 4.44 mm, a gap of 1.45 mm.
    shape = box(FRONT + 0.2 * math.sqrt(2) + gap, 0.0, yaw=math.pi / 4)
    assert read(CAPACITIVE, shape)[0] == kind


@pytest.mark.parametrize("sensor", [IDEAL, CAPACITIVE], ids=["ideal", "capacitive"])
@pytest.mark.parametrize("value", [math.nan, -0.01, math.inf])
def test_check_names_the_parameter_that_no_skin_can_have(sensor, value):
    sensor.check()
    for name in set(sensor._fields) - {"shell"}:
        with pytest.raises(errors.InputError, match=rf"\b{name} = "):
            sensor._replace(**{name: value}).check()


@pytest.mark.parametrize(
    ("name", "value"),
    [("foam", 0.0), ("time_constant", 0.0), ("max_compression", 1.0), ("dead_share", 1.1)],
)
def test_check_rejects_divisions_by_zero_and_invalid_shares(name, value):
    with pytest.raises(errors.InputError, match=rf"\b{name} = "):
        CAPACITIVE._replace(**{name: value}).check()


# The capacitive sensor


def active_taxels(active: np.ndarray):
    """The reading of exactly these taxels: their signals are set, and no time passes."""
    state = CAPACITIVE.init(jax.random.key(0))
    signal = jnp.where(jnp.asarray(active), 1.0, 0.0)
    return sense_one(CAPACITIVE, state._replace(signal=signal), ball(9.0, 0.0), 0.0)[1]


def test_one_taxel_is_a_point_contact_at_its_position():
    for i in range(42):
        reading = active_taxels(np.arange(42) == i)
        assert reading.contact_type == POINT
        np.testing.assert_allclose(reading.p_robot_contact, TAXELS[i], rtol=1e-6)


@property_test
@hypothesis.given(st.sets(st.integers(0, 41), min_size=2))
def test_several_taxels_give_a_line_at_the_mean_of_the_outermost_two(active):
    reading = active_taxels(np.isin(np.arange(42), list(active)))
    assert reading.contact_type == LINE
    expected = (TAXELS[min(active)] + TAXELS[max(active)]) / 2
    np.testing.assert_allclose(reading.p_robot_contact, expected, atol=1e-6)


def test_no_taxel_is_no_contact():
    reading = active_taxels(np.zeros(42, bool))
    assert reading.contact_type == NONE
    assert not reading.in_contact
    np.testing.assert_array_equal(reading.p_robot_contact, [0, 0])


def test_a_small_object_pressed_onto_one_taxel_is_felt_there():
    for i, (x, y) in enumerate(TAXELS[15:27]):
        got = read(CAPACITIVE, ball(x + 0.01, y, radius=0.015))
        assert got == approx_reading(POINT, *TAXELS[15 + i])


FLUSH_TAXELS = slice(19, 23)  # the four about the middle of the front


def signals(gap: float, period: float, steps: int, sensor=CAPACITIVE):
    """The signal of a taxel (steps,) after a flush box appears at `gap`, and the readings."""
    state, shape = sensor.init(jax.random.key(0)), box(FRONT + 0.2 + gap, 0.0)
    values, touch = [], []
    for _ in range(steps):
        state, reading = sense_one(sensor, state, shape, period)
        np.testing.assert_allclose(state.signal[FLUSH_TAXELS], state.signal[20], rtol=1e-5)
        values.append(float(state.signal[20]))
        touch.append(bool(reading.in_contact))
    return np.array(values), touch


@pytest.mark.parametrize(
    ("gap", "change"),
    [
        (0.005, 1.0),  # 10 mm / 5 mm - 1
        (0.008, 0.25),
        (0.002, 4.0),
        (0.0, 9.0),  # nine tenths of the foam can give way: 10 mm / 1 mm - 1
        (-0.02, 9.0),
        (0.01, 0.0),
        (0.5, 0.0),
    ],
)
def test_the_capacitance_is_inverse_to_the_gap_the_object_leaves(gap, change):
    assert signals(gap, SETTLED, 1)[0] == pytest.approx(change, rel=1e-4, abs=1e-5)


def test_the_signal_follows_a_step_with_the_time_constant():
    # 5 mm of compression: change 1. After t it has grown to 1 - exp(-t / 50 ms).
    values, _ = signals(0.005, 0.01, 10)
    np.testing.assert_allclose(values[[4, 9]], [0.6321206, 0.8646647], rtol=1e-4)
    np.testing.assert_allclose(values, 1 - np.exp(-np.arange(1, 11) / 5), rtol=1e-4)


def test_the_step_response_does_not_depend_on_the_period():
    assert signals(0.005, 0.02, 1)[0][-1] == pytest.approx(signals(0.005, 0.001, 20)[0][-1])


def test_the_signal_fades_with_the_time_constant():
    state, _ = sense_one(
        CAPACITIVE, CAPACITIVE.init(jax.random.key(0)), box(FRONT + 0.205, 0.0), SETTLED
    )
    next_state, _ = sense_one(CAPACITIVE, state, ball(9.0, 0.0), 0.05)
    np.testing.assert_allclose(next_state.signal, state.signal / math.e, rtol=1e-5, atol=1e-7)


def test_touch_begins_when_the_signal_passes_the_threshold():
    # 1 - exp(-t / 50 ms) = 1/4 at t = 50 ms ln(4/3) = 14.4 ms: the 15th reading, 1 ms apart.
    _, touch = signals(0.005, 0.001, 20)
    assert touch == [False] * 14 + [True] * 6


def test_a_flush_box_is_felt_where_the_signal_exceeds_the_threshold():
    """The low-pass filter has settled."""
    # 10 mm / gap - 1 > 0.25: a gap below 8 mm. And with threshold 1: below 5 mm.
    for threshold, gap in [(0.25, 0.008), (1.0, 0.005)]:
        sensor = CAPACITIVE._replace(threshold=threshold)
        assert read(sensor, box(FRONT + 0.2 + gap - 1e-5, 0.0)) == approx_reading(LINE, FRONT, 0.0)
        assert read(sensor, box(FRONT + 0.2 + gap + 1e-5, 0.0)) == (NONE, 0.0, 0.0)


def test_the_more_an_object_presses_the_more_capacitance():
    def settled(gap):
        shape = place_before_the_front(fp.rectangle(0.2, 0.1), 0.3, 0.05, gap)
        return CAPACITIVE.sense(CAPACITIVE.init(jax.random.key(0)), shape, SETTLED)[0].signal

    signal = np.asarray(jax.jit(jax.vmap(settled))(jnp.linspace(0.012, -0.05, 200)))
    assert (np.diff(signal, axis=0) >= -1e-6).all()
    np.testing.assert_allclose(signal[0], np.zeros(42), atol=1e-7)
    assert (signal[-1] > 1).sum() >= 3


LONG = 2000
QUIET = box(9.0, 0.0)


@jax.jit
def long_record(sensor, key):
    """The signals (LONG, 42) of a sensor without contact, every 20 ms."""

    def scan(state, _):
        state, _ = sensor.sense(state, QUIET, 0.02)
        return state, state.signal

    return jax.lax.scan(scan, sensor.init(key), length=LONG)[1]


def test_noise_is_drawn_afresh_for_every_reading_and_taxel_then_filtered():
    signal = np.asarray(long_record(CAPACITIVE._replace(noise=0.1), jax.random.key(1)))[100:]
    # Variance of a first-order filter: a / (2 - a), a = 1 - exp(-20 / 50) = 0.3297; root 0.4443.
    assert signal.std() == pytest.approx(0.04443, rel=0.03)
    assert abs(signal.mean()) < 1e-3
    # One reading later the correlation has fallen to exp(-20 / 50) = 0.670.
    assert np.mean(signal[1:] * signal[:-1]) / signal.var() == pytest.approx(0.670, abs=0.02)
    between_taxels = np.corrcoef(signal.T)[np.triu_indices(42, 1)]
    assert np.abs(between_taxels).max() < 0.2
    assert abs(between_taxels.mean()) < 0.01


def test_noise_depends_on_the_key_alone():
    noisy = CAPACITIVE._replace(noise=0.1)
    first, again, different = (long_record(noisy, jax.random.key(k)) for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (np.asarray(first) != np.asarray(different)).mean() > 0.99


def test_without_noise_a_sensor_that_feels_nothing_is_silent():
    signal = long_record(CAPACITIVE, jax.random.key(1))
    np.testing.assert_allclose(signal, np.zeros((LONG, 42)), atol=1e-7)


@jax.jit
def batch_of(sensor):
    """Return 500 sensors with equal parameters."""
    return jax.vmap(sensor.init)(jax.random.split(jax.random.key(3), 500))


def test_gains_spread_about_one_from_taxel_to_taxel_and_sensor_to_sensor():
    gain = np.asarray(batch_of(CAPACITIVE._replace(gain_spread=0.2)).gain)
    assert gain.mean() == pytest.approx(1, abs=0.01)
    assert gain.std() == pytest.approx(0.2, rel=0.03)
    assert gain.std(axis=0).min() > 0.15
    assert gain.std(axis=1).min() > 0.1
    np.testing.assert_array_equal(batch_of(CAPACITIVE).gain, np.ones((500, 42)))


def test_a_signal_is_proportional_to_the_gain():
    state = CAPACITIVE.init(jax.random.key(0))
    gain = jnp.linspace(0.5, 1.5, 42)
    shape = box(FRONT + 0.205, 0.0)
    plain, _ = sense_one(CAPACITIVE, state, shape, 0.02)
    scaled, _ = sense_one(CAPACITIVE, state._replace(gain=gain), shape, 0.02)
    np.testing.assert_allclose(scaled.signal, gain * plain.signal, rtol=1e-6)


def test_the_share_of_dead_taxels_is_as_requested():
    for share in (0.0, 0.3, 1.0):
        alive = np.asarray(batch_of(CAPACITIVE._replace(dead_share=share)).alive)
        assert alive.mean() == pytest.approx(1 - share, abs=0.01)
    assert not alive.any()


def test_a_skin_of_dead_taxels_feels_nothing():
    for shape in (box(FRONT + 0.2, 0.0), box(FRONT, 0.0), box(0.0, SIDE)):
        assert read(CAPACITIVE, shape)[0] == LINE
        assert read(CAPACITIVE._replace(dead_share=1.0), shape) == (NONE, 0.0, 0.0)


def test_a_dead_taxel_at_the_end_of_a_contact_shifts_it_by_half_a_pitch():
    state, shape = CAPACITIVE.init(jax.random.key(0)), box(FRONT + 0.2, 0.0)
    whole, reading = sense_one(CAPACITIVE, state, shape, SETTLED)
    first = int(np.argmax(whole.signal > CAPACITIVE.threshold))
    one_dead = state._replace(alive=jnp.arange(42) != first)
    _, shifted = sense_one(CAPACITIVE, one_dead, shape, SETTLED)
    np.testing.assert_allclose(
        shifted.p_robot_contact - reading.p_robot_contact, [0, -PITCH / 2], atol=1e-6
    )
