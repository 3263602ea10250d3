"""Objects by name: the paper's, and custom ones.

A custom object has an MJCF file with its visual geoms and mass, and a footprint. Contacts and skin
use the upright solid over the footprint, in all engines.
"""

import functools
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.errors import InputError
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import solid
from rps_jax.geometry.footprint import Footprint
from rps_jax.geometry.solid import SIDES, Solid
from rps_jax.record import files, options
from rps_jax.record.files import Arrays, JsonObject
from rps_jax.record.manifest import Stored
from rps_jax.record.options import check_arguments
from rps_jax.spec import Named
from rps_jax.world.opengl import mujoco

SHAPES = ("box", "cylinder", "prism")  # the shape families


def mjcf_folder() -> Path:
    """Return the folder of the scenes: in an installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    installed = package / "mjcf"
    return installed if installed.is_dir() else package.parent / "mjcf"


def _families() -> dict[str, str]:
    """Return the shape families of the objects with a file in `mjcf_folder`, by name."""
    kinds = {}
    for path in sorted(mjcf_folder().glob("*.xml")):
        geom = ElementTree.parse(path).find(".//geom[@name='object']")
        kinds[path.stem] = "" if geom is None else geom.get("type", "")
    return {name: kind for name, kind in kinds.items() if kind in SHAPES}


FAMILIES = _families()  # object -> shape family
OBJECTS = FAMILIES.keys()  # grows with registered objects
PAPER_OBJECTS = ("box", "cylinder", "nonuniform_box")  # Fig. 4, in the order of Table II
_BUILT_IN = tuple({**FAMILIES, **dict.fromkeys(SHAPES)})
_REQUIRED = {
    "body": ("base", "object", "target"),
    "joint": ("base_x", "base_y", "base_yaw", "object"),
    "geom": ("ground", "base", "object", "skin_front", "skin_left", "skin_right"),
}
_UPRIGHT = (1.0, 0.0, 0.0, 0.0)
_MAX_OFF = 0.02  # [1] of the reach of the geoms: difference of an outline from it, at most
_OVERHANG = 0.005  # [m] of geoms beyond the solid for contacts, at most
_GIVE_OUTLINE = (
    "give the outline, a circle or a convex polygon of 3 to 8 corners (of a concave object its "
    'convex hull): in the file <custom><numeric name="footprint" data="X Y X Y X Y"/></custom> [m] '
    "or as footprint=[(x, y), ...] of rps_jax.register_object"
)


class Registered(NamedTuple):
    """Custom object: its file and its solid."""

    path: Path  # of the MJCF file
    solid: Solid  # for contacts; leaves without a leading axis
    is_file: bool = False  # whether the file alone determines it


REGISTERED: dict[str, Registered] = {}


def path_of(name: str) -> Path:
    """Return the MJCF file of an object, or of the template of a shape family."""
    return REGISTERED[name].path if name in REGISTERED else mjcf_folder() / f"{name}.xml"


@functools.cache
def guesses_of(name: str) -> np.ndarray | None:
    """Return the ranges (4, 2) of depth, breadth, height [m] and mass [kg] that a file guesses.

    Raises:
      InputError: the object is no box, or the ranges are not allowed.
    """
    numeric = ElementTree.parse(path_of(name)).find("custom/numeric[@name='guess']")
    if numeric is None:
        return None
    try:
        ranges = np.array(numeric.get("data", "").split(), float).reshape(4, 2)
        allowed = FAMILIES[name] == "box" and bool(np.all(ranges[:, 0] > 0))
        allowed &= bool(np.all(ranges[:, 0] <= ranges[:, 1]) and np.all(ranges < np.inf))
    except ValueError:
        allowed, ranges = False, None
    if not allowed:
        rule = "give low and high of depth, breadth, height [m] and mass [kg] of a box"
        raise errors.not_allowed(f"object '{name}': numeric guess", numeric.get("data"), rule)
    return ranges


def draw_guesses(name: str, u: Arrays) -> Solid | None:
    """Return boxes (n, ...) of guessed sizes and mass, or None if those of the file are known.

    The random numbers `u` (n,) in [0, 1) choose from the ranges.
    """
    if (ranges := guesses_of(name)) is None:
        return None
    shares = np.stack([u[x] for x in ("size", "aspect", "height", "mass")])
    depth, breadth, height, mass = ranges[:, :1] + np.diff(ranges) * shares
    zero = np.zeros_like(mass)
    outlines = solid.rectangles(depth / 2, breadth / 2)
    return solid.build(outlines, zero, height, mass, zero, zero, zero)


def parse_object(text: str) -> str:
    """Return the name of an object from its name or its MJCF file, which is then registered."""
    if not isinstance(text, str) or files.suffix_of(text) != ".xml":
        return text
    path = Path(text).absolute()
    name = path.stem if path.stem not in _BUILT_IN else str(path)
    if REGISTERED.get(name, (None,))[0] != path:
        files.read_regular(path, "xml")
        register_object(name, path)
        REGISTERED[name] = REGISTERED[name]._replace(is_file=True)
    return name


def check_object(kind: str, name: str, *more: str) -> str:
    """Return the name of an object, or of `more`, or raise InputError.

    The error does not offer the names of files, which may have failed.
    """
    files = {x for x, custom in REGISTERED.items() if custom.is_file} - {name}
    known = [x for x in (*more, *OBJECTS) if x not in files]
    return errors.check_name(kind, name, known, "FILE.xml")


def has_feet(name: str) -> bool:
    """Return whether a custom object stands on feet of its own."""
    return name in REGISTERED and REGISTERED[name].solid.feet is not None


def is_on_pads(name: str) -> bool:
    """Return whether a custom object stands on pads, or on feet with weights."""
    return name in REGISTERED and REGISTERED[name].solid.pads is not None


def text_of(name: str) -> str:
    """Return the text from which another process parses an object: its file, or its name."""
    custom = REGISTERED.get(name)
    return str(custom.path) if custom is not None and custom.is_file else name


def custom_solids(names: Iterable[str]) -> JsonObject:
    """Return the solids of the custom objects among `names` as JSON, by their texts.

    They are rounded, so that all processors give the same.
    """
    rows = {name: REGISTERED[name].solid._asdict() for name in names if name in REGISTERED}
    for row in rows.values():
        if row["pads"] is None:  # as records of version 0.4
            del row["pads"]
    solids = {text_of(name): row for name, row in rows.items()}
    return options.to_json(jax.tree.map(lambda x: np.round(x, 9), solids))


def _stored(name: str, objects: str | Sequence[str]) -> JsonObject:
    """Return the entries of a field with objects, with the solids of custom ones."""
    texts = [objects] if isinstance(objects, str) else objects
    solids = custom_solids(map(parse_object, texts))
    return {name: options.to_json(objects)} | ({"solids": solids} if solids else {})


STORED = Stored(_stored)
ObjectLike = Annotated[str, STORED, Named(lambda: OBJECTS)]  # name of an object, or its file


def read(path: Path) -> mujoco.MjSpec:
    """Read an MJCF file in any folder; `base.xml` is that of `mjcf_folder`."""
    base = (mjcf_folder() / "base.xml").read_bytes()
    try:
        name = os.fsencode(path).decode()  # MuJoCo encodes it in UTF-8, whatever the locale
    except UnicodeDecodeError as error:
        raise errors.not_allowed("object", path, "MuJoCo needs a name in UTF-8") from error
    if path.suffix == ".xml":
        return mujoco.MjSpec.from_file(name, include={"base.xml": base})
    # MuJoCo reads no other suffix, as .XML.
    spec = mujoco.MjSpec.from_string(path.read_text("utf-8"), include={"base.xml": base})
    spec.modelfiledir = str(Path(name).parent)
    return spec


def register_object(
    name: str,
    path: str | Path,
    footprint: Footprint | ArrayLike | None = None,
    feet: ArrayLike | None = None,
) -> None:
    """Register a custom object, to be used like the paper's objects.

    The file includes `base.xml`, perhaps of another folder. It has a body `object` with
    a free joint `object` and upright geoms, one of them named `object`. The body's origin is at
    half the height of that geom. Contacts and skin use one upright solid: a circle or a convex
    polygon of up to 8 corners, which must hold all geoms unless an outline is given.

    Args:
      name: of the object; it replaces an object registered under the same name.
      path: MJCF file. Mass, centre of mass and inertia are those of all geoms of the body.
      footprint: outline of the solid for contacts, in the body's frame: corners (N, 2) [m] of a
        convex polygon around the origin, counter-clockwise and at most 8, or a circle about it as
        a `Footprint`. By default that of the file: the numeric
        `footprint` in its element `custom`, with a radius or corners x y x y ... [m], or else the
        geom `object`, if it is a box or a cylinder. The height of the solid is that of this geom.
        It reaches from that geom to the convex hull of all geoms, within 2 %.
      feet: positions (S, 2) [m] of 3 to 8 points on which it stands, in the body's frame, also with
        weights (S, 3) [m, m, 1], as of springs that share the load, and with factors of friction
        with the ground (S, 4) [m, m, 1, 1], as 0.02 of a castor; or up to 16 pads (S, 5), whose
        last column is their radius [m], as `fit_object` gives them. Weights are loads if the centre
        of mass is at their mean. By default it has the support of the physics: its corners or its
        rim, or even pressure with `physics=default,support=even`.

    Raises:
      InputError: the name is one of the paper's, or file, footprint or feet are invalid.

    Examples:
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
    check_arguments(register_object, {"name": name, "path": path})
    if name in _BUILT_IN:
        rule = f"{', '.join(_BUILT_IN)} exist already"
        raise errors.not_allowed("name of an object", name, rule)
    path = Path(path).absolute()
    label = f"object '{name}'"
    model = _compiled(label, path)
    if footprint is None:
        footprint = _file_outline(label, model)
    elif not isinstance(footprint, Footprint):
        footprint = fp.polygon(footprint)
    family, vertices, radius = _outline(label, footprint)
    _check_extent(label, model, vertices, radius)
    body, pads = model.body("object"), None
    if feet is not None:
        family, vertices = "cylinder" if radius else "prism", solid.padded(vertices)
        feet = solid.check_feet(f"{label}: feet", feet, body.ipos[:2], at_most=SIDES)
        size = SIDES if len(feet) <= SIDES else solid.PADS
        missing = np.repeat(feet[-1:] * [1, 1, 0, 1, 0], size - len(feet), axis=0)
        rows, equal = np.concatenate([feet, missing]), np.ptp(feet[:, 2]) == 0
        if not equal or np.any(feet[:, 3:] != [1, 0]):  # points have a mean weight of 1
            rows[:, 2] /= feet[:, 2].mean() * (len(feet) / solid.LOAD if feet[:, 4].any() else 1)
            pads = rows[:, 3:]
        feet = rows[:, :3]
    single = solid_of_body(body, vertices, radius, _height(label, model))
    REGISTERED[name] = Registered(path, single._replace(feet=feet, pads=pads))
    FAMILIES[name] = family
    guesses_of.cache_clear()
    guesses_of(name)


