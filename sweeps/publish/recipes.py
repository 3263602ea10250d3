"""How every data file is made anew: its commands, what they need, and which table of the report.

The commands of a recipe are those of its data file. Each has a run folder in `runs`, its own or
the one that it names; one that stands in two recipes is run once. The table is that of a section of
the report, so that a page shows what the run of a reader prints.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from rps_jax.studies.attack import yields

Rows = list[list[str]]


def _by_bearing(found: xr.Dataset) -> Rows:
    """Header and a row for each law of a ladder: success by the target's bearing."""
    ends, off = (0.0, 0.3, 0.8, 1.6, np.inf), np.abs(found.bearing.values)
    parts = [(off >= low) & (off < high) for low, high in itertools.pairwise(ends)]
    rows = [["law", "senses", "target within 0.3 rad of ahead", "0.3 to 0.8 rad", "0.8 to 1.6 rad",
             "beside and behind, above 1.6 rad"]]  # fmt: skip
    laws = sorted(map(str, found.law.values), key=lambda n: -float(found.success.sel(law=n).mean()))
    for law in laws:
        one = found.sel(law=law)
        rates = [f"{100 * (one.success.values[part] > 0).mean():.0f} %" for part in parts]
        rows.append([law, str(one.senses.item()), *rates])
    return rows


def _searched(found: xr.Dataset) -> Rows:
    """Header and rows of an attack: its search, and the drawn worlds beside it."""
    gain, tried = yields(found), np.isfinite(found.again.values)
    bad = int((found.again.values == 1).sum())
    return [
        ["", "trials", "simulated [h]", "cells with a failure", "such cells for each simulated "
         "hour", "elites that fail again in converged C MuJoCo"],
        ["search", f"{int(found.trials[-1]):,}", f"{float(found.simulated[-1]) / 3600:.1f}",
         str(int(found.failing[-1])), f"{gain['search']:.2g}", f"{bad} of {int(tried.sum())}"],
        ["drawn worlds", f"{found.attrs['drawn_trials']:,}",
         f"{found.attrs['drawn_simulated'] / 3600:.1f}", str(found.attrs["drawn_failing"]),
         f"{gain['drawn']:.2g}", ""],
    ]  # fmt: skip


class Recipe(NamedTuple):
    """How a data file is made."""

    commands: tuple[str, ...]
    two_cores: float | None  # [min] on two cores; None: hours
    one_gpu: float | None  # [min] on one H100 and 16 cores; None: no better there
    # Pattern of the title of the report's section, or the table of the answer; "": the study writes
    # its own file.
    section: str | Callable[[Any], Rows] = ""
    of: tuple[str, ...] = ()  # what stands before the rows of each command, if it has any
    columns: tuple[str, ...] = ()  # those that are shown, by their names; by default all
    note: str = ""
    folder: str = ""  # of `sweeps`, where a file is that was not made before

    @property
    def device(self) -> Literal["cpu", "gpu"]:
        """Where it is made: on a GPU if two cores need more than an hour, or thrice as long."""
        if self.one_gpu is None:
            return "cpu"
        cores = self.two_cores
        return "gpu" if cores is None or cores > min(60, 3 * self.one_gpu) else "cpu"


def _each(command: str, *names: str) -> tuple[str, ...]:
    return tuple(command.format(name) for name in names)


_WIDE, _ALL = ("wide", "hostile"), ("wide", "real", "hostile")
_LADDERS = _each("rps ladder --domain {0} --worlds 10000 --seed 10 --out runs/ladder_{0}", *_WIDE)
_AGAINST = ("", "success", "against rps_tuned", "p (Holm)")
_RATES = ("", "boxes", "cylinders", "prisms", "all", "CVaR 5 % of distance", "median time")
_MACHINE = "--machine MACHINE"  # in its place come the words for the machine
_IDEAL = (
    "wide,skin=ideal,pose_noise=0:0,yaw_noise=0:0,pose_latency=0:0,command_delay=0:0,"
    "velocity_error=0:0"
)
_PLUS = {
    "wide, 10,000": _LADDERS[0],
    "wide in C MuJoCo, 500": "rps ladder --domain wide --worlds 500 --seed 11 --engine mujoco "
    "--laws rps_plus rps_tuned learned_gru",
    "hostile, 10,000": _LADDERS[1],
    "hostile in C MuJoCo, 500": "rps ladder --domain hostile --worlds 500 --seed 11 "
    "--engine mujoco --laws rps_plus rps_tuned learned_gru",
    "hostile, quasi-static, 1,000": "rps ladder --domain hostile --worlds 1000 --seed 8 "
    "--engine quasistatic --laws rps_plus rps_tuned",
    "real, 10,000": "rps ladder --domain real --worlds 10000 --seed 10 "
    "--laws rps rps_tuned rps_plus",
    "the paper's grid": "rps ladder --domain paper --seed 7 --laws rps_plus rps_tuned",
}
_ROBOTS = ("ideal", "kairos", "ridgeback", "mpo_500")

