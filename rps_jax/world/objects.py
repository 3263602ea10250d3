"""The objects that can be pushed, by name: the paper's, and one's own.

An object of one's own is an MJCF file, which gives its looks and its mass, and a footprint: what
touches is the upright solid over it, in every engine and for the skin alike.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.solid import SIDES, Solid
from rps_jax.record import files

FAMILIES = {
    "box": "box",
    "cylinder": "cylinder",
    "nonuniform_box": "box",
    "hardware_box": "box",
    "hardware_cylinder": "cylinder",
}  # object -> shape family
SHAPES = ("box", "cylinder", "prism")  # the families
OBJECTS = FAMILIES.keys()  # also those that are registered later
PAPER_OBJECTS = ("box", "cylinder", "nonuniform_box")  # Fig. 4, in the order of Table II
_BUILT_IN = tuple({**FAMILIES, **dict.fromkeys(SHAPES)})
_NEEDED = {
    mujoco.mjtObj.mjOBJ_BODY: ("base", "object", "target"),
    mujoco.mjtObj.mjOBJ_JOINT: ("base_x", "base_y", "base_yaw", "object"),
    mujoco.mjtObj.mjOBJ_GEOM: ("ground", "base", "object", "skin_front", "skin_left", "skin_right"),
}
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


class Registered(NamedTuple):
    """An object of one's own."""

    path: Path  # of its looks
    solid: Solid  # what touches; leaves without a leading axis


REGISTERED: dict[str, Registered] = {}


def mjcf_folder() -> Path:
    """The folder of the scenes: inside an installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "mjcf"
    return installed if installed.is_dir() else package.parent / "mjcf"


def path_of(name: str) -> Path:
    """The MJCF file of an object, or of the template of a shape family."""
    return REGISTERED[name].path if name in REGISTERED else mjcf_folder() / f"{name}.xml"


def named(text: str) -> str:
    """Read an object's text: its name, or the path of an MJCF file, which is then registered."""
    if not isinstance(text, str) or not text.endswith(".xml"):
        return text
    path = Path(text).absolute()
    name = path.stem if path.stem not in _BUILT_IN else str(path)
    if REGISTERED.get(name, (None,))[0] != path:
        try:
            files.read_regular(path, "xml")
        except OSError as error:
            raise InputError(
                f"object = {text} cannot be read ({error.strerror}): give an MJCF file."
            ) from error
        register_object(name, path)
    return name


def read(path: Path) -> mujoco.MjSpec:
    """An MJCF file, wherever it is; `base.xml` is that of `mjcf_folder`."""
    base = (mjcf_folder() / "base.xml").read_bytes()
    return mujoco.MjSpec.from_file(str(path), include={"base.xml": base})


def register_object(
    name: str,
    path: str | Path,
    footprint: Footprint | None = None,
    feet: ArrayLike | None = None,
) -> None:
    """Make an object of one's own known, to be used as those of the paper are.

    Its file includes `base.xml`, which need not lie beside it, and has a body `object` with a free
    joint `object` and geoms that stand upright, one of them called `object`. The body's origin is
    in the middle of that geom's height.

    Args:
      name: what it is called; registered again, it replaces what was called so.
      path: of the MJCF file. Mass, centre of mass and inertia are those of all the body's geoms.
      footprint: outline of the solid that touches, in the body's frame: a circle about the origin,
        or a convex polygon of up to 8 corners around it. By default that of the geom `object`, if
        it is a box or a cylinder. The solid is as high as this geom.
      feet: places (S, 2) [m] of 3 to 8 points on which it stands, in the body's frame, or with
        weights (S, 3) [m, m, 1], as of springs; by default its corners or its rim. Weights are of
        the engine quasistatic alone: the others find the load of each foot from how the object
        leans, on ground that gives way alike under all.

    Raises:
      InputError: the name is one of the paper's, or file, footprint or feet are not such.

    Example:
      >>> from pathlib import Path
      >>> import rps_jax
      >>> crate = '''
      ... <mujoco model="crate">
      ...   <include file="base.xml"/>
      ...   <worldbody>
      ...     <body name="object">
      ...       <freejoint name="object"/>
      ...       <geom name="object" class="object" type="box" size="0.2 0.3 0.25" mass="12"/>
      ...     </body>
      ...   </worldbody>
      ... </mujoco>'''
      >>> _ = Path("crate.xml").write_text(crate)
      >>> rps_jax.register_object("crate", "crate.xml")
      >>> from rps_jax.trials.case import Case
      >>> Case("crate", "S1", (2.0, 0.0), "rps").object
      'crate'
    """
    if name in _BUILT_IN:
        raise InputError(
            f"object name '{name}' is not allowed: {', '.join(_BUILT_IN)} are there already."
        )
    path = Path(path).absolute()
    what = f"object '{name}'"
    model = _compiled(what, path)
    family, vertices, radius = _outline(what, footprint or _own_outline(what, model))
    thing = model.body("object")
    if feet is not None:
        family, vertices = "cylinder" if radius else "prism", solid.padded(vertices)
        feet = _feet(what, np.asarray(feet, float), thing.ipos[:2])
    one = Solid(
        vertices=vertices,
        radius=np.asarray(radius),
        height=np.asarray(_height(what, model)),
        mass=thing.mass[0],
        p_object_com=thing.ipos.copy(),
        inertia=thing.inertia.copy(),
        q_object_body=thing.iquat.copy(),
        feet=feet,
    )
    REGISTERED[name] = Registered(path, one)
    FAMILIES[name] = family