def solid_of_body(body: Any, vertices: np.ndarray, radius: float, height: float) -> Solid:
    """Return an upright solid (leaves without a leading axis) with the mass of a compiled body."""
    inertial = body.ipos.copy(), body.inertia.copy(), body.iquat.copy()
    return Solid(vertices, np.asarray(radius), np.asarray(height), body.mass[0], *inertial)


def _compiled(label: str, path: Path) -> mujoco.MjModel:
    """Compile the model of a file, or raise InputError if it lacks a required element."""
    try:
        spec = read(path)
        model = spec.compile()
    except ValueError as error:
        reason = errors.one_line(error)
        raise InputError(f"{label}: MuJoCo cannot compile {path} ({reason}).") from error
    for kind, elements in (("body", spec.bodies), ("joint", spec.joints), ("geom", spec.geoms)):
        if missing := sorted(set(_REQUIRED[kind]) - {element.name for element in elements}):
            raise InputError(
                f"{label}: {path} lacks the {kind} '{missing[0]}': include base.xml, and give the "
                "body, its free joint and one geom the name object."
            )
    joint, body = model.joint("object"), model.body("object")
    free = joint.type[0] == mujoco.mjtJoint.mjJNT_FREE and joint.bodyid[0] == body.id
    if not free or joint.qposadr[0] != 3 or model.nq != 10:
        rule = "give the body object a free joint, and no other body a joint"
        raise InputError(f"{label}: joints of {path} are not allowed: {rule}.")
    if not math.isclose(model.body_subtreemass[body.id], body.mass[0]):
        rule = "give the body object all geoms, and no other body within it"
        raise InputError(f"{label}: bodies of {path} are not allowed: {rule}.")
    _check_ignored(label, path, model, spec)
    return model