# In the order of their weight, in which they are made.
RECIPES: dict[str, Recipe] = {
    "headline": Recipe((f"rps sweeps/headline {_MACHINE}",), None, 30),
    "models": Recipe((f"rps sweeps/headline {_MACHINE}",), None, 30),
    "million": Recipe((f"rps sweeps/million --laws rps_tuned {_MACHINE}",), None, 3),
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
        ("the outline", "feet"),
    ),
    "table": Recipe(("rps table",), 4, None, "Table II*"),
    "grid": Recipe(
        ("rps table --laws rps rps_tuned rps_plus learned_gru --engine fused",),
        3,
        1,
        "Table II*",
        folder="table",
    ),
    "hardware": Recipe(("rps hardware --engine fused",), 4, 2, "Hardware experiments"),
    "shoves": Recipe(("rps hardware --engine fused",), 4, 2, "The object shoved aside"),
    "real_pushes_*": Recipe((f"rps sweeps/real_pushes {_MACHINE}",), 15, None),
    "ladder": Recipe(_LADDERS, None, 6, "Against rps_tuned*", _WIDE, _AGAINST),
    "bearings": Recipe(_LADDERS[:1], None, 3, _by_bearing),
    "ceiling": Recipe(
        (*_LADDERS, *_each("rps ceiling runs/ladder_{} --samples 32 --rounds 6", *_WIDE)),
        None,
        20,
        "A planner that knows the world",
        ("", "", *_WIDE),
    ),
    "plus": Recipe(
        tuple(_PLUS.values()),
        None,
        12,
        "Against rps_tuned*",
        tuple(_PLUS),
        _AGAINST,
    ),
    "tuned": Recipe(
        ("rps compare --laws rps rps_tuned --domain wide hostile real --seed 4",),
        None,
        4,
        "Success in *",
        (),
        _RATES,
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
            "rps sweep --domain real --worlds 4096 --seed 11 --laws rps rps_tuned",
        ),
        None,
        5,
        "Success",
        (*_ROBOTS, "drawn (real)"),
        ("", "all", "median time"),
    ),
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
        "Which quantity is to blame",
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
        "How rare is a failure",
    ),
    "rare_million": Recipe(
        (
            "rps rare --law rps_plus --domain wide --particles 1000 --groups 10 --share 0.5 "
            "--repetitions 20",
        ),
        None,
        3,
        "How rare is a failure",
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
        _searched,
        ("rps_tuned", "rps_plus", "rps_plus, three axes"),
    ),
    "regression": Recipe(("rps regress --laws rps rps_tuned rps_plus learned_gru",), 3, 1, "Wins"),
    "readings": Recipe(("rps sweeps/ambiguities",), 15, 4, "Readings, *"),
    "readings_plus": Recipe(("rps sweeps/ambiguities --laws rps_plus",), 15, 4, "Readings, *"),
    "gazebo": Recipe(
        ("rps sweeps/ambiguities --gazebo --readings paper_gazebo",),
        12,
        2,
        "Cells of Table II",
    ),
    "fidelity": Recipe(("rps sweeps/fidelity",), 60, 10, "Settings of the solver*"),
    "engines_random": Recipe(
        (
            "rps sweeps/engines --objects random_box random_cylinder --worlds 600",
            "rps sweeps/engines --objects random_prism --worlds 300",
        ),
        60,
        8,
        "Equal outcomes",
        ("boxes and cylinders", "prisms"),
        ("engine", "equal outcomes", "95 %", "+/-"),
    ),
    "engines_ideal": Recipe(
        (
            f"rps sweeps/engines --domain {_IDEAL} --worlds 240 --engines 'C, reference' "
            "'fused, standard' 'fused, 5 ms' 'C, standard' 'MJX, standard'",
        ),
        25,
        4,
        "Equal outcomes",
    ),
    "engines_wide": Recipe(
        (
            "rps sweeps/engines --domain wide --worlds 240 --engines 'C, reference' "
            "'C, reference, moved' 'fused, 10 ms' 'fused, 5 ms'",
        ),
        25,
        4,
        "Equal outcomes",
    ),
    "ground": Recipe(("rps sweeps/ground",), 30, None, "Grounds beside a rigid object"),
    "force_push_grid": Recipe(("rps sweeps/force_push_grid",), 4, None, "Pushes that succeed"),
    "mends": Recipe(
        _each("rps sweeps/mends --domain {} --worlds 4096 --seed 80", *_WIDE[::-1]),
        None,
        6,
        "Against*",
        _WIDE[::-1],
        ("", "success", "against P1, P2 outside the Realignment State", "p (Holm)"),
    ),
    "fit_*": Recipe((f"rps sweeps/fit {_MACHINE}",), 40, None),
    "export_*": Recipe(
        (
            f"rps sweeps/export --tables inputs trials speed odd {_MACHINE}",
            f"rps sweeps/export --tables paper --laws rps rps_tuned rps_plus learned_mlp "
            f"{_MACHINE}",
            f"rps sweeps/export --tables worlds --laws rps_plus --worlds 200 {_MACHINE}",
        ),
        40,
        None,
    ),
    "sb3": Recipe((f"rps sweeps/learned/sb3.py {_MACHINE}",), 3, None),
    # --- speed, with nothing else running ---
    "gpus": Recipe(
        ("rps sweep --domain wide --laws rps --worlds 262144 --part 16384",),
        None,
        2,
        "Success",
        (),
        _RATES,
    ),
    "speed": Recipe(
        ("rps sweeps/speed --worlds 64 4096 65536 262144 --mujocos 4096 --at-once 16 --refill 0",),
        None,
        6,
        "Simulated seconds in a second",
    ),
    "speed_cores": Recipe(
        (
            "rps sweeps/speed --names 'fused standard' 'C in closed loop' 'C, mj_step alone' "
            "'mjx standard' --worlds 24 64 --refill 0",
        ),
        3,
        None,
        "Simulated seconds in a second",
    ),
    "speed_peers": Recipe(
        (
            "rps sweeps/speed --names 'fused standard' 'mjx standard' 'C in closed loop' "
            "'C, mj_step alone' 'C, one trial at a time' --worlds 32768 --mujocos 32768 "
            "--families box cylinder --at-once 16 --refill 0",
        ),
        None,
        6,
        "Simulated seconds in a second",
    ),
    "commands": Recipe((f"rps sweeps/speed/commands.py {_MACHINE}",), 8, None),
    # After `python sweeps/speed/peers.py peers`.
    "arena": Recipe((f"rps sweeps/speed/arena.py --peers peers {_MACHINE}",), None, 5),
    "costs": Recipe(("rps sweeps/speed/costs.py --families box prism",), 2, None, "Functions"),
    "levers": Recipe(
        (
            "rps sweeps/levers --program 'fused standard' --worlds 65536 --at-once 16",
            "rps sweeps/levers --program 'mjx standard' --worlds 4096 --simulated 1 --goes 3",
        ),
        None,
        8,
        "*, box",
        ("fused standard", "mjx standard"),
    ),
}

