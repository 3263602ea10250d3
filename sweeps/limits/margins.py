"""A bound that can be proved: a contact in the critical region of the skin moves back.

Assume quasi-static pushing with Coulomb friction, a vertex (or any material point) of the object at
p = (x, l) on the base's flat front, and an ellipsoidal limit surface (Lynch, Maekawa and Tanie
1992; Goyal, Ruina and Papadopoulos 1991): the force f that the base exerts moves the object's point
at r from its centre of friction with

  T1  w = f + (r x f) z x r / c^2 = A f,   A = I + r_perp r_perp^T / c^2,   r_perp = (-r_y, r_x)

up to a positive factor, c [m] being the ratio of the greatest moment to the greatest force of the
object on its ground. A has the eigenvalues 1 and 1 + (r / c)^2, so w is off f by at most
delta = asin(r^2 / (2 c^2 + r^2)); f is off the front's normal by at most phi = atan(mu). Hence

  T2  |w_y| <= tan(phi + delta) w_x     if phi + delta < pi / 2

The base's point there moves at u = (v_x - omega l, v_y + omega x), and w_x = u_x while it pushes,
so the contact drifts along the skin at

  T3  dl/dt = w_y - u_y <= tan(phi + delta) u_x - u_y    for l > 0, and mirrored for l < 0.

In the Realignment State at |l| >= l_cr the law does not turn (Eq. 10: sigma = 0) and drives with
v_y = a_r,max sgn(l) v_x. So **|l| shrinks wherever |l| >= l_cr if**

  T4  a_r,max > tan(phi + delta)

and a contact on the skin stays within the larger of l_cr and its start, up to its motion in one
control period. For a disc l is the position of its centre, which moves along f itself: delta = 0.
The condition is sufficient and not necessary. It does not cover a corner of the base on a face of
the object, and does not imply that the target is reached.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rps_jax import RPSParams, errors


class Touch(NamedTuple):
    """A point of the object on the base's front; leaves (...)."""

    p_robot_contact: np.ndarray  # (..., 2) [m]
    p_robot_arm: np.ndarray  # (..., 2) [m] r, from the centre of friction to the contact
    c: np.ndarray  # (...) [m] greatest moment over greatest force of the ground
    mu: np.ndarray  # (...) [1] friction between object and base


def steepest(mu: ArrayLike, arm: ArrayLike) -> np.ndarray:
    """T2's tan(phi + delta) (...) [1]; infinite from a right angle on.

    Args:
      mu: (...) [1] friction between object and base.
      arm: (...) [1] r / c; 0 for a disc.

    Raises:
      InputError: one is negative.

    Example:
      >>> float(steepest(1.0, 0.0))
      1.0
    """
    mu, arm = np.asarray(mu, float), np.asarray(arm, float)
    for name, values in (("mu", mu), ("arm", arm)):
        for value in np.ravel(values)[:1] if np.ravel(values).min() >= 0 else [values.min()]:
            errors.check_finite(name, value, at_least=0)
    square = arm**2
    angle = np.arctan(mu) + np.arcsin(square / (2 + square))
    below = angle < np.pi / 2
    return np.where(below, np.tan(np.where(below, angle, 0.0)), np.inf)


def stays(params: RPSParams, mu: ArrayLike, arm: ArrayLike) -> np.ndarray:
    """T4 (...) bool: whether the contact moves back from the critical region.

    Args:
      params: of the law.
      mu: (...) [1] friction between object and base.
      arm: (...) [1] r / c; 0 for a disc.

    Example:
      >>> bool(stays(RPSParams.paper(), mu=0.5, arm=1.0))
      True
    """
    return np.asarray(params.a_r_max, float) > steepest(mu, arm)


def drift(twist: np.ndarray, touch: Touch) -> np.ndarray:
    """T3's dl/dt (...) [m/s], exactly: the contact sticks, or slips at the edge of its cone.

    Args:
      twist: (..., 3) [m/s, m/s, rad/s] of the base in its own frame.
      touch: contact and object; T4's phi + delta must be below a right angle.

    Returns:
      NaN where the base moves away from the object.
    """
    x, l = np.moveaxis(touch.p_robot_contact, -1, 0)  # noqa: E741
    v_x, v_y, omega = np.moveaxis(twist, -1, 0)
    u_x, u_y = v_x - omega * l, v_y + omega * x
    r_x, r_y = np.moveaxis(touch.p_robot_arm, -1, 0)
    a_xx, a_xy, a_yy = (1 + r_y**2 / touch.c**2, -r_x * r_y / touch.c**2, 1 + r_x**2 / touch.c**2)
    # Sticking: f = A^-1 u, up to a positive factor, if it lies in the cone.
    f_x, f_y = a_yy * u_x - a_xy * u_y, a_xx * u_y - a_xy * u_x
    sticks = (f_x > 0) & (np.abs(f_y) <= touch.mu * f_x)
    # Slipping: the base drags the object's point along, by a force at the edge of the cone.
    slips = []
    for sign in (1.0, -1.0):
        w_x, w_y = a_xx + sign * touch.mu * a_xy, a_xy + sign * touch.mu * a_yy
        speed = w_y * u_x / w_x - u_y
        slips.append(np.where((w_x > 0) & (sign * speed <= 0), speed, np.nan))
    rate = np.where(sticks, 0.0, np.where(np.isnan(slips[0]), slips[1], slips[0]))
    return np.where(u_x > 0, rate, np.nan)
