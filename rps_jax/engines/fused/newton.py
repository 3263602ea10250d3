"""MuJoCo's convex problem for one free object, by Newton's method with an exact line search.

The unknowns are the object's six accelerations, and three more of a base with a limited force.
They minimise

    (a - a_free)' M (a - a_free) / 2 + sum over contacts of s(J a - a_ref),

as in MuJoCo and MJX.

Reference: MuJoCo documentation, "Computation: Constraint model" and "Solver".
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name

from rps_jax.engines.fused.contacts import Body, Contact, Point, State
from rps_jax.engines.native import restrict, varied_indices
from rps_jax.geometry import vectors as sp
from rps_jax.geometry.arrays import Array, Number, Pytree
from rps_jax.geometry.solid import GRAVITY
from rps_jax.geometry.vectors import Vec
from rps_jax.robot.base import Tyres
from rps_jax.world.physics import Physics

SOLUTION = "accelerations"  # name of the solver's results, for policies of `jax.checkpoint`
_TOLERANCE = 1e-4  # [m/s^2] error of the acceleration at which the solver ends
_FLAT = 1e-3  # [1] share of the initial slope at which a line search ends
_FAR = 1e9  # upper bound of a line search without a bracket


Row = tuple[Number, ...]  # along n, t and s, and of a pad its torque about n over its radius


def contact_force(contact: Contact, x: Row, physics: Physics) -> tuple[Row, Row]:
    """Return the force [N] along (n, t, s) at J a - aref = x, and the stiffness.

    The stiffness (nn, nt, ns, tt, ts, ss) is minus the derivative of the force. A pad has a fourth
    row, and the entries (nn, nt, ns, nq, tt, ts, tq, ss, sq, qq).
    """
    if physics.cone == "pyramidal":
        return _pyramid(contact, x, physics)
    d, f = contact.d, contact.friction
    d_t = physics.impratio * d
    mu = f * physics.impratio**-0.5
    n, *sideways = mu * x[0], *(f * y for y in x[1:])
    slip = sp.norm(sideways)
    sticks = mu * n + slip <= 0
    slides = (n < mu * slip) & ~sticks
    d_m = jnp.where(slides, d / (mu * mu * (1 + mu * mu)), 0.0)
    h = n - mu * slip
    way = [y / slip for y in sideways]
    pull = -d_m * h * mu  # normal force of a sliding contact
    force = pull, *(-pull * f * e for e in way)
    nn = d_m * mu * mu
    along = nn * f * f  # of the slip
    across = pull * f * f / slip
    stiffness, stuck = [nn, *(-nn * f * e for e in way)], [d, *(0.0 for _ in way)]
    for i, e in enumerate(way):
        rest = (across * y * y for j, y in enumerate(way) if j != i)
        stiffness += [reduce(sp.plus, rest, along * e * e)]
        stiffness += [(along - across) * e * y for y in way[i + 1 :]]
        stuck += [d_t, *(0.0 for _ in way[i + 1 :])]
    sticking = (-d * x[0], *(-d_t * y for y in x[1:])), tuple(stuck)
    sliding = force, tuple(stiffness)
    return jax.tree.map(partial(jnp.where, sticks), sticking, sliding)


def _pyramid(contact: Contact, x: Row, physics: Physics) -> tuple[Row, Row]:
    """Return force and stiffness of four frictionless edges n +- friction t, n +- friction s."""
    f = contact.friction
    d = contact.d * physics.impratio / (2 * f * f * (1 + f * f))
    up_t, down_t = x[0] + f * x[1], x[0] - f * x[1]
    up_s, down_s = x[0] + f * x[2], x[0] - f * x[2]
    rows = [jnp.where(y < 0, d, 0.0) for y in (up_t, down_t, up_s, down_s)]
    p, q, r, o = (-y * k for y, k in zip((up_t, down_t, up_s, down_s), rows, strict=True))
    force = (p + q + r + o, f * (p - q), f * (r - o))
    stiffness = (
        rows[0] + rows[1] + rows[2] + rows[3],
        f * (rows[0] - rows[1]),
        f * (rows[2] - rows[3]),
        f * f * (rows[0] + rows[1]),
        0.0,
        f * f * (rows[2] + rows[3]),
    )
    return force, stiffness


class Base(NamedTuple):
    """Base that its drive pushes, in the world's axes; zeros of one that follows every twist."""

    inertia: Vec = (0.0, 0.0, 0.0)  # [kg, kg, kg m^2]
    force: Vec = (0.0, 0.0, 0.0)  # [N, N, N m] of the drive, about the vertical the last
    tyres: Tyres | None = None  # of an axle that does not move sideways


