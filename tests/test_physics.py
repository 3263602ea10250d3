"""Physics with analytical solutions: pushes by the base, and objects at rest or sliding.

Each law is derived where it is tested. The engine `mujoco` is C MuJoCo with the reference physics,
`mjx` and `fused` have the standard physics, in float32; worlds are seen every control period.
"""

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import jax
import mujoco
import numpy as np
import pytest
from helpers import slow
from numpy.random import default_rng
from scipy.optimize import minimize_scalar
from staging import simulate, staged
from test_quasistatic import stuck

from rps_jax.control.laws.rps import RPSParams
from rps_jax.engines.mjx_colliders import collision, mjx
from rps_jax.engines.mujoco import Batch
from rps_jax.trials import pushes
from rps_jax.trials.pushes import Case
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Rules
from rps_jax.world import scene
from rps_jax.world.physics import Physics, preset
from rps_jax.world.scene import FRICTION, OBJECTS, Friction

G = 9.81  # [m/s^2]
MASS = {"box": 20.0, "cylinder": 25.0}  # [kg]
HALF, RADIUS = 0.20, 0.25  # [m] half a side of the box; of the cylinder
INERTIA = {"box": 20 * 2 * 0.4**2 / 12, "cylinder": 25 * RADIUS**2 / 2}  # [kg m^2] vertical axis
# c = m_max / f_max [m]: the largest torque of the ground's friction over its largest force. The
# points on which MuJoCo stands an object are all this far from its middle.
ARM = {"box": math.hypot(HALF, HALF), "cylinder": RADIUS}
BASE = 1e6 + 130  # [kg] armature and mass
STANDARD, REFERENCE = preset(), preset(fidelity="reference")
SECONDS = 2.5


class World(NamedTuple):
    """An object in front of the base, and their initial and commanded motion."""

    friction: Friction = FRICTION["S1"]
    push: tuple[float, float] = (0.0, 0.0)  # [m/s] of the base
    thrown: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [m/s, m/s, rad/s] object at the start
    yaw: float = 0.0  # [rad] of the object at the start
    gap: float = 0.0  # [m] between them at the start
    name: str = "box"


class Film(NamedTuple):
    """States of one world, one row for each control period and the start."""

    qpos: np.ndarray  # (T, 10)
    qvel: np.ndarray  # (T, 9)
    physics: Physics

    @property
    def pose(self):  # (T, 3) of the object
        yaw = np.unwrap(2 * np.arctan2(self.qpos[:, 9], self.qpos[:, 6]))
        return np.column_stack([self.qpos[:, 3:5], yaw])

    @property
    def moved(self):
        return self.pose[-1] - self.pose[0]

    @property
    def way(self):
        return float(np.hypot(*self.moved[:2]))

    def twist(self):
        """Mean velocity (3,) [m/s, m/s, rad/s] from 0.5 s on, and the yaw half way."""
        period = self.physics.control_period
        pose = self.pose[round(0.5 / period) :]
        mean = (pose[-1] - pose[0]) / ((len(pose) - 1) * period)
        return mean, (pose[0, 2] + pose[-1, 2]) / 2


def starts(worlds, physics):
    scenes = [scene.load(w.name, physics, w.friction) for w in worlds]
    pairs = zip(scenes, worlds, strict=True)
    qpos = np.array([scene.initial_qpos(s, w.gap, w.yaw) for s, w in pairs])
    qvel = np.zeros((len(worlds), 9))
    qvel[:, [3, 4, 8]] = [w.thrown for w in worlds]
    return scenes, qpos, qvel, np.array([(*w.push, 0.0) for w in worlds])


def films_in_engine(engine, worlds, physics=STANDARD, seconds=SECONDS):
    """Return films of worlds of one shape family."""
    scenes, qpos, qvel, twist = starts(worlds, physics)
    stage, fields = staged(engine, scenes, physics)
    periods = round(seconds / physics.control_period)
    recording = simulate(engine, stage, fields, qpos, twist, physics, periods, qvel=qvel)
    return [Film(recording.qpos[:, i], recording.qvel[:, i], physics) for i in range(len(worlds))]


