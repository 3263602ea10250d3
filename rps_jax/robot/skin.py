"""The tactile skin: sensors of the contact between object and base.

Both sensors are purely geometric: they read the object's footprint, placed in the robot frame, and
never the engine's contacts. They sense along the boards of a base's shell. The two extreme
positions of a contact are the first and the last along the shell's strip.

    sensor.init(key) -> state
    sensor.sense(state, footprint, period) -> (state, Reading)

With a `temperature` a capacitive sensor is smooth: its reading has a contact weight from 0 to 1. As
the temperature goes to zero, the reading tends to that without a temperature. The temperature is a
relative change of capacitance [1], for which 0.03 is a good value. It must be well below the
threshold, or the skin senses contact without an object.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors, spec
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import (
    Array,
    Bool,
    Bools,
    Float,
    Floats,
    Ints,
    Pair,
    Parameter,
    Scalar,
)
from rps_jax.geometry.footprint import Footprint
from rps_jax.record.files import Arrays
from rps_jax.record.options import parse_changes
from rps_jax.robot.base import low_pass, normal
from rps_jax.robot.robot import Robot
from rps_jax.robot.shell import HALF_WIDTH, Shell, side_lengths
from rps_jax.spec import Named, Spec

# [1] of an even contact: the least and the greatest local mean over the mean; the least mean. They
# were fitted in worlds of `hostile`.
_EVEN, _PROUD, _PRESSED = 0.6, 1.35, 4.0
_COVERED = 0.35  # [1] signal over that of the neighbour, of a taxel that the object covers
_NEVER = -1e9  # excess of a dead taxel over the threshold, in temperatures

NONE, POINT, LINE = 0, 1, 2  # contact types, Fig. 6c


class Reading(NamedTuple):
    """Contact that a skin measures; that of a smooth skin has a weight from 0 to 1."""

    # NONE also up to a weight of 1/2.
    contact_type: Annotated[Ints, Spec("1", "type of the contact: 0 none, 1 a point, 2 a line")]
    # 0 if NONE, but of a smooth skin at any weight.
    p_robot_contact: Annotated[
        Float[Array, "*B 2"], Spec("m", "location of the contact in the robot frame")
    ]
    in_contact: Annotated[Bools | Floats, Spec("1", "whether there is contact, or the weight")]


class SkinState(NamedTuple):
    """State of a sensor between two readings; empty for the ideal one."""

    key: Annotated[Array, Spec("1", "key of the noise of later readings")]
    signal: Annotated[
        Float[Array, "*B T"], Spec("1", "filtered relative change of capacitance of each taxel")
    ]
    gain: Annotated[Float[Array, "*B T"], Spec("1", "gain of each taxel")]
    # Empty for the ideal sensor.
    alive: Annotated[
        Bool[Array, "*B T"] | Float[Array, "*B 0"], Spec("1", "whether each taxel works")
    ]


class IdealSkin(NamedTuple):
    """Sensor of the exact contact interval, as the paper's Gazebo contact sensor.

    A point of a face is in contact if it lies within `tolerance` of the object. Foam gives a real
    skin a tolerance of several millimetres. Without it the corners of a box alternate, and the law
    chatters.
    """

    tolerance: Annotated[Parameter, Spec("m", "gap that counts as contact", 0, 0.1)] = 0.006
    # One taxel.
    point_length: Annotated[Parameter, Spec("m", "longest POINT contact", 0, 0.1)] = (
        2 * HALF_WIDTH / 12
    )
    shell: Shell = Shell()  # outline and boards; in a trial, the robot's

    def check(self) -> None:
        """Raise InputError for fields that are no lengths."""
        spec.check(self, "skin ")
        self.shell.check()

    def init(self, key: Array) -> SkinState:
        """Return the empty state."""
        return SkinState(key, *(jnp.zeros(0),) * 3)

    def sense(
        self, state: SkinState, footprint: Footprint, period: Scalar
    ) -> tuple[SkinState, Reading]:
        """Return the middle between the two ends of the contact interval; the period is unused."""
        del period
        if self.shell.radius is not None:
            return state, self._nearest(footprint)
        hits, positions = [], []  # of both ends of each row's interval, in strip order
        for row in self.shell.rows():
            start, along = (
                jnp.asarray(x, footprint.vertices.dtype) for x in (row.start, row.along)
            )
            low, high = fp.crossing(footprint, start, along, self.tolerance)
            hit = (low <= high) & (high >= 0) & (low <= row.length)
            for s in (low, high):
                s = jnp.clip(s, 0.0, row.length)
                positions.append(jnp.concatenate([start + s * along, row.offset + s[None]]))
                hits.append(hit)
        positions, hits = jnp.stack(positions), jnp.stack(hits)
        first, last = _extremes(hits, positions)
        kind = jnp.where(last[2] - first[2] > self.point_length, LINE, POINT)
        return state, _reading(jnp.where(jnp.any(hits), kind, NONE), first[:2], last[:2])

    def _nearest(self, footprint: Footprint) -> Reading:
        """Return the contact at the point of a round base's boards that is nearest to the object.

        A circle touches in a point.
        """
        shell, middle = self.shell, jnp.zeros(2, footprint.vertices.dtype)
        away = jax.grad(fp.signed_distance, argnums=1)(footprint, middle)
        nearest = shell.on_arc(planar.direction(-away))
        spans = [(row.offset, row.offset + row.length) for row in shell.rows()]
        at = jnp.stack([jnp.clip(nearest, *span) for span in spans])
        distances = fp.signed_distance(footprint, shell.on_strip(at))
        distance = -planar.greatest(-distances)
        # Within rounding errors, since a compiler may compute a distance twice.
        ends = (shell.on_strip(_extremes(distances <= distance + 1e-6, at)[0]),) * 2
        return _reading(jnp.where(distance <= self.tolerance, POINT, NONE), *ends)


class CapacitiveSkin(NamedTuple):
    """Taxels under foam: compression -> capacitance -> low-pass -> threshold (Sec. II-B).

    The foam is `foam` thick on the rigid base. The capacitance of an electrode is the mean of
    eps / gap over its length, where the gap is the thickness of the compressed foam.
    """

    foam: Annotated[Parameter, Spec("m", "thickness of uncompressed foam", gt=0, le=0.1)] = 0.010
    max_compression: Annotated[
        Parameter, Spec("1", "share of the thickness that can be compressed", gt=0, le=0.99)
    ] = 0.9
    time_constant: Annotated[Parameter, Spec("s", "time constant of the low-pass filter", gt=0)] = (
        0.05
    )
    threshold: Annotated[Parameter, Spec("1", "relative change of capacitance at contact", 0)] = (
        0.25
    )
    noise: Annotated[Parameter, Spec("1", "standard deviation of each raw reading", 0)] = 0.0
    gain_spread: Annotated[
        Parameter, Spec("1", "standard deviation of the taxels' gains about 1", 0)
    ] = 0.0
    dead_share: Annotated[Parameter, Spec("1", "probability that a taxel is dead", 0, 1)] = 0.0
    shell: Shell = Shell()  # outline and boards; in a trial, the robot's
    temperature: Annotated[
        Parameter | None, Spec("1", "width of the smooth threshold", gt=0, le=1)
    ] = None

    SMOOTH = 0.03  # [1] a good temperature

    def check(self) -> None:
        """Raise InputError for foam, filter or imperfections that no skin can have."""
        spec.check(self, "skin ")
        self.shell.check()

    def init(self, key: Array) -> SkinState:
        """Draw the gain of each taxel, and whether it is dead."""
        key, key_gain, key_dead = jax.random.split(key, 3)
        n = self.shell.count
        gain = 1 + self.gain_spread * normal(key_gain, (n,), float)
        alive = jax.random.uniform(key_dead, (n,), jnp.float32) >= self.dead_share
        return SkinState(key, jnp.zeros(n), gain, alive)

    def compression(self, footprint: Footprint) -> list[Float[Array, " T"]]:
        """Return the compression of the foam [m] of all taxels at each of their samples."""
        samples = jnp.asarray(self.shell.taxels(self.shell.samples), footprint.vertices.dtype)
        depths = (self.foam - fp.signed_distance(footprint, x) for x in jnp.swapaxes(samples, 0, 1))
        return [jnp.clip(x, 0.0, self.max_compression * self.foam) for x in depths]

    def _scan(self, state: SkinState, footprint: Footprint) -> tuple[SkinState, Array]:
        """Return the raw signals (T,) [1] of all taxels, with gains and noise."""
        # A loop over samples: reductions of such short axes are slow on every device.
        shares = [self.foam / (self.foam - x) for x in self.compression(footprint)]
        change = sum(shares) / len(shares) - 1.0
        key, key_noise = jax.random.split(state.key)
        noise = self.noise * normal(key_noise, change.shape, change.dtype)
        return state._replace(key=key), state.gain * change + noise

    def _filtered(self, state: SkinState, raw: Array, period: Scalar) -> SkinState:
        signal = low_pass(state.signal, raw, period, self.time_constant)
        return state._replace(signal=signal)

    def read(
        self, state: SkinState, raw: Float[Array, " T"], period: Scalar
    ) -> tuple[SkinState, Reading]:
        """Return the reading of one scan of a real or simulated skin: filtered, with a threshold.

        `raw` [1] is the relative change of capacitance of each taxel, in the order of
        `Shell.taxels`, `period` [s] after the previous scan.
        """
        state = self._filtered(state, raw, period)
        active = (state.signal > self.threshold) & state.alive
        middles = jnp.asarray(self.shell.taxels()[:, 0], raw.dtype)
        first, last = _extremes(active, middles)
        return state, _reading(jnp.minimum(jnp.sum(active), LINE), first, last)

    def ends(self, state: SkinState) -> Ends:
        """Return the ends of the contact on the front after a scan: see `ends_of`."""
        signal = jnp.where(state.alive, state.signal, 0.0)
        return ends_of(signal, jnp.asarray(state.alive, bool), self.shell, self.threshold)

    def sense(
        self, state: SkinState, footprint: Footprint, period: Scalar
    ) -> tuple[SkinState, Reading]:
        """Return the reading of one scan of all taxels."""
        state, raw = self._scan(state, footprint)
        if self.temperature is None:
            return self.read(state, raw, period)
        state = self._filtered(state, raw, period)
        return state, self._smooth_reading(state, self.temperature)

    def _smooth_reading(self, state: SkinState, temperature: Scalar) -> Reading:
        """Return the reading of taxels whose activity is a sigmoid.

        The activity of a taxel is sigmoid((signal - threshold) / temperature). It serves as the
        probability of being active: the two ends of the contact are the expected first and last
        active taxels. As the temperature falls they tend to those of `read`, also if dead taxels
        interrupt a contact.
        """
        excess = jnp.where(state.alive, (state.signal - self.threshold) / temperature, _NEVER)
        middles = jnp.asarray(self.shell.taxels()[:, 0], excess.dtype)
        first, last = _first(excess) @ middles, _first(excess[::-1]) @ middles[::-1]
        # The weight is the greatest activity: 1/2 at the threshold.
        kind = jnp.minimum(jnp.sum(excess > 0), LINE).astype(jnp.int32)
        return Reading(kind, 0.5 * (first + last), jax.nn.sigmoid(planar.greatest(excess)))


Skin = IdealSkin | CapacitiveSkin  # a pytree of parameters with two pure functions


def signals(skin: Skin, state: SkinState, footprint: Footprint) -> Float[Array, " T"]:
    """Return the filtered signals of the taxels of a skin [1]; 0 for a dead one.

    For a skin without taxels, they are the unfiltered signals of perfect taxels on its boards, for
    a footprint placed in the robot frame.
    """
    if state.signal.size:
        return jnp.where(state.alive, state.signal, 0.0)
    perfect = CapacitiveSkin(shell=skin.shell)
    return perfect._scan(perfect.init(state.key), footprint)[1]


class Ends(NamedTuple):
    """Ends of a contact on the front."""

    ends: Float[Array, "2"]  # [m] offsets of the left and the right end; 0 without contact
    seen: Bool[Array, "2"]  # whether the object ends there, not the front or its taxels
    even: Bool[Array, ""]  # whether a face lies flush on the front
    front: Floats  # [m] of the front from the base's middle


def ends_of(
    signal: Float[Array, " T"], alive: Bool[Array, " T"], shell: Shell, threshold: Scalar
) -> Ends:
    """Return the ends of the contact on the front, from the signals [1] of the taxels.

    A contact is even if the inner taxels are pressed, and no mean of three neighbours is much below
    that of all: the gains of single taxels differ. The object covers a share of the outermost
    taxels: their signals over those of their inner neighbours. An end is seen if the contact is
    even, and the next taxel works and feels nothing, or the outermost one is not covered. Offsets
    are those of `Observation.l`. The simulated foam senses an object up to 8 mm ahead, without
    force; a real one needs force, and blurs the ends.
    """
    rows, length = shell.rows(), sum(side_lengths(*shell.sizes).values())
    front = jnp.asarray(shell.half[0], signal.dtype)
    first = sum(x.taxels for x in shell.boards if x.side == "left")
    parts, counts = [], [x.taxels for x in shell.boards if x.side == "front"]
    for boards, row in zip(shell.boards, rows, strict=True):
        if boards.side == "front":
            pitch = jnp.asarray(row.length / boards.taxels, signal.dtype)
            middles = row.offset + pitch * (np.arange(boards.taxels) + 0.5)
            parts.append(jnp.stack([length / 2 - middles, jnp.full(boards.taxels, pitch)], axis=-1))
    count = sum(counts)
    if not count:
        nothing = jnp.zeros(2, signal.dtype), jnp.zeros(2, bool), jnp.zeros((), bool)
        return Ends(*nothing, front)
    signal, alive = signal[first : first + count], alive[first : first + count]
    active = (signal > threshold) & alive
    border, empty = jnp.ones(1, bool), jnp.zeros(1, signal.dtype)
    hidden, next_to = _neighbours(~alive, border), _neighbours(signal, empty)
    columns = [*jnp.concatenate(parts).T, signal, *hidden, *next_to]
    table = jnp.stack([x.astype(signal.dtype) for x in columns], axis=-1)
    left, right = _extremes(active, table)
    inner = active & (table[:, 0] < left[0]) & (table[:, 0] > right[0])
    pressure, weight = jnp.where(inner, signal, 0.0), inner.astype(signal.dtype)
    top = jnp.maximum(jnp.sum(pressure) / jnp.maximum(jnp.sum(weight), 1), threshold)
    sums, weights = (x + sum(_neighbours(x, empty)) for x in (pressure, weight))
    least = jnp.min(jnp.where(inner, sums / jnp.maximum(weights, 1), jnp.inf))
    outer = jnp.maximum(left[2] + left[6], right[2] + right[5]) / 2
    is_even = (least > _EVEN * top) & (outer < _PROUD * top) & (top > _PRESSED)
    is_even &= jnp.any(inner)
    # Over the inner neighbour, so that a slight tilt is no end; this may be dead.
    inside = jnp.stack([left[6], right[5]])
    inside = jnp.where(inside > threshold, jnp.minimum(inside, top), top)
    share = jnp.clip(jnp.stack([left[2], right[2]]) / inside, 0.0, 1.0)
    touches = jnp.any(active)
    half = jnp.stack([left[1], -right[1]]) * (share - 0.5)
    ends = jnp.where(touches, jnp.stack([left[0], right[0]]) + half, 0.0)
    seen = (jnp.stack([left[3], right[4]]) < 0.5) | (share < _COVERED)
    return Ends(ends, seen & is_even, is_even, front)


def _neighbours(values: Array, border: Array) -> Pair:
    """Return the values (n,) of the previous and of the next taxel, with that beyond the border."""
    return jnp.concatenate([border, values[:-1]]), jnp.concatenate([values[1:], border])


def check_taxels(signal: np.ndarray, shell: Shell, source: str) -> None:
    """Raise InputError unless recorded signals (N, T) are of as many taxels as the shell's."""
    if signal.shape[1] != shell.count:
        raise errors.InputError(
            f"{source} has {signal.shape[1]} taxels, and the robot {shell.count}: name the log's "
            "robot by --robot."
        )


