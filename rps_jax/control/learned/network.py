"""The network of a learned law, as pure functions of its weights, and the law that it makes.

Every layer keeps a pair of rows, one for the world and one for its mirror image (y to -y), and
treats both alike, so the network has the mirror symmetry of the task exactly: in the mirrored
world it does the mirrored thing, whatever its weights. A layer with a width of n works as a dense
one of 2 n, with half the weights.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from rps_jax import errors
from rps_jax.control.learned import features
from rps_jax.control.learned.features import TouchState
from rps_jax.control.observation import Details, TaxelObservation, Twist

NetworkKind = Literal["mlp", "gru"]
Weights = dict[str, Any]  # by name, float32
_ACTION_SIGNS = np.array([1, -1, -1], np.float32)  # of (v_x, v_y, omega) under the mirror
_REACH = 1.5  # [1] bound on the mean of each component of an action


class Network(NamedTuple):
    """What a network is, apart from its weights. Static."""

    kind: NetworkKind = "gru"  # mlp: two hidden layers; gru: one, and a recurrent one with a state
    width: int = 64  # pairs of units in a hidden layer
    taxels: int = 42  # of the skin
    hold: float = 0.2  # [s] for which an action is carried out

    def check(self) -> Network:
        """Itself; raises InputError if it means nothing."""
        errors.check_name("network", self.kind, get_args(NetworkKind))
        errors.check_count("network width", self.width, at_most=1024)
        errors.check_count("network taxels", self.taxels, at_most=10_000)
        errors.check_finite("network hold", self.hold, above=0, at_most=10, unit="s")
        return self

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights, by name."""
        size, n = features.feature_count(self.taxels), self.width
        second = _dense("second", n, n) if self.kind == "mlp" else _gru("memory", n)
        return _dense("first", size, n) | second | _dense("action", n, 3)

    def init(self, key: jax.Array) -> Weights:
        """Weights by chance, with which the mean action is nearly to stand still."""
        return init_weights(self.shapes, key, small=("action",))

    def initial_hidden(
        self, batch: tuple[int, ...] = (), dtype: jax.typing.DTypeLike = float
    ) -> jax.Array:
        """What a network remembers (..., 2, H) before its first observation; an MLP nothing."""
        return jnp.zeros((*batch, 2, self.width if self.kind == "gru" else 0), dtype)

    def apply(
        self, weights: Weights, hidden: jax.Array, numbers: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """What it remembers (..., 2, H) and its mean action (..., 3) [1], from numbers (..., F)."""
        x = jnp.tanh(dense(weights, "first", mirror_pairs(numbers)))
        if self.kind == "mlp":
            x = jnp.tanh(dense(weights, "second", x))
        else:
            x = hidden = _remember(weights, "memory", hidden, x)
        out = dense(weights, "action", x)
        mean = 0.5 * (out[..., 0, :] + jnp.asarray(_ACTION_SIGNS, out.dtype) * out[..., 1, :])
        return hidden, _REACH * jnp.tanh(mean / _REACH)


# --- layers, each on pairs (..., 2, n) -----------------------------------------------------


def _dense(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.w": (2 * inputs, outputs), f"{name}.b": (outputs,)}


def _gru(name: str, n: int) -> dict[str, tuple[int, ...]]:
    return _dense(f"{name}.gates", 2 * n, 2 * n) | _dense(f"{name}.new", 2 * n, n)


def critic_shapes(inputs: int, width: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the weights of a value function of so many numbers."""
    return (
        _dense("first", inputs, width) | _dense("second", width, width) | _dense("value", width, 1)
    )


def critic(weights: Weights, pair: jax.Array) -> jax.Array:
    """A value (...) of pairs (..., 2, n) of numbers: that of the mirrored world is the same."""
    x = jnp.tanh(dense(weights, "first", pair))
    x = jnp.tanh(dense(weights, "second", x))
    return jnp.mean(dense(weights, "value", x)[..., 0], axis=-1)


def init_weights(
    shapes: dict[str, tuple[int, ...]], key: jax.Array, small: tuple[str, ...] = ()
) -> Weights:
    """Weights of these shapes: normal, of variance one over the inputs; biases are zero.

    Those of the layers `small` are a hundred times smaller.
    """
    found = {}
    for one, (name, shape) in zip(jax.random.split(key, len(shapes)), shapes.items(), strict=True):
        scale = (0.01 if name.split(".")[0] in small else 1.0) / math.sqrt(shape[0])
        weight = name.endswith(".w")
        found[name] = scale * jax.random.normal(one, shape) if weight else jnp.zeros(shape)
    return found


def mirror_pairs(numbers: jax.Array) -> jax.Array:
    """Numbers (..., F) and those of the mirrored world, (..., 2, F)."""
    return jnp.stack([numbers, features.mirror(numbers)], axis=-2)


def dense(weights: Weights, name: str, pair: jax.Array) -> jax.Array:
    """A layer of pairs: each row of itself and of the other one."""
    both = jnp.concatenate([pair, pair[..., ::-1, :]], axis=-1)
    return both @ weights[f"{name}.w"] + weights[f"{name}.b"]


def _remember(weights: Weights, name: str, hidden: jax.Array, x: jax.Array) -> jax.Array:
    """A gated recurrent unit."""
    both = jnp.concatenate([x, hidden], axis=-1)
    reset, update = jnp.split(jax.nn.sigmoid(dense(weights, f"{name}.gates", both)), 2, axis=-1)
    new = jnp.tanh(dense(weights, f"{name}.new", jnp.concatenate([x, reset * hidden], axis=-1)))
    return (1 - update) * hidden + update * new


# --- the law -------------------------------------------------------------------------------


class PolicyState(NamedTuple):
    """What a learned law remembers between two control steps."""

    touch_state: TouchState
    hidden: jax.Array  # (2, H) of the network
    action: jax.Array  # (3,) [1] the last one, which is carried out until the next
    waiting: jax.Array  # () [s] until then

    @classmethod
    def init(cls, network: Network, dtype: jax.typing.DTypeLike = float) -> PolicyState:
        """Return the state before the first observation."""
        zero = jnp.zeros((), dtype)
        hidden = network.initial_hidden(dtype=dtype)
        return cls(TouchState.initial(dtype), hidden, jnp.zeros(3, dtype), zero)

    def due(self, obs: TaxelObservation) -> jax.Array:
        """Whether the next action is decided now."""
        return self.waiting < 0.5 * obs.touch.period


def decide(
    network: Network, weights: Weights, state: PolicyState, obs: TaxelObservation
) -> tuple[PolicyState, jax.Array]:
    """The state after a decision, and the mean action (3,) [1], which may exceed 1.

    The state has followed `obs`; its action is still the last one.
    """
    numbers = features.compute_features(state.touch_state, state.action, obs)
    hidden, mean = network.apply(weights, state.hidden, numbers)
    return state._replace(touch_state=state.touch_state.mark_decision(obs), hidden=hidden), mean


def observe_sent(
    params: Any, state: PolicyState, obs: TaxelObservation, sent: Twist
) -> PolicyState:
    """The state to which the last action is what was sent to the base, if it decides now."""
    action = features.clip_action(jnp.stack(sent) / _greatest(params))
    return state._replace(action=jnp.where(state.due(obs), action, state.action))


def _greatest(params: Any) -> jax.Array:
    return jnp.stack([params.v_max, params.v_max, params.omega_max])


def init(network: Network, params: Any) -> PolicyState:
    """What a learned law remembers before its first step."""
    return PolicyState.init(network)


def step(
    network: Network, weights: Weights, params: Any, state: PolicyState, obs: TaxelObservation
) -> tuple[PolicyState, Twist, Details]:
    """One control step of a learned law, which acts as the mean of what was learned.

    Raises:
      InputError: the skin has another number of taxels than the network.
    """
    if obs.signal.shape[-1] != network.taxels:
        raise errors.InputError(
            f"a law learned with {network.taxels} taxels cannot be told {obs.signal.shape[-1]}: "
            "choose a robot with the boards that it was learned with."
        )
    state = state._replace(touch_state=state.touch_state.update(obs))
    due = state.due(obs)
    told, mean = decide(network, weights, state, obs)
    told = told._replace(action=features.clip_action(mean))
    told = told._replace(waiting=jnp.full_like(state.waiting, network.hold))
    after = jax.tree.map(partial(jnp.where, due), told, state)
    twist = Twist(*(_greatest(params) * after.action))
    contact = after.touch_state.p_robot_contact(obs)
    details = Details.from_obs(obs.touch._replace(p_robot_contact=contact))
    return after._replace(waiting=after.waiting - obs.touch.period), twist, details
