"""Positions of the taxels of the skin, and type and position of its contacts.

The base is 0.725 m by 0.58 m: its front face is the line x = 0.3625, its sides are y = +-0.29.
"""

from __future__ import annotations

import itertools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    FRONT,
    SEEDS,
    SETTLED,
    SIDE,
    box,
    jitted,
    place_before_the_front,
    property_test,
    row,
)
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from rps_jax.geometry import footprint as fp
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot import shell
from rps_jax.robot.shell import Shell
from rps_jax.robot.skin import LINE, NONE, POINT, CapacitiveSkin, IdealSkin

PITCH = 0.58 / 12  # [m] from taxel to taxel
FACES = Shell().rows()
TAXELS = np.asarray(Shell().taxels()[:, 0])  # (42, 2) [m] their middles
TAXEL_SAMPLES = np.asarray(Shell().taxels(5))  # (42, 5, 2) [m]

BATCH = 128  # of one batch


any_seed = property_test(SEEDS)
IDEAL, CAPACITIVE = IdealSkin(), CapacitiveSkin()
KEY = jax.random.key(0)


@jax.jit
def sense_one(sensor, state, footprint, period):
    return sensor.sense(state, footprint, period)


@jitted
def sense_all(sensor, shapes, key):
    """Return settled readings of a batch of footprints, each of a separate sensor."""
    keys = jax.random.split(key, BATCH)
    return jax.vmap(lambda k, shape: sensor.sense(sensor.init(k), shape, SETTLED)[1])(keys, shapes)


def ball(x: float, y: float, radius: float = 0.25) -> Footprint:
    return fp.place(fp.circle(radius), jnp.array([x, y]), 0.0)


def read(sensor, footprint: Footprint) -> tuple[int, float, float]:
    """Return (contact type, x, y) of a settled reading."""
    _, reading = sense_one(sensor, sensor.init(KEY), footprint, SETTLED)
    assert bool(reading.in_contact) == (reading.contact_type != NONE)
    return int(reading.contact_type), *map(float, reading.p_robot_contact)


def approx_reading(kind: int, x: float, y: float, abs=1e-6):
    return kind, pytest.approx(x, abs=abs), pytest.approx(y, abs=abs)


def random_shapes(seed: int, gap=(-0.004, 0.012)) -> Footprint:
    """Return boxes and circles near the front at any yaw, some flush, some around its corners."""
    rng = default_rng(seed)
    yaw = rng.choice([0.0, 1.0], BATCH, p=[0.2, 0.8]) * rng.uniform(-4, 4, BATCH)
    where = (yaw, rng.uniform(-0.35, 0.35, BATCH), rng.uniform(*gap, BATCH))
    half = rng.uniform(0.1, 0.35, (BATCH, 1, 2))
    corners = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    is_round = rng.random(BATCH) < 0.5  # of four corners that are one
    corners = np.where(is_round[:, None, None], 0.0, corners)
    shape = Footprint(corners, np.where(is_round, half[:, 0, 0], 0.0))
    single = jax.tree.map(lambda x: x.astype(np.float32), (shape, *where))
    return jax.vmap(place_before_the_front)(*single)


def mirrored(shapes: Footprint) -> Footprint:
    """Return mirrored shapes, whose vertices are counter-clockwise in reverse."""
    return shapes._replace(vertices=(shapes.vertices * jnp.array([1.0, -1.0]))[:, ::-1])


# The layout


def test_42_taxels_run_from_left_rear_across_the_front_to_right_rear_at_48_3_mm():
    """15 lie on each side and 12 on the front, on 14 boards of three electrodes."""
    assert pytest.approx(0.0483, abs=1e-4) == PITCH
    side, front = (PITCH * (np.arange(count) + 0.5) for count in (15, 12))  # [m] along a face
    left_face = np.column_stack([side - FRONT, np.full(15, SIDE)])
    front_face = np.column_stack([np.full(12, FRONT), SIDE - front])
    assert_allclose(TAXELS, [*left_face, *front_face, *-left_face], atol=1e-7)
    assert sum(row.count for row in shell.BOARDS) == 14
    assert {row.electrodes for row in shell.BOARDS} == {3}


