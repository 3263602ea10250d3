"""Physics of the simulation: timestep, friction cone, solver and contact softness; presets."""

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

from rps_jax import errors
from rps_jax.geometry.solid import Support
from rps_jax.record.options import check_fields, option, parse_changes, to_json


@dataclass(frozen=True)
class Physics:
    """Options of the simulation. Static: a change compiles another program."""

    timestep: float = option(0.01, 1e-5, 0.1, unit="s")
    # Between two steps of the law; the paper leaves it open.
    control_period: float = option(0.02, above=0, at_most=1, unit="s")
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    impratio: float = option(10.0, above=0)  # [1] friction stiffness over normal stiffness
    # Maximum, of the Newton solver; with 4 the base loses the object.
    iterations: int = option(8, 1, 10_000)
    ls_iterations: int = option(10, 1, 10_000)  # maximum, of its line search
    # Of the solver, relative to the trace of the mass matrix. The base's armature makes that 3e6:
    # MuJoCo's default of 1e-8 would end the solver far from the object's solution.
    tolerance: float = option(1e-13, 0)  # [1]
    # Time constant and damping ratio [s, 1] of the two contacts (MuJoCo's solref) and the ground's
    # impedance [1] (its solimp). MuJoCo's cone lifts sliding objects. On its default ground, with
    # (0.02, 1) and 0.9, objects hop at 5 cm/s and the push force chatters by three quarters of its
    # mean. On this softer and less damped ground they slide steadily, 0.5 mm deep: straight pushes
    # at 5 cm/s have a force of mu m g within 5 % (sweeps/ground/straight.py).
    base_solref: tuple[float, float] = option((0.02, 1.0), above=0)  # MuJoCo's default
    ground_solref: tuple[float, float] = option((0.1, 0.2), above=0)
    ground_impedance: float = option(0.5, above=0, at_most=0.9999)
    # Pressure under objects without explicit feet: at corners or rim, even, or along the rim.
    support: Support = "corners"

    def __post_init__(self) -> None:
        check_fields(self)
        for name, value in to_json(self).items():  # numbers of Python, as a static record needs
            object.__setattr__(self, name, tuple(value) if isinstance(value, list) else value)
        if self.support != "corners" and self.cone == "pyramidal":
            raise errors.not_allowed("support", self.support, "a friction pyramid has corners")
        steps = self.control_period / self.timestep
        if steps < 0.5 or not math.isclose(steps, round(steps), rel_tol=1e-6):
            rule = f"it must be a multiple of timestep = {self.timestep:g} s"
            raise errors.not_allowed("control_period", f"{self.control_period:g} s", rule)

    @property
    def substeps(self) -> int:
        """Physics steps in one control period."""
        return round(self.control_period / self.timestep)


# MuJoCo's default ground contact.
MUJOCO_GROUND = {"ground_solref": (0.02, 1.0), "ground_impedance": 0.9}
_EXACT = Physics(timestep=0.001, iterations=100, ls_iterations=50, tolerance=1e-15)
# The pyramid needs Gazebo's own step of 1 ms: in steps of 5 ms it loses most boxes.
_PYRAMID = Physics(timestep=0.001, cone="pyramidal", iterations=20, ls_iterations=20)
# By friction model and fidelity: see `preset`.
PHYSICS = {
    "default": {
        "reference": _EXACT,
        "standard": Physics(),
        # On the ground of `standard`, flat boxes at rest drift at 20 ms.
        "fast": Physics(timestep=0.02, iterations=6, ls_iterations=8, ground_solref=(0.1, 0.3)),
    },
    "paper_gazebo": {
        "reference": replace(_EXACT, cone="pyramidal"),
        "standard": _PYRAMID,
        "fast": _PYRAMID,
    },
}


PhysicsName = Literal["default", "paper_gazebo"]
PhysicsLike = str | Physics  # or its text: see `parse_physics`
Fidelity = Literal["reference", "standard", "fast"]


def preset(name: PhysicsName = "default", fidelity: Fidelity = "standard") -> Physics:
    """Return physics by name and fidelity.

    Args:
      name: `default`, isotropic Coulomb friction; or `paper_gazebo`, the paper's friction pyramid
        along the world's axes.
      fidelity: `reference`, converged, for the engine `mujoco`; `standard`, for tables; or `fast`,
        whose steps of 20 ms double the time constant of the base's contact: MuJoCo lifts it to two
        steps.

    Examples:
      >>> preset("default", "fast").timestep
      0.02
    """
    errors.check_name("physics", name, PHYSICS)
    return PHYSICS[name][errors.check_name("fidelity", fidelity, PHYSICS[name])]


def parse_physics(physics: PhysicsLike, fidelity: Fidelity = "standard") -> Physics:
    """Return physics from a name with changes, as `default,timestep=0.005`."""
    if isinstance(physics, Physics):
        return physics
    if not isinstance(physics, str):
        raise errors.not_allowed("physics", repr(physics), "give a name or a Physics")
    name, changes = parse_changes("physics", physics)
    base = preset(name, fidelity)  # pyright: ignore[reportArgumentType]
    known = [field.name for field in fields(Physics)]
    for field, value in changes.items():
        errors.check_name("field of physics", field, known)
        if isinstance(getattr(base, field), int) and value in range(2**31):
            changes[field] = int(value)
    return replace(base, **changes)
