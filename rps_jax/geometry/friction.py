"""Coulomb friction of pads that slide on the ground, for planar solvers."""

from collections.abc import Sequence

import jax.numpy as jnp

from rps_jax.geometry import vectors as sp
from rps_jax.geometry.arrays import Number
from rps_jax.geometry.vectors import Vec

ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix


def friction_of_pads(pads: tuple[Number, ...], v: Vec, pace: Number) -> tuple[Vec, list[Number]]:
    """Return gradient and upper Hessian of D^2 / 2, with D the power of friction over its force."""
    x, y, share, radius = pads
    u = *sp.at_point(v, (x, y)), v[2] * radius
    speed = jnp.sqrt(sp.dot(u, u) + pace * pace)
    load, total = share / speed, sp.total(share * speed)
    flow = u[0], u[1], x * u[1] - y * u[0] + radius * u[2]
    slope = sp.map_entries(lambda f: sp.total(load * f), flow)
    one = jnp.ones_like(x)
    metric = one, 0 * x, -y, one, x, x * x + y * y + radius * radius
    hessian: list[Number] = [
        total * sp.total(load * (g - flow[i] * flow[j] / (speed * speed))) + slope[i] * slope[j]
        for g, (i, j) in zip(metric, ENTRIES, strict=True)
    ]
    return sp.scale(total, slope), hessian


def solved(g: Vec, h: Sequence[Number]) -> Vec:
    """Solve h x = g for a symmetric 3 x 3 matrix with the upper entries h."""
    a, b, c, d, e, f = h
    l_1, l_2 = b / a, c / a
    d, e = d - l_1 * b, e - l_1 * c
    y = g[1] - l_1 * g[0]
    z = (g[2] - l_2 * g[0] - e / d * y) / (f - l_2 * c - e * e / d)
    y = (y - e * z) / d
    return (g[0] - b * y - c * z) / a, y, z