def test_the_faces_of_the_strip_follow_each_other_around_the_corners():
    lengths = [face.length for face in FACES]
    assert_allclose(lengths, np.array([15, 12, 15]) * PITCH, atol=1e-12)
    for face, following in itertools.pairwise(FACES):
        assert_allclose(face.start + face.length * face.along, following.start)


def test_the_base_is_0_725_m_by_0_58_m_and_the_critical_region_ends_5_cm_beyond_l_cr():
    assert Shell().half == (0.3625, 0.29)
    assert pytest.approx(0.24 + 0.05) == SIDE


def test_the_samples_of_a_taxel_are_spread_evenly_about_its_middle():
    assert_allclose(TAXEL_SAMPLES.mean(axis=1), TAXELS, atol=1e-7)
    steps = np.linalg.norm(np.diff(TAXEL_SAMPLES, axis=1), axis=-1)
    assert_allclose(steps, PITCH / TAXEL_SAMPLES.shape[1], rtol=1e-4)


# The ideal sensor


def corner_first(gap, y=0.0) -> Footprint:
    """Return a box with one corner `gap` before the front, turned by 45 degrees."""
    return box(FRONT + 0.2 * math.sqrt(2) + gap, y, yaw=math.pi / 4)


# Shapes with their type and position of contact.
READINGS = {
    "a flush box: a line at its middle": lambda: [
        (box(FRONT + 0.2 + gap, y), LINE, FRONT, y)
        for y in (0.0, 0.05, -0.07)
        for gap in (0.0, 0.004, -0.003)
    ],
    "a box at 45 degrees: a point at its corner": lambda: [
        (corner_first(gap, y), POINT, FRONT, y) for y in (0.0, 0.1, -0.2) for gap in (0.0, 0.004)
    ],
    # Half the chord is sqrt(0.256^2 - 0.25^2) = 55 mm. 5.5 mm before the front it is
    # sqrt(0.256^2 - 0.2555^2) = 16 mm: less than one taxel in all.
    "a circle: beside its middle": lambda: [
        (ball(FRONT + 0.25 + gap, y), kind, FRONT, y)
        for gap, kind in ((0.0, LINE), (0.0055, POINT))
        for y in (0.0, 0.12, -0.2)
    ],
    # The corner (-h, h) of a box turned by the angle of (4, 3) is at (-1.4, 0.2) h. From it one
    # side leaves along (4, 3) / 5, above, and one along (3, -4) / 5. Shifted outward by the
    # tolerance of 6 mm they meet the front 6 / 0.8 = 7.5 mm above and 6 / 0.6 = 10 mm below it.
    "a tilted corner: as far as the tolerance reaches on both sides": lambda: [
        (box(FRONT + 0.28, -0.14, yaw=math.atan2(3, 4)), POINT, FRONT, -0.1 - 0.00125)
    ],
    # A flush box over y = 0.05 ... 0.45: the left face is within 6 mm of it from x = FRONT - 6 mm,
    # the front down to y = 0.05 - 6 mm.
    "around a corner: from its end on the side to its end on the front": lambda: [
        (box(FRONT + 0.2, side * 0.25), LINE, FRONT - 0.003, side * (SIDE + 0.044) / 2)
        for side in (1, -1)
    ],
    # A flush box of half width h, at no gap, is within 6 mm of 2 h + 12 mm of the front.
    "a contact longer than one taxel: a line, a shorter one: a point": lambda: [
        (flush((PITCH - 0.012 + margin) / 2, 0.03), kind, FRONT, 0.03)
        for margin, kind in ((-1e-4, POINT), (1e-4, LINE))
    ],
    "a flush box beside the base: on its side": lambda: [
        (box(x, side * (SIDE + 0.2)), LINE, x, side * SIDE)
        for x in (0.0, 0.1, -0.15)
        for side in (1, -1)
    ],
    # Over x = -0.5625 ... -0.1625: from the end at -0.3625 to 6 mm beyond -0.1625.
    "an object that overhangs the rear: only on the side": lambda: [
        (box(-FRONT, side * (SIDE + 0.2)), LINE, (-FRONT - 0.1565) / 2, side * SIDE)
        for side in (1, -1)
    ],
    "at the rear: nothing, as there is no skin": lambda: [(box(-FRONT - 0.2, 0.0), NONE, 0.0, 0.0)],
}