def _rows(contact: Contact, x: Sequence[Vec]) -> Row:
    """Return J times accelerations: those of a contact's point along n, t, s, and about n of a pad.

    The acceleration of a base, at and about its origin, is subtracted.
    """
    a, alpha, *base = x
    u = sp.add(a, sp.cross(alpha, contact.r))
    if base and contact.arm is not None:
        u = sp.sub(u, (*sp.at_point(base[0], contact.arm), 0.0))
    rows = sp.dot(contact.n, u), sp.dot(contact.t, u), sp.dot(contact.s, u)
    if contact.radius is None:
        return rows
    return *rows, contact.radius * sp.dot(contact.n, alpha)


def _at(contact: Contact, x: Sequence[Vec]) -> Row:
    """Return J a - a_ref of a contact."""
    return sp.add(_rows(contact, x), contact.bias)


def _solve(h: list[list[Number]], g: Sequence[Number]) -> list[Number]:
    """Solve h x = g for a symmetric positive definite h, given by its lower triangle."""
    size = len(g)
    low: list[list[Number]] = [[0.0] * size for _ in range(size)]
    for i in range(size):
        for j in range(i + 1):
            rest = h[i][j] - sp.dot(low[i][:j], low[j][:j]) if j else h[i][j]
            low[i][j] = jax.lax.rsqrt(rest) if i == j else rest * low[j][j]
        # the diagonal holds the reciprocals
    y: list[Number] = []
    for i in range(size):
        y.append((g[i] - sp.dot(low[i][:i], y) if i else g[i]) * low[i][i])
    x: list[Number] = [0.0] * size
    for i in reversed(range(size)):
        below = [low[k][i] for k in range(i + 1, size)]
        x[i] = (y[i] - sp.dot(below, x[i + 1 :]) if below else y[i]) * low[i][i]
    return x


class Problem(NamedTuple):
    """The convex cost of one step."""

    mass: Number  # [kg] of the object
    spin: list[Vec]  # [kg m^2] its inertia tensor in the world's axes
    free: Vec  # [rad/s^2] its angular acceleration without contacts
    contacts: list[Contact]
    base: Base
    start: list[Vec]  # last accelerations, the solver's first guess
    lift: Vec  # [m/s^2] minus gravity

    @classmethod
    def of(
        cls, body: Body, state: State, m: Sequence[Vec], contacts: list[Contact], base: Base
    ) -> Problem:
        """Return the problem of a state; `m` are the rows of the rotation of its principal axes."""
        i, w = body.inertia, state.w
        torque = sp.cross(sp.map_entries(sp.mul, i, w), w)  # - w x (I w)
        free = sp.to_world(m, sp.map_entries(operator.truediv, torque, i))
        start = state.accelerations
        lift = (0.0, 0.0, GRAVITY) if body.gravity is None else sp.scale(-1, body.gravity)
        spin: Any = [
            tuple(sum(m[r][k] * m[c][k] * i[k] for k in range(3)) for c in range(3))
            for r in range(3)
        ]
        return cls(body.mass, spin, free, contacts, base, start, lift)

    def gauss(self, x: Sequence[Vec]) -> list[Vec]:
        """Return M (x - free accelerations)."""
        a, alpha, *b = x
        linear = sp.scale(self.mass, sp.add(a, self.lift))
        angular = sp.to_world(self.spin, sp.sub(alpha, self.free))
        inertia, force, tyres = self.base
        rows = [sp.sub(sp.map_entries(sp.mul, inertia, y), force) for y in b]
        if tyres is not None:
            excess = sp.dot(tyres.sideways, b[0]) - tyres.rest
            rows = [sp.add(rows[0], tyres.along(tyres.mass * excess))]
        return [linear, angular, *rows]

    def gradient(
        self, x: Sequence[Vec], physics: Physics
    ) -> tuple[list[Number], list[list[Number]]]:
        """Return the gradient of the cost, and the lower triangle of its Hessian."""
        g = self.gauss(x)
        h: list[list[Number]] = [[0.0] * (3 * len(x)) for _ in range(3 * len(x))]
        for row in range(3):
            if len(x) > 2:
                h[6 + row][6 + row] = self.base.inertia[row]
            h[row][row] = self.mass
            for column in range(row + 1):
                h[3 + row][3 + column] = self.spin[row][column]
                if (tyres := self.base.tyres) is not None:
                    added = tyres.mass * tyres.sideways[row] * tyres.sideways[column]
                    h[6 + row][6 + column] = h[6 + row][6 + column] + added
        for c in self.contacts:
            force, k = contact_force(c, _at(c, x), physics)
            f = sp.combine(force[:3], (c.n, c.t, c.s))
            torque = sp.cross(c.r, f)
            if c.radius is not None:
                torque = sp.add(torque, sp.scale(c.radius * force[3], c.n))
            g[:2] = (
                sp.sub(g[0], sp.map_entries(sp.total, f)),
                sp.sub(g[1], sp.map_entries(sp.total, torque)),
            )
            if c.arm is not None:
                g[2] = sp.add(g[2], sp.map_entries(sp.total, sp.wrench(c.arm, f)))
            _stiffen(h, c, k)
        return [entry for block in g for entry in block], h


