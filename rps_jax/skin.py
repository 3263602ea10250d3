"""The tactile skin: where does the object touch the base?

Two sensors behind one interface, both purely geometric: they read the object's footprint, placed
in the robot frame, and never the engine's contacts. The skin covers the front, left and right
faces. Positions along it form one strip that starts at the rear of the left face, runs forward,
across the front from left to right, and back along the right face; the two extreme positions of a
contact are its first and last along this strip.

    sensor.init(key) -> state
    sensor.sense(state, footprint, period) -> (state, Reading)
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax import footprint as fp
from rps_jax.footprint import Footprint

HALF_LENGTH = 0.3625  # [m] of the base: 15 taxels of 48.3 mm make 0.725 m
HALF_WIDTH = 0.29  # [m] of the base: l_cr + 5 cm, Sec. III-A
BOARDS = {"left": 5, "front": 4, "right": 5}  # 14 boards, Sec. II-B
ELECTRODES = 3  # on each board
_SAMPLES = 5  # of each taxel, about 1 cm apart: a corner pressed home is felt

NONE, POINT, LINE = 0, 1, 2  # contact types, Fig. 6c


class Face(NamedTuple):
    """One side of the base, in strip order."""

    start: jax.Array  # (2,) [m] in the robot frame
    along: np.ndarray  # (2,) unit vector
    length: Any  # () [m]


def faces(half_length: Any = HALF_LENGTH) -> dict[str, Face]:
    """The covered sides of a base of length 2 half_length [m], in strip order."""
    x, y = half_length, HALF_WIDTH
    return {
        "left": Face(jnp.stack([-x, y]), np.array([1.0, 0.0]), 2 * x),
        "front": Face(jnp.stack([x, y]), np.array([0.0, -1.0]), 2 * y),
        "right": Face(jnp.stack([x, -y]), np.array([-1.0, 0.0]), 2 * x),
    }


class Reading(NamedTuple):
    """What the skin tells the law."""

    contact_type: jax.Array  # () int32: NONE, POINT or LINE
    p_robot_contact: jax.Array  # (2,) [m] contact location in the robot frame; 0 if NONE

    @property
    def in_contact(self) -> jax.Array:
        """() bool."""
        return self.contact_type != NONE


class Skin(Protocol):
    """A tactile sensor: a pytree of parameters with two pure functions."""

    @property
    def half_length(self) -> float | jax.Array:
        """Of the base that it covers [m]."""
        ...

    def check(self) -> None:
        """Raises InputError for scalar parameters that mean nothing."""
        ...

    def init(self, key: jax.Array) -> SkinState:
        """The sensor before it has felt anything; `key` draws its imperfections."""
        ...

    def sense(
        self, state: SkinState, footprint: Footprint, period: float
    ) -> tuple[SkinState, Reading]:
        """One reading of a footprint placed in the robot frame, `period` [s] after the last."""
        ...


class SkinState(NamedTuple):
    """What a sensor carries from one reading to the next (empty for the ideal one)."""

    key: jax.Array  # noise of the readings to come
    signal: jax.Array  # (T,) [1] filtered relative change of capacitance
    gain: jax.Array  # (T,) [1] of each taxel
    alive: jax.Array  # (T,) bool


class IdealSkin(NamedTuple):
    """The exact contact interval, as the position of the paper's Gazebo contact sensor.

    A point of a face is in contact if it lies within `tolerance` of the object: foam gives a real
    skin several millimetres of it, and without any, the corners of a box alternate and the law
    chatters.
    """

    tolerance: float | jax.Array = 0.006  # [m]
    point_length: float | jax.Array = 2 * HALF_WIDTH / 12  # [m] up to one taxel long: a point
    half_length: float | jax.Array = HALF_LENGTH  # [m] of the base

    def check(self) -> None:
        """Raises InputError unless all are lengths."""
        for name in ("tolerance", "point_length"):
            errors.check_finite(
                f"skin {name}", getattr(self, name), at_least=0, at_most=0.1, unit="m"
            )
        _check_half_length(self.half_length)

    def init(self, key: jax.Array) -> SkinState:
        """No memory, no imperfections."""
        return SkinState(key, *(jnp.zeros(0),) * 3)

    def sense(
        self, state: SkinState, footprint: Footprint, period: float
    ) -> tuple[SkinState, Reading]:
        """The middle between the two ends of the contact interval; the period is unused."""
        del period
        dtype = footprint.vertices.dtype
        strip_start = 0.0
        hits, ends = [], []  # of both ends of each face's interval, in strip order
        for face in faces(self.half_length).values():
            start, along = jnp.asarray(face.start, dtype), jnp.asarray(face.along, dtype)
            low, high = fp.crossing(footprint, start, along, self.tolerance)
            hit = (low <= high) & (high >= 0) & (low <= face.length)
            for s in (low, high):
                s = jnp.clip(s, 0.0, face.length)
                ends.append(jnp.concatenate([start + s * along, strip_start + s[None]]))
                hits.append(hit)
            strip_start += face.length
        ends, hits = jnp.stack(ends), jnp.stack(hits)
        first, last = _extremes(hits, ends)
        kind = jnp.where(last[2] - first[2] > self.point_length, LINE, POINT)
        return state, _reading(jnp.where(jnp.any(hits), kind, NONE), first[:2], last[:2])


class CapacitiveSkin(NamedTuple):
    """42 taxels under foam: compression -> capacitance -> low-pass -> threshold (Sec. II-B).

    The foam stands proud of the rigid base by `foam`. An electrode's capacitance is the mean of
    eps / gap over its length, the gap being what the object leaves of the foam.
    """

    foam: float | jax.Array = 0.010  # [m] thickness, uncompressed
    max_compression: float | jax.Array = 0.9  # [1] share of the thickness that can give way
    time_constant: float | jax.Array = 0.05  # [s] of the low-pass filter
    threshold: float | jax.Array = 0.25  # [1] relative change of capacitance that counts as touch
    noise: float | jax.Array = 0.0  # [1] standard deviation of each raw reading
    gain_spread: float | jax.Array = 0.0  # [1] standard deviation of the taxels' gains about 1
    dead_share: float | jax.Array = 0.0  # [1] probability that a taxel never answers
    half_length: float | jax.Array = HALF_LENGTH  # [m] of the base

    def check(self) -> None:
        """Raises InputError for foam, filter or imperfections that no skin can have."""
        errors.check_finite("skin foam", self.foam, above=0, at_most=0.1, unit="m")
        errors.check_finite("skin max_compression", self.max_compression, above=0, at_most=0.99)
        errors.check_finite("skin time_constant", self.time_constant, above=0, unit="s")
        for name in ("threshold", "noise", "gain_spread"):
            errors.check_finite(f"skin {name}", getattr(self, name), at_least=0)
        errors.check_finite("skin dead_share", self.dead_share, at_least=0, at_most=1)
        _check_half_length(self.half_length)

    def init(self, key: jax.Array) -> SkinState:
        """Draws each taxel's gain and whether it is dead."""
        key, key_gain, key_dead = jax.random.split(key, 3)
        n = sum(BOARDS.values()) * ELECTRODES
        gain = 1 + self.gain_spread * jax.random.normal(key_gain, (n,))
        alive = jax.random.uniform(key_dead, (n,)) >= self.dead_share
        return SkinState(key, jnp.zeros(n), gain, alive)

    def compression(self, footprint: Footprint) -> jax.Array:
        """How far the object presses into the foam (T, S) [m] at each sample of each taxel."""
        samples = jnp.asarray(taxels(_SAMPLES, self.half_length), footprint.vertices.dtype)
        depth = self.foam - fp.signed_distance(footprint, samples)
        return jnp.clip(depth, 0.0, self.max_compression * self.foam)

    def sense(
        self, state: SkinState, footprint: Footprint, period: float
    ) -> tuple[SkinState, Reading]:
        """One scan of all taxels as the foam, its gains and its noise would have it, read."""
        gap = self.foam - self.compression(footprint)
        change = jnp.mean(self.foam / gap, axis=-1) - 1.0
        key, key_noise = jax.random.split(state.key)
        noise = self.noise * jax.random.normal(key_noise, change.shape, change.dtype)
        return self.read(state._replace(key=key), state.gain * change + noise, period)

    def read(self, state: SkinState, raw: jax.Array, period: float) -> tuple[SkinState, Reading]:
        """One scan of a real skin, or of a simulated one, filtered and compared to the threshold.

        `raw` (42,) [1] is each taxel's relative change of capacitance, in strip order (that of
        `taxels`), `period` [s] after the last scan.
        """
        signal = state.signal + (1 - jnp.exp(-period / self.time_constant)) * (raw - state.signal)
        active = (signal > self.threshold) & state.alive
        middles = jnp.asarray(taxels(1, self.half_length)[:, 0], raw.dtype)
        first, last = _extremes(active, middles)
        kind = jnp.minimum(jnp.sum(active), LINE)
        return state._replace(signal=signal), _reading(kind, first, last)