def flush(half, y=0.0):
    """Return a box of a half width that touches the front."""
    return box(FRONT + half, y, half)


@pytest.mark.parametrize("name", READINGS)
def test_the_ideal_sensor_reads_type_and_position_of_the_contact(name):
    for shape, *reading in READINGS[name]():
        assert read(IDEAL, shape) == approx_reading(*reading)
    assert read(IDEAL._replace(point_length=1.0), flush(0.2))[0] == POINT


def test_the_capacitive_sensor_feels_a_box_beside_the_base_and_nothing_at_the_rear():
    """A box of half width 0.2 covers 8 whole taxels and some of two more."""
    for shape, kind, x, y in READINGS["a flush box beside the base: on its side"]():
        got_kind, got_x, got_y = read(CAPACITIVE, shape)
        assert (got_kind, got_y) == (kind, pytest.approx(y))
        assert abs(got_x - x) <= PITCH / 2
    assert read(CAPACITIVE, box(-FRONT - 0.2, 0.0)) == (NONE, 0.0, 0.0)


SHAPES = {
    "box": lambda gap: box(FRONT + 0.2 + gap, 0.05),
    "corner": corner_first,
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
    state = IDEAL.init(KEY)
    next_state, _ = sense_one(IDEAL, state, flush(0.2), 0.02)
    chex.assert_trees_all_equal(next_state, state)


@any_seed
def test_an_ideal_contact_is_on_the_skin_and_near_the_object(seed):
    """Or between two points of the skin, if the object touches around a corner."""
    shapes = random_shapes(seed)
    reading = sense_all(IDEAL, shapes, KEY)
    touch, at = np.asarray(reading.in_contact), np.asarray(reading.p_robot_contact)
    assert touch.any()
    assert (~touch).any()
    assert (np.abs(at) <= np.array([FRONT, SIDE]) + 1e-6).all()
    assert (at[~touch] == 0).all()
    # The object and its surroundings are convex, so no mean of two of their points is outside.
    distance = np.asarray(jax.vmap(fp.signed_distance)(shapes, at))
    assert (distance[touch] <= 0.006 + 1e-5).all()


def test_derivatives_of_a_reading_are_finite_even_if_nothing_is_felt():
    state = IDEAL.init(KEY), CAPACITIVE.init(KEY)

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
    assert_allclose(ideal[0, :, 1], [0.0, 1.0], atol=1e-5)


# Both sensors


def clear_cut(less_sensitive, more_sensitive, shapes: Footprint) -> np.ndarray:
    """Return whether (n,) a slightly different sensor gives the same: rounding decides nothing."""
    less, more = (sense_all(x, shapes, KEY) for x in (less_sensitive, more_sensitive))
    moved = np.abs(less.p_robot_contact - more.p_robot_contact).max(axis=1)
    return (moved < 2e-5) & np.asarray(less.contact_type == more.contact_type)


# Each sensor with a slightly less and a slightly more sensitive one.
SIMILAR = {
    IDEAL: [IDEAL._replace(tolerance=0.006 + x) for x in (-1e-6, 1e-6)],
    CAPACITIVE: [CAPACITIVE._replace(threshold=0.25 + x) for x in (1e-4, -1e-4)],
}


@pytest.mark.parametrize("sensor", SIMILAR, ids=["ideal", "capacitive"])
@any_seed
def test_a_mirrored_object_gives_the_mirrored_reading(sensor, seed):
    shapes = random_shapes(seed)
    sure = clear_cut(*SIMILAR[sensor], shapes)
    assert sure.mean() > 0.5
    plain, flipped = (row(sense_all(sensor, x, KEY), sure) for x in (shapes, mirrored(shapes)))
    assert_array_equal(flipped.contact_type, plain.contact_type)
    expected = plain.p_robot_contact * np.array([1, -1])
    assert_allclose(flipped.p_robot_contact, expected, atol=1e-5)


@any_seed
def test_in_firm_contact_both_sensors_agree_within_one_taxel(seed):
    """Firm: against the rigid base. `tolerance` is where a flush box passes the threshold."""
    ideal = IDEAL._replace(tolerance=0.008)  # 10 mm / 1.25
    shapes = random_shapes(seed, gap=(-0.004, 0.0005))
    exact, felt = (sense_all(sensor, shapes, KEY) for sensor in (ideal, CAPACITIVE))
    is_front = np.abs(exact.p_robot_contact[:, 1]) < SIDE - PITCH  # not on a corner of the base
    is_front &= np.asarray(exact.in_contact)
    assert is_front.sum() > 32
    assert felt.in_contact[is_front].all()
    distance = np.linalg.norm(exact.p_robot_contact - felt.p_robot_contact, axis=1)
    assert distance[is_front].max() <= PITCH


@pytest.mark.parametrize(("gap", "kind"), [(1.4e-3, LINE), (1.5e-3, NONE)])
def test_a_corner_between_two_taxels_must_press_deeper_than_a_flush_box(gap, kind):
    # A corner at 45 degrees, 4.83 mm beside the nearest sample of each of the two taxels, is
    # (gap + 4.83 mm) / sqrt(2) from it; the other samples feel nothing. The mean of five changes
    # is 1/4 if this one is 5/4: 10 mm / 2.25 = 4.44 mm, a gap of 1.45 mm.
    assert read(CAPACITIVE, corner_first(gap))[0] == kind


# The capacitive sensor


def active_taxels(active):
    """Return type and position of the contact of exactly these taxels."""
    state = CAPACITIVE.init(KEY)
    signal = jnp.asarray(np.isin(np.arange(42), list(active)), float)
    reading = sense_one(CAPACITIVE, state._replace(signal=signal), ball(9.0, 0.0), 0.0)[1]
    assert bool(reading.in_contact) == bool(active)
    return reading.contact_type, reading.p_robot_contact


@property_test(st.sets(st.integers(0, 41), min_size=2))
def test_several_taxels_give_a_line_at_the_mean_of_the_outermost_two(active):
    kind, contact = active_taxels(active)
    assert kind == LINE
    expected = (TAXELS[min(active)] + TAXELS[max(active)]) / 2
    assert_allclose(contact, expected, atol=1e-6)


def test_one_taxel_is_a_point_contact_at_its_position_and_none_is_no_contact():
    for i in range(42):
        kind, contact = active_taxels({i})
        assert kind == POINT
        assert_allclose(contact, TAXELS[i], rtol=1e-5)
    kind, contact = active_taxels(set())
    assert kind == NONE
    assert_array_equal(contact, [0, 0])


def test_a_small_object_pressed_onto_one_taxel_is_felt_there():
    for i, (x, y) in enumerate(TAXELS[15:27]):
        got = read(CAPACITIVE, ball(x + 0.01, y, radius=0.015))
        assert got == approx_reading(POINT, *TAXELS[15 + i])


FLUSH_TAXELS = slice(19, 23)  # the four about the middle of the front


def signals(gap: float, period: float, steps: int, sensor=CAPACITIVE):
    """The signal of a taxel (steps,) after a flush box appears at `gap`, and the readings."""
    state, shape = sensor.init(KEY), box(FRONT + 0.2 + gap, 0.0)
    values, touch = [], []
    for _ in range(steps):
        state, reading = sense_one(sensor, state, shape, period)
        assert_allclose(state.signal[FLUSH_TAXELS], state.signal[20], rtol=1e-5)
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


def test_the_signal_follows_a_step_with_the_time_constant_and_fades_with_it():
    # 5 mm of compression: change 1. After t it has grown to 1 - exp(-t / 50 ms).
    values, _ = signals(0.005, 0.01, 10)
    assert_allclose(values[[4, 9]], [0.6321206, 0.8646647], rtol=1e-4)
    assert_allclose(values, 1 - np.exp(-np.arange(1, 11) / 5), rtol=1e-4)
    # The response does not depend on the period.
    assert signals(0.005, 0.02, 1)[0][-1] == pytest.approx(
        signals(0.005, 0.001, 20)[0][-1], rel=1e-5
    )
    state, _ = sense_one(CAPACITIVE, CAPACITIVE.init(KEY), box(FRONT + 0.205, 0.0), SETTLED)
    next_state, _ = sense_one(CAPACITIVE, state, ball(9.0, 0.0), 0.05)
    assert_allclose(next_state.signal, state.signal / math.e, rtol=1e-5, atol=1e-7)


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
        return CAPACITIVE.sense(CAPACITIVE.init(KEY), shape, SETTLED)[0].signal

    signal = np.asarray(jax.jit(jax.vmap(settled))(jnp.linspace(0.012, -0.05, 200)))
    assert (np.diff(signal, axis=0) >= -1e-6).all()
    assert_allclose(signal[0], np.zeros(42), atol=1e-7)
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
    assert abs(signal.mean()) < 2e-3
    # One reading later the correlation has fallen to exp(-20 / 50) = 0.670.
    assert np.mean(signal[1:] * signal[:-1]) / signal.var() == pytest.approx(0.670, abs=0.02)
    between_taxels = np.corrcoef(signal.T)[np.triu_indices(42, 1)]
    assert np.abs(between_taxels).max() < 0.4
    assert abs(between_taxels.mean()) < 0.01


def test_noise_depends_on_the_key_alone():
    noisy = CAPACITIVE._replace(noise=0.1)
    first, again, different = (np.asarray(long_record(noisy, jax.random.key(k))) for k in (1, 1, 2))
    assert_array_equal(first, again)
    assert (first != different).mean() > 0.99
    # Without noise a sensor that feels nothing is silent.
    assert_allclose(long_record(CAPACITIVE, jax.random.key(1)), 0.0, atol=1e-7)


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
    assert_array_equal(batch_of(CAPACITIVE).gain, np.ones((500, 42)))


def test_a_signal_is_proportional_to_the_gain():
    state = CAPACITIVE.init(KEY)
    gain = jnp.linspace(0.5, 1.5, 42)
    shape = box(FRONT + 0.205, 0.0)
    plain, _ = sense_one(CAPACITIVE, state, shape, 0.02)
    scaled, _ = sense_one(CAPACITIVE, state._replace(gain=gain), shape, 0.02)
    assert_allclose(scaled.signal, gain * plain.signal, rtol=1e-6)


def test_the_share_of_dead_taxels_is_as_requested():
    for share in (0.0, 0.3, 1.0):
        alive = np.asarray(batch_of(CAPACITIVE._replace(dead_share=share)).alive)
        assert alive.mean() == pytest.approx(1 - share, abs=0.02)
    assert not alive.any()


def test_a_skin_of_dead_taxels_feels_nothing():
    for shape in (flush(0.2), box(FRONT, 0.0), box(0.0, SIDE)):
        assert read(CAPACITIVE, shape)[0] == LINE
        assert read(CAPACITIVE._replace(dead_share=1.0), shape) == (NONE, 0.0, 0.0)


def test_a_dead_taxel_at_the_end_of_a_contact_shifts_it_by_half_a_pitch():
    state, shape = CAPACITIVE.init(KEY), flush(0.2)
    whole, reading = sense_one(CAPACITIVE, state, shape, SETTLED)
    first = int(np.argmax(whole.signal > CAPACITIVE.threshold))
    one_dead = state._replace(alive=jnp.arange(42) != first)
    _, shifted = sense_one(CAPACITIVE, one_dead, shape, SETTLED)
    moved = shifted.p_robot_contact - reading.p_robot_contact
    assert_allclose(moved, [0, -PITCH / 2], atol=1e-6)