def accelerations(
    problem: Problem, physics: Physics, solution: Sequence[Vec] | None = None
) -> list[Vec]:
    """Return the minimum of MuJoCo's convex cost, with exact derivatives.

    The derivative is that of the implicit function theorem at the minimum: minus the inverse
    Hessian times the derivative of the gradient. The iterations are not differentiated. Where a
    contact appears or a cone ends, it is one-sided. Second derivatives do not exist.

    Args:
      problem: of one world or a batch.
      physics: cone and limits of the solver.
      solution: result of an earlier call with this problem; then only derivatives are computed.

    Returns:
      Linear and angular acceleration of the object; and of a base with a limited force along x, y
      and about the vertical.
    """
    # Literal numbers stay literal: `vectors` folds zeros and ones.
    leaves, tree = jax.tree.flatten((problem, solution))
    positions = [i for i, x in enumerate(leaves) if isinstance(x, jax.Array)]

    def rebuilt(arrays: Sequence[Array]) -> tuple[Problem, Sequence[Vec] | None]:
        values = dict(zip(positions, arrays, strict=True))
        return tree.unflatten([values.get(i, x) for i, x in enumerate(leaves)])

    @jax.custom_jvp
    def run(arrays: list[Array]) -> list[Vec]:
        problem, solution = rebuilt(arrays)
        return _minimise(problem, physics) if solution is None else list(solution)

    def rule(primals: Pytree, tangents: Pytree) -> tuple[list[Vec], list[Vec]]:
        (arrays,), (directions,) = primals, tangents
        x = checkpoint_name(run(arrays), SOLUTION)

        def gradient(arrays: list[Array]) -> tuple[list[Number], list[list[Number]]]:
            g, h = rebuilt(arrays)[0].gradient(x, physics)
            return [jnp.asarray(entry) for entry in g], h

        varied = varied_indices(directions)
        of_varied, point = restrict(gradient, arrays, varied)
        tangent = [directions[i] for i in varied]
        _, dg, h = jax.jvp(of_varied, (point,), (tangent,), has_aux=True)
        step = _solve(h, [-entry for entry in dg])
        return x, _blocks(step)

    run.defjvp(rule, symbolic_zeros=True)
    return run([leaves[i] for i in positions])


def _blocks(entries: Sequence[Number]) -> list[Vec]:
    """Return entries as vectors, three each."""
    return list(zip(*[iter(entries)] * 3, strict=True))


def _minimise(problem: Problem, physics: Physics) -> list[Vec]:
    """Return the minimum, by Newton's method with an exact line search from the last accelerations.

    The solver ends at an error of `_TOLERANCE`; the tolerance of `physics`, which also depends on
    the mass of the base, is not used.
    """
    mass, base = problem.mass, problem.base

    def improve(carry):
        count, x, active, _ = carry
        g, h = problem.gradient(x, physics)
        step = _solve(h, [-entry for entry in g])
        d = _blocks(step)
        slope = reduce(sp.plus, map(sp.dot, problem.gauss(x), d))
        bend = mass * sp.dot(d[0], d[0]) + sp.dot(d[1], sp.to_world(problem.spin, d[1]))
        for e in d[2:]:
            bend = bend + sp.dot(base.inertia, sp.map_entries(sp.mul, e, e))
            if base.tyres is not None:
                bend = bend + base.tyres.mass * sp.dot(base.tyres.sideways, e) ** 2
        lines = [(c, _at(c, x), _rows(c, d)) for c in problem.contacts]
        # Inner product of step and gradient: twice the decrease of a quadratic cost.
        gain = -sp.dot(step, g)
        length = _line_search(lines, slope, bend, active * gain, physics)
        continues = gain > 2 * mass * _TOLERANCE**2
        # A converged world stays while others continue, so that its result does not depend on them.
        move = jnp.where(continues, length, jnp.minimum(length, 1.0))
        move = jnp.where(active > 0, move, 0.0)
        x = [sp.add(y, sp.scale(move, e)) for y, e in zip(x, d, strict=True)]
        active = jnp.where(continues, active, 0.0)
        return count + 1, x, active, _any(active)

    active = jnp.ones_like(mass)
    return jax.lax.while_loop(
        lambda carry: (carry[0] < physics.iterations) & carry[3],
        improve,
        (0, problem.start, active, _any(active)),
    )[1]