def _compiled(what: str, path: Path) -> mujoco.MjModel:
    """The model of a file that keeps to the convention."""
    try:
        model = read(path).compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{what}: MuJoCo cannot compile {path} ({reason}).") from error
    for kind, names in _NEEDED.items():
        for needed in names:
            if mujoco.mj_name2id(model, kind, needed) < 0:
                kind_name = kind.name.removeprefix("mjOBJ_").lower()
                raise InputError(
                    f"{what}: {path} lacks the {kind_name} '{needed}': include base.xml, and give "
                    "the body, its free joint and one geom the name object."
                )
    joint, body = model.joint("object"), model.body("object")
    free = joint.type[0] == mujoco.mjtJoint.mjJNT_FREE and joint.bodyid[0] == body.id
    if not free or joint.qposadr[0] != 3 or model.nq != 10:
        raise InputError(
            f"{what}: the joints of {path} are not allowed: give the body object a free joint, and "
            "nothing else a joint."
        )
    if not math.isclose(model.body_subtreemass[body.id], body.mass[0]):
        raise InputError(
            f"{what}: bodies within the body object of {path} are not allowed: give it all geoms."
        )
    return model


def outline_of(geom: Any) -> Footprint | None:
    """The outline of a geom that is a box or a cylinder."""
    if geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX:
        return fp.rectangle(geom.size[0], geom.size[1])
    return fp.circle(geom.size[0]) if geom.type[0] == mujoco.mjtGeom.mjGEOM_CYLINDER else None


def _own_outline(what: str, model: mujoco.MjModel) -> Footprint:
    """The outline of the geom `object`."""
    geom = model.geom("object")
    centred = np.allclose(geom.pos[:2], 0) and np.allclose(geom.quat, _UPRIGHT)
    if centred and (outline := outline_of(geom)) is not None:
        return outline
    raise InputError(
        f"{what}: footprint = None is not allowed: the geom object is not an upright box or "
        "cylinder about the body's origin, so give the outline."
    )


def _outline(what: str, footprint: Footprint) -> tuple[str, np.ndarray, float]:
    """Shape family, vertices (N, 2) [m] as its solids have them, and radius [m]."""
    vertices, radius = np.asarray(footprint.vertices, float), float(footprint.radius)
    if vertices.shape == (1, 2) and not vertices.any():
        errors.check_finite(f"{what}: radius of the footprint", radius, at_least=0.02, at_most=2)
        return "cylinder", vertices, radius
    if radius or not 3 <= len(vertices) <= SIDES:
        raise InputError(
            f"{what}: footprint = {vertices.tolist()} with radius {radius:g} m is not allowed: "
            f"give a circle about the origin, or a polygon of 3 to {SIDES} corners with radius 0."
        )
    fp.polygon(vertices)  # raises unless it is convex
    reach = np.linalg.norm(vertices, axis=1).max()
    errors.check_finite(f"{what}: reach of the footprint", reach, at_least=0.02, at_most=2)
    ahead = np.roll(vertices, -1, axis=0)
    if (vertices[:, 0] * ahead[:, 1] <= vertices[:, 1] * ahead[:, 0]).any():
        raise InputError(
            f"{what}: footprint = {vertices.tolist()} is not allowed: the origin must be inside."
        )
    half = np.abs(vertices[0])
    if len(vertices) == 4 and np.allclose(np.abs(vertices), half):
        return "box", solid.rectangles(*half[:, None])[0], 0.0
    return "prism", solid.padded(vertices), 0.0


def _feet(what: str, feet: np.ndarray, com: np.ndarray) -> np.ndarray:
    """Feet (SIDES, 3) [m, m, 1], those that are missing with a weight of 0."""
    if feet.ndim == 2 and feet.shape[1] == 2:
        feet = np.column_stack([feet, np.ones(len(feet))])
    said = f"{what}: feet = {feet.tolist()} is not allowed:"
    if feet.ndim != 2 or feet.shape[1] != 3 or not 3 <= len(feet) <= SIDES:
        raise InputError(f"{said} give 3 to {SIDES} rows of x, y [m] and, if you like, a weight.")
    if not np.isfinite(feet).all() or (feet[:, 2] <= 0).any():
        raise InputError(f"{said} all numbers must be finite, and weights positive.")
    bearing = np.linspace(0, 2 * np.pi, 360)
    reach = (feet[:, :2] - com) @ np.stack([np.cos(bearing), np.sin(bearing)])
    if reach.max(axis=0).min() <= 0:
        raise InputError(f"{said} the centre of mass must be between them, or it tips over.")
    missing = np.repeat(feet[-1:] * [1, 1, 0], SIDES - len(feet), axis=0)
    return np.concatenate([feet, missing])


def _height(what: str, model: mujoco.MjModel) -> float:
    """Of the geom `object` [m]."""
    geom = model.geom("object")
    if geom.type[0] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(geom.dataid[0])
        points = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    else:
        middle, half = model.geom_aabb[geom.id].reshape(2, 3)
        points = middle + half * (2 * np.array(list(np.ndindex(2, 2, 2))) - 1)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, geom.quat)
    z = points @ turn.reshape(3, 3)[2] + geom.pos[2]
    low, high = float(z.min()), float(z.max())
    if abs(low + high) > 1e-3:
        raise InputError(
            f"{what}: its geom object reaches from {low:g} to {high:g} m above the body's origin, "
            "which is not allowed: the origin must be in the middle of its height."
        )
    return errors.check_finite(f"{what}: height", high - low, at_least=0.1, at_most=3, unit="m")
