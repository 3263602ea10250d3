"""Slow pushes of objects by one round finger, many at once, with exact derivatives.

The object slides on its support without inertia. Its outline is any simple polygon, its support are
pads that share its load: the friction of the engine `quasistatic`. In each step the finger sticks
to the outline or slides along it. If it sticks, the object turns about the contact so that the
power of friction is least. If that needs a force outside of Coulomb's cone, the force is on the
edge of the cone, friction with the ground gives the twist under it, and the speed of the finger
along the normal gives its size (Mason 1986; Lynch, Maekawa and Tanie 1992).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from rps_jax import errors
from rps_jax.geometry import planar
from rps_jax.geometry import vectors as sp
from rps_jax.geometry.arrays import Array, Entries, Float, Pytree
from rps_jax.geometry.friction import friction_of_pads, solved
from rps_jax.geometry.polyline import is_inside
from rps_jax.geometry.vectors import Vec, trace_one_world

STEPS = 50  # of a push; with 100, ends move by 0.03 mm of 50 mm in the median
_SMOOTH = 1e-3  # [1] share of the speed of the contact below which friction is smooth
_ITERATIONS = 30  # of the two solvers, at most
_TOGETHER = 16  # pushes of one loop: all of them go on until the last has converged
_LENGTHS = (1.0, 0.3, 0.08)  # of steps of Newton's method
_DEEP = 3e-4  # [m] penetration that one step undoes at most
_ALONG = 0.02  # [1] least speed along the normal of a sliding contact, of the whole
_NODES = 40  # pads of a uniform pressure, about
_PAD = 0.36  # [1] radius of a pad over the width of its cell


class Slider(NamedTuple):
    """Object that a finger pushes; in the frame of the object."""

    outline: Float[Array, "N 2"]  # [m] corners of a simple polygon, counter-clockwise
    # x, y [m], share of the load [1] and radius [m] of pads
    pads: Float[Array, "S 4"]
    friction: Float[Array, ""]  # [1] with the finger
    radius: Float[Array, ""]  # [m] of the finger


class Pushed(NamedTuple):
    """Motion of objects."""

    pose: Float[Array, "B T 3"]  # [m, m, rad] of the object's frame, the first at the start
    gap: Float[Array, "B T"]  # [m] between finger and outline


def check_outline(outline: ArrayLike) -> np.ndarray:
    """Return the corners (N, 2) [m] of a simple polygon, counter-clockwise.

    Raises:
      InputError: there are fewer than three corners, sides cross, or the size is not in metres.
    """
    corners = errors.check_array("outline", outline, ("N", 2))
    size = float(np.ptp(corners, axis=0).max())
    if len(corners) < 3 or not 0.005 <= size <= 5:
        rule = "give 3 or more corners x, y [m] of an object of 0.005 to 5 m"
        raise errors.not_allowed("outline", f"{len(corners)} corners over {size:.3g} m", rule)
    ahead = np.roll(corners, -1, axis=0)
    way = ahead - corners

    def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

    side = cross(way[:, None], corners - corners[:, None])  # of corner j from edge i
    separated = side * np.roll(side, -1, axis=1) < 0  # the ends of edge j from edge i
    if np.any(separated & separated.T):
        raise errors.not_allowed("outline", f"{len(corners)} corners", "its sides must not cross")
    area = cross(corners, ahead).sum() / 2
    if abs(area) < 1e-3 * size**2:
        raise errors.not_allowed("outline", f"{len(corners)} corners", "it must enclose an area")
    return corners if area > 0 else corners[::-1]


def uniform_pads(outline: np.ndarray, count: int = _NODES) -> np.ndarray:
    """Return pads (S, 4) of a uniform pressure under a simple polygon (N, 2) [m], about `count`."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    x, y = outline.T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2
    width, fine = np.sqrt(area / count), 6  # cells, and points of each along a side
    cells = np.ceil((high - low) / width).astype(int)
    width = (high - low) / cells
    at = [low[k] + width[k] / fine * (np.arange(cells[k] * fine) + 0.5) for k in (0, 1)]
    points = np.stack(np.meshgrid(*at, indexing="ij"), axis=-1)
    corners = outline @ (1, 1j)
    inside = is_inside((points @ (1, 1j)).reshape(-1, 1), corners, np.roll(corners, -1))
    weight = inside.reshape(cells[0], fine, cells[1], fine)
    at_cell = points.reshape(cells[0], fine, cells[1], fine, 2)
    load = weight.sum(axis=(1, 3)).astype(float)
    used = load > 0
    middle = (weight[..., None] * at_cell).sum(axis=(1, 3))[used] / load[used, None]
    radius = _PAD * np.sqrt(load[used] / fine**2 * width.prod())
    return np.column_stack([middle, load[used] / load.sum(), radius])