def wrench_on_base(
    contact: Contact, arm: Point, x: Sequence[Vec], turn: Point, physics: Physics
) -> Vec:
    """Return the wrench of the object on the base [N, N, N m], about its origin, in its frame.

    Args:
      contact: contacts of the object with the base.
      arm: (C, ...) [m] to the contacts from the base's origin, in the world's axes.
      x: solution for the accelerations.
      turn: cosine and sine of the base's heading.
      physics: with the friction cone.
    """
    force, _ = contact_force(contact, _at(contact, x), physics)
    wrenches = sp.wrench(arm, sp.combine(force, (contact.n, contact.t, contact.s)))
    wrench = sp.turned_back(turn, sp.map_entries(sp.total, wrenches))
    return sp.map_entries(lambda x: -x, wrench)  # the contacts' force is on the object


def _any(active: Array) -> Array:
    """Whether any entry is above zero."""
    return jnp.sum(active) > 0


def _stiffen(h: list[list[Number]], c: Contact, k: Row) -> None:
    """Add the contacts' J^T K J to the lower triangle of h."""
    if c.radius is not None:  # the row of a pad: its couplings to the others, and to itself
        nn, nt, ns, nq, tt, ts, tq, ss, sq, qq = k
        k, side = (nn, nt, ns, tt, ts, ss), sp.combine((nq, tq, sq), (c.n, c.t, c.s))
        spin, arm = sp.scale(c.radius, c.n), sp.cross(c.r, side)
        for i in range(3):
            for j in range(3):
                h[3 + i][j] = sp.plus(h[3 + i][j], sp.total(sp.mul(spin[i], side[j])))
            for j in range(i + 1):
                pair = sp.plus(sp.mul(spin[i], arm[j]), sp.mul(arm[i], spin[j]))
                pair = sp.plus(pair, sp.mul(sp.mul(spin[i], spin[j]), qq))
                h[3 + i][3 + j] = sp.plus(h[3 + i][3 + j], sp.total(pair))
    nn, nt, ns, tt, ts, ss = k
    # K in the world's axes: columns of Q K Q^T with Q = (n, t, s).
    axes = (c.n, c.t, c.s)
    sides = [sp.combine(row, axes) for row in ((nn, nt, ns), (nt, tt, ts), (ns, ts, ss))]
    columns = [sp.combine([axis[j] for axis in axes], sides) for j in range(3)]
    turned = [sp.cross(c.r, column) for column in columns]  # columns of [r] K
    for i in range(3):
        for j in range(i + 1):
            h[i][j] = sp.plus(h[i][j], sp.total(columns[j][i]))
        for j in range(3):
            h[3 + i][j] = sp.plus(h[3 + i][j], sp.total(turned[j][i]))
        row = sp.cross(c.r, [column[i] for column in turned])
        for j in range(i + 1):
            h[3 + i][3 + j] = sp.plus(h[3 + i][3 + j], sp.total(row[j]))
    if c.arm is None:
        return
    # The base's rows: -B^T K (1, [r]^T, -B), where B maps the motion of its origin to the point's.
    onto = [sp.wrench(c.arm, column) for column in columns]
    for j in range(3):
        twisted = sp.wrench(c.arm, [column[j] for column in turned])
        for i in range(3):
            h[6 + i][j] = sp.minus(h[6 + i][j], sp.total(onto[j][i]))
            h[6 + i][3 + j] = sp.minus(h[6 + i][3 + j], sp.total(twisted[i]))
    for i in range(3):
        row = sp.wrench(c.arm, [column[i] for column in onto])
        for j in range(i + 1):
            h[6 + i][6 + j] = sp.plus(h[6 + i][6 + j], sp.total(row[j]))


