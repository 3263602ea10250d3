"""Files of learned laws: the network, its weights, and a record of how it was learned.

A file is a NumPy archive (`.npz`) without pickled objects: `about`, a line of JSON, one array for
each weight, and `digest`, the SHA-256 of them all. `SHIPPED` lists the files of the package.
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
from rps_jax.control.learned.network import LearnedParams, Network, Weights
from rps_jax.errors import InputError
from rps_jax.record import files

FORMAT, VERSION = "rps_jax policy", 1
SHIPPED = {path.stem: path for path in sorted(Path(__file__).parent.glob("learned_*.npz"))}


class Policy(NamedTuple):
    """Content of a policy's file."""

    network: Network
    weights: Weights  # float32, on the host
    task: LearnedParams = LearnedParams()
    learned: Mapping[str, Any] = {}  # JSON: how the law was learned

    @property
    def about(self) -> dict[str, Any]:
        """JSON header of the file, with everything except the weights."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "network": self.network._asdict(),
            "task": self.task._asdict(),
            "learned": dict(self.learned),
        }


def encode(policy: Policy) -> bytes:
    """Return the content of a policy's file, a function of the policy alone."""
    policy.network.check()
    arrays = {"about": np.array(json.dumps(policy.about))}
    for name in policy.network.shapes:
        arrays[name] = np.asarray(policy.weights[name], np.float32)
    return files.encode_arrays(digest=np.array(_digest(arrays)), **arrays)


def decode(content: bytes, source: Path | str) -> Policy:
    """Return the policy of a file's content; InputError names the `source` of invalid content."""
    try:
        arrays = files.decode_arrays(content)
        digest = str(arrays.pop("digest"))
        about = files.parse_json(str(arrays["about"]))
        if about["format"] != FORMAT:
            raise ValueError(f"its format is {about['format']}")
    except (ValueError, KeyError, TypeError) as error:
        reason = " ".join(str(error).split()).strip("'\".")
        fault = f"it is no readable policy ({reason}); give a file that `rps learn` wrote"
        raise _error(source, fault) from error
    if (version := about.get("version")) != VERSION:
        raise _error(source, f"its version is {version}, and this package reads {VERSION}")
    if digest != _digest(arrays):
        raise InputError(f"policy = {source} is corrupt: its digest does not match; restore it.")
    del arrays["about"]
    learned = about.get("learned")
    if not isinstance(learned, dict):
        raise _error(source, f"its record of learning is {learned!r}, and must be a JSON object")
    task = {
        name: errors.check_finite(f"policy {name}", value, above=0, at_most=100)
        for name, value in _section("task", LearnedParams._fields, about, source).items()
    }
    return Policy(_decode_network(about, arrays, source), arrays, LearnedParams(**task), learned)


def _error(source: Path | str, fault: str) -> InputError:
    return InputError(f"policy = {source} is not allowed: {fault}.")


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of names, types, shapes and values."""
    sha256 = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha256.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        sha256.update(array.tobytes())
    return sha256.hexdigest()


def _decode_network(about: Mapping[str, Any], weights: Weights, source: Path | str) -> Network:
    """Return the network of a file, whose weights must have its shapes and be finite."""
    network = Network(**_section("network", Network._fields, about, source)).check()
    shapes = {name: array.shape for name, array in weights.items()}
    for name in (*shapes, *network.shapes):
        shape, expected = shapes.get(name), network.shapes.get(name)
        if shape != expected:
            raise _error(source, f"its {name} has the shape {shape}, and its network {expected}")
    for name, array in weights.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise _error(source, f"its {name} must hold finite numbers of 32 bits")
    return network


def _section(
    key: str, fields: tuple[str, ...], about: Mapping[str, Any], source: Path | str
) -> dict[str, Any]:
    """Return a section of a file's JSON, which must have these fields."""
    section = about.get(key)
    if not isinstance(section, dict) or set(section) != set(fields):
        raise _error(source, f"its {key} is {section}, and must have {', '.join(fields)}")
    return {name: section[name] for name in fields}


def check(params: LearnedParams) -> LearnedParams:
    """Return the parameters if they are positive and finite; otherwise raise InputError."""
    for name, value in params._asdict().items():
        errors.check_finite(f"learned.{name}", value, above=0)
    return params


def build_law(policy: Policy) -> tuple[str, Law, LearnedParams]:
    """Return the label of a policy, its law, and its parameters.

    The label holds the kind of network and a digest of the weights. The parameters have a class of
    the same name, so that the class selects the policy.
    """
    kind, digest = policy.network.kind, _digest(policy.weights)[:8]
    params: type[LearnedParams] = type(f"Learned{kind.upper()}_{digest}", (LearnedParams,), {})
    law = Law(
        partial(networks.init, policy.network),
        partial(networks.step, policy.network, policy.weights),
        "taxels",
        check=check,
        observe_sent=networks.observe_sent,
    )
    return f"learned_{kind}_{digest}", law, params(*policy.task)