def _check_ignored(label: str, path: Path, model: mujoco.MjModel, spec: mujoco.MjSpec) -> None:
    """Raise InputError for physics that no engine would simulate: they replace the scene."""
    plain = read(mjcf_folder() / "prism.xml").compile()
    names = {"nbody": "a body", "npair": "a contact pair", "neq": "an equality constraint"}
    names |= {"ntendon": "a tendon", "nu": "an actuator", "nsensor": "a sensor"}
    extra = [words for name, words in names.items() if getattr(model, name) > getattr(plain, name)]
    body, plain_body = model.body("object").id, plain.body("object").id
    if (model.geom_bodyid != body).sum() > (plain.geom_bodyid != plain_body).sum():
        extra.append("a geom of another body than the object, as a wall")
    if any(geom.contype or geom.conaffinity for geom in spec.geoms):
        extra.append("a geom that collides by contype and conaffinity")
    for name in vars(type(model.opt)):  # attributes of MjOption
        values = [getattr(x.opt, name) for x in (model, plain)]
        if not name.startswith("_") and not np.array_equal(*values):
            extra.append(f"the option {name}")
    if extra:
        raise InputError(
            f"{label}: {path} has {', '.join(extra)}, which no trial uses: remove it. "
            "Friction, time step and solver are options of the commands."
        )


