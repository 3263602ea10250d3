"""Files of learned laws: the network, its weights, and a record of how it was learned.

A file is a NumPy archive (`.npz`) without pickled objects: `about`, a line of JSON, one array for
each weight, and `digest`, the SHA-256 of them all. `SHIPPED` lists the files of the package.
"""

import hashlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from rps_jax import errors, spec
from rps_jax.control.base import Law
from rps_jax.control.learned import network as networks
from rps_jax.control.learned.network import LearnedParams, Network, Weights
from rps_jax.record import files
from rps_jax.robot.robot import DriveKind

FORMAT, VERSION = "rps_jax policy", 1
SHIPPED = {path.stem: path for path in sorted(Path(__file__).parent.glob("learned*.npz"))}


class Policy(NamedTuple):
    """Content of a policy's file."""

    network: Network
    weights: Weights  # float32, on the host
    task: LearnedParams = LearnedParams()
    learned: Mapping[str, object] = {}  # JSON: how the law was learned


def encode(policy: Policy) -> bytes:
    """Return the content of a policy's file, a function of the policy alone."""
    about = {
        "format": FORMAT,
        "version": VERSION,
        "network": policy.network.check()._asdict(),
        "task": policy.task._asdict(),
        "learned": dict(policy.learned),
    }
    arrays = {"about": np.array(json.dumps(about))}
    for name in policy.network.shapes:
        arrays[name] = np.asarray(policy.weights[name], np.float32)
    return files.encode_arrays(digest=np.array(_digest(arrays)), **arrays)


def decode(content: bytes, source: Path | str) -> Policy:
    """Return the policy of a file's content; InputError names the `source` of invalid content."""
    try:
        arrays = files.decode_arrays(content)
        digest, current = str(arrays.pop("digest")), _digest(arrays)
        about = files.parse_json(str(arrays.pop("about")))
        if about["format"] != FORMAT or about["version"] != VERSION:
            raise ValueError(f"its format is {about['format']}, version {about['version']}")
        if digest != current:
            raise ValueError("its digest does not match")
        network = Network(**about["network"]).check()
        _check_weights(network, arrays)
        task = {
            name: errors.check_finite(f"policy {name}", about["task"][name], above=0, at_most=100)
            for name in LearnedParams._fields
        }
        return Policy(network, arrays, LearnedParams(**task), dict(about["learned"]))
    except (ValueError, KeyError, TypeError) as error:
        reason = errors.one_line(error).strip("'\".")
        rule = "give a file that `rps learn` wrote"
        raise errors.not_allowed("policy", f"{source} ({reason})", rule) from error


def read(law: str) -> Policy:
    """Return the policy of a shipped law's name, or of a file.

    Raises:
      InputError: there is no such file, or no policy in it.
    """
    path = SHIPPED.get(law, Path(law))
    return decode(files.read_regular(path, "policy"), path)


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """Return the SHA-256 of names, types, shapes and values."""
    sha256 = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha256.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        sha256.update(array.tobytes())
    return sha256.hexdigest()


def _check_weights(network: Network, weights: Weights) -> None:
    """Raise ValueError unless weights are finite and have the shapes of a network."""
    shapes = {name: array.shape for name, array in weights.items()}
    for name in (*shapes, *network.shapes):
        shape, expected = shapes.get(name), network.shapes.get(name)
        if shape != expected:
            raise ValueError(f"its {name} has the shape {shape}, and its network {expected}")
        if weights[name].dtype != np.float32 or not np.isfinite(weights[name]).all():
            raise ValueError(f"its {name} must hold finite numbers of 32 bits")


check = partial(spec.check, prefix="learned.")


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
        drives=("omni",) if policy.network.actions == 3 else get_args(DriveKind),
        observe_sent=networks.observe_sent,
    )
    return f"learned_{kind}_{digest}", law, params(*policy.task)
