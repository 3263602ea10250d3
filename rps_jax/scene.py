"""Scenes: `mjcf/` -> a MuJoCo model for looking at, and one stripped to the physics for stepping.

The physics model holds the three geoms that touch and nothing else; it is what C MuJoCo and MJX
both step. All objects of one shape family compile to the same MJX structure, so that they can
be batched in one program: `stack` collects the fields in which they differ.
"""

from __future__ import annotations

import contextlib
import io
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from rps_jax import errors, skin
from rps_jax import footprint as fp
from rps_jax.footprint import Footprint

with contextlib.redirect_stdout(io.StringIO()):  # MJX reports on the console that warp is absent
    from mujoco import mjx

    from rps_jax import colliders
colliders.register()

Side = Literal["near", "far"]
SIDES = ("near", "far")
# All that differs between objects of one shape family, as paths into an MJX model.
FIELDS = (
    *(f".stat.mean{name}" for name in ("inertia", "mass", "size")),
    *(f".body_{name}" for name in ("pos", "ipos", "iquat", "mass", "subtreemass", "inertia")),
    *(".body_invweight0", ".dof_invweight0", ".dof_M0", ".qpos0", ".qpos_spring"),
    *(".geom_size", ".geom_aabb", ".geom_rbound", ".pair_friction"),
)
# An inertial frame off by this [m] keeps MuJoCo from compiling centred bodies to a structure of
# their own, which could not be batched with the others.
_OFF_CENTRE = 1e-6


class Friction(NamedTuple):
    """Coulomb coefficients of the two contacts."""

    ground: float  # [1] object-ground
    robot: float  # [1] object-robot


FRICTION = {"S1": Friction(0.3, 0.35), "S2": Friction(0.2, 0.5)}  # Table I
FAMILIES = {
    "box": "box",
    "cylinder": "cylinder",
    "nonuniform_box": "box",
    "hardware_box": "box",
    "hardware_cylinder": "cylinder",
}  # object -> shape family
OBJECTS = tuple(FAMILIES)
PAPER_OBJECTS = ("box", "cylinder", "nonuniform_box")  # Fig. 4, in the order of Table II


@dataclass(frozen=True)
class Physics:
    """How the world is stepped. Static: a change compiles another program."""

    timestep: float = 0.01  # [s]
    control_period: float = 0.02  # [s] between two decisions of the law; left open by the paper
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    impratio: float = 10.0  # [1] friction stiffness over normal stiffness
    iterations: int = 8  # of the Newton solver, at most; with 4 the object is lost
    ls_iterations: int = 10  # of its line search, always done
    # Of the solver, relative to the trace of the mass matrix: that is 3e6 by the base's armature,
    # so MuJoCo's own 1e-8 would end the solver far from an object's solution.
    tolerance: float = 1e-13  # [1]
    # Time constant and damping ratio [s, 1] of the two contacts (MuJoCo's solref) and the ground's
    # impedance [1] (its solimp). MuJoCo's cone lifts what slides; on its own ground, (0.02, 1) and
    # 0.9, objects hop at 5 cm/s and the push force chatters by three quarters of its mean. This
    # softer and less damped ground carries them steadily, 0.5 mm deep.
    base_solref: tuple[float, float] = (0.02, 1.0)  # MuJoCo's own
    ground_solref: tuple[float, float] = (0.1, 0.3)
    ground_impedance: float = 0.7

    def __post_init__(self) -> None:
        """Raises InputError for values that MuJoCo would accept and that mean nothing."""
        errors.check_finite("timestep", self.timestep, above=0, at_most=0.1, unit="s")
        errors.check_finite("control_period", self.control_period, above=0, at_most=1, unit="s")
        errors.check_finite("impratio", self.impratio, above=0)
        errors.check_finite("iterations", self.iterations, at_least=1)
        errors.check_finite("ls_iterations", self.ls_iterations, at_least=1)
        errors.check_finite("tolerance", self.tolerance, at_least=0)
        for name, solref in (("base", self.base_solref), ("ground", self.ground_solref)):
            for what, value in zip(("time constant", "damping ratio"), solref, strict=True):
                errors.check_finite(f"{name} contact's {what}", value, above=0)
        errors.check_finite("ground_impedance", self.ground_impedance, above=0, at_most=0.9999)
        errors.check_name("cone", self.cone, ("elliptic", "pyramidal"))
        steps = self.control_period / self.timestep
        if steps < 0.5 or not math.isclose(steps, round(steps), rel_tol=1e-6):
            raise errors.InputError(
                f"control_period = {self.control_period:g} s is not allowed: it must be a "
                f"multiple of timestep = {self.timestep:g} s."
            )

    @property
    def substeps(self) -> int:
        """Physics steps in one control period."""
        return round(self.control_period / self.timestep)


