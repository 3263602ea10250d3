"""Unknowns of the paper: readings of its text, and physics of its experiments.

A draw has a value of every unknown, from one point of the unit cube. Unknowns of the text hold in
simulation and on the hardware; the others belong to one of these.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from rps_jax import Range, RPSParams
from rps_jax.laws import LawParams, resolve_law

Part = Literal["text", "hardware", "simulation"]


class Unknown(NamedTuple):
    """Range of an unknown, or its choices."""

    part: Part
    label: str
    range: Range = Range(0, 1)
    unit: str = "1"
    choices: tuple[str, ...] = ()  # words for 0, 1, ...


_NO_YES = ("no", "yes")
# By name, which may be that of a parameter of the law or of a quantity of a domain.
UNKNOWNS: dict[str, Unknown] = {
    "saturate_first": Unknown("text", "omega from the saturated v_x", choices=_NO_YES),
    "clip_each": Unknown("text", "v_x and v_y clipped one by one", choices=_NO_YES),
    "gamma_max": Unknown("text", "bound on gamma", Range(0.9, 1.57), "rad"),
    "l_mr": Unknown("text", "end of the middle region", Range(0.02, 0.22), "m"),
    "a_r_max": Unknown("text", "adaptive rate in Realignment", Range(5, 40, log=True)),
    "v_lost": Unknown("text", "speed after a loss", Range(0.01, 0.05, log=True), "m/s"),
    "counts_d": Unknown("text", "D counts", choices=("time in contact", "all the time")),
    "counts_time": Unknown("text", "time counts", choices=("from the start", "from contact")),
    "rear": Unknown("text", "corner of the load on the nonuniform box", choices=("near", "far")),
    "aps_aim_beyond": Unknown("text", "APS: aim beyond the target, radii", Range(0.6, 1.2)),
    "aps_r_robot": Unknown("text", "APS: radius of the robot", Range(0.29, 0.47), "m"),
    "aps_min_motion": Unknown("text", "APS: least motion", Range(1e-4, 1e-2, log=True), "m"),
    "ground_box": Unknown("hardware", "friction box-ground", Range(0.1, 0.8)),
    "ground_cylinder": Unknown("hardware", "friction cylinder-ground", Range(0.1, 0.8)),
    "robot_box": Unknown("hardware", "friction box-robot", Range(0.15, 1.2)),
    "robot_cylinder": Unknown("hardware", "friction cylinder-robot", Range(0.15, 1.2)),
    "robot_slip": Unknown("hardware", "share of v_x that is lost", Range(0, 0.3)),
    "robot_slip_sideways": Unknown("hardware", "share of v_y that is lost", Range(0, 0.5)),
    "robot_slip_yaw": Unknown("hardware", "share of omega that is lost", Range(0, 0.6)),
    "robot_lag": Unknown("hardware", "lag of the robot", Range(0, 0.5), "s"),
    "gap": Unknown("hardware", "gap at the start", Range(0, 0.06), "m"),
    "foam": Unknown("hardware", "foam of the skin", Range(0.002, 0.02), "m"),
    "time_constant": Unknown("hardware", "time constant of the skin", Range(0.02, 0.2), "s"),
    "pose_latency": Unknown("hardware", "latency of the pose", Range(0, 0.2), "s"),
    "command_delay": Unknown("hardware", "delay of the command", Range(0, 0.2), "s"),
    "cone": Unknown("simulation", "friction cone", choices=("pyramidal", "elliptic")),
    "tolerance": Unknown("simulation", "tolerance of the skin", Range(3e-4, 6e-3, log=True), "m"),
    "yaw": Unknown("simulation", "yaw of the object at the start", Range(-0.03, 0.03), "rad"),
    "sim_gap": Unknown("simulation", "gap at the start", Range(0, 0.1), "m"),
}
NAMES = tuple(UNKNOWNS)
_OF_RPS = tuple(name for name in RPSParams._fields if name in UNKNOWNS)


def values(u: np.ndarray, name: str) -> np.ndarray:
    """Return an unknown (n,) in its unit, or as the index of its choice, at points u (n, q)."""
    unknown, column = UNKNOWNS[name], u[:, NAMES.index(name)]
    if unknown.choices:
        return np.floor(column * len(unknown.choices))
    return unknown.range.at(column)


def texts(u: np.ndarray, name: str) -> list[str]:
    """Return the words of a choice at points u (n, q)."""
    return [UNKNOWNS[name].choices[int(i)] for i in values(u, name)]


def params(u: np.ndarray) -> RPSParams:
    """Return the parameters of RPS (n,) under the readings at points u (n, q)."""
    known = {name: np.full(len(u), value) for name, value in RPSParams()._asdict().items()}
    return RPSParams()._replace(**known | {name: values(u, name) for name in _OF_RPS})


def aps_params(u: np.ndarray) -> LawParams:
    """Return the parameters of APS (n,) under the readings at points u (n, q)."""
    aps: Any = resolve_law("aps")[1]
    known = {name: np.full(len(u), value) for name, value in aps._asdict().items()}
    drawn = {name: values(u, f"aps_{name}") for name in known if f"aps_{name}" in UNKNOWNS}
    return aps._replace(**known | drawn)


def redraw_hardware(
    proposal: Proposal, u: np.ndarray, samples: int, rng: np.random.Generator
) -> np.ndarray:
    """Return each point u (n, q) several times, (n * samples, q), with its own hardware each."""
    repeated = np.repeat(u, samples, 0)
    is_hardware = [unknown.part == "hardware" for unknown in UNKNOWNS.values()]
    return np.where(is_hardware, proposal.sample(len(repeated), rng), repeated)


# --- proposals: densities in the unit cube ---------------------------------------------------

BINS = 6  # of each coordinate of a proposal
_PRIOR = 0.2  # share of the prior in every coordinate


class Proposal(NamedTuple):
    """Product density in the unit cube: a histogram for each coordinate."""

    shares: np.ndarray  # (q, BINS), of which each row sums to 1

    @classmethod
    def prior(cls) -> Proposal:
        """Return the uniform density."""
        return cls(np.full((len(NAMES), BINS), 1 / BINS))

    @classmethod
    def fitted(cls, u: np.ndarray, weights: Mapping[Part, np.ndarray]) -> Proposal:
        """Return the density of points u (n, q), mixed with the prior.

        The weights (n,) of the points differ between the parts of the unknowns.
        """
        parts = (weights[unknown.part] for unknown in UNKNOWNS.values())
        counts = [
            np.bincount(column, each, BINS) / each.sum()
            for column, each in zip(_bin(u).T, parts, strict=True)
        ]
        return cls((1 - _PRIOR) * np.array(counts) + _PRIOR / BINS)

    def sample(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return points (count, q)."""
        chosen = [rng.choice(BINS, count, p=row) for row in self.shares]
        return (np.stack(chosen, 1) + rng.random((count, len(NAMES)))) / BINS

    def log_density(self, u: np.ndarray) -> np.ndarray:
        """Return the logarithm of the density (n,) at points u (n, q); that of the prior is 0."""
        at = _bin(u)
        return np.log(BINS * self.shares[np.arange(len(NAMES)), at]).sum(1)


def _bin(u: np.ndarray) -> np.ndarray:
    return np.minimum((u * BINS).astype(int), BINS - 1)
