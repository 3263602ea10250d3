"""How worlds are stepped: the timestep, the cone, the solver, the softness of contacts; by name."""

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

from rps_jax import errors
from rps_jax.record.options import check_fields, option, parse_changes


@dataclass(frozen=True)
class Physics:
    """How the world is stepped. Static: a change compiles another program."""

    timestep: float = option(0.01, 1e-5, 0.1, unit="s")
    # Between two decisions of the law; left open by the paper.
    control_period: float = option(0.02, above=0, at_most=1, unit="s")
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    impratio: float = option(10.0, above=0)  # [1] friction stiffness over normal stiffness
    # Of the Newton solver, at most; with 4 the object is lost.
    iterations: int = option(8, 1, 10_000)
    ls_iterations: int = option(10, 1, 10_000)  # of its line search, at most
    # Of the solver, relative to the trace of the mass matrix: that is 3e6 by the base's armature,
    # so MuJoCo's own 1e-8 would end the solver far from an object's solution.
    tolerance: float = option(1e-13, 0)  # [1]
    # Time constant and damping ratio [s, 1] of the two contacts (MuJoCo's solref) and the ground's
    # impedance [1] (its solimp). MuJoCo's cone lifts what slides; on its own ground, (0.02, 1) and
    # 0.9, objects hop at 5 cm/s and the push force chatters by three quarters of its mean. This
    # softer and less damped ground carries them steadily, 0.5 mm deep.
    base_solref: tuple[float, float] = option((0.02, 1.0), above=0)  # MuJoCo's own
    ground_solref: tuple[float, float] = option((0.1, 0.3), above=0)
    ground_impedance: float = option(0.7, above=0, at_most=0.9999)

    def __post_init__(self) -> None:
        check_fields(self)
        steps = self.control_period / self.timestep
        if steps < 0.5 or not math.isclose(steps, round(steps), rel_tol=1e-6):
            raise errors.InputError(
                f"control_period = {self.control_period:g} s is not allowed: it must be a "
                f"multiple of timestep = {self.timestep:g} s."
            )

    @property
    def substeps(self) -> int:
        """Physics steps in one control period."""
        return round(self.control_period / self.timestep)


# The ground contact that MuJoCo has if none is chosen.
MUJOCOS_GROUND = {"ground_solref": (0.02, 1.0), "ground_impedance": 0.9}
_EXACT = Physics(timestep=0.001, iterations=100, ls_iterations=50, tolerance=1e-15)
# The pyramid needs Gazebo's own step of 1 ms: in steps of 5 ms it loses most boxes.
_PYRAMID = Physics(timestep=0.001, cone="pyramidal", iterations=20, ls_iterations=20)
# How the friction is modelled, and how finely that is solved: see `preset`.
PHYSICS = {
    "default": {
        "reference": _EXACT,
        # Share of the 432 outcomes equal to the reference's in C (`rps paper`):
        "standard": Physics(),  # MJX 99.5 %, fused 100 %
        # MJX 95.6 %, fused 100 %. On `standard`'s ground flat boxes at rest wander off at 20 ms.
        "fast": Physics(timestep=0.02, iterations=6, ls_iterations=8, ground_impedance=0.5),
    },
    "paper_gazebo": {
        "reference": replace(_EXACT, cone="pyramidal"),
        "standard": _PYRAMID,
        "fast": _PYRAMID,
    },
}


PhysicsName = Literal["default", "paper_gazebo"]
PhysicsLike = str | Physics  # or its text, see `named`
Fidelity = Literal["reference", "standard", "fast"]


def preset(name: PhysicsName = "default", fidelity: Fidelity = "standard") -> Physics:
    """Physics by name: `default`, isotropic Coulomb friction; or `paper_gazebo`, as in the paper.

    There friction is a pyramid along the world's axes. The fidelity is `reference`, converged, for
    the engine `mujoco`; `standard`, for tables; or `fast`.
    """
    errors.check_name("physics", name, PHYSICS)
    return PHYSICS[name][errors.check_name("fidelity", fidelity, PHYSICS[name])]


def named(physics: PhysicsLike, fidelity: Fidelity = "standard") -> Physics:
    """Read a physics: itself, or a name with changes, as `default,timestep=0.005`."""
    if isinstance(physics, Physics):
        return physics
    if not isinstance(physics, str):
        raise errors.InputError(f"physics = {physics!r} is not allowed: give a name or a Physics.")
    name, changes = parse_changes("physics", physics)
    errors.check_name("physics", name, PHYSICS)
    usual = preset(name, fidelity)  # pyright: ignore[reportArgumentType]
    for field, value in changes.items():
        errors.check_name("field of physics", field, [one.name for one in fields(Physics)])
        if isinstance(getattr(usual, field), int) and isinstance(value, float):
            changes[field] = int(value) if value == int(value) else value
        elif isinstance(value, list):
            changes[field] = tuple(value)
    try:
        return replace(usual, **changes)
    except TypeError as error:
        raise errors.InputError(f"physics = {physics} is not allowed ({error}).") from error
