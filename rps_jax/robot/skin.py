"""The tactile skin: where does the object touch the base?

Two sensors behind one interface, both purely geometric: they read the object's footprint, placed
in the robot frame, and never the engine's contacts. They feel where the boards of a base's shell
are; the two extreme positions of a contact are its first and last along the shell's strip.

    sensor.init(key) -> state
    sensor.sense(state, footprint, period) -> (state, Reading)

`SmoothSkin` makes either sensor smooth: a reading tells how much contact there is, from 0 to 1.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.geometry import footprint as fp
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array, Bool, Float, Int, Scalar
from rps_jax.geometry.footprint import Footprint
from rps_jax.record.options import parse_changes
from rps_jax.robot.shell import HALF_WIDTH, Shell

_NODES = 16  # points on each row of boards of the smooth ideal sensor
_REACH = 8.0  # [1] temperatures beyond its tolerance at which they end, with 3e-4 of the weight
_NEVER = -1e9  # of a dead taxel: its excess over the threshold, in temperatures

NONE, POINT, LINE = 0, 1, 2  # contact types, Fig. 6c


class Reading(NamedTuple):
    """What the skin tells the law."""

    contact_type: Int[Array, "*B"]  # NONE, POINT or LINE
    p_robot_contact: Float[Array, "*B 2"]  # [m] contact location in the robot frame; 0 if NONE

    @property
    def in_contact(self) -> Bool[Array, "*B"]:
        """Whether there is contact."""
        return self.contact_type != NONE


class SmoothReading(NamedTuple):
    """What a smooth skin tells: a `Reading` whose contact is a weight."""

    contact_type: Int[Array, "*B"]  # NONE up to a weight of 1/2, beyond it POINT or LINE
    p_robot_contact: Float[Array, "*B 2"]  # [m] contact location in the robot frame, at any weight
    in_contact: Float[Array, "*B"]  # [1] weight of the contact, from 0 to 1


class SkinState(NamedTuple):
    """What a sensor carries from one reading to the next (empty for the ideal one)."""

    key: jax.Array  # noise of the readings to come
    signal: Float[Array, "*B T"]  # [1] filtered relative change of capacitance
    gain: Float[Array, "*B T"]  # [1] of each taxel
    alive: Bool[Array, "*B T"] | Float[Array, "*B 0"]  # of the ideal sensor empty


class IdealSkin(NamedTuple):
    """The exact contact interval, as the position of the paper's Gazebo contact sensor.

    A point of a face is in contact if it lies within `tolerance` of the object: foam gives a real
    skin several millimetres of it, and without any, the corners of a box alternate and the law
    chatters.
    """

    tolerance: float | jax.Array = 0.006  # [m]
    point_length: float | jax.Array = 2 * HALF_WIDTH / 12  # [m] up to one taxel long: a point
    shell: Shell = Shell()  # what it covers; in a trial, that of the robot

    def check(self) -> None:
        """Raises InputError unless all are lengths."""
        for name in ("tolerance", "point_length"):
            errors.check_finite(
                f"skin {name}", getattr(self, name), at_least=0, at_most=0.1, unit="m"
            )
        self.shell.check()

    def on(self, shell: Shell) -> IdealSkin:
        """Return this sensor on another shell."""
        return self._replace(shell=shell)

    def init(self, key: Array) -> SkinState:
        """No memory, no imperfections."""
        return SkinState(key, *(jnp.zeros(0),) * 3)

    def sense(
        self, state: SkinState, footprint: Footprint, period: Scalar
    ) -> tuple[SkinState, Reading]:
        """The middle between the two ends of the contact interval; the period is unused."""
        del period
        dtype = footprint.vertices.dtype
        hits, ends = [], []  # of both ends of each row's interval, in strip order
        for row in self.shell.rows():
            start, along = jnp.asarray(row.start, dtype), jnp.asarray(row.along, dtype)
            low, high = fp.crossing(footprint, start, along, self.tolerance)
            hit = (low <= high) & (high >= 0) & (low <= row.length)
            for s in (low, high):
                s = jnp.clip(s, 0.0, row.length)
                ends.append(jnp.concatenate([start + s * along, row.begins + s[None]]))
                hits.append(hit)
        ends, hits = jnp.stack(ends), jnp.stack(hits)
        first, last = _extremes(hits, ends)
        kind = jnp.where(last[2] - first[2] > self.point_length, LINE, POINT)
        return state, _reading(jnp.where(jnp.any(hits), kind, NONE), first[:2], last[:2])

    def sense_smoothly(
        self, state: SkinState, footprint: Footprint, period: Scalar, temperature: Any
    ) -> tuple[SkinState, SmoothReading]:
        """The reading if a point at signed distance x is active by its excess, tolerance - x.

        Active is sigmoid(excess / temperature [m]). The contact is one run along the strip, so
        its mean is the middle of its two ends and its total activity their distance, also around
        a corner. The points lie where `footprint.crossing` finds a face near enough, and so move
        with the object: a few suffice, and as the temperature falls their reading tends to that
        of `sense`.
        """
        del period
        s, share = self._nodes(footprint, self.tolerance + _REACH * temperature)
        distance = fp.signed_distance(footprint, self.shell.on_strip(s))
        excess = (self.tolerance - distance) / temperature
        # A softmax: defined where nothing is near too, by whatever is nearest.
        middle = jnp.sum(s * jax.nn.softmax(jax.nn.log_sigmoid(excess) + jnp.log(share)))
        length = jnp.sum(share * jax.nn.sigmoid(excess))
        first, last = self.shell.on_strip(middle + length * jnp.array([-0.5, 0.5], s.dtype))
        kind = jnp.where(length > self.point_length, LINE, POINT)
        return state, _smooth_reading(planar.greatest(excess), kind, first, last)

    def _nodes(self, footprint: Footprint, tolerance: Any) -> tuple[jax.Array, jax.Array]:
        """Points (N,) [m] of the strip within `tolerance` of a footprint, the length of each.

        Of a row of boards that lies beyond it, points all along.
        """
        middles = (np.arange(_NODES) + 0.5) / _NODES
        nodes, shares = [], []
        for row in self.shell.rows():
            dtype = footprint.vertices.dtype
            start, along = jnp.asarray(row.start, dtype), jnp.asarray(row.along, dtype)
            low, high = fp.crossing(footprint, start, along, tolerance)
            near = (low <= high) & (high >= 0) & (low <= row.length)
            low = jnp.where(near, jnp.clip(low, 0.0, row.length), 0.0)
            high = jnp.where(near, jnp.clip(high, 0.0, row.length), row.length)
            nodes.append(row.begins + low + (high - low) * middles)
            share = jnp.maximum(high - low, 1e-6) / _NODES  # not zero: its logarithm is taken
            shares.append(jnp.broadcast_to(share, _NODES))
        return jnp.concatenate(nodes), jnp.concatenate(shares)


class CapacitiveSkin(NamedTuple):
    """Taxels under foam: compression -> capacitance -> low-pass -> threshold (Sec. II-B).

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
    shell: Shell = Shell()  # what it covers; in a trial, that of the robot

    def check(self) -> None:
        """Raises InputError for foam, filter or imperfections that no skin can have."""
        errors.check_finite("skin foam", self.foam, above=0, at_most=0.1, unit="m")
        errors.check_finite("skin max_compression", self.max_compression, above=0, at_most=0.99)
        errors.check_finite("skin time_constant", self.time_constant, above=0, unit="s")
        for name in ("threshold", "noise", "gain_spread"):
            errors.check_finite(f"skin {name}", getattr(self, name), at_least=0)
        errors.check_finite("skin dead_share", self.dead_share, at_least=0, at_most=1)
        self.shell.check()

    def on(self, shell: Shell) -> CapacitiveSkin:
        """Return this sensor on another shell."""
        return self._replace(shell=shell)

    def init(self, key: Array) -> SkinState:
        """Draws each taxel's gain and whether it is dead."""
        key, key_gain, key_dead = jax.random.split(key, 3)
        n = self.shell.count
        gain = 1 + self.gain_spread * jax.random.normal(key_gain, (n,))
        alive = jax.random.uniform(key_dead, (n,)) >= self.dead_share
        return SkinState(key, jnp.zeros(n), gain, alive)

    def compression(self, footprint: Footprint) -> Float[Array, "T S"]:
        """How far the object presses into the foam [m] at each sample of each taxel."""
        samples = jnp.asarray(self.shell.taxels(self.shell.samples), footprint.vertices.dtype)
        # One long axis: a processor's vectors are filled along the last.
        line = jnp.swapaxes(samples, 0, 1).reshape(-1, 2)
        depth = (self.foam - fp.signed_distance(footprint, line)).reshape(samples.shape[1::-1]).T
        return jnp.clip(depth, 0.0, self.max_compression * self.foam)

    def _scan(self, state: SkinState, footprint: Footprint) -> tuple[SkinState, jax.Array]:
        """What all taxels answer (T,) [1], as foam, gains and noise have it."""
        share = self.foam / (self.foam - self.compression(footprint))
        # Sample by sample: a reduction of so short an axis is slow on every device.
        change = sum(share[:, i] for i in range(self.shell.samples)) / self.shell.samples - 1.0
        key, key_noise = jax.random.split(state.key)
        noise = self.noise * jax.random.normal(key_noise, change.shape, change.dtype)
        return state._replace(key=key), state.gain * change + noise

    def _filtered(self, state: SkinState, raw: jax.Array, period: Scalar) -> SkinState:
        signal = state.signal + (1 - jnp.exp(-period / self.time_constant)) * (raw - state.signal)
        return state._replace(signal=signal)

    def read(
        self, state: SkinState, raw: Float[Array, " T"], period: Scalar
    ) -> tuple[SkinState, Reading]:
        """One scan of a real skin, or of a simulated one, filtered and compared to the threshold.

        `raw` [1] is each taxel's relative change of capacitance, in the order of
        `Shell.taxels`, `period` [s] after the last scan.
        """
        state = self._filtered(state, raw, period)
        active = (state.signal > self.threshold) & state.alive
        middles = jnp.asarray(self.shell.taxels()[:, 0], raw.dtype)
        first, last = _extremes(active, middles)
        kind = jnp.minimum(jnp.sum(active), LINE)
        return state, _reading(kind, first, last)

    def sense(
        self, state: SkinState, footprint: Footprint, period: Scalar
    ) -> tuple[SkinState, Reading]:
        """One scan of all taxels, read."""
        return self.read(*self._scan(state, footprint), period)

    def sense_smoothly(
        self, state: SkinState, footprint: Footprint, period: Scalar, temperature: Any
    ) -> tuple[SkinState, SmoothReading]:
        """The reading if a taxel is active by its excess, signal - threshold.

        Active is sigmoid(excess / temperature [1]). As if each were so with that probability, the
        two ends are the means of the first and of the last active taxel. As the temperature falls
        they tend to those of `sense`, also where dead taxels interrupt a contact.
        """
        state = self._filtered(*self._scan(state, footprint), period)
        excess = jnp.where(state.alive, (state.signal - self.threshold) / temperature, _NEVER)
        middles = jnp.asarray(self.shell.taxels()[:, 0], excess.dtype)
        first, last = _first(excess) @ middles, _first(excess[::-1]) @ middles[::-1]
        kind = jnp.clip(jnp.sum(excess > 0), POINT, LINE)
        return state, _smooth_reading(planar.greatest(excess), kind, first, last)