def with_contacts(steps: Arrays, shell: Shell, source: str) -> Arrays:
    """Return the steps of a bag with contacts, computed from its taxels if it has none.

    The default skin on this shell filters one scan for each command, as the exported skin does,
    and compares it with its threshold.

    Raises:
      InputError: the taxels of the source are not those of this shell.
    """
    if "contact_type" in steps:
        return steps
    check_taxels(steps["signal"], shell, source)
    skin = CapacitiveSkin(shell=shell)

    def scan(state: SkinState, row: Pair) -> tuple[SkinState, tuple[Array, ...]]:
        state, reading = skin.read(state, *row)
        return state, (state.signal, reading.contact_type, reading.p_robot_contact)

    rows = jnp.asarray(steps["signal"]), jnp.asarray(steps["period"])
    columns = jax.lax.scan(scan, skin.init(jax.random.PRNGKey(0)), rows)[1]
    names = "signal", "contact_type", "p_robot_contact"
    return steps | dict(zip(names, map(np.asarray, columns), strict=True))


# "thin" chatters between the corners of a box, as a rigid contact sensor.
SKINS: dict[str, Skin] = {
    "ideal": IdealSkin(),
    "thin": IdealSkin(tolerance=0.001),
    "capacitive": CapacitiveSkin(),
    "hardware": CapacitiveSkin(noise=0.05, gain_spread=0.1),  # noise a fifth of the threshold
}


