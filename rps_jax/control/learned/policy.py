"""Files that hold a learned law: its network, its weights, and how it was learned.

A file is a NumPy archive (`.npz`) without pickled objects: `about`, a line of JSON, one array for
each of the network's weights, and `digest`, the SHA-256 of all these. `SHIPPED` lists the files
that come with the package.
"""

import hashlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rps_jax import errors
from rps_jax.control.base import Law
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import Network, Weights
from rps_jax.errors import InputError
from rps_jax.record import files

FORMAT, VERSION = "rps_jax policy", 1
SHIPPED = {path.stem: path for path in sorted(Path(__file__).parent.glob("learned_*.npz"))}
_TASK = {"d_success": 0.05, "v_max": 0.05, "omega_max": 0.15}  # [m], [m/s], [rad/s]


class Policy(NamedTuple):
    """A learned law as its file holds it."""

    network: Network
    weights: Weights  # float32, on the host
    task: Mapping[str, float] = _TASK  # values of its parameters: [m], [m/s], [rad/s]
    learned: Mapping[str, Any] = {}

    @property
    def about(self) -> dict[str, Any]:
        """All but the weights, as JSON."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "network": self.network._asdict(),
            "task": dict(self.task),
            "learned": dict(self.learned),
        }


def encode(policy: Policy) -> bytes:
    """The content of a policy's file, which depends on the policy alone."""
    policy.network.check()
    arrays: dict[str, Any] = {"about": np.array(json.dumps(policy.about))}
    for name in policy.network.shapes:
        arrays[name] = np.asarray(policy.weights[name], np.float32)
    return files.encode_arrays(digest=np.array(_digest(arrays)), **arrays)


def decode(content: bytes, source: Any) -> Policy:
    """The policy of a file's content, which came from `source`; InputError if it is none."""
    try:
        arrays = files.decode_arrays(content)
        digest = str(arrays.pop("digest"))
        about = files.parse_json(str(arrays["about"]))
        if about["format"] != FORMAT:
            raise ValueError(f"its format is {about['format']}")
    except (ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split()).strip("'\".")
        why = f"it is no policy that can be read ({reason}); give a file that `rps learn` wrote"
        raise _refused(source, why) from error
    if (version := about.get("version")) != VERSION:
        why = f"it is of version {version}, and this package reads version {VERSION}"
        raise _refused(source, why)
    if digest != _digest(arrays):
        raise InputError(
            f"policy = {source} is corrupt: its content is not what its digest says; restore it."
        )
    del arrays["about"]
    learned = about.get("learned")
    if not isinstance(learned, dict):
        why = f"its note on how it was learned is {learned!r}, and must be names with values"
        raise _refused(source, why)
    given = _named("task", tuple(_TASK), about, source)
    task = {
        name: errors.check_finite(f"policy {name}", given[name], above=0, at_most=100)
        for name in _TASK
    }
    return Policy(_network(about, arrays, source), arrays, task, learned)


def _refused(source: Any, why: str) -> InputError:
    return InputError(f"policy = {source} is not allowed: {why}.")


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of names, types, shapes and values."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        found.update(array.tobytes())
    return found.hexdigest()


def _network(about: Mapping[str, Any], weights: Weights, source: Any) -> Network:
    """The network of a file, whose weights must be its own, and finite."""
    network = Network(**_named("network", Network._fields, about, source)).check()
    found, wanted = {name: array.shape for name, array in weights.items()}, network.shapes
    for name in (*found, *wanted):
        if found.get(name) != wanted.get(name):
            why = f"its {name} has the shape {found.get(name)}, and its network asks for "
            raise _refused(source, f"{why}{wanted.get(name)}")
    for name, array in weights.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise _refused(source, f"its {name} must hold finite numbers of 32 bits")
    return network


def _named(
    what: str, names: tuple[str, ...], about: Mapping[str, Any], source: Any
) -> dict[str, Any]:
    """What a file says of one thing, by these names."""
    found = about.get(what)
    if not isinstance(found, dict) or set(found) != set(names):
        raise _refused(source, f"its {what} is {found}, and must have {', '.join(names)}")
    return found


def check(params: Any) -> Any:
    """Return the parameters if they are positive and finite; otherwise raise InputError."""
    for name in params._fields:
        errors.check_finite(f"learned.{name}", getattr(params, name), above=0)
    return params


def build_law(policy: Policy) -> tuple[str, Law, Any]:
    """The label of a policy, by its network and digest, its law and parameters.

    These are of a class of their own, which has no other numbers than the task's. The weights are
    no parameters: they are constants of the program, and not copied to each world.
    """
    kind, digest = policy.network.kind, _digest(policy.weights)[:8]
    name = f"Learned{kind.upper()}_{digest}"
    own = NamedTuple(name, [(field, Any) for field in _TASK])  # pyright: ignore
    own.__doc__ = "Parameters of a learned law: what is asked of it."
    step = partial(networks.step, policy.network, policy.weights)
    law = Law(
        partial(networks.init, policy.network),
        step,
        "taxels",
        check=check,
        observe_sent=networks.observe_sent,
    )
    return f"learned_{kind}_{digest}", law, own(**policy.task)