class SmoothSkin(NamedTuple):
    """A sensor whose threshold is soft. As the temperature goes to zero it tends to the sensor.

    The temperature is of the threshold's unit: [m] of an ideal sensor; [1], a relative change of
    capacitance, of a capacitive one, where 0.03 is a good value. It must be well below the
    threshold itself, or the skin feels what is not there.
    """

    sensor: IdealSkin | CapacitiveSkin = IdealSkin()
    temperature: float | jax.Array = 0.001

    @property
    def shell(self) -> Shell:
        """What it covers."""
        return self.sensor.shell

    def on(self, shell: Shell) -> SmoothSkin:
        """Return this sensor on another shell."""
        return self._replace(sensor=self.sensor.on(shell))

    def check(self) -> None:
        """Raises InputError for a sensor or a temperature that means nothing."""
        self.sensor.check()
        errors.check_finite("skin temperature", self.temperature, above=0, at_most=1)

    def init(self, key: Array) -> SkinState:
        """As of the sensor."""
        return self.sensor.init(key)

    def sense(
        self, state: SkinState, footprint: Footprint, period: Scalar
    ) -> tuple[SkinState, SmoothReading]:
        """A smooth reading, by the rule of the sensor."""
        return self.sensor.sense_smoothly(state, footprint, period, self.temperature)


