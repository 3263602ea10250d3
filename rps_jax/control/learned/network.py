"""Network of a learned law, as pure functions of its weights, and the law built on it.

The network is equivariant under mirroring (y to -y): in the mirrored world it commands the
mirrored action, for any weights. Each layer has a pair of rows, one for the world and one for its
mirror image, and treats both alike. A layer of width n acts as a dense one of 2 n, with half the
weights.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from rps_jax import errors
from rps_jax.control.base import OmegaMax, SpeedMax, SuccessDistance
from rps_jax.control.learned import features
from rps_jax.control.learned.features import TouchState
from rps_jax.control.observation import Details, TaxelObservation, Twist
from rps_jax.geometry.arrays import Array, Pair
from rps_jax.spec import Spec, specs_of

NetworkKind = Literal["mlp", "gru"]
Shapes = dict[str, tuple[int, ...]]  # of weights, by name
Weights = dict[str, Any]  # float32 arrays by name, of NumPy or JAX
_ACTION_SIGNS = {3: (1, -1, -1), 2: (1, -1)}  # of (v_x, v_y, omega) under the mirror, (v_x, omega)
_REACH = 1.5  # [1] bound on the mean of each component of an action


class Network(NamedTuple):
    """Architecture of a network, without its weights. Static."""

    kind: NetworkKind = "gru"  # mlp: two hidden layers; gru: one, and a recurrent layer
    width: Annotated[int, Spec("1", "pairs of units in a hidden layer")] = 64
    taxels: Annotated[int, Spec("1", "taxels of the skin")] = 42
    hold: Annotated[float, Spec("s", "duration of an action", gt=0, le=10)] = 0.2
    actions: Annotated[int, Spec("1", "numbers of an action: 3, or 2 without v_y")] = 3

    def check(self) -> Network:
        """Return the network; raise InputError for a field that is out of range."""
        errors.check_name("network", self.kind, get_args(NetworkKind))
        errors.check_count("network width", self.width, at_most=1024)
        errors.check_count("network taxels", self.taxels, at_most=10_000)
        errors.check_count("network actions", self.actions, at_least=2, at_most=3)
        specs_of(Network)["hold"].check("network hold", self.hold)
        return self

    @property
    def shapes(self) -> Shapes:
        """Shapes of the weights by name."""
        size, n = features.feature_count(self.taxels), self.width
        gru = _dense("memory.gates", 2 * n, 2 * n) | _dense("memory.new", 2 * n, n)
        second = _dense("second", n, n) if self.kind == "mlp" else gru
        return _dense("first", size, n) | second | _dense("action", n, self.actions)

    def init(self, key: Array) -> Weights:
        """Return random weights, with a mean action near zero."""
        return init_weights(self.shapes, key, small=("action",))

    def apply(self, weights: Weights, hidden: Array, inputs: Array) -> Pair:
        """Map features (..., F) to the hidden state (..., 2, H) and mean action (..., A) [1]."""
        x = jnp.tanh(dense(weights, "first", mirror_pairs(inputs)))
        if self.kind == "mlp":
            x = jnp.tanh(dense(weights, "second", x))
        else:
            x = hidden = _apply_gru(weights, hidden, x)
        out = dense(weights, "action", x)
        signs = jnp.asarray(_ACTION_SIGNS[self.actions], out.dtype)
        mean = 0.5 * (out[..., 0, :] + signs * out[..., 1, :])
        return hidden, _REACH * jnp.tanh(mean / _REACH)


# --- layers, each on pairs (..., 2, n) -----------------------------------------------------


def _dense(name: str, inputs: int, outputs: int) -> Shapes:
    return {f"{name}.w": (2 * inputs, outputs), f"{name}.b": (outputs,)}


def critic_shapes(inputs: int, width: int) -> Shapes:
    """Return the shapes of the weights of a value function with `inputs` pairs of inputs."""
    return (
        _dense("first", inputs, width) | _dense("second", width, width) | _dense("value", width, 1)
    )


def critic(weights: Weights, pair: Array) -> Array:
    """Compute the value (...) of pairs (..., 2, n), which is invariant under mirroring."""
    x = jnp.tanh(dense(weights, "first", pair))
    x = jnp.tanh(dense(weights, "second", x))
    return jnp.mean(dense(weights, "value", x)[..., 0], axis=-1)


def init_weights(shapes: Shapes, key: Array, small: tuple[str, ...] = ()) -> Weights:
    """Draw normal weights of variance 1 over the inputs, and zero biases.

    Weights of the layers named in `small` are a hundred times smaller.
    """
    weights = {}
    keys = jax.random.split(key, len(shapes))
    for layer_key, (name, shape) in zip(keys, shapes.items(), strict=True):
        scale = (0.01 if name.split(".")[0] in small else 1.0) / math.sqrt(shape[0])
        draw = jnp.zeros if name.endswith(".b") else partial(jax.random.normal, layer_key)
        weights[name] = scale * draw(shape)
    return weights


def mirror_pairs(inputs: Array) -> Array:
    """Stack features (..., F) with those of the mirrored world, to (..., 2, F)."""
    return jnp.stack([inputs, features.mirror(inputs)], axis=-2)


def dense(weights: Weights, name: str, pair: Array) -> Array:
    """Apply an equivariant dense layer to pairs (..., 2, n)."""
    both = jnp.concatenate([pair, pair[..., ::-1, :]], axis=-1)
    return both @ weights[f"{name}.w"] + weights[f"{name}.b"]


def _apply_gru(weights: Weights, hidden: Array, x: Array) -> Array:
    """Apply a gated recurrent unit to pairs (..., 2, n)."""
    both = jnp.concatenate([x, hidden], axis=-1)
    reset, update = jnp.split(jax.nn.sigmoid(dense(weights, "memory.gates", both)), 2, axis=-1)
    new = jnp.tanh(dense(weights, "memory.new", jnp.concatenate([x, reset * hidden], axis=-1)))
    return (1 - update) * hidden + update * new


# --- the law -------------------------------------------------------------------------------


class PolicyState(NamedTuple):
    """State of a learned law between two control steps."""

    touch_state: TouchState
    hidden: Annotated[Array, Spec("1", "hidden state of the network")]  # (2, H), H = 0 for an MLP
    action: Annotated[Array, Spec("1", "current action")]  # (3,)
    waiting: Annotated[Array, Spec("s", "time until the next decision")]  # ()

    @classmethod
    def init(cls, network: Network, dtype: jax.typing.DTypeLike = float) -> PolicyState:
        """Return the state before the first observation."""
        zero = jnp.zeros((), dtype)
        hidden = jnp.zeros((2, network.width if network.kind == "gru" else 0), dtype)
        return cls(TouchState.initial(dtype), hidden, jnp.zeros(3, dtype), zero)

    def due(self, obs: TaxelObservation) -> Array:
        """Whether this control step needs a decision."""
        return self.waiting < 0.5 * obs.touch.period


class LearnedParams(NamedTuple):
    """Parameters of a learned law. The weights are no parameters, but constants of the program."""

    d_success: SuccessDistance = 0.05
    v_max: SpeedMax = 0.05
    omega_max: OmegaMax = 0.15


def observe_sent(
    params: LearnedParams, state: PolicyState, obs: TaxelObservation, sent: Twist
) -> PolicyState:
    """Return the state whose last action is the twist sent to the base, if the law decides now."""
    action = features.clip_action(jnp.stack(sent) / _twist_bounds(params))
    return state._replace(action=jnp.where(state.due(obs), action, state.action))


def _twist_bounds(params: LearnedParams) -> Array:
    return jnp.stack([params.v_max, params.v_max, params.omega_max])


def init(network: Network, params: LearnedParams) -> PolicyState:
    """Return the initial state of a learned law."""
    return PolicyState.init(network)


def step(
    network: Network,
    weights: Weights,
    params: LearnedParams,
    state: PolicyState,
    obs: TaxelObservation,
) -> tuple[PolicyState, Twist, Details]:
    """Compute one control step of a learned law, which commands the mean action.

    Raises:
      InputError: the skin and the network have different numbers of taxels.
    """
    if obs.signal.shape[-1] != network.taxels:
        rule = f"the law was learned with {network.taxels}: choose a robot with the same boards"
        raise errors.not_allowed("number of taxels", obs.signal.shape[-1], rule)
    state = state._replace(touch_state=state.touch_state.update(obs))
    due = state.due(obs)
    inputs = features.compute_features(state.touch_state, state.action, obs)
    hidden, mean = network.apply(weights, state.hidden, inputs)
    decided = PolicyState(
        state.touch_state.mark_decision(obs),
        hidden,
        features.clip_action(mean),
        jnp.full_like(state.waiting, network.hold),
    )
    state = jax.tree.map(partial(jnp.where, due), decided, state)
    twist = Twist(*(_twist_bounds(params) * state.action))
    contact = state.touch_state.p_robot_contact(obs)
    details = Details.from_obs(obs.touch._replace(p_robot_contact=contact))
    return state._replace(waiting=state.waiting - obs.touch.period), twist, details
