"""Box that a law remembers from the ends of contacts on its front."""

from typing import NamedTuple

import jax.numpy as jnp

from rps_jax.control.observation import EndsObservation
from rps_jax.geometry.arrays import Array, Number

_HALF = 0.07, 0.5  # [m] half widths of objects
FLUSH = 0.4  # [s] of even contact, after which a face is flush
_EDGE = 0.05  # [m] of contact beyond a known end, which contradicts it
_SAME = 0.03  # [m] by which a face or an end may have moved between two contacts


def turned(values: Array, leg: Array) -> Array:
    """Return values (4,) of the four directions, from that of a leg on."""
    rolled = values
    for k in (1, 2, 3):
        rolled = jnp.where(leg == k, jnp.roll(values, -k), rolled)
    return rolled


class Box(NamedTuple):
    """Box that the law remembers, in the frame of the goal or of a leg."""

    h: Array  # (4,) [m] supports ahead, left, behind and right
    known: Array  # (4,) bool
    centred: Array  # (2,) bool: along and across

    def turned(self, leg: Array) -> "Box":
        """Return the box from the direction of a leg on."""
        centred = jnp.where(leg % 2 == 1, self.centred[::-1], self.centred)
        return Box(turned(self.h, leg), turned(self.known, leg), centred)


def extents(h: Array) -> tuple[Array, Array]:
    """Return the middle (2,) and the half widths (2,) of supports (4,), along and across [m]."""
    return (h[:2] - h[2:]) / 2, jnp.clip((h[:2] + h[2:]) / 2, *_HALF)


def feel(
    r: Number, box: Box, front: Array, lateral: Array, obs: EndsObservation, t_even: Array
) -> Box:
    """Compute Q1 to Q3 of the law `pose`: the box in the frame of the leg, at a contact.

    An unknown object has the half width `r` [m]. `front` and `lateral` [m] are the positions of the
    front along, and of the base across the leg. The contact is even for `t_even` [s].
    """
    (ahead, _, behind, _), known, centred = box
    sides, was_known = box.h[1::2], known[1::2]
    flush = obs.even & (t_even > FLUSH)
    # The pushed face: the box moves with it, or another face is there and the middle stays.
    near = -front
    same = known[2] & (jnp.abs(near - behind) < _SAME)
    middle = jnp.where(centred[0], (ahead - behind) / 2, front + r)
    mirrored = front + 2 * jnp.clip(middle - front, *_HALF)
    keeps = known[0] & ~known[2]
    far = jnp.where(same, ahead + behind - near, jnp.where(keeps, ahead, mirrored))
    ahead, behind = jnp.where(obs.even, far, ahead), jnp.where(obs.even, near, behind)
    far_known = known[0] & (same | keeps | ~obs.even)
    # Its ends, as supports to the left and to the right.
    felt = (lateral + obs.ends) * jnp.array([1.0, -1.0])
    seen = obs.seen & flush
    is_known = was_known & (felt < sides + _EDGE)
    is_same = is_known & (jnp.abs(felt - sides) < _SAME)
    measured = jnp.where(is_same, sides + 0.1 * (felt - sides), felt)
    unknown = jnp.where(centred[1], jnp.maximum(sides, felt), felt)
    sides = jnp.where(seen, measured, jnp.where(is_known, sides, unknown))
    left, right = is_known | seen
    known = jnp.stack([far_known, left, known[2] | flush, right])
    h = jnp.stack([ahead, sides[0], behind, sides[1]])
    return Box(h, known, centred | jnp.stack([False, flush]))