@jax.jit(static_argnames="steps")
def push(slider: Slider, path: Float[Array, "B P 2"], pose: Array, steps: int = STEPS) -> Pushed:
    """Push objects from poses (B, 3) [m, m, rad] along paths of the finger's middle [m, world].

    The leaves of `slider` may have a leading axis B. The finger goes straight between points of a
    path, at any speed.
    """
    batched: Entries = tuple(
        x if jnp.ndim(x) > rank else None for x, rank in zip(slider, (2, 2, 0, 0), strict=True)
    )

    def push_one(inputs: tuple) -> Pushed:
        leaves = [a if b is None else b for a, b in zip(slider, inputs[0], strict=True)]
        return _push(Slider(*leaves), *inputs[1:], steps=steps)

    with trace_one_world():
        return jax.lax.map(push_one, (batched, path, pose), batch_size=_TOGETHER)


def _push(slider: Slider, path: Array, pose: Array, steps: int) -> Pushed:
    """Return one push."""
    lengths = jnp.sqrt(jnp.sum(jnp.diff(path, axis=0) ** 2, axis=1) + 1e-18)
    along = jnp.concatenate([jnp.zeros(1), jnp.cumsum(lengths)])
    at = jnp.linspace(0.0, 1.0, steps + 1) * along[-1]
    tips = jnp.stack([jnp.interp(at, along, x) for x in path.T], axis=1)
    pads = slider.pads
    unit = jnp.sqrt(pads[:, 2] @ jnp.sum((pads[:, :2] - pads[:, 2] @ pads[:, :2]) ** 2, axis=1))
    step = partial(_step, slider, jax.lax.stop_gradient(unit))
    first = pose, (0.0, jnp.array([1.0, 0.0, 0.0]))
    tip = jnp.stack([tips[:-1], tips[1:]], axis=1)
    (last, _), (poses, gaps) = jax.lax.scan(step, first, tip)
    gap = gap_of(slider, last, tips[-1])[0]
    return Pushed(jnp.concatenate([poses, last[None]]), jnp.append(gaps, gap))


def _nearest(outline: Array, point: Array) -> tuple[Array, Array]:
    """Return the signed distance [m] of a point from a polygon, and the outward normal (2,)."""
    ahead = jnp.roll(outline, -1, axis=0)
    way, offset = ahead - outline, point - outline
    length2 = jnp.sum(way * way, axis=1) + 1e-18
    share = jnp.clip(jnp.sum(offset * way, axis=1) / length2, 0.0, 1.0)
    away = offset - share[:, None] * way
    i = jnp.argmin(jnp.sum(away * away, axis=1))
    above = outline[:, 1] > point[1]
    crosses = above != jnp.roll(above, -1)
    slope = way[:, 0] / jnp.where(crosses, way[:, 1], 1.0)
    right = offset[:, 0] < slope * offset[:, 1]
    inside = jnp.sum(crosses & right) % 2 == 1
    side = jnp.stack([way[i, 1], -way[i, 0]]) / jnp.sqrt(length2[i])
    sign = jnp.where(inside, -1.0, 1.0)
    distance = jnp.sqrt(jnp.sum(away[i] ** 2) + 1e-18)
    is_near = distance < 1e-7  # the direction to the outline is rounding
    normal = jnp.where(is_near, side, sign * away[i] / distance)
    return jnp.where(is_near, jnp.sum(offset[i] * side), sign * distance), normal


def gap_of(slider: Slider, pose: Array, tip: Array) -> tuple[Array, Array, Array]:
    """Return the gap [m] of a finger, the outward normal and the contact point, in the body."""
    local = planar.rotate(-pose[2], tip - pose[:2])
    distance, normal = _nearest(slider.outline, local)
    return distance - slider.radius, normal, local - distance * normal


def _step(slider: Slider, unit: Array, carry: tuple, tip: Array) -> tuple:
    """Return pose and guesses after one step of the finger, with pose and gap before it."""
    pose, (spin, flow) = carry
    gap, normal, contact = gap_of(slider, pose, tip[0])
    moved = planar.rotate(-pose[2], tip[1] - tip[0])
    approach = -moved @ normal
    # The object moves along the normal by what the finger does beyond the gap.
    depth = approach + jnp.minimum(-gap, _DEEP)
    touches = depth > 0
    share = jnp.where(gap > 0, depth / jnp.where(approach > 0, approach, 1.0), 1.0)
    tangent = jnp.stack([normal[1], -normal[0]])
    depth = jnp.where(touches, depth, 1.0)
    across = jnp.where(touches, share * (moved @ tangent), 0.0)
    length = jnp.sqrt(depth * depth + across * across)
    x, y = ((slider.pads[:, :2] - contact) / unit).T
    pads = x, y, slider.pads[:, 2], slider.pads[:, 3] / unit
    stuck = (across * tangent - depth * normal) / length
    spin, force = _turn(pads, stuck, spin)
    pressing, rubbing = -force @ normal, force @ tangent
    sticks = (pressing > 0) & (jnp.abs(rubbing) <= slider.friction * pressing)
    edge = jnp.where(rubbing > 0, 1.0, -1.0) * slider.friction * tangent - normal
    flow = _slide(pads, edge / jnp.sqrt(edge @ edge), flow, jnp.append(stuck, spin))
    along = -flow[:2] @ normal
    slides = ~sticks & (along > _ALONG)
    # Velocity of the contact, over the length of the step.
    sliding = depth / length / jnp.where(slides, along, 1.0) * flow
    twist = length * jnp.where(slides, sliding, jnp.append(stuck, spin))
    angle = jnp.where(touches, twist[2] / unit, 0.0)
    origin = twist[:2] + angle * jnp.stack([contact[1], -contact[0]])
    origin = planar.rotate(pose[2] + angle / 2, jnp.where(touches, origin, 0.0))
    moved_pose = pose + jnp.append(origin, angle)
    return (moved_pose, (spin, flow)), (pose, gap)