SkinLike = Annotated[str | Skin, Named(lambda: SKINS)]  # a sensor, or its text: see `parse_skin`


def parse_skin(skin: SkinLike) -> Any:
    """Return a skin from a name with changes, as `capacitive,foam=0.01`; or raise InputError."""
    if not isinstance(skin, str):
        if not isinstance(skin, Skin):
            rule = f"choose from {', '.join(SKINS)}, or give a skin"
            raise errors.not_allowed("skin", repr(skin), rule)
        skin.check()
        return skin
    name, changes = parse_changes("skin", skin)
    preset: Any = SKINS[errors.check_name("skin", name, SKINS)]
    known = [field for field in preset._fields if field not in ("shell", "temperature")]
    for field, value in changes.items():
        errors.check_name(f"number of the skin {name}", field, known)
        errors.check_number(f"skin {field}", value)
    changed = preset._replace(**changes)
    changed.check()
    return changed


def mounted(skin: SkinLike, robot: Robot) -> Skin:
    """Return a skin on the boards of a robot, whose time constant replaces that of the skin."""
    sensor = parse_skin(skin)._replace(shell=robot.shell)
    known = robot.time_constant is not None and isinstance(sensor, CapacitiveSkin)
    return sensor._replace(time_constant=robot.time_constant) if known else sensor


def _first(excess: Array) -> Array:
    """Return the probability (n,) of each entry to be the first active one, if any is active.

    Each is active with the probability sigmoid(excess), independently of the others.
    """
    none_before = -jnp.cumsum(jax.nn.softplus(excess))[:-1]
    log_active = jax.nn.log_sigmoid(excess)
    return jax.nn.softmax(log_active + jnp.concatenate([jnp.zeros_like(excess[:1]), none_before]))


def _extremes(active: Array, values: Array) -> Pair:
    """Return the rows of `values` (n, m) at the first and the last True of `active` (n,)."""
    count = active.shape[0]
    # Minimum and maximum of indices: on a processor `argmax` is twenty times slower.
    index = jnp.arange(count)
    first = jnp.min(jnp.where(active, index, count - 1))
    last = jnp.max(jnp.where(active, index, 0))
    return values[first], values[last]


def _reading(kind: Array, first: Array, last: Array) -> Reading:
    """Return the reading of Sec. II-B: the location is the mean of the extreme positions."""
    location = jnp.where(kind == NONE, 0.0, 0.5 * (first + last))
    return Reading(kind.astype(jnp.int32), location, kind != NONE)
