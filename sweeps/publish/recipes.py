"""Recipes of all data files: commands, required device, and the table of the report.

Each command has a run folder in `runs`, which it may name; a command of two recipes is run once.
The table is a section of the report, so that a page shows the same numbers as a reader's run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from sweeps.publish import rows
from sweeps.publish.rows import Rows


class Recipe(NamedTuple):
    """Commands and table of a data file."""

    commands: tuple[str, ...]
    two_cores: float | None  # [min] on two cores; None: hours
    one_gpu: float | None  # [min] on one H100 and 16 cores; None: not faster there
    # Pattern of a section's title, or function from results to rows; "": the study publishes.
    section: str | Callable[[Any], Rows] = ""
    labels: tuple[str, ...] = ()  # first cell of the rows of each command
    columns: tuple[str, ...] = ()  # names of the columns to show; by default all
    note: str = ""
    folder: str = ""  # folder of `sweeps` for a new file

    @property
    def device(self) -> Literal["cpu", "gpu"]:
        """Device: a GPU if two cores need more than an hour, or three times as long."""
        if self.one_gpu is None:
            return "cpu"
        cores = self.two_cores
        return "gpu" if cores is None or cores > min(60, 3 * self.one_gpu) else "cpu"


def _each(command: str, *names: str) -> tuple[str, ...]:
    return tuple(command.format(name) for name in names)


_WIDE, _ALL = ("wide", "hostile"), ("wide", "real", "hostile")
_LADDERS = _each("rps ladder --domain {0} --worlds 10000 --seed 10 --out runs/ladder_{0}", *_WIDE)
_AGAINST = ("", "success", "against rps_tuned", "p (Holm)")
_OBJECTS = ("random_box", "random_cylinder", "random_prism")
_RATES = ("", *_OBJECTS, "all", "median time", "timeout", "lost contact", "fell over")
_MACHINE = "--machine MACHINE"  # MACHINE is replaced by a description
_IDEAL = (
    "wide,skin=ideal,pose_noise=0:0,yaw_noise=0:0,pose_latency=0:0,command_delay=0:0,"
    "velocity_error=0:0"
)
_PLUS = {
    "`wide`, 10,000": _LADDERS[0],
    "`wide` in C MuJoCo, 500": "rps ladder --domain wide --worlds 500 --seed 11 --engine mujoco "
    "--laws rps_plus rps_tuned learned_gru",
    "`hostile`, 10,000": _LADDERS[1],
    "`hostile` in C MuJoCo, 500": "rps ladder --domain hostile --worlds 500 --seed 11 "
    "--engine mujoco --laws rps_plus rps_tuned learned_gru",
    "`hostile`, quasi-static, 1,000": "rps ladder --domain hostile --worlds 1000 --seed 8 "
    "--engine quasistatic --laws rps_plus rps_tuned",
    "`real`, 10,000": "rps ladder --domain real --worlds 10000 --seed 10 "
    "--laws rps rps_tuned rps_plus",
    "`paper`, the paper's grid, 144": "rps ladder --domain paper --seed 7 "
    "--laws rps_plus rps_tuned",
}
_ROBOTS = ("ideal", "kairos", "ridgeback", "mpo_500")
_REAL = "rps sweep --domain real --worlds 4096 --seed 11 --laws rps rps_tuned"
_RACE = "--tuned K_h K_v L beta l_cr d_th --horizon 150 --validation 256 --seed 5"
_DESCENT = f"rps tune grad {_RACE} --starts 2 --worlds 512 --steps 20 --learning-rate 0.2"
_RACERS = " ".join(f"rps,runs/{name}/tuned.json" for name in ("evolution", "gradient", "hybrid"))
_GROUNDS = ("error", "push over mu m g")
_RIVALS = ("rps", "pursuit", "dipole", "force_push", "force_push_published")
_SWEPT = "sweep --laws rps_tuned --domain wide"
_GRADIENTS = "rps sweeps/gradients --worlds 32 --estimators"

# In order of importance, which is the order of computation.
RECIPES: dict[str, Recipe] = {
    "headline": Recipe((f"rps sweeps/random_worlds {_MACHINE}",), None, 30),
    "models": Recipe((f"rps sweeps/random_worlds {_MACHINE}",), None, 30),
    "million": Recipe((f"rps sweeps/random_worlds/million.py {_MACHINE}",), None, 9),
    "rest": Recipe((f"rps sweeps/fidelity/rest.py {_MACHINE}",), 5, None),
    "hardware_[qr]*": Recipe((f"rps sweeps/hardware {_MACHINE}",), None, 20),
    "feet": Recipe(
        (
            "rps sweep --domain wide --laws rps rps_tuned rps_plus --worlds 400",
            "rps sweep --domain wide,feet=0.5:0.9 --laws rps rps_tuned rps_plus --worlds 400",
        ),
        10,
        None,
        "Success",
        ("corners and rims", "three or four feet"),
        _RATES,
    ),
    "table": Recipe(("rps table",), 1, None, "Table II*"),
    "table_mjx": Recipe(("rps table --engine mjx",), 4, None, "Table II*", folder="table"),
    "grid": Recipe(
        ("rps table --laws rps rps_tuned rps_plus learned_gru",), 3, 1, "Table II*", folder="table"
    ),
    "hardware": Recipe(("rps hardware --engine fused",), 4, 2, "Hardware experiments"),
    "shoves": Recipe(("rps hardware --engine fused",), 4, 2, "The object shoved aside"),
    "real_pushes_*": Recipe((f"rps sweeps/real_pushes {_MACHINE}",), 15, None),
    "ladder": Recipe(_LADDERS, None, 6, "Against rps_tuned*", _WIDE, _AGAINST),
    "bearings": Recipe(_LADDERS[:1], None, 3, rows.by_bearing),
    "ceiling": Recipe(
        (*_LADDERS, *_each("rps ceiling runs/ladder_{} --samples 32 --rounds 6", *_WIDE)),
        None,
        20,
        "A planner that knows the world",
        ("", "", *_WIDE),
    ),
    "plus": Recipe(tuple(_PLUS.values()), None, 12, rows.plus_beside_tuned, tuple(_PLUS)),
    "tuned": Recipe(
        ("rps ladder --laws rps rps_tuned --domain wide hostile real --worlds 10000 --seed 4",),
        None,
        4,
        rows.comparison,
    ),
    "random_worlds": Recipe(
        ("rps sweep --domain wide --worlds 36000 --laws rps nps aps",),
        None,
        4,
        "Success",
        (),
        _RATES,
    ),
    "robots": Recipe(
        (
            *_each(
                "rps sweep --domain wide --worlds 4096 --seed 11 --laws rps rps_tuned --robot {}",
                *_ROBOTS,
            ),
            _REAL,
        ),
        None,
        5,
        "Success",
        (*_ROBOTS, "drawn (real)"),
        ("", "all", "median time"),
    ),
    "real": Recipe((_REAL,), None, 1, rows.by_robot),
    "limits": Recipe(
        ("rps sweeps/limits --limits force lag acceleration --worlds 4096",),
        None,
        3,
        "Success over each limit",
    ),
    "sizes": Recipe(
        ("rps sweeps/limits --limits half_width pitch --worlds 2048",),
        None,
        4,
        "Success at each size",
    ),
    "sensitivity": Recipe(
        (
            "rps sensitivity --law rps_tuned --domain hostile --worlds 16384",
            "rps sensitivity --law rps_plus --domain hostile --worlds 16384",
            "rps sensitivity --law rps_tuned --domain real --worlds 16384",
        ),
        None,
        4,
        rows.largest_indices,
        ("rps_tuned, hostile", "rps_plus, hostile", "rps_tuned, real"),
    ),
    "rare": Recipe(
        (
            "rps sweeps/failures/drawn.py --law rps --domain wide,distance=1:1.2 --engine "
            "quasistatic --horizon 100 --beyond 0.3 --particles 200 --groups 5 --repetitions 20 "
            "--brute 2000",
        ),
        5,
        None,
        rows.rare_failures,
    ),
    "rare_million": Recipe(
        (
            "rps rare --law rps_plus --domain wide --particles 1000 --groups 10 --share 0.5 "
            "--repetitions 20",
        ),
        None,
        3,
        rows.rare_failures,
    ),
    "attack": Recipe(
        (
            "rps attack --law rps_tuned --domain wide --minutes 3.5 --batch 64 --repeats 3 "
            "--drawn 600 --check-again 8",
            "rps attack --law rps_plus --domain wide --minutes 13 --batch 128 --repeats 2 "
            "--drawn 256 --check-again 24",
            "rps attack --law rps_plus --domain wide --axes height size friction_ground "
            "--minutes 5 --batch 96 --repeats 2 --drawn 64 --check-again 12",
        ),
        30,
        None,
        rows.attack_table,
        ("rps_tuned", "rps_plus", "rps_plus, three axes"),
    ),
    "regression": Recipe(("rps regress --laws rps rps_tuned rps_plus learned_gru",), 3, 1, "Wins"),
    "readings": Recipe(("rps sweeps/ambiguities",), 15, 4, "Readings, *"),
    "readings_plus": Recipe(
        (
            "rps sweeps/ambiguities --laws rps_plus",
            "rps sweeps/ambiguities --gazebo --laws rps_plus --readings paper_gazebo pyramid thin",
        ),
        15,
        4,
        "Readings, *",
    ),
    "gazebo": Recipe(
        ("rps sweeps/ambiguities --gazebo --readings paper_gazebo",), 12, 2, "Cells of Table II"
    ),
    "gazebo_parts": Recipe(
        ("rps sweeps/ambiguities --gazebo --laws rps --readings paper_gazebo pyramid thin",),
        8,
        None,
        "Readings, *",
        folder="ambiguities",
    ),
    "fidelity": Recipe(
        ("rps sweeps/fidelity",),
        60,
        10,
        "Settings of the solver*",
        (),
        (
            "setting",
            "equal outcomes",
            "95 %",
            "+/-",
            "McNemar p",
            "5 s error: median, 95 %",
            "cost",
        ),
    ),
    "engines_ideal": Recipe(
        (
            f"rps sweeps/engines --domain {_IDEAL} --worlds 240 --engines 'C, reference' "
            "'C, reference, moved' 'fused, standard' 'fused, 5 ms' 'C, standard' 'MJX, standard'",
        ),
        25,
        4,
        "Equal outcomes",
    ),
    "engines_wide": Recipe(
        (
            "rps sweeps/engines --domain wide --worlds 240 --engines 'C, reference' "
            "'C, reference, moved' 'C, standard' 'fused, standard' 'fused, 5 ms' 'fused, fast' "
            "'MJX, standard' quasistatic",
        ),
        25,
        4,
        "Equal outcomes",
    ),
    "ground": Recipe(
        ("rps sweeps/ground",),
        30,
        None,
        "Grounds beside a rigid object",
        (),
        (
            "ground",
            *(f"{column}, {speed} cm/s" for speed in (1, 5, 20) for column in _GROUNDS),
            "height of the push",
            "largest hop",
            "aloft",
        ),
    ),
    "force_push_grid": Recipe(("rps sweeps/force_push_grid",), 4, None, "Pushes that succeed"),
    "mends": Recipe(
        _each("rps sweeps/mends --domain {} --worlds 4096 --seed 80", *_WIDE[::-1]),
        None,
        6,
        "Against*",
        _WIDE[::-1],
        ("", "success", "against P1, P2 outside the Realignment State", "p (Holm)"),
    ),
    "rivals_tuned": Recipe(
        (
            *_each(
                "rps tune es --law {0} --domain wide hostile --worlds 16 --population 12 "
                "--generations 200 --budget 400000 --validation 64 --out runs/tuned_{0}",
                *_RIVALS,
            ),
            "rps ladder --domain wide --worlds 1000 --seed 10 --laws "
            + " ".join(f"{law} {law},runs/tuned_{law}/tuned.json" for law in _RIVALS),
        ),
        None,
        10,
        rows.default_beside_tuned,
    ),
    "race": Recipe(
        (
            f"rps tune es {_RACE} --population 16 --worlds 64 --budget 2.4e6 --out runs/evolution",
            f"{_DESCENT} --budget 2.4e6 --out runs/gradient",
            f"{_DESCENT} --budget 1.2e6 --out runs/half",
            f"rps tune es {_RACE} --law rps,runs/half/tuned.json --spread 0.2 --prior 0.01 "
            "--population 16 --worlds 64 --budget 1.2e6 --out runs/hybrid",
            f"rps ladder --laws rps {_RACERS} --domain paper wide hostile --worlds 1000 --seed 3",
        ),
        None,
        15,
        rows.comparison,
    ),
    "gradients": Recipe(
        (
            f"{_GRADIENTS} reverse clipped evolution combined",
            f"{_GRADIENTS} reverse clipped evolution combined --object random_cylinder",
            f"{_GRADIENTS} forward --horizons 0.5 2 8 30",
        ),
        None,
        30,
        rows.cosines,
        ("boxes", "cylinders", "boxes"),
    ),
    "robot": Recipe((f"rps sweeps/speed/robot.py {_MACHINE}",), 1, None),
    "dependencies": Recipe((f"rps sweeps/publish/dependencies.py {_MACHINE}",), 15, None),
    "extras": Recipe((f"rps sweeps/publish/dependencies.py {_MACHINE}",), 15, None),
    "fit_*": Recipe((f"rps sweeps/fit {_MACHINE}", f"rps sweeps/fit/bags.py {_MACHINE}"), 20, None),
    "export_*": Recipe(
        (
            f"rps sweeps/export --tables speed {_MACHINE}",
            f"rps sweeps/export --tables trials paper worlds bags odd {_MACHINE}",
            f"rps sweeps/export --tables inputs {_MACHINE}",
        ),
        60,
        None,
    ),
    "sb3": Recipe((f"rps sweeps/learned/sb3.py {_MACHINE}",), 3, None),
    # --- speed, with nothing else running ---
    "speed": Recipe(
        (
            "rps sweeps/speed --names 'C in closed loop' 'fused standard' 'fused fast' quasistatic "
            "--worlds 64 4096 262144 --at-once 16 --refill 0",
        ),
        None,
        6,
        rows.speeds,
    ),
    "speed_cores": Recipe(
        (
            "rps sweeps/speed --names 'fused standard' 'C in closed loop' 'C, mj_step alone' "
            "'mjx standard' --worlds 24 64 --refill 0",
        ),
        3,
        None,
        rows.speeds,
    ),
    "commands": Recipe((f"rps sweeps/speed/commands.py {_MACHINE}",), 14, None),
    "compilers": Recipe((f"rps sweeps/speed/compilers.py {_MACHINE}",), 5, None),
    "compilers_gpu": Recipe(
        (
            f"rps sweeps/speed/compilers.py --against cpu --worlds 4000 --file compilers_gpu "
            f"{_MACHINE}",
        ),
        None,
        2,
    ),
    "kernel": Recipe((f"rps sweeps/speed/kernel.py {_MACHINE}",), None, 3),
    "commands_gpu": Recipe(
        (
            "rps sweeps/speed/commands.py --commands "
            + " ".join(f"'{_SWEPT} --worlds {n}'" for n in (1000, 10_000, 262_144))
            + f" --gpus 1 --warm 1000 10000 --file commands_gpu {_MACHINE}",
        ),
        None,
        8,
    ),
    "gpus": Recipe(
        (
            f"rps sweeps/speed/commands.py --file gpus --gpus 1 2 --commands '{_SWEPT} "
            f"--worlds 262144' {_MACHINE}",
        ),
        None,
        6,
        folder="speed",
    ),
    # After `python sweeps/speed/peers.py peers`.
    "arena": Recipe((f"rps sweeps/speed/arena.py --peers peers {_MACHINE}",), None, 5),
    "costs": Recipe(
        (
            "rps sweeps/speed/costs.py --names 'fused standard' 'mjx standard' --families box "
            "prism --most 3",
        ),
        4,
        None,
        "Functions",
    ),
    "levers": Recipe(
        (
            "rps sweeps/levers --program 'fused standard' --worlds 65536 --at-once 16",
            "rps sweeps/levers --program 'mjx standard' --worlds 4096 --simulated 1 --goes 3",
        ),
        None,
        8,
        "*, box",
        (),
        ("what", "lever", "worlds", "simulated s/s", "times"),
    ),
}

# Files of old versions, which are not computed again.
HISTORY = {
    "tuning_runs": "the runs of 0.1.0 and 0.2.0 that tuned the law",
    "learned": "the runs of 0.2.0 that trained the laws; `rps sweeps/learned` reads such runs",
}