def _iterate(refine: Callable[[tuple], tuple], start: tuple) -> tuple:
    """Return the fixed point of a step, to rounding of its first entry, or the last iterate."""
    enough = 50 * jnp.finfo(start[0].dtype).eps

    def advance(carry: tuple) -> tuple:
        count, x, _ = carry
        new = refine(x)
        return count + 1, new, jnp.max(jnp.abs(new[0] - x[0]))

    def unfinished(carry: tuple) -> Array:
        return (carry[0] < _ITERATIONS) & (carry[2] > enough)

    return jax.lax.while_loop(
        unfinished, advance, (0, start, jnp.asarray(jnp.inf, start[0].dtype))
    )[1]


def _power(pads: tuple, v: Vec) -> Array:
    """Return the power of friction at a twist."""
    x, y, share, radius = pads
    u, w = sp.at_point(v, (x, y))
    return share @ jnp.sqrt(u * u + w * w + (v[2] * radius) ** 2 + _SMOOTH**2)


def _pull(pads: tuple, v: Array, spin: Array) -> tuple[Array, ...]:
    """Return force (2,), torque and its slope of friction at a velocity and spin."""
    x, y, share, radius = pads
    u, w, t = v[0] - spin * y, v[1] + spin * x, spin * radius
    square = u * u + w * w + t * t + _SMOOTH**2
    load, flow = share / jnp.sqrt(square), x * w - y * u + radius * t
    slope = load @ (x * x + y * y + radius * radius - flow * flow / square)
    return jnp.stack([load @ u, load @ w]), load @ flow, slope


def _turn(pads: tuple, v: Array, spin: Array) -> tuple[Array, Array]:
    """Return the spin of least power at a velocity (2,) of the contact, and the force (2,).

    Newton's method with a bracket; the last step alone is differentiated.
    """
    fixed, v_fixed, spin = jax.lax.stop_gradient((pads, v, spin))
    far = 4.0 / jnp.sqrt(fixed[2] @ (fixed[0] ** 2 + fixed[1] ** 2) + 1e-9)

    def refine(carry: tuple) -> tuple:
        spin, low, high = carry
        _, torque, slope = _pull(fixed, v_fixed, spin)
        low, high = jnp.where(torque < 0, spin, low), jnp.where(torque < 0, high, spin)
        new = spin - torque / jnp.maximum(slope, 1e-6)
        return jnp.where((new > low) & (new < high), new, (low + high) / 2), low, high

    start = jnp.clip(spin, -far, far), -far, far
    spin = jax.lax.stop_gradient(_iterate(refine, start)[0])
    _, torque, slope = _pull(pads, v, spin)
    spin = spin - torque / jax.lax.stop_gradient(jnp.maximum(slope, 1e-6))
    return spin, _pull(pads, v, spin)[0]


def _slide(pads: tuple, force: Array, flow: Array, stuck: Array) -> Array:
    """Return the twist (3,) about the contact under a force (2,) there, of any scale.

    It minimises half of the squared power less the force times the velocity. Guesses are the last
    one, and the twist (3,) of a contact that sticks.
    """
    constant: Pytree = jax.lax.stop_gradient((pads, (force[0], force[1], 0.0), flow, stuck))
    fixed, pull, flow, stuck = constant

    def cost(v: Vec) -> Array:
        return _power(fixed, v) ** 2 / 2 - pull[0] * v[0] - pull[1] * v[1]

    def refine(carry: tuple) -> tuple:
        v: Entries = tuple(carry[0])
        gradient, hessian = friction_of_pads(fixed, v, _SMOOTH)
        change = solved(sp.sub(gradient, pull), hessian)
        tried = [sp.sub(v, sp.scale(s, change)) for s in _LENGTHS]
        costs = jnp.stack([cost(x) for x in tried])
        best = jnp.argmin(costs)
        return (jnp.stack([jnp.stack(x) for x in tried])[best],)

    power = _power(fixed, tuple(stuck))
    scaled = (pull[0] * stuck[0] + pull[1] * stuck[1]) / (power * power) * stuck
    guess = jnp.where(cost(tuple(flow)) < cost(tuple(scaled)), flow, scaled)
    v = tuple(jax.lax.stop_gradient(_iterate(refine, (guess,))[0]))
    gradient, hessian = friction_of_pads(pads, v, _SMOOTH)
    rest = sp.sub(gradient, (force[0], force[1], 0.0))
    return jnp.stack(sp.sub(v, solved(rest, jax.lax.stop_gradient(hessian))))