# The ground contact that MuJoCo has if none is chosen.
MUJOCOS_GROUND = {"ground_solref": (0.02, 1.0), "ground_impedance": 0.9}
_EXACT = Physics(timestep=0.001, iterations=100, ls_iterations=50, tolerance=1e-15)
# The pyramid needs Gazebo's own step of 1 ms: in steps of 5 ms it loses most boxes.
_PYRAMID = Physics(timestep=0.001, cone="pyramidal", iterations=20, ls_iterations=20)
# How the friction is modelled, and how finely that is solved: see `physics`.
PHYSICS = {
    "default": {
        "reference": _EXACT,
        # Share of the 432 outcomes equal to the reference's in C (`rps paper`):
        "standard": Physics(),  # MJX 98.1 %, fused 100 %
        "fast": Physics(timestep=0.02, iterations=6, ls_iterations=8),  # MJX 95.8 %, fused 100 %
    },
    "paper_gazebo": {
        "reference": replace(_EXACT, cone="pyramidal"),
        "standard": _PYRAMID,
        "fast": _PYRAMID,
    },
}


def physics(name: str = "default", fidelity: str = "standard") -> Physics:
    """Physics by name.

    Args:
      name: `default`, isotropic Coulomb friction; `paper_gazebo`, a friction pyramid along the
        world's axes, as in the paper's engine.
      fidelity: `reference`, converged, for the engine `mujoco`; `standard`, for tables; `fast`.

    Raises:
      InputError: unknown name or fidelity.
    """
    errors.check_name("physics", name, PHYSICS)
    return PHYSICS[name][errors.check_name("fidelity", fidelity, PHYSICS[name])]


class Scene(NamedTuple):
    """One object before the robot."""

    name: str
    family: str
    model: mujoco.MjModel  # everything, for pictures
    physics: mujoco.MjModel  # the three geoms that touch, for stepping
    footprint: Footprint


class Joints(NamedTuple):
    """Where the joints are in qpos and qvel; the same in every scene and in both models."""

    base: slice = slice(0, 3)  # x, y [m], yaw [rad] in the world
    object: slice = slice(3, 10)  # position [m] and quaternion, scalar first


JOINTS = Joints()


def mjcf_folder() -> Path:
    """The folder of the scenes: inside an installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "mjcf"
    return installed if installed.is_dir() else package.parent / "mjcf"


def load(
    name: str,
    physics: Physics = PHYSICS["default"]["standard"],
    friction: Friction = FRICTION["S1"],
    *,
    rear: Side = "near",
    mass: float | None = None,
    half_length: float = skin.HALF_LENGTH,
) -> Scene:
    """Compile a scene.

    Args:
      name: one of `OBJECTS`.
      physics: how it will be stepped.
      friction: coefficients of its two contacts.
      rear: which side the nonuniform box's load stands on, nearest the robot or farthest; the
        paper says "rear left corner".
      mass: of the object [kg], its inertia scaled along; None: the object's own.
      half_length: of the base [m].

    Raises:
      InputError: unknown name, or friction or mass that is not a positive finite number.
    """
    errors.check_name("object", name, OBJECTS)
    errors.check_name("rear", rear, SIDES)
    check(friction, mass)
    spec = mujoco.MjSpec.from_file(str(mjcf_folder() / f"{name}.xml"))
    for geom in spec.geoms:
        if geom.name == "load" and rear == "far":
            geom.pos[0] = -geom.pos[0]
    _set_length(spec, half_length)
    for pair in spec.pairs:
        if pair.name == "base_object":
            pair.solref[:] = physics.base_solref
        else:
            pair.solref[:] = physics.ground_solref
            pair.solimp[:2] = physics.ground_impedance
        pair.friction[:2] = friction.ground if pair.name == "ground_object" else friction.robot
    if mass is not None:
        _set_mass(spec, mass)
    _set_options(spec.option, physics)
    model = spec.compile()
    stripped = _strip(spec, model)
    return Scene(name, FAMILIES[name], model, stripped, _footprint(stripped))


def check(friction: Friction, mass: float | None) -> None:
    """Raises InputError unless friction and mass are positive and finite, as MuJoCo does not."""
    for side, value in friction._asdict().items():
        errors.check_finite(f"friction {side}", value, above=0, at_most=10)
    if mass is not None:
        errors.check_finite("mass", mass, above=0, at_most=1e4, unit="kg")


def _set_length(spec: mujoco.MjSpec, half_length: float) -> None:
    """Stretch the base and its skin to this half length [m]."""
    spec.geom("skin_front").pos[0] = half_length
    for name in ("base", "skin_left", "skin_right"):
        spec.geom(name).size[0] = half_length


def _set_mass(spec: mujoco.MjSpec, mass: float) -> None:
    """Scale the object's geoms to this mass in all [kg]."""
    geoms = [geom for geom in spec.body("object").geoms if geom.mass > 0]
    total = sum(geom.mass for geom in geoms)
    for geom in geoms:
        geom.mass *= mass / total