def films_in_c(worlds, physics=REFERENCE, seconds=SECONDS):
    return films_in_engine("mujoco", worlds, physics, seconds)


def polar(length, degrees):
    return length * math.cos(math.radians(degrees)), length * math.sin(math.radians(degrees))


ALL = {
    "centre": World(push=(0.05, 0.0)),
    "rolling": World(FRICTION["S2"], (0.05, 0.02), name="cylinder"),
    "slipping": World(Friction(0.2, 0.02), (0.05, 0.02), name="cylinder"),
    "diagonal box": World(thrown=(*polar(0.5, 45), 0.0), gap=1.0),
}
for name in MASS:
    ALL[f"resting {name}"] = World(gap=1.0, name=name)
    ALL[f"sliding {name}"] = World(thrown=(0.5, 0.0, 0.0), gap=1.0, name=name)
    ALL[f"spinning {name}"] = World(Friction(0.1, 0.35), (0, 0), (0, 0, 2.0), gap=1.0, name=name)
# Yaw of the box whose corner meets the face, direction of the base's velocity [degrees]: the box
# then turns about a point about c away, or, pushed straight ahead, one that is farther away.
NEAR, FAR = [(10, 50), (20, 50)], [(10, 0), (20, 0), (30, 0)]
for yaw, direction in NEAR + FAR:
    # So little friction on the ground that the push, 0.2 m above it, does not tip the box.
    push = World(Friction(0.05, 1.0), polar(0.01, direction), yaw=math.radians(yaw))
    ALL[f"corner {yaw} {direction}"] = push


@functools.cache
def films(engine):
    names = [[n for n in ALL if ALL[n].name == name] for name in MASS]
    with ThreadPoolExecutor(2) as pool:  # MJX compiles both families at once
        physics = REFERENCE if engine == "mujoco" else STANDARD
        run = functools.partial(films_in_engine, engine, physics=physics)
        boxes, cylinders = pool.map(run, [[ALL[n] for n in group] for group in names])
    return dict(zip(names[0] + names[1], boxes + cylinders, strict=True))


@pytest.fixture
def all_films(request):
    """Films of all worlds in one engine."""
    return films(request.param)


# MJX compiles for long; in other tests, and in few steps, it agrees with C MuJoCo.
MJX = slow("mjx")
IN_ALL = pytest.mark.parametrize("all_films", [MJX, "fused", "mujoco"], indirect=True)


@IN_ALL
def test_a_box_pushed_through_its_centre_keeps_its_heading_and_follows_the_base(all_films):
    film = all_films["centre"]
    assert film.qpos[-1, 0] == pytest.approx(0.05 * SECONDS, abs=1e-4)
    assert film.moved[:2] == pytest.approx([0.05 * SECONDS, 0.0], abs=1e-3)
    assert abs(film.moved[2]) < math.radians(0.2)


