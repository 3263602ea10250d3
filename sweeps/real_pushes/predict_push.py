"""Prediction of slow pushes of a known object by fingers with known paths."""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline

from rps_jax import errors
from rps_jax.geometry import footprint, solid
from rps_jax.trials.results import labelled
from sweeps.real_pushes import fingers

Support = Literal["feet", "ellipsoid"]
_STEPS = 500  # of a push by the width of the object
_INSIDE, _FAR = 0.005, 100.0  # of a start inside, and away or of a path at most, in widths
_POINTS = 40  # at least, of a uniform pressure


def predict_push(
    outline: ArrayLike,
    path: ArrayLike,
    *,
    mass: float,
    friction_ground: float,
    friction_finger: ArrayLike,
    feet: ArrayLike | None = None,
    com: ArrayLike | None = None,
    height: float = 0.0,
    pose: ArrayLike = (0.0, 0.0, 0.0),
    time: ArrayLike | None = None,
    model: Support = "feet",
) -> xr.Dataset:
    """Predict the motion of a known object that fingers push slowly.

    The object is rigid, friction is dry, and inertia is negligible. So mass and friction with the
    ground change the forces, but not the motion, unless the fingers push above the ground.

    Args:
      outline: corners (N, 2) [m] of a convex polygon, counter-clockwise, in the body frame.
      path: of a finger (T, 2), of F fingers (T, F, 2), or of n pushes (n, T, F, 2) [m, world]. A
        finger is a point, and moves straight between the points of its path.
      mass: of the object [kg].
      friction_ground: between object and ground [1].
      friction_finger: between object and fingers [1], also of each push (n,).
      feet: support points (S, 2) [m, body], with a third column also their stiffness, as of springs
        that share the load; the pressure of an uneven contact is a grid of such points. By
        default the object is flat, with a uniform pressure under its outline.
      com: centre of mass (2,) [m, body]; by default the centroid of the outline.
      height: of the fingers above the ground [m], which moves the load.
      pose: x, y [m] and yaw [rad] (3,) of the body frame at the start, also of each push (n, 3).
      time: of the points of the path (T,) [s]; by default their index.
      model: `feet`, a rigid body on its support points, or `ellipsoid`, the ellipsoid limit surface
        whose ratio of moment to force is that of the support points.

    Returns:
      `object_pose` (time, pose) [m, m, rad], `force` (time, axis) [N] of all fingers on the object
      in the world, a mean since the previous time, and `gap` (time, finger) [m] between fingers
      and object. Many pushes have the first dimension `push`.

    Raises:
      InputError: an argument is not allowed, or the object would tip over.

    Example:
      >>> from sweeps.real_pushes.predict_push import predict_push
      >>> square = [(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)]
      >>> path = [(-0.11, 0.02), (-0.06, 0.02)]  # off the centre, so the square turns
      >>> known = {"mass": 2.0, "friction_ground": 0.3, "friction_finger": 0.5}
      >>> push = predict_push(square, path, **known)
      >>> push.object_pose[-1].values.round(2).tolist()
      [0.04, -0.01, -0.07]
    """
    errors.check_name("model", model, get_args(Support))
    corners = footprint.check_corners("outline", outline)
    width = float(np.ptp(corners, axis=0).max())
    errors.check_finite("width of the outline", width, at_least=5e-3, at_most=5, unit="m")
    errors.check_finite("mass", mass, at_least=1e-3, at_most=1e4, unit="kg")
    errors.check_finite("friction_ground", friction_ground, at_least=0.01, at_most=2)
    errors.check_finite("height", height, at_least=0, at_most=5 * width, unit="m")
    centroid = (corners - solid.centred(corners[None])[0])[0]
    p_com = centroid if com is None else errors.check_array("com", com, (2,))
    points = uniform_pressure(corners, centroid) if feet is None else feet
    points = solid.check_feet("com" if feet is None else "feet", points, p_com)
    outside = fingers.nearest(corners, points[:, :2])[0]
    if outside.max() > 1e-3 * width:
        rule = f"one is {outside.max():.2g} m outside of the outline: give both in one frame, in m"
        raise errors.not_allowed("feet", points.tolist(), rule)

    paths = errors.check_array("path", path, ("T", 2), ("T", "F", 2), ("n", "T", "F", 2))
    is_batch = paths.ndim == 4
    paths = np.array(paths[:, None] if paths.ndim == 2 else paths, ndmin=4)
    count, length = paths.shape[:2]
    pose = errors.check_array("pose", pose, (3,), *[(count, 3)] * is_batch)
    errors.check_finite("yaw of the pose", np.abs(pose[..., 2]).max(), at_most=13, unit="rad")
    friction = errors.check_array("friction_finger", friction_finger, (), *[(count,)] * is_batch)
    for value in (friction.min(), friction.max()):
        errors.check_finite("friction_finger", value, at_least=0, at_most=3)
    times = errors.check_array("time", np.arange(length) if time is None else time, (length,))
    if length < 2 or (np.diff(times) <= 0).any():
        rule = "give at least two points of the path, at increasing times"
        raise errors.not_allowed("time", times.tolist(), rule)

    pose, friction = np.broadcast_to(pose, (count, 3)), np.broadcast_to(friction, count)
    paths = paths.swapaxes(0, 1)
    gap, moves = _gaps(corners, pose, paths[0]), np.linalg.norm(np.diff(paths, axis=0), axis=-1)
    if gap.min() < -_INSIDE * width or max(gap.max(), moves.sum(axis=0).max()) > _FAR * width:
        rule = "fingers start outside and near: give path and pose in one frame, in metres"
        value = f"{moves.sum(axis=0).max():.2g} m long, {gap.min():.2g} m off the object at first"
        raise errors.not_allowed("path", value, rule)
    support = np.broadcast_to(points[:, :3] - [*p_com, 0.0], (count, len(points), 3))
    shift = np.full(count, friction_ground * height)
    ground = fingers.Ground(support[..., :2], support[..., 2], np.zeros(count), shift)
    chosen = ground.ellipsoid() if model == "ellipsoid" else ground
    parts = np.maximum(np.ceil(moves.max(axis=(1, 2)) * _STEPS / width), 1)
    first = np.concatenate([[0], np.cumsum(parts)]).astype(int)
    fine = make_interp_spline(first, paths, k=1)(np.arange(first[-1] + 1))
    motion = fingers.push(corners, p_com, chosen, fine, pose, friction)
    moment = solid.rotate(-motion.pose[:-1, :, 2], ground.shift[:, None] * motion.force)
    if not solid.encloses(points[:, :2] - p_com, moment).all():
        raise errors.not_allowed("height", f"{height:g} m", "the object would tip over: push lower")
    poses = motion.pose[first]
    means = np.add.reduceat(motion.force, first[:-1]) / np.diff(first)[:, None, None]
    force = friction_ground * mass * solid.GRAVITY * np.insert(means, 0, 0.0, axis=0)
    gaps = np.array([_gaps(corners, *at) for at in zip(poses, paths, strict=True)])
    if gaps.min() < -_INSIDE * width:
        rule = "fingers must not squeeze a rigid object: move one of them away"
        raise errors.not_allowed("path", f"that ends {-gaps.min():.2g} m inside the object", rule)
    words = "force of the fingers on the object, mean since the previous time"
    columns = labelled(
        time=("time", times, "1" if time is None else "s", "time"),
        object_pose=(("time", "push", "pose"), poses, "m, m, rad", "pose of the object"),
        force=(("time", "push", "axis"), force, "N", words),
        gap=(("time", "push", "finger"), gaps, "m", "gap between finger and object"),
    )
    result = xr.Dataset(columns, {"pose": ["x", "y", "yaw"], "axis": ["x", "y"]}, {"model": model})
    result = result.set_coords("time").transpose("push", ...)
    return result if is_batch else result.isel(push=0)