Skin = IdealSkin | CapacitiveSkin | SmoothSkin  # a pytree of parameters with two pure functions


def signals(skin: Skin, state: SkinState, footprint: Footprint) -> Float[Array, " T"]:
    """What the taxels of a skin tell [1], filtered; 0 of one that is dead.

    For a skin without taxels: what perfect ones on its boards would answer at once to a footprint
    placed in the robot frame.
    """
    if state.signal.size:
        return jnp.where(state.alive, state.signal, 0.0)
    perfect = CapacitiveSkin(shell=skin.shell)
    return perfect._scan(perfect.init(state.key), footprint)[1]


def check_taxels(signal: np.ndarray, shell: Shell, source: str) -> None:
    """Raise InputError unless recorded signals (N, T) are of as many taxels as the shell's."""
    if signal.shape[1] != shell.count:
        raise errors.InputError(
            f"{source} has {signal.shape[1]} taxels, and the robot {shell.count}: name the log's "
            "robot by --robot."
        )


def with_contacts(steps: dict[str, np.ndarray], shell: Shell, source: str) -> dict[str, np.ndarray]:
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

    def scan(
        state: SkinState, row: tuple[jax.Array, jax.Array]
    ) -> tuple[SkinState, tuple[jax.Array, ...]]:
        state, reading = skin.read(state, *row)
        return state, (state.signal, reading.contact_type, reading.p_robot_contact)

    rows = jnp.asarray(steps["signal"]), jnp.asarray(steps["period"])
    columns = jax.lax.scan(scan, skin.init(jax.random.PRNGKey(0)), rows)[1]
    names = "signal", "contact_type", "p_robot_contact"
    return steps | dict(zip(names, map(np.asarray, columns), strict=True))