@pytest.mark.parametrize("physics", [STANDARD, REFERENCE], ids=["standard", "reference"])
@pytest.mark.parametrize("robot", [0.02, 0.35])
@pytest.mark.parametrize("ground", [0.3, 0.2, 0.05])
def test_a_steady_push_needs_the_force_mu_m_g_and_the_work_of_friction(ground, robot, physics):
    """The base loses the momentum that the push takes, and is set anew every period.

    0.3 x 20 kg x 9.81 m/s^2 = 58.9 N. The face may bear mu_robot F of the weight, either way:
    mu m g / (1 + mu mu_robot) < F < mu m g / (1 - mu mu_robot), 1 % or 12 % off. The work is that
    of friction, and m v^2 at the start: half of it sets the box moving, half is lost, as always
    when speed is given at once.
    """
    speed = 0.05
    (film,) = films_in_c([World(Friction(ground, robot), (speed, 0.0))], physics)
    force = BASE * (speed - film.qvel[1:, 0]) / physics.control_period
    weight, borne = ground * MASS["box"] * G, ground * robot / (1 - ground * robot)
    steady = force[len(force) // 2 :]
    assert steady.mean() == pytest.approx(weight, rel=0.01 + borne)
    assert steady.std() < 0.01 * weight
    work = force.sum() * speed * physics.control_period
    assert work == pytest.approx(weight * film.way + MASS["box"] * speed**2, rel=0.02 + borne)


@pytest.mark.parametrize("friction", FRICTION)
def test_a_box_pushed_at_the_papers_speed_stays_on_the_ground(friction):
    """MuJoCo's cone lifts what slides; on its own, stiffer ground a box hops from 1 cm/s on."""
    (film,) = films_in_c([World(FRICTION[friction], (0.05, 0.0))], STANDARD)
    assert film.qvel[25:, 5].std() < 1e-3


@pytest.mark.parametrize(
    ("engine", "name", "way", "yaw"),
    [
        *(("mujoco", name, 1.5e-3, math.radians(0.1)) for name in OBJECTS),
        *(("fused", name, 1e-5, 1e-6) for name in MASS),  # in float32
    ],
)
def test_an_object_at_rest_hardly_creeps_in_a_minute(engine, name, way, yaw):
    calm = replace(STANDARD, control_period=1.0)
    (film,) = films_in_engine(engine, [World(gap=1.0, name=name)], calm, seconds=60.0)
    assert film.way < way
    assert abs(film.moved[2]) < yaw


@IN_ALL
@pytest.mark.parametrize("name", MASS)
def test_an_object_at_rest_creeps_less_than_half_a_millimetre_a_second(all_films, name):
    """Float32 noise in MJX moves it by up to 0.2 mm/s; tests above hold the others to more."""
    assert all_films[f"resting {name}"].way < 0.5e-3 * SECONDS


def loses_energy(film, name):
    """Whether the energy never exceeds the initial one and its planar part only falls.

    Rocking may return less than 1 % to the planar part.
    """
    inertia = scene.load(name).physics.body("object").inertia
    squares = np.hstack([MASS[name] * film.qvel[:, 3:6] ** 2, inertia * film.qvel[:, 6:] ** 2]) / 2
    planar = squares[:, [0, 1, 5]].sum(axis=1)
    total = squares.sum(axis=1) + MASS[name] * G * (film.qpos[:, 5] - film.qpos[0, 5])
    return np.diff(planar).max() < 0.01 * planar[0] and total.max() < 1.001 * planar[0]


@IN_ALL
@pytest.mark.parametrize("motion", ["sliding box", "diagonal box", "sliding cylinder"])
def test_an_object_thrown_at_v_slides_v2_over_2_mu_g_and_never_gains_energy(all_films, motion):
    """0.5^2 / (2 x 0.3 x 9.81) = 42.5 mm.

    Steps and soft contacts change it by up to half of the way v dt of one step, and 0.6 mm.
    """
    film = all_films[motion]
    tolerance = 0.002 + 0.5 * film.physics.timestep
    assert film.way == pytest.approx(0.5**2 / (2 * 0.3 * G), abs=tolerance)
    assert abs(film.moved[2]) < math.radians(0.2)
    assert loses_energy(film, motion.split()[1])


@IN_ALL
@pytest.mark.parametrize("name", MASS)
def test_a_spun_object_is_stopped_by_the_torque_mu_m_g_c(all_films, name):
    """C is half the diagonal of the box, or the radius of the cylinder.

    Energy I w^2 / 2 over torque: this measures c, on which the laws of turning below stand.
    """
    film = all_films[f"spinning {name}"]
    angle = INERTIA[name] * 2.0**2 / (2 * 0.1 * MASS[name] * G * ARM[name])
    # Steps change it by up to half of the turn w dt of one step, and soft contacts by 3 mrad.
    assert film.moved[2] == pytest.approx(angle, abs=0.008 + 2.0 * film.physics.timestep)
    assert film.way < 1e-3
    assert loses_energy(film, name)


@pytest.mark.parametrize(("name", "points"), [("box", 4), ("cylinder", 3)])
def test_an_object_stands_on_equally_loaded_points_all_equally_far_from_its_middle(name, points):
    model = scene.load(name, REFERENCE).physics
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 3000)
    mujoco.mj_forward(model, data)
    middle = data.body("object").xpos
    load = np.zeros((data.ncon, 6))
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, load[i])
    assert data.ncon == points
    assert load[:, 0] == pytest.approx(MASS[name] * G / points, rel=0.01)
    assert np.hypot(*(data.contact.pos - middle)[:, :2].T) == pytest.approx(ARM[name], rel=1e-3)
    assert data.contact.pos.mean(axis=0)[:2] == pytest.approx(middle[:2], abs=1e-3)