def _file_outline(label: str, model: mujoco.MjModel) -> Footprint:
    """Return the outline that a file gives, or else that of its geom `object`."""
    for i in range(model.nnumeric):
        if model.numeric(i).name == "footprint":
            values = model.numeric(i).data
            if values.size % 2 == 0:
                return fp.polygon(values.reshape(-1, 2))
            if values.size == 1:
                return fp.circle(values[0])
            rule = "give a radius, or x and y of each corner [m]"
            raise errors.not_allowed(f"{label}: numeric footprint", values.tolist(), rule)
    return _geom_outline(label, model)


def _geom_outline(label: str, model: mujoco.MjModel) -> Footprint:
    """Return the outline of the geom `object` if it holds all geoms, or raise InputError."""
    geom, outline = model.geom("object"), None
    if np.allclose(geom.pos[:2], 0) and np.allclose(geom.quat, _UPRIGHT):
        if geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX:
            outline = fp.rectangle(geom.size[0], geom.size[1])
        elif geom.type[0] == mujoco.mjtGeom.mjGEOM_CYLINDER:
            outline = fp.circle(geom.size[0])
    reason = "the geom object is no upright box or cylinder about the origin"
    if outline is not None:
        reach = max(
            float(np.max(fp.signed_distance(outline, jnp.asarray(_points_of(model, i)[:, :2]))))
            for i in np.flatnonzero(model.geom_bodyid == model.body("object").id).tolist()
        )
        if reach <= _OVERHANG:
            return outline
        reason = f"its geoms reach {reach:.2g} m beyond the geom object, which alone has contacts"
    raise errors.not_allowed(f"{label}: footprint", None, f"{reason}, so {_GIVE_OUTLINE}")


