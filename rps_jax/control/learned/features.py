"""What a learned law observes, what it keeps of it, and the numbers that its network sees.

A law that senses `taxels` observes the signal of every taxel beside what RPS observes. Between two
control steps it remembers where it last felt the object, by odometry.

The numbers of a network are of order 1: lengths are on logarithmic or tanh scales, directions are
unit vectors. A world that is mirrored at the robot's axis, y to -y, gives the mirrored numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.observation import Observation, TaxelObservation, Twist, displacement
from rps_jax.geometry import planar
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot import skin as skins
from rps_jax.robot.skin import LINE, NONE, Reading, Skin, SkinState, SmoothReading

_BASE = 0.36  # [m] scale of places on the base
_NEAR, _FAR = 0.05, 3.0  # [m] distances that are 0 and 1 on the logarithmic scale
_CLOSE = 0.3  # [m] of the tanh scale of distances
_WHILE = 5.0  # [s] of the tanh scale of the time since contact
_DRIFT = 0.01  # [m] of the tanh scale of a contact's way on the base between two decisions


def taxel_observation(
    touch: Observation,
    reading: Reading | SmoothReading,
    skin: Skin,
    state: SkinState,
    placed: Footprint,
) -> TaxelObservation:
    """What a law observes that senses taxels, of an object's outline `placed` in the robot frame.

    A skin without taxels answers as perfect ones on the same boards would.
    """
    return TaxelObservation(
        touch._replace(in_contact=reading.contact_type != NONE),
        skins.signals(skin, state, placed),
        reading.contact_type == LINE,
    )


class TouchState(NamedTuple):
    """What is remembered of touch, with odometry."""

    p_world_contact: jax.Array  # (2,) [m] where the object was last touched
    touched: jax.Array  # () bool: it was at least once
    time_since_contact: jax.Array  # () [s] since then
    in_contact: jax.Array  # () bool: it is touched now
    p_robot_decision: jax.Array  # (2,) [m] the contact at the last decision
    has_decided: jax.Array  # () bool: there was one

    @classmethod
    def initial(cls, dtype: jax.typing.DTypeLike = float) -> TouchState:
        """Return the state before the first contact."""
        zero, no = jnp.zeros((), dtype), jnp.zeros((), bool)
        return cls(jnp.zeros(2, dtype), no, zero, no, jnp.zeros(2, dtype), no)

    def update(self, obs: TaxelObservation) -> TouchState:
        """The memory after one more control step."""
        touch = obs.touch
        there = touch.p_world_robot + planar.rotate(touch.yaw, touch.p_robot_contact)
        return self._replace(
            p_world_contact=jnp.where(touch.in_contact, there, self.p_world_contact),
            touched=self.touched | touch.in_contact,
            time_since_contact=jnp.where(
                touch.in_contact, 0.0, self.time_since_contact + obs.touch.period
            ),
            in_contact=touch.in_contact,
        )

    def mark_decision(self, obs: TaxelObservation) -> TouchState:
        """The memory after a decision."""
        return self._replace(
            p_robot_decision=self.p_robot_contact(obs), has_decided=self.in_contact
        )

    def p_robot_contact(self, obs: TaxelObservation) -> jax.Array:
        """The last contact (2,) [m], in the robot frame as it is now; 0 before any."""
        away = self.p_world_contact - obs.touch.p_world_robot
        there = jnp.where(
            obs.touch.in_contact, obs.touch.p_robot_contact, planar.rotate(-obs.touch.yaw, away)
        )
        return jnp.where(self.touched, there, 0.0)


def _way(p_robot: jax.Array) -> list[jax.Array]:
    """A way (2,) [m] as a direction, and its length on two scales."""
    length = planar.norm(p_robot)
    direction = p_robot / jnp.maximum(length, 1e-6)
    scaled = jnp.log(jnp.maximum(length, _NEAR / 2) / _NEAR) / np.log(_FAR / _NEAR)
    return [direction, scaled[None], jnp.tanh(length / _CLOSE)[None]]


# Signs under the mirror of all that `compute_features` gives after the taxels.
_SIGNS = np.array(
    [1, 1, 1, 1]  # contact, line, touched, since
    + [1, -1]  # place of the contact
    + [1, -1, 1, 1] * 2  # ways from the contact and from the base to the target
    + [1, -1]  # drift
    + [1, -1, -1],  # action
    np.float32,
)


def feature_count(taxels: int) -> int:
    """How many numbers `compute_features` gives for a skin of so many taxels."""
    return taxels + _SIGNS.size


def compute_features(
    touch_state: TouchState, action: jax.Array, obs: TaxelObservation
) -> jax.Array:
    """The numbers (F,) that a network sees at a decision, after the last `action` (3,) [1].

    What is remembered, `touch_state`, has followed `obs`.
    """
    touch = obs.touch
    contact = touch_state.p_robot_contact(obs)
    d = displacement(touch._replace(p_robot_contact=contact))
    base = displacement(touch._replace(p_robot_contact=jnp.zeros_like(contact)))
    drift = jnp.tanh((contact - touch_state.p_robot_decision) / _DRIFT)
    kept = touch.in_contact & touch_state.has_decided
    flags = jnp.stack([touch.in_contact, obs.line & touch.in_contact, touch_state.touched])
    return jnp.concatenate(
        [
            jnp.arcsinh(obs.signal),
            flags.astype(contact.dtype),
            jnp.tanh(touch_state.time_since_contact / _WHILE)[None],
            jnp.clip(contact / _BASE, -3.0, 3.0),
            *_way(planar.rotate(-touch.yaw, d)),
            *_way(planar.rotate(-touch.yaw, base)),
            jnp.where(kept, drift, 0.0),
            action,
        ]
    )


def mirror(numbers: jax.Array) -> jax.Array:
    """The numbers (..., F) of the mirrored world: the strip of taxels runs the other way."""
    count = numbers.shape[-1] - _SIGNS.size
    signs = jnp.asarray(_SIGNS, numbers.dtype)
    return jnp.concatenate([numbers[..., :count][..., ::-1], numbers[..., count:] * signs], -1)


def clip_action(action: jax.Array) -> jax.Array:
    """An action (..., 3) [1] as it is carried out: a share of the greatest twist, within 1."""
    return jnp.stack(Twist(*jnp.moveaxis(action, -1, 0)).saturate(1.0, 1.0), axis=-1)
