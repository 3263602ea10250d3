"""Observations of a learned law, its record of touch, and the input features of its network.

A law that senses `taxels` observes the signal of every taxel. Between two control steps it stores
where it last touched the object, by odometry.

Features are of order 1: lengths are on logarithmic or tanh scales, directions are unit vectors.
Mirroring a world about the robot's x axis (y to -y) mirrors its features.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax.control.base import LastContact, TimeLost, Touched
from rps_jax.control.observation import (
    EndsObservation,
    Observation,
    TaxelObservation,
    Twist,
    displacement,
)
from rps_jax.geometry import planar
from rps_jax.geometry.arrays import Array
from rps_jax.geometry.footprint import Footprint
from rps_jax.robot import skin as skins
from rps_jax.robot.skin import LINE, NONE, CapacitiveSkin, Reading, Skin, SkinState
from rps_jax.spec import Spec

_BASE = 0.36  # [m] scale of positions on the base
_NEAR, _FAR = 0.05, 3.0  # [m] distances that map to 0 and 1 on the logarithmic scale
_CLOSE = 0.3  # [m] tanh scale of distances
_DURATION = 5.0  # [s] tanh scale of the time since contact
_DRIFT = 0.01  # [m] tanh scale of the contact's motion on the base between two decisions


def taxel_observation(
    touch: Observation, reading: Reading, skin: Skin, state: SkinState, footprint: Footprint
) -> TaxelObservation:
    """Return the observation of a law that senses taxels.

    `footprint` is the object's outline in the robot frame. For a skin without taxels, the signal
    is that of perfect taxels on the same boards.
    """
    return TaxelObservation(
        touch._replace(in_contact=reading.contact_type != NONE),
        skins.signals(skin, state, footprint),
        reading.contact_type == LINE,
    )


def ends_observation(
    touch: Observation, reading: Reading, skin: Skin, state: SkinState, footprint: Footprint
) -> EndsObservation:
    """Return the observation of a law that senses the ends of contacts: `taxel_observation`."""
    signal = skins.signals(skin, state, footprint)
    alive = state.alive if state.signal.size else jnp.ones(signal.shape, bool)
    del reading  # `touch` has the contact, or its weight of a smooth law
    threshold = getattr(skin, "threshold", CapacitiveSkin().threshold)
    return touch.with_ends(signal, alive, skins.ends_of(signal, alive, skin.shell, threshold))


# By what a law senses.
OBSERVATIONS = {"taxels": taxel_observation, "ends": ends_observation}


class TouchState(NamedTuple):
    """Record of touch, with positions by odometry."""

    p_world_contact: LastContact
    touched: Touched
    time_since_contact: TimeLost
    in_contact: Annotated[
        Array, Spec("1", "whether there is a contact in this control step")
    ]  # () bool
    p_robot_decision: Annotated[Array, Spec("m", "the contact at the last decision")]  # (2,)
    has_decided: Annotated[
        Array, Spec("1", "whether the last decision was made in contact")
    ]  # () bool

    @classmethod
    def initial(cls, dtype: jax.typing.DTypeLike = float) -> TouchState:
        """Return the state before the first contact."""
        zero, no = jnp.zeros((), dtype), jnp.zeros((), bool)
        return cls(jnp.zeros(2, dtype), no, zero, no, jnp.zeros(2, dtype), no)

    def update(self, obs: TaxelObservation) -> TouchState:
        """Return the state after one control step."""
        touch = obs.touch
        p_world_contact = touch.p_world_robot + planar.rotate(touch.yaw, touch.p_robot_contact)
        time = self.time_since_contact + touch.period
        return self._replace(
            p_world_contact=jnp.where(touch.in_contact, p_world_contact, self.p_world_contact),
            touched=self.touched | touch.in_contact,
            time_since_contact=jnp.where(touch.in_contact, 0.0, time),
            in_contact=touch.in_contact,
        )

    def mark_decision(self, obs: TaxelObservation) -> TouchState:
        """Return the state after a decision."""
        return self._replace(
            p_robot_decision=self.p_robot_contact(obs), has_decided=self.in_contact
        )

    def p_robot_contact(self, obs: TaxelObservation) -> Array:
        """Return the last contact (2,) [m] in the current robot frame; 0 before any contact."""
        touch = obs.touch
        p_robot_last = planar.rotate(-touch.yaw, self.p_world_contact - touch.p_world_robot)
        p_robot = jnp.where(touch.in_contact, touch.p_robot_contact, p_robot_last)
        return jnp.where(self.touched, p_robot, 0.0)


def _vector_features(p_robot: Array) -> list[Array]:
    """Return the direction of a vector (2,) [m], and its length on two scales."""
    length = planar.norm(p_robot)
    direction = p_robot / jnp.maximum(length, 1e-6)
    scaled = jnp.log(jnp.maximum(length, _NEAR / 2) / _NEAR) / np.log(_FAR / _NEAR)
    return [direction, scaled[None], jnp.tanh(length / _CLOSE)[None]]


# Signs of the features after the taxels, under mirroring.
_SIGNS = np.array(
    [1, 1, 1, 1]  # contact, line, touched, time since contact
    + [1, -1]  # position of the contact
    + [1, -1, 1, 1] * 2  # vectors from the contact and from the base to the target
    + [1, -1]  # drift
    + [1, -1, -1],  # action
    np.float32,
)


def feature_count(taxels: int) -> int:
    """Return the number of features for a skin of `taxels` taxels."""
    return taxels + _SIGNS.size


def compute_features(touch_state: TouchState, action: Array, obs: TaxelObservation) -> Array:
    """Compute the input features (F,) of the network at a decision.

    `action` (3,) [1] is the last one. `touch_state` is already updated with `obs`.
    """
    touch = obs.touch
    contact = touch_state.p_robot_contact(obs)
    d = displacement(touch._replace(p_robot_contact=contact))
    base = displacement(touch._replace(p_robot_contact=jnp.zeros_like(contact)))
    drift = jnp.tanh((contact - touch_state.p_robot_decision) / _DRIFT)
    is_continued = touch.in_contact & touch_state.has_decided
    flags = jnp.stack([touch.in_contact, obs.line & touch.in_contact, touch_state.touched])
    return jnp.concatenate(
        [
            jnp.arcsinh(obs.signal),
            flags.astype(contact.dtype),
            jnp.tanh(touch_state.time_since_contact / _DURATION)[None],
            jnp.clip(contact / _BASE, -3.0, 3.0),
            *_vector_features(planar.rotate(-touch.yaw, d)),
            *_vector_features(planar.rotate(-touch.yaw, base)),
            jnp.where(is_continued, drift, 0.0),
            action,
        ]
    )


def mirror(features: Array) -> Array:
    """Return the features (..., F) of the mirrored world, with the strip of taxels reversed."""
    count = features.shape[-1] - _SIGNS.size
    signs = jnp.asarray(_SIGNS, features.dtype)
    return jnp.concatenate([features[..., :count][..., ::-1], features[..., count:] * signs], -1)


def clip_action(action: Array) -> Array:
    """Saturate an action [1], (..., 3), or (..., 2) without v_y, to a twist (..., 3) of norm 1.

    Both are shares of the largest twist.
    """
    if action.shape[-1] == 2:
        action = jnp.stack([action[..., 0], jnp.zeros_like(action[..., 0]), action[..., 1]], -1)
    return jnp.stack(Twist(*jnp.moveaxis(action, -1, 0)).saturate(1.0, 1.0), axis=-1)