def test_a_nearly_upright_cylinder_touches_only_with_its_rim_in_mjx():
    """A rim of radius R, tilted, lies within R times the tilt of the plane of its middle."""
    loaded = scene.load("cylinder")
    model, data = mjx.put_model(loaded.physics), mjx.make_data(loaded.physics)
    tilt = np.repeat([0.0, 1e-7, 1e-6, 1e-5, 1e-4], 40)
    yaw, towards = default_rng(0).uniform(-3, 3, (2, tilt.size))
    qpos = np.tile(scene.initial_qpos(loaded, gap=1.0), (tilt.size, 1))
    (qpos[:, 6], qpos[:, 9]), leaning = (np.cos(yaw / 2), np.sin(yaw / 2)), np.sin(tilt / 2)
    qpos[:, 7], qpos[:, 8] = leaning * np.cos(towards), leaning * np.sin(towards)

    @jax.jit
    @jax.vmap
    def ground_contact(qpos):
        contact = collision(model, mjx.kinematics(model, data.replace(qpos=qpos)))._impl.contact
        return contact.dist[:3], contact.pos[:3] - qpos[3:6]

    depth, arm = ground_contact(qpos.astype(np.float32))
    assert (np.abs(depth) < RADIUS * tilt[:, None] + 1e-6).all()
    assert np.hypot(arm[..., 0], arm[..., 1]) == pytest.approx(RADIUS, rel=1e-3)


def slip(film, push):
    """Share of the base's sideways speed that the cylinder's surface does not share.

    And the share that it takes up by rolling.
    """
    (_, v_y, omega), _ = film.twist()
    return 1 - (v_y - RADIUS * omega) / push[1], -RADIUS * omega / push[1]


@IN_ALL
def test_a_cylinder_rolls_along_the_face_without_slipping(all_films):
    """The base moves at (v_n, v_t) = (5, 2) cm/s, with mu_robot 0.5.

    The contact force f = (f_n, f_t) acts on the rim with the torque -R f_t, so by the limit
    surface the twist goes as (f_n, f_t, -R f_t / c^2), and the rim moves sideways at
    f_t (1 + R^2 / c^2) over f_n: it sticks up to v_t / v_n = mu (1 + R^2 / c^2). On three points
    at radius R, c = R where the cylinder mostly turns. Where it mostly translates, along e, the
    torque of an added w is mu m g w <(r.e)^2> / v, so that c^2 = R^2 / 2. It sticks up to 1 to
    1.5, and rolling takes up R^2 / (R^2 + c^2) of v_t: between a half and two thirds.
    """
    slipping, rolling = slip(all_films["rolling"], ALL["rolling"].push)
    assert abs(slipping) < 0.02
    assert 1 / 2 < rolling < 2 / 3


@IN_ALL
def test_a_cylinder_slips_along_a_slippery_face(all_films):
    """The rim moves sideways at 3 mu v_n, with mu_robot 0.02 and c^2 = R^2 / 2: 85 % is slip."""
    slipping, _ = slip(all_films["slipping"], ALL["slipping"].push)
    assert slipping == pytest.approx(1 - 3 * 0.02 / 0.4, abs=0.02)


def on_points(feet, point, v):
    """The exact twist on equally loaded feet: friction has no moment about the sticking point.

    That is the condition of least power, the sum of the feet's speeds, over the rate of turning.
    """

    def twist(omega):
        return np.array([v[0] + omega * point[1], v[1] - omega * point[0], omega])

    def power(omega):
        v_x, v_y, _ = twist(omega)
        return np.hypot(v_x - omega * feet[:, 1], v_y + omega * feet[:, 0]).sum()

    bound = 10 * math.hypot(*v) / HALF
    return twist(minimize_scalar(power, bounds=(-bound, bound), options={"xatol": 1e-9}).x)