# What is not made anew, and why.
BY_HAND = {
    "summary": "cites other tables",
    "notebook_runs": "lists what the notebooks read",
    "dependencies": "sizes of what pip installs in an empty environment",
    "extras": "sizes of what pip installs in an empty environment",
    "robot": "times of notebooks/examples/on_a_robot.py, which prints them",
    "tuning_runs": "the runs of 0.1.0 and 0.2.0 that made the tuned law",
    "learned": "the runs of 0.2.0 that made the learned laws; `rps sweeps/learned` reads them",
    "race": "a race of 0.1.0, by an optimiser that is no longer used",
    "gradients": "three runs of 0.1.0, of which one takes more than an hour",
    "rivals_tuned": "five runs of `rps tune es`, whose laws were then compared",
    "mends_together": "mends of 0.2.0 upon each other, of which RPS+ was made",
    "real": "the worlds of robots.json, by the limits of their robots",
    "table_time": "wall clocks of whole commands, by the shell",
    "speed_goals": "wall clocks of whole commands before and after changes",
    "gpu_sweeps": "wall clocks of whole commands before and after changes",
    "compile": "said by the column `compile` of `rps sweeps/speed`",
    "fast": "two runs of `rps sweep`, whose rates of simulation are printed",
    "tuned_elsewhere": "rows of 0.1.0, for comparison",
    "engines": "the first column is prose; its rates are those of fidelity.json",
}