def _outline(label: str, footprint: Footprint) -> tuple[str, np.ndarray, float]:
    """Return shape family, vertices (N, 2) [m] of its solids, and radius [m]."""
    vertices, radius = np.asarray(footprint.vertices, float), float(footprint.radius)
    if vertices.shape == (1, 2) and not vertices.any():
        errors.check_finite(f"{label}: radius of the footprint", radius, at_least=0.02, at_most=2)
        return "cylinder", vertices, radius
    field, value = f"{label}: footprint", f"{vertices.tolist()} with radius {radius:g} m"
    if radius or not 3 <= len(vertices) <= SIDES:
        rule = f"give a circle about the origin, or a polygon of 3 to {SIDES} corners with radius 0"
        raise errors.not_allowed(field, value, rule)
    fp.polygon(vertices)  # raises unless it is convex
    reach = np.linalg.norm(vertices, axis=1).max()
    errors.check_finite(f"{label}: reach of the footprint", reach, at_least=0.02, at_most=2)
    ahead = np.roll(vertices, -1, axis=0)
    if (vertices[:, 0] * ahead[:, 1] <= vertices[:, 1] * ahead[:, 0]).any():
        raise errors.not_allowed(field, value, "the origin must be inside")
    half = np.abs(vertices[0])
    if len(vertices) == 4 and np.allclose(np.abs(vertices), half):
        return "box", solid.rectangles(*half[:, None])[0], 0.0
    return "prism", solid.padded(vertices), 0.0


def _check_extent(label: str, model: mujoco.MjModel, vertices: np.ndarray, radius: float) -> None:
    """Raise InputError for an outline that is not that of the geoms, which have the mass.

    It may reach from the geom `object` to the convex hull of all geoms.
    """
    ways = solid.unit(np.arange(32) * np.pi / 16).T
    owned = np.flatnonzero(model.geom_bodyid == model.body("object").id).tolist()
    reaches = [np.max(_points_of(model, i)[:, :2] @ ways, axis=0) for i in owned]
    least, greatest = reaches[owned.index(model.geom("object").id)], np.max(reaches, axis=0)
    reach = np.max(vertices @ ways, axis=0) + radius
    off = np.maximum(least - reach, reach - greatest) / greatest
    if off.max() > _MAX_OFF:
        k = int(np.argmax(off))
        rule = (
            f"its geoms, which have the mass, reach {least[k]:.3g} to {greatest[k]:.3g} m there: "
            f"give both the same size, within {_MAX_OFF:.0%}"
        )
        raise errors.not_allowed(f"{label}: reach of the footprint", f"{reach[k]:.3g} m", rule)


def _points_of(model: mujoco.MjModel, geom_id: int) -> np.ndarray:
    """Return points (n, 3) [m] of a geom in its body's frame, whose convex hull is the geom."""
    geom, turn = model.geom(geom_id), np.zeros(9)
    middle, half = model.geom_aabb[geom_id].reshape(2, 3)
    if geom.type[0] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(geom.dataid[0])
        points = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    elif geom.type[0] == mujoco.mjtGeom.mjGEOM_BOX:
        points = middle + half * (2 * np.array(list(np.ndindex(2, 2, 2))) - 1)
    else:  # round about its axis
        rim = np.insert(solid.unit(np.linspace(0, 2 * np.pi, 33)), 2, 1.0, axis=1)
        points = middle + half * np.concatenate([rim, rim * [1, 1, -1]])
    mujoco.mju_quat2Mat(turn, geom.quat)
    return np.asarray(points @ turn.reshape(3, 3).T + geom.pos)


def _height(label: str, model: mujoco.MjModel) -> float:
    """Return the height of the geom `object` [m]."""
    z = _points_of(model, model.geom("object").id)[:, 2]
    low, high = float(z.min()), float(z.max())
    if abs(low + high) > 1e-3:
        rule = "the body's origin must be in the middle of its height"
        raise errors.not_allowed(f"{label}: z of its geom object", f"{low:g} to {high:g} m", rule)
    return errors.check_finite(f"{label}: height", high - low, at_least=0.1, at_most=3, unit="m")