def centre(twist):
    """Return the centre of rotation of an object, from its middle (2,) [m]."""
    return np.array([-twist[1], twist[0]]) / twist[2]


@IN_ALL
@pytest.mark.parametrize(("yaw", "direction"), NEAR + FAR)
def test_a_box_pushed_at_a_corner_turns_about_the_centre_of_friction(all_films, yaw, direction):
    """A corner of the box sticks to the face, at 1 cm/s.

    The ellipsoid through the measured f_max and m_max is right where the box turns about a point
    some c away. The limit surface of four feet bulges out of it elsewhere: turning about a point
    farther away, the box is as on c^2 / 2, as derived for the cylinder. There the ellipsoid puts
    the centre a third too far, and only the exact solution holds.
    """
    twist, middle = all_films[f"corner {yaw} {direction}"].twist()
    feet = np.array([polar(ARM["box"], 45 + 90 * i + math.degrees(middle)) for i in range(4)])
    corner, push = feet[1], np.array(polar(0.01, direction))
    is_near = (yaw, direction) in NEAR
    v_corner = twist[:2] + twist[2] * np.array([-corner[1], corner[0]])
    # In steps of 10 ms the contact creeps where friction carries most of the push.
    assert math.hypot(*(v_corner - push)) < (0.10 if is_near else 0.03) * 0.01
    exact = centre(on_points(feet, corner, push))
    assert math.hypot(*(centre(twist) - exact)) < 0.05 * math.hypot(*exact)
    ellipsoid = centre(stuck(corner, push, ARM["box"]))
    share = math.hypot(*centre(twist)) / math.hypot(*ellipsoid)
    assert share == pytest.approx(1.0 if is_near else 0.74, rel=0.1)


@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("yaw", [10, 20])
def test_an_off_centre_push_of_10_cm_ends_equally_at_1_and_5_cm_a_second(yaw, friction):
    """Quasi-static: at 5 cm/s the box slides v^2 / (2 mu g) = 0.4 mm by itself."""
    slow = World(FRICTION[friction], (0.01, 0.0), yaw=math.radians(yaw))
    (a,) = films_in_c([slow], seconds=10.0)
    (b,) = films_in_c([slow._replace(push=(0.05, 0.0))], seconds=2.0)
    assert abs(a.moved[2]) > math.radians(5)
    assert np.hypot(*(a.moved - b.moved)[:2]) < 2e-3
    assert abs(a.moved[2] - b.moved[2]) < math.radians(0.5)


@pytest.mark.parametrize("name", MASS)
def test_pyramidal_friction_slides_farther_along_the_diagonal_by_the_root_of_two(name):
    """The pyramid's edges hold mu N along the axes, and between them only mu N / sqrt(2)."""
    still = World(Friction(0.1, 0.35), gap=1.0, name=name)
    thrown = [still._replace(thrown=(*polar(0.5, degrees), 0.0)) for degrees in (0, 45)]
    ahead, diagonal = films_in_c(thrown, preset("paper_gazebo"))
    assert diagonal.way / ahead.way == pytest.approx(math.sqrt(2), rel=0.06)


def test_a_diverging_world_in_c_mujoco_is_marked_and_prints_nothing(capfd, tmp_path, monkeypatch):
    """MuJoCo alone would reset the world and continue."""
    monkeypatch.chdir(tmp_path)
    params = RPSParams.paper()._replace(v_approach=1e11)
    setting = Setting(physics=STANDARD, rules=Rules(horizon=0.1), engine="mujoco")
    outcome, _ = pushes.run([Case("box", FRICTION["S1"], (2.0, 0.0), params)], setting)
    assert outcome.diverged.all()
    assert not outcome.success.any()
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())  # no log
    batch = Batch([scene.load("box").physics], np.zeros((1, 10)), threads=1)
    batch.drive(np.arange(1), np.array([[np.nan, 0.0, 0.0]]), 2)
    assert np.isnan(batch.qpos).all()
    batch.close()
