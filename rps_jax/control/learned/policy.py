"""Files that hold a learned law: its network, its weights, and how it was learned.

A file is a NumPy archive (`.npz`) without pickled objects: `about`, a line of JSON, one array for
each of the network's weights, and `digest`, the SHA-256 of all these. `SHIPPED` lists the files
that come with the package.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rps_jax import errors
from rps_jax.control.base import Law
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import Memory, Network, Weights
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


def encoded(policy: Policy) -> bytes:
    """The content of a policy's file, which depends on the policy alone."""
    policy.network.check()
    arrays: dict[str, Any] = {"about": np.array(json.dumps(policy.about))}
    for name in policy.network.shapes:
        arrays[name] = np.asarray(policy.weights[name], np.float32)
    content = io.BytesIO()
    np.savez(content, digest=np.array(_digest(arrays)), **arrays)
    return content.getvalue()


def decoded(content: bytes, source: Any) -> Policy:
    """The policy of a file's content.

    Raises:
      InputError: the content, which came from `source`, is no policy, is damaged, is of another
        version, or its weights are not those of its network.
    """
    try:
        arrays = files.arrays_of(content)
        digest = str(arrays.pop("digest"))
        about = files.parsed(str(arrays["about"]))
        if about["format"] != FORMAT:
            raise ValueError(f"its format is {about['format']}")
    except (ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split()).strip("'\".")
        raise InputError(
            f"policy = {source} is not allowed: it is no policy that can be read ({reason}); give "
            "a file that `rps learn` wrote."
        ) from error
    if about.get("version") != VERSION:
        raise InputError(
            f"policy = {source} is not allowed: it is of version {about.get('version')}, and this "
            f"package reads version {VERSION}."
        )
    if digest != _digest(arrays):
        raise InputError(
            f"policy = {source} is corrupt: its content is not what its digest says; restore it."
        )
    del arrays["about"]
    learned = about.get("learned")
    if not isinstance(learned, dict):
        raise InputError(
            f"policy = {source} is not allowed: its note on how it was learned is {learned!r}, and "
            "must be names with values."
        )
    return Policy(_network(about, arrays, source), arrays, _task(about, source), learned)


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
    fields = about.get("network")
    if not isinstance(fields, dict) or set(fields) != set(Network._fields):
        raise InputError(
            f"policy = {source} is not allowed: its network is {fields}, and must have "
            f"{', '.join(Network._fields)}."
        )
    network = Network(**fields).check()
    found = {name: array.shape for name, array in weights.items()}
    if found != network.shapes:
        names = [n for n in (*found, *network.shapes) if found.get(n) != network.shapes.get(n)]
        raise InputError(
            f"policy = {source} is not allowed: its {names[0]} has the shape "
            f"{found.get(names[0])}, and its network asks for {network.shapes.get(names[0])}."
        )
    for name, array in weights.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise InputError(
                f"policy = {source} is not allowed: its {name} must hold finite numbers of 32 bits."
            )
    return network


def _task(about: Mapping[str, Any], source: Any) -> dict[str, float]:
    given = about.get("task")
    if not isinstance(given, dict) or set(given) != set(_TASK):
        raise InputError(
            f"policy = {source} is not allowed: its task is {given}, and must have "
            f"{', '.join(_TASK)}."
        )
    return {
        name: errors.check_finite(f"policy {name}", given[name], above=0, at_most=100)
        for name in _TASK
    }


def label(policy: Policy) -> str:
    """What a policy of a file is called: by its network, and by its digest."""
    return f"learned_{policy.network.kind}_{_digest(policy.weights)[:8]}"


def parameters(policy: Policy) -> Any:
    """Parameters of a class of this policy's own, which has no other numbers than the task's.

    The weights are no parameters: they are constants of the program, and not copied to each world.
    """
    name = f"Learned{policy.network.kind.upper()}_{_digest(policy.weights)[:8]}"
    kind = NamedTuple(name, [(field, Any) for field in _TASK])  # pyright: ignore
    kind.__doc__ = "Parameters of a learned law: what is asked of it."
    return kind(**policy.task)


def functions(policy: Policy) -> tuple[Any, Any]:
    """`init` and `step` of the law."""

    def init(params: Any) -> Memory:
        return Memory.init(policy.network)

    return init, partial(networks.step, policy.network, policy.weights)


def check(params: Any) -> Any:
    """Return the parameters if they are positive and finite; otherwise raise InputError."""
    for name in params._fields:
        errors.check_finite(f"learned.{name}", getattr(params, name), above=0)
    return params


def law_of(content: bytes, source: Any) -> tuple[str, Law, Any]:
    """Read a policy's file as a law: its label, the law and its parameters.

    Raises:
      InputError: as `decoded`.
    """
    found = decoded(content, source)
    return label(found), Law(*functions(found), "taxels", check=check), parameters(found)