def uniform_pressure(outline: np.ndarray, centroid: np.ndarray) -> np.ndarray:
    """Return points (S, 3) [m, m, m^2] with their areas, of equal pressure under a polygon (N, 2).

    They are the centroids of small triangles, into which the triangles from the centroid to the
    edges are divided.
    """
    parts = math.ceil(math.sqrt(_POINTS / len(outline)))
    i, j = np.indices((parts, parts)).reshape(2, -1)
    upright = np.stack([3 * i + 1, 3 * j + 1])[:, i + j < parts]
    inverted = np.stack([3 * i + 2, 3 * j + 2])[:, i + j < parts - 1]
    share = np.concatenate([upright, inverted], axis=1).T / (3 * parts)  # (parts^2, 2)
    sides = np.stack([outline, np.roll(outline, -1, axis=0)], axis=1) - centroid  # (N, 2, 2)
    at = centroid + (share @ sides).reshape(-1, 2)
    area = np.abs(np.linalg.det(sides)) / (2 * parts * parts)
    return np.column_stack([at, np.repeat(area, len(share))])


def _gaps(outline: np.ndarray, pose: np.ndarray, finger: np.ndarray) -> np.ndarray:
    """Return gaps (n, F) [m] between fingers (n, F, 2) and objects at poses (n, 3)."""
    offset = finger - pose[:, None, :2]
    return fingers.nearest(outline, solid.rotate(-pose[:, None, 2], offset))[0]