def _set_options(option: mujoco.MjOption, physics: Physics) -> None:
    option.timestep = physics.timestep
    option.cone = {
        "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
        "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    }[physics.cone]
    option.impratio = physics.impratio
    option.iterations = physics.iterations
    option.ls_iterations = physics.ls_iterations
    option.tolerance = physics.tolerance


def _strip(spec: mujoco.MjSpec, full: mujoco.MjModel) -> mujoco.MjModel:
    """Only what touches: the geoms of the contact pairs, with each body's whole inertia."""
    spec = spec.copy()
    spec.modelname = "physics"
    spec.delete(spec.body("target"))
    touching = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in list(spec.geoms):
        if geom.name not in touching:
            spec.delete(geom)
    for item in [*spec.lights, *spec.cameras]:
        spec.delete(item)
    for name in ("base", "object"):
        body, compiled = spec.body(name), full.body(name)
        body.explicitinertial = True
        body.mass = compiled.mass[0]
        body.ipos = compiled.ipos + _OFF_CENTRE
        body.iquat = compiled.iquat
        body.inertia = compiled.inertia
    model = spec.compile()
    model.body_sameframe[:] = 0  # likewise: always the general formula for the inertial frame
    return model


def _footprint(model: mujoco.MjModel) -> Footprint:
    """The outline of the object's geom that stands on the ground."""
    geom = model.geom("object")
    half_x, half_y, _ = geom.size
    if geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX:
        return fp.rectangle(half_x, half_y)
    return fp.circle(half_x)


def initial_qpos(scene: Scene, gap: float = 0.02, yaw: float = 0.0) -> np.ndarray:
    """Base at the origin, object `gap` [m] in front of the middle of its front face: (10,).

    `yaw` [rad] turns the object.
    """
    placed = fp.place(scene.footprint, jnp.zeros(2), jnp.asarray(yaw, float))
    reach = float(fp.extent(placed, jnp.array([-1.0, 0.0])))
    qpos = scene.physics.qpos0.copy()
    qpos[JOINTS.base] = 0.0
    height = qpos[JOINTS.object][2]
    front = scene.physics.geom("base").size[0]
    position = [front + gap + reach, 0.0, height]
    qpos[JOINTS.object] = [*position, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
    return qpos


def stack(models: list[mujoco.MjModel]) -> tuple[mjx.Model, dict[str, jax.Array]]:
    """One MJX model for all, and the fields that vary: name -> (len(models), ...).

    The fields are always the same ones, so that a world's numbers depend neither on what it is
    batched with nor on a program of its own. They are copied from compiled models, so nothing
    that MuJoCo derives from a mass, a size or a friction is forgotten.

    Raises:
      ValueError: the models differ in anything but `FIELDS`.
    """
    # A static copy of the bounding radii, which only height fields use, would bar stacking.
    unused: dict[str, Any] = {"_impl.geom_rbound_hfield": np.zeros(models[0].ngeom)}
    trees: list[Any] = [mjx.put_model(m).tree_replace(unused) for m in models]
    leaves, structures = zip(*map(jax.tree_util.tree_flatten_with_path, trees), strict=True)
    if any(s != structures[0] for s in structures):
        raise ValueError("models of different structure cannot be stacked")
    fields = {}
    for columns in zip(*leaves, strict=True):
        name = jax.tree_util.keystr(columns[0][0])
        values = [np.asarray(leaf) for _, leaf in columns]
        if name in FIELDS:
            fields[name] = jnp.stack(values)
        elif any(not np.array_equal(v, values[0]) for v in values):
            raise ValueError(f"models that differ in {name} cannot be stacked")
    return trees[0], fields


def apply(model: mjx.Model, fields: dict[str, jax.Array]) -> mjx.Model:
    """The model with one world's fields, as named by `stack`, put in place."""
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: fields.get(jax.tree_util.keystr(path), leaf), model
    )