SkinName = Literal["ideal", "thin", "capacitive", "hardware"]
# "thin" chatters between the corners of a box, as a rigid contact sensor does.
SKINS: dict[SkinName, Skin] = {
    "ideal": IdealSkin(),
    "thin": IdealSkin(tolerance=0.001),
    "capacitive": CapacitiveSkin(),
    "hardware": CapacitiveSkin(noise=0.05, gain_spread=0.1),  # noise a fifth of the threshold
}


SkinLike = str | Skin  # a sensor, or its text, see `named`


def named(skin: SkinLike) -> Any:
    """Read a skin: itself, or a name with changes, as `capacitive,foam=0.01`; or InputError."""
    if not isinstance(skin, str):
        skin.check()
        return skin
    name, changes = parse_changes("skin", skin)
    usual: Any = SKINS[errors.check_name("skin", name, SKINS)]  # pyright: ignore
    own = [field for field in usual._fields if field != "shell"]  # which is the robot's
    for field, value in changes.items():
        errors.check_name(f"number of the skin {name}", field, own)
        errors.check_number(f"skin {field}", value)
    found = usual._replace(**changes)
    found.check()
    return found


def _first(excess: jax.Array) -> jax.Array:
    """Probability (n,) of each to be the first active one, given that there is one.

    Each is active with the probability sigmoid(excess), independently.
    """
    none_before = -jnp.cumsum(jax.nn.softplus(excess))[:-1]
    return jax.nn.softmax(
        jax.nn.log_sigmoid(excess) + jnp.concatenate([jnp.zeros_like(excess[:1]), none_before])
    )


def _extremes(active: jax.Array, values: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rows of `values` (n, m) at the first and the last True of `active` (n,)."""
    count = active.shape[0]
    # Least and greatest numbers: a processor is slow at `argmax`, twenty times.
    number = jnp.arange(count)
    first = jnp.min(jnp.where(active, number, count - 1))
    last = jnp.max(jnp.where(active, number, 0))
    return values[first], values[last]


def _reading(kind: jax.Array, first: jax.Array, last: jax.Array) -> Reading:
    """Sec. II-B: one position is the location itself, several give the mean of the extremes."""
    location = jnp.where(kind == NONE, 0.0, 0.5 * (first + last))
    return Reading(kind.astype(jnp.int32), location)


def _smooth_reading(
    excess: jax.Array, kind: jax.Array, first: jax.Array, last: jax.Array
) -> SmoothReading:
    """As much contact as where there is most: so it is 1/2 at the threshold at any temperature."""
    in_contact = jax.nn.sigmoid(excess)
    kind = jnp.where(excess > 0, kind, NONE)
    return SmoothReading(kind.astype(jnp.int32), 0.5 * (first + last), in_contact)
