"""Options that several commands share, and what they mean."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rps_jax.app.cli import parsing, running
from rps_jax.engines import EngineName

if TYPE_CHECKING:
    from rps_jax.trials.conditions import Conditions

Engine = Annotated[
    EngineName,
    tyro.conf.arg(
        help=(
            "What steps the worlds: mjx (MuJoCo's equations in JAX), fused (the same equations, "
            "specialised to these scenes: much faster), warp (MJX-Warp, on an NVIDIA GPU), mujoco "
            "(C MuJoCo, on all cores) or quasistatic (planar, without inertia: fastest, and "
            "differentiable)."
        )
    ),
]
Physics = Annotated[
    Literal["default", "paper_gazebo"],
    tyro.conf.arg(
        help=(
            "How friction is modelled: default is isotropic Coulomb friction; paper_gazebo is a "
            "friction pyramid, as in the paper's simulator."
        )
    ),
]
Fidelity = Annotated[
    Literal["reference", "standard", "fast"],
    tyro.conf.arg(
        help=(
            "How finely the physics is solved: reference is converged and meant for the engine "
            "mujoco, standard is for results, and fast gives up some accuracy."
        )
    ),
]
Skin = Annotated[
    Literal["ideal", "thin", "capacitive", "hardware"] | None,
    tyro.conf.arg(
        help=(
            "The skin: ideal is the paper's simulated contact sensor under foam, thin is the same "
            "without foam, capacitive has 42 taxels, and hardware adds noise and unequal gains to "
            "these. By default the physics chooses between ideal and thin."
        )
    ),
]
RobotName = Annotated[
    str,
    tyro.conf.arg(
        help=(
            "The robot: ideal (it follows every twist at once, with any force), kairos (the "
            "paper's), ridgeback or mpo_500, or a JSON file of its size, its boards and its "
            'limits, as {"mass": 130, "force_max": 300, "lag": 0.2}.'
        )
    ),
]
Device = Annotated[
    Literal["auto", "cpu", "gpu"],
    tyro.conf.arg(help="Where the worlds are stepped; auto takes what JAX finds."),
]
Friction = Annotated[
    str,
    tyro.conf.arg(help="Friction: a set of the paper's Table I (S1, S2), or GROUND,ROBOT."),
]
Strategy = Annotated[
    str,
    tyro.conf.arg(
        help=(
            "What decides: rps, nps, aps, or a law of a file, as my_law.py:MyParams or policy.npz."
        )
    ),
]
Strategies = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        help=(
            "What decides: rps, nps, aps, and laws of files, as my_law.py:MyParams or policy.npz."
        )
    ),
]


@dataclass(frozen=True)
class Spread:
    """How a run's trials are spread over the machine."""

    slots: int | None = None
    """Number of worlds that one worker steps at once; by default as suits engine and device."""
    workers: int | None = None
    """Number of host threads that drive worlds; by default as suits engine and device."""

    def shape(self) -> dict[str, Any]:
        """The same as arguments of a run, checked."""
        from rps_jax.trials.batch import check_shape

        check_shape(self.slots, self.workers)
        return {"slots": self.slots, "workers": self.workers}


@dataclass(frozen=True)
class Asked:
    """The conditions of trials that are asked for one by one."""

    params: tuple[str, ...] = ()
    """Parameters to change from their defaults, each as NAME=VALUE; those of a strategy other than
    RPS and NPS as STRATEGY.NAME=VALUE."""
    physics: Physics = "default"
    fidelity: Fidelity = "standard"
    engine: Engine = "mjx"
    timestep: float | None = None
    """Length of a physics step [s]; by default that of the physics."""
    control_period: float | None = None
    """Time between two decisions of the law [s]; by default that of the physics."""
    skin: Skin = None
    skin_params: tuple[str, ...] = ()
    """Parameters of the skin to change from their defaults, each as NAME=VALUE."""
    gap: float = 0.02
    """Distance between the base and the object at the start [m]."""
    robot: RobotName = "ideal"
    horizon: float = 300.0
    """Time after which a trial has failed [s]."""
    seed: int = 0
    """Seed of the skin's imperfections."""

    def conditions(self) -> Conditions:
        """The same as the library has them."""
        from rps_jax.robot import skin
        from rps_jax.trials.conditions import Conditions

        known = {f.name for f in dataclasses.fields(Conditions)}
        given = {name: value for name, value in self.__dict__.items() if name in known}
        of_skins = {name for one in skin.SKINS.values() for name in skin.own(one)}
        changes = parsing.assignments("skin-params", self.skin_params, sorted(of_skins))
        return Conditions.of(given | {"skin_params": changes})


@dataclass(frozen=True)
class Recorded(Asked):
    """Such trials, in a run folder of their own."""

    out: Path | None = None
    """Run folder; by default runs/COMMAND-TIME."""
    overwrite: bool = False
    """Whether a run folder that already holds a run may be overwritten."""

    def open(self, command: str, strategies: tuple[str, ...]) -> Path:
        """The run folder, with what was asked and what it runs on already in it."""
        import time

        from rps_jax.record import files, provenance
        from rps_jax.record import folder as run_folder

        out = self.out or Path("runs") / f"{command}-{time.strftime('%Y%m%d-%H%M%S')}"
        running.choose_device("auto")
        run_folder.prepare(out, overwrite=self.overwrite)
        running.use_cache()
        files.write_json(out / "environment.json", provenance.environment())
        files.write_json(out / run_folder.CONFIG, self.configuration(strategies, out))
        return out

    def configuration(self, strategies: tuple[str, ...], out: Path) -> dict[str, Any]:
        """What was asked, and what it means, as JSON."""
        from rps_jax.robot import skin
        from rps_jax.robot.robot import named

        chosen = self.conditions()
        setting, sensor = chosen.setting(), chosen.sensor()
        arms = parsing.arms_of(strategies, self.params)
        return {
            "options": dataclasses.asdict(self) | {"out": str(out)},
            "params": {name: parsing.as_json(params) for name, params in arms.items()},
            "physics": dataclasses.asdict(setting.physics),
            "rules": setting.rules._asdict(),
            "skin": {name: getattr(sensor, name) for name in skin.own(sensor)},
            "robot": dataclasses.asdict(named(self.robot)),
        }


@dataclass(frozen=True)
class StudyOptions(Spread):
    """What every study of the paper's trials takes; its run folder can be continued."""

    out: Path = Path("runs/study")
    """Run folder; a run that was killed is continued there."""
    quick: bool = False
    """Whether to run only four of the paper's 24 targets."""

    def targets(self) -> tuple[tuple[float, float], ...]:
        """The paper's targets, or a few of them."""
        from rps_jax.studies.study import FEW_TARGETS
        from rps_jax.world import paper

        return FEW_TARGETS if self.quick else paper.TARGETS

    @contextlib.contextmanager
    def opened(self) -> Iterator[Path]:
        """The run folder, new or to be continued, in use; the options are checked first."""
        from rps_jax.record import folder, provenance

        self.shape()
        running.choose_device("auto")
        folder.writable(self.out)
        running.use_cache()
        with folder.hold(self.out):
            provenance.sign(self.out)
            yield self.out