# "thin" chatters between the corners of a box, as a rigid contact sensor does.
SKINS = {
    "ideal": IdealSkin(),
    "thin": IdealSkin(tolerance=0.001),
    "capacitive": CapacitiveSkin(),
    "hardware": CapacitiveSkin(noise=0.05, gain_spread=0.1),  # noise a fifth of the threshold
}


def _check_half_length(value: Any) -> None:
    errors.check_finite("skin half_length", value, at_least=0.1, at_most=2, unit="m")


def taxels(samples: int = 1, half_length: Any = HALF_LENGTH) -> jax.Array:
    """Sample points (42, samples, 2) [m] of the taxels, in strip order, in the robot frame."""
    rows = []
    for name, face in faces(half_length).items():
        count = BOARDS[name] * ELECTRODES * samples
        s = (np.arange(count) + 0.5) / count * face.length
        rows.append((face.start + s[:, None] * face.along).reshape(-1, samples, 2))
    return jnp.concatenate(rows)


def _extremes(active: jax.Array, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rows of `values` (n, m) at the first and the last True of `active` (n,)."""
    first = jnp.argmax(active)
    last = active.shape[0] - 1 - jnp.argmax(active[::-1])
    return values[first], values[last]


def _reading(kind: jax.Array, first: jax.Array, last: jax.Array) -> Reading:
    """Sec. II-B: one position is the location itself, several give the mean of the extremes."""
    location = jnp.where(kind == NONE, 0.0, 0.5 * (first + last))
    return Reading(kind.astype(jnp.int32), location)