class _Line(NamedTuple):
    """Rows of contacts (C, ...) along the line a + x step, in the axes of the cone.

    For each, n(x) = n + x pace and slip(x)^2 = square + 2 x half + x^2 bend.
    """

    n: Number
    pace: Number
    square: Number
    half: Number
    bend: Number
    weight: Number  # [kg] stiffness of a sticking contact
    mu: Number


def _line(c: Contact, start: Row, pace: Row, physics: Physics) -> _Line:
    """Return the line of contacts in the elliptic cone whose rows start at `start`."""
    f = c.friction
    mu = f * physics.impratio**-0.5
    (n, *side), (p, *rise) = start, pace
    ff = f * f
    square, half, bend = (ff * sp.dot(a, b) for a, b in ((side, side), (side, rise), (rise, rise)))
    return _Line(mu * n, mu * p, square, half, bend, c.d * physics.impratio / ff, mu)


def _slope_of_ellipse(line: _Line, x: Number) -> tuple[Number, Number]:
    """Return first and second derivative of the contacts' cost along the line."""
    n, mu = line.n + x * line.pace, line.mu
    turn = line.half + x * line.bend
    slip = jnp.sqrt(jnp.maximum(line.square + x * (line.half + turn), 1e-30))
    sticks = mu * n + slip <= 0
    slides = (n < mu * slip) & ~sticks
    h, first = n - mu * slip, turn / slip  # the slip's derivative
    rise = line.pace - mu * first
    d_m = line.weight / (1 + mu * mu)
    second = rise * rise - h * mu * (line.bend - first * first) / slip
    stuck = n * line.pace + turn, line.pace * line.pace + line.bend
    return (
        jnp.where(sticks, line.weight * stuck[0], jnp.where(slides, d_m * h * rise, 0.0)),
        jnp.where(sticks, line.weight * stuck[1], jnp.where(slides, d_m * second, 0.0)),
    )


def _slope_of_pyramid(
    lines: tuple[Contact, Any, Any], x: Number, physics: Physics
) -> tuple[Number, Number]:
    """Return first and second derivative of the contacts' cost for the friction pyramid."""
    c, start, pace = lines  # rows (n, t, s)
    force, k = _pyramid(c, sp.add(start, sp.scale(x, pace)), physics)
    nn, nt, ns, tt, _, ss = k
    p, q, r = pace
    curve = nn * p * p + tt * q * q + ss * r * r + 2 * p * (nt * q + ns * r)
    return -sp.dot(force, pace), curve


def _line_search(
    lines: list[tuple[Contact, Row, Row]],
    slope: Number,
    bend: Number,
    steepness: Number,
    physics: Physics,
) -> Number:
    """Return the step length of minimum cost, by Newton's method with a bracket.

    The search ends at a slope of `_FLAT` times the initial one.

    `slope` and `bend` are the first and second derivative of the cost without contacts; `lines` are
    the contacts with their rows at the start and the change of these; `steepness` is minus the
    initial slope, or 0 for worlds that need no search.
    """
    slopes: list[Callable[[Number], tuple[Number, Number]]]
    if physics.cone == "pyramidal":
        slopes = [partial(lambda line, x: _slope_of_pyramid(line, x, physics), c) for c in lines]
    else:
        slopes = [partial(_slope_of_ellipse, _line(*c, physics)) for c in lines]

    def refine(carry):
        count, x, low, high, searching, _ = carry
        first, second = slope + x * bend, bend
        for of_contacts in slopes:
            rise, curve = of_contacts(x)
            first, second = first + sp.total(rise), second + sp.total(curve)
        searching = jnp.where(jnp.abs(first) > _FLAT * steepness, searching, 0.0)
        low, high = jnp.where(first < 0, x, low), jnp.where(first < 0, high, x)
        new = x - first / second
        halved = jnp.where(high < _FAR, 0.5 * (low + high), 2 * x)
        new = jnp.where((new > low) & (new < high), new, halved)
        x = jnp.where(searching > 0, new, x)
        return count + 1, x, low, high, searching, _any(searching)

    unit = jnp.ones_like(slope)
    searching = jnp.where(steepness > 0, unit, 0.0)
    start = (0, unit, 0.0 * unit, _FAR * unit, searching, _any(searching))
    return jax.lax.while_loop(
        lambda carry: (carry[0] < physics.ls_iterations) & carry[5], refine, start
    )[1]
