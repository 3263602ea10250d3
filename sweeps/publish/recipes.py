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

    @property
    def device(self) -> Literal["cpu", "gpu"]:
        """Device: a GPU if two cores need more than an hour, or three times as long."""
        if self.one_gpu is None:
            return "cpu"
        cores = self.two_cores
        return "gpu" if cores is None or cores > min(60, 3 * self.one_gpu) else "cpu"


def recipe(
    *commands: str, cores: float | None = None, gpu: float | None = None, **table: Any
) -> Recipe:
    """Return a recipe with the minutes that its commands take on two cores and on one GPU."""
    return Recipe(commands, cores, gpu, **table)


def _filled(command: str, *names: str) -> tuple[str, ...]:
    return tuple(command.format(name) for name in names)


_WIDE = ("wide", "hostile")
_LADDERS = _filled("rps ladder --domain {0} --worlds 10000 --seed 10 --out runs/ladder_{0}", *_WIDE)
_AGAINST = ("", "success", "against rps_tuned", "p (Holm)")
_OBJECTS = ("random_box", "random_cylinder", "random_prism")
_RATES = ("", *_OBJECTS, "all", "median time", "timeout", "lost contact", "fell over")
_MACHINE = "--machine MACHINE"  # MACHINE is replaced by a description
_IDEAL = (
    "wide,skin=ideal,pose_noise=0:0,yaw_noise=0:0,pose_latency=0:0,command_delay=0:0,"
    "velocity_error=0:0"
)
_CORRIDOR = "--domain wide --horizon 600 --task corridor,length=10,lookahead=0.95"
_BETWEEN_WALLS = {
    "corridors of 1.1 to 1.6 m, turns of 45°": f"{_CORRIDOR},width=1.1:1.6,turn_angle=0.785:0.786"
    " --worlds 1500",
    "corridors of 1.1 to 2.5 m": f"{_CORRIDOR},width=1.1:2.5,turn_angle=0:1.57 --worlds 3000",
    **{f"`{name}`": f"--domain {name} --worlds 2000" for name in ("hostile", "real", "wide")},
}
_PLUS = {
    "`wide`, 10,000": "rps ladder --domain wide --worlds 10000 --seed 10 --laws rps_plus rps_tuned",
    "`wide` in C MuJoCo, 500": "rps ladder --domain wide --worlds 500 --seed 11 --engine mujoco "
    "--laws rps_plus rps_tuned",
    "`hostile`, 10,000": "rps ladder --domain hostile --worlds 10000 --seed 10 "
    "--laws rps_plus rps_tuned",
    "`hostile` in C MuJoCo, 500": "rps ladder --domain hostile --worlds 500 --seed 11 "
    "--engine mujoco --laws rps_plus rps_tuned",
    "`hostile`, quasi-static, 1,000": "rps ladder --domain hostile --worlds 1000 --seed 8 "
    "--engine quasistatic --laws rps_plus rps_tuned",
    "`real`, 10,000": "rps ladder --domain real --worlds 10000 --seed 10 --laws rps_plus rps_tuned",
    "`paper`, the paper's grid, 144": "rps ladder --domain paper --seed 7 "
    "--laws rps_plus rps_tuned",
}
_HARDWARE = {
    "`rps`, slipping": "",
    "`rps`, ideal": " --robot ideal",
    "`rps_unsaturated`, slipping": " --law rps_unsaturated",
    "`rps_unsaturated`, ideal": " --law rps_unsaturated --robot ideal",
}
_ROBOTS = ("ideal", "kairos", "ridgeback", "mpo_500")
_IN_WIDE = "sweep --domain wide --worlds 1000 --seed 9243"
_WITH_AN_AXLE = ("turtlebot4", "jackal", "husky", "mir100", "pioneer_3dx")
_REAL = "rps sweep --domain real --worlds 4096 --seed 11 --laws rps rps_tuned"
_FORMER = "sweeps/learned/learned_0_4.npz"  # `learned` of 0.4
_LEARNED = _filled(
    "rps sweep --domain {0} --worlds 10000 --seed 5301 "
    "--laws rps_plus sweeps/learned/learned_gru.npz learned --out runs/learned_{0}",
    *_WIDE,
    "real",
)
_TABLES = "rps tune grad --law sweeps/gradients/tables.py"
_PLUS_TABLES = ("Plus64", "Plus2048")
_HOSTILE = (
    "--windows 512 --trials 128 --validation 512 --checks 128 --worlds 256 --steps 12 --horizon 200"
)
_WINDOWS = (
    "rps learn --initial learned --action-std 0.2 --learning-rate 2e-4 --domain wide hostile "
    "--num-envs 1024 --drawn 8192 --validation 128 --every 1.5 --horizon 300 --max-lost 150 "
    "--prioritised 0.5 --success 2 --failure 1 --anneal 0.4 --ema-updates 100 --minutes 4.5 "
    "--out runs/ppo",
    "rps tune grad --law sweeps/learned/weights.py:Weights --domain wide hostile --windows 512 "
    "--trials 64 --validation 128 --checks 256 --worlds 256 --steps 60 --window-steps 60 "
    "--refresh 10 --learning-rate 0.01 --sigma 0.02 --horizon 100 --fidelity fast --minutes 3.5 "
    "--out runs/windows",
)
_RIVALS = ("rps", "pursuit", "dipole", "force_push", "force_push_published")
_SWEPT = "sweep --laws rps_tuned --domain wide"


# In order of importance, which is the order of computation.
RECIPES: dict[str, Recipe] = {
    "headline": recipe(f"rps sweeps/random_worlds {_MACHINE}", gpu=20),
    "models": recipe(f"rps sweeps/random_worlds {_MACHINE}", gpu=20),
    "million": recipe(f"rps sweeps/random_worlds/million.py {_MACHINE}", gpu=9),
    "rest": recipe(f"rps sweeps/fidelity/rest.py {_MACHINE}", cores=5),
    "reading_*": recipe(f"rps sweeps/paper_reading {_MACHINE}", gpu=10),
    "feet": recipe(
        "rps sweep --domain wide --laws rps rps_tuned rps_plus --worlds 4000 --seed 7007",
        "rps sweep --domain wide,feet=0.5:0.9 --laws rps rps_tuned rps_plus --worlds 4000 "
        "--seed 7007",
        gpu=2,
        section="Success",
        labels=("corners and rims", "three or four feet"),
        columns=_RATES,
    ),
    "table": recipe("rps table", cores=1, section="Table II*"),
    "table_mjx": recipe("rps table --engine mjx", cores=4, section="Table II*"),
    "grid": recipe(
        "rps table --laws rps rps_tuned rps_plus learned",
        cores=3,
        gpu=1,
        section="Table II*",
    ),
    "hardware": recipe(
        *_filled("rps hardware --engine fused{}", *_HARDWARE.values()),
        cores=2,
        section="Hardware experiments",
        labels=tuple(_HARDWARE),
    ),
    "shoves": recipe("rps hardware --engine fused", cores=1, section="The object shoved aside"),
    "real_pushes_*": recipe(f"rps sweeps/real_pushes {_MACHINE}", cores=15),
    "ladder": recipe(
        *_LADDERS, gpu=6, section="Against rps_tuned*", labels=_WIDE, columns=_AGAINST
    ),
    "bearings": recipe(*_LADDERS[:1], gpu=3, section=rows.by_bearing),
    "ceiling": recipe(
        *_LADDERS,
        *_filled("rps ceiling runs/ladder_{} --samples 32 --rounds 6", *_WIDE),
        gpu=20,
        section="A planner that knows the world",
        labels=("", "", *_WIDE),
    ),
    "plus": recipe(
        *tuple(_PLUS.values()),
        cores=45,
        gpu=8,
        section=rows.plus_beside_tuned,
        labels=tuple(_PLUS),
    ),
    "tuned": recipe(
        "rps ladder --laws rps rps_tuned --domain wide hostile real --worlds 10000 --seed 4",
        gpu=4,
        section=rows.comparison,
    ),
    "saturation": recipe(
        "rps ladder --laws rps_unsaturated rps rps_tuned --domain wide hostile real "
        "--worlds 10000 --seed 4",
        cores=10,
        gpu=4,
        section=rows.comparison,
    ),
    "random_worlds": recipe(
        "rps sweep --domain wide --worlds 36000 --laws rps nps aps",
        gpu=4,
        section="Success",
        columns=_RATES,
    ),
    "robots": recipe(
        *_filled(
            "rps sweep --domain wide --worlds 4096 --seed 11 --laws rps rps_tuned --robot {}",
            *_ROBOTS,
        ),
        _REAL,
        gpu=5,
        section="Success",
        labels=(*_ROBOTS, "drawn (real)"),
        columns=("", "all", "median time"),
    ),
    "real": recipe(_REAL, gpu=1, section=rows.by_robot),
    "limits": recipe(
        "rps sweeps/limits --limits force lag acceleration --worlds 16384",
        cores=11,
        gpu=4,
        section="Success over each limit",
    ),
    "sizes": recipe(
        "rps sweeps/limits --limits half_width pitch --worlds 2048",
        gpu=4,
        section="Success at each size",
    ),
    "sensitivity": recipe(
        "rps sensitivity --law rps_tuned --domain hostile --worlds 16384",
        "rps sensitivity --law rps_plus --domain hostile --worlds 16384",
        "rps sensitivity --law rps_tuned --domain real --worlds 16384",
        gpu=4,
        section=rows.largest_indices,
        labels=("rps_tuned, hostile", "rps_plus, hostile", "rps_tuned, real"),
    ),
    "rare": recipe(
        "rps sweeps/failures/drawn.py --law rps --domain wide,distance=1:1.2 --engine "
        "quasistatic --horizon 100 --beyond 0.3 --particles 200 --groups 5 --repetitions 20 "
        "--brute 2000",
        cores=5,
        section=rows.rare_failures,
    ),
    "rare_million": recipe(
        "rps rare --law rps_plus --domain wide --particles 1000 --groups 10 --share 0.5 "
        "--repetitions 20",
        gpu=3,
        section=rows.rare_failures,
    ),
    "attack": recipe(
        "rps attack --law rps_tuned --domain wide --minutes 3.5 --batch 64 --repeats 3 "
        "--drawn 600 --check-again 8",
        "rps attack --law rps_plus --domain wide --minutes 6 --batch 128 --repeats 2 "
        "--drawn 256 --check-again 24",
        "rps attack --law rps_plus --domain wide --axes height size friction_ground "
        "--minutes 4 --batch 96 --repeats 2 --drawn 64 --check-again 12",
        cores=30,
        section=rows.attack_table,
        labels=("rps_tuned", "rps_plus", "rps_plus, three axes"),
    ),
    "regression": recipe(
        "rps regress --laws rps rps_tuned rps_plus learned", cores=3, gpu=1, section="Successes"
    ),
    "readings": recipe("rps sweeps/ambiguities", cores=15, gpu=4, section="Readings, *"),
    "readings_plus": recipe(
        "rps sweeps/ambiguities --laws rps_plus",
        "rps sweeps/ambiguities --gazebo --laws rps_plus --readings paper_gazebo pyramid thin",
        cores=15,
        gpu=4,
        section="Readings, *",
    ),
    "gazebo": recipe(
        "rps sweeps/ambiguities --gazebo --readings paper_gazebo",
        cores=12,
        gpu=2,
        section="Cells of Table II",
    ),
    "gazebo_parts": recipe(
        "rps sweeps/ambiguities --gazebo --laws rps --readings paper_gazebo pyramid thin",
        cores=8,
        section="Readings, *",
    ),
    "fidelity": recipe(
        "rps sweeps/fidelity",
        cores=60,
        gpu=10,
        section="Settings of the solver*",
    ),
    "engines_ideal": recipe(
        f"rps sweeps/engines --domain {_IDEAL} --worlds 240 --engines 'C, reference' "
        "'C, reference, moved' 'fused, standard' 'fused, 5 ms' 'C, standard' 'MJX, standard'",
        cores=25,
        gpu=4,
        section="Equal outcomes",
    ),
    "engines_wide": recipe(
        "rps sweeps/engines --domain wide --worlds 240 --engines 'C, reference' "
        "'C, reference, moved' 'C, standard' 'fused, standard' 'fused, 5 ms' 'fused, fast' "
        "'MJX, standard' quasistatic",
        cores=25,
        gpu=4,
        section="Equal outcomes",
    ),
    "ground": recipe(
        "rps sweeps/ground",
        cores=30,
        section="Grounds beside a rigid object",
    ),
    "straight": recipe(f"rps sweeps/ground/straight.py {_MACHINE}", cores=4),
    "support*": recipe(
        f"rps sweeps/ground/support.py --worlds 1000 --repeats 6 {_MACHINE}", cores=1
    ),
    "force_push_grid": recipe("rps sweeps/force_push_grid", cores=4, section="Pushes that succeed"),
    "rivals_tuned": recipe(
        *_filled(
            "rps tune es --law {0} --domain wide hostile --worlds 16 --population 12 "
            "--generations 200 --budget 400000 --validation 64 --out runs/tuned_{0}",
            *_RIVALS,
        ),
        "rps ladder --domain wide --worlds 1000 --seed 10 --laws "
        + " ".join(f"{law} {law},runs/tuned_{law}/tuned.json" for law in _RIVALS),
        gpu=10,
        section=rows.default_beside_tuned,
    ),
    "round_base": recipe(
        "rps sweeps/round_base --worlds 3000", cores=60, gpu=1, section="Flat against round"
    ),
    "round_base_fine": recipe(
        "rps sweeps/round_base --worlds 400 --laws rps rps_tuned --fidelity reference",
        cores=10,
        gpu=2,
        section="Flat against round",
    ),
    "pose_paths": recipe(f"rps sweeps/pose/paths.py --worlds 300 {_MACHINE}", cores=35),
    "pose_parity": recipe(f"rps sweeps/pose/parity.py --worlds 300 {_MACHINE}", cores=10),
    **dict.fromkeys(
        ("pose", "pose_failures"), recipe(f"rps sweeps/pose --worlds 10000 {_MACHINE}", gpu=2)
    ),
    "pose_sight": recipe(f"rps sweeps/pose/sight.py {_MACHINE}", gpu=2),
    "drives": recipe(f"rps sweeps/drives {_MACHINE}", cores=35, gpu=6),
    "drives_omni": recipe(
        "rps sweeps/drives --bases 'holonomic, rps_plus' 'holonomic, rps_reposition' "
        "'round, holonomic, rps_plus' 'round, holonomic, rps_reposition' --file drives_omni "
        + _MACHINE,
        cores=15,
        gpu=5,
    ),
    "drives_tasks": recipe(
        "rps sweeps/drives --domains paths 'corridors of 2 m' 'corridors of 2 m, lookahead 1 m' "
        f"--bases 'holonomic, rps_plus' differential --file drives_tasks {_MACHINE}",
        gpu=4,
    ),
    "drives_engines": recipe(f"rps sweeps/drives/engines.py {_MACHINE}", cores=40, gpu=4),
    "drives_learned": recipe(
        "rps learn --robot ideal,drive=differential --domain wide --num-envs 1024 --drawn 8192 "
        "--horizon 180 --max-lost 60 --discount-time 60 --gae-time 10 --minutes 6.2 "
        "--out runs/learn_differential",
        "rps sweep --domain wide --robot ideal,drive=differential --worlds 1000 --seed 9242 "
        "--laws unicycle runs/learn_differential/policy.npz --out runs/learned_differential",
        gpu=8,
        section="Success",
        columns=_RATES,
    ),
    "presets": recipe(
        *_filled(
            f"rps {_IN_WIDE} --robot {{0}} --laws unicycle --out runs/preset_{{0}}", *_WITH_AN_AXLE
        ),
        f"rps {_IN_WIDE} --robot f1tenth --laws unicycle_car --out runs/preset_f1tenth",
        f"rps {_IN_WIDE} --robot f1tenth --laws unicycle_car --max-lost 600 --out runs/preset_600",
        gpu=2,
        section="Success",
        labels=(*_WITH_AN_AXLE, "f1tenth", "f1tenth, 600 s without contact"),
        columns=("", "all", "median time", "timeout", "lost contact"),
    ),
    "pose_presets": recipe(
        *_filled(
            "rps sweep --task pose --domain wide,objects=random_box --worlds 1000 --seed 9244 "
            "--robot {0} --out runs/pose_{0}",
            *_WITH_AN_AXLE,
        ),
        cores=3,
        section="Success",
        labels=_WITH_AN_AXLE,
        columns=("", "all", "median time", "timeout", "lost contact"),
    ),
    "corridors_*": recipe(
        "rps sweeps/corridors --laws rps rps_tuned rps_plus learned force_push dipole aps "
        f"rps_tuned,sweeps/corridors/tuned.json {_MACHINE}",
        gpu=3,
    ),
    "floors_*": recipe(f"rps sweeps/floors {_MACHINE}", cores=30, gpu=2),
    "tasks_parity": recipe(f"rps sweeps/corridors/parity.py --part 300 {_MACHINE}", cores=90),
    "tasks_cost_cpu": recipe(f"rps sweeps/corridors/costs.py {_MACHINE}", cores=3),
    "tasks_cost_gpu": recipe(
        f"rps sweeps/corridors/costs.py --worlds 16384 --rounds 6 {_MACHINE}", gpu=2
    ),
    "maps": recipe(f"rps sweeps/corridors/maps.py --data FOLDER {_MACHINE}", cores=10),
    "force_push_paths": recipe(f"rps sweeps/force_push_grid/paths.py {_MACHINE}", cores=60, gpu=2),
    "tuned_for_corridors": recipe(
        "rps ladder --laws rps_tuned rps_tuned,sweeps/corridors/tuned.json --domain wide real "
        "--worlds 4000 --seed 10",
        cores=6,
        gpu=1,
        section=rows.comparison,
    ),
    "plans": recipe(f"rps sweeps/planning {_MACHINE}", cores=15),
    "replans": recipe(f"rps sweeps/planning {_MACHINE}", cores=15),
    "gradients_mjx": recipe(f"rps sweeps/gradients/mjx.py {_MACHINE}", cores=6),
    "gradients_stiff": recipe(f"rps sweeps/gradients/stiff.py {_MACHINE}", cores=3),
    "gradients_direction": recipe(f"rps sweeps/gradients/direction.py {_MACHINE}", cores=5),
    "gradients_race": recipe(f"rps sweeps/gradients/race.py {_MACHINE}", cores=60),
    "gradients_race_18": recipe(f"rps sweeps/gradients/race.py --counts 18 {_MACHINE}", cores=20),
    "gradients_tables": recipe(
        *_filled(f"{_TABLES}:{{0}} --domain hostile {_HOSTILE} --out runs/{{0}}", *_PLUS_TABLES),
        "rps ladder --domain wide hostile --worlds 10000 --seed 69 --laws rps_plus "
        + " ".join(f"sweeps/gradients/tables.py:{x},runs/{x}/tuned.json" for x in _PLUS_TABLES),
        cores=60,
        section=rows.comparison,
    ),
    "robot": recipe(f"rps sweeps/speed/robot.py {_MACHINE}", cores=1),
    **dict.fromkeys(
        ("fit_coverage", "fit_quantities", "fit_worth"),
        recipe(f"rps sweeps/fit {_MACHINE}", cores=15),
    ),
    "fit_bags": recipe(f"rps sweeps/fit/bags.py {_MACHINE}", cores=5),
    "fit_one_push": recipe(f"rps sweeps/fit/one_push.py {_MACHINE}", cores=20),
    "fit_methods*": recipe(f"rps sweeps/fit/methods.py {_MACHINE}", cores=25),
    "mit*": recipe(f"rps sweeps/real_pushes/mit --data FOLDER {_MACHINE}", cores=30),
    "export_*": recipe(
        f"rps sweeps/export --tables speed {_MACHINE}",
        f"rps sweeps/export --tables trials paper worlds bags odd {_MACHINE}",
        f"rps sweeps/export --tables inputs {_MACHINE}",
        cores=60,
    ),
    "learned_windows": recipe(
        *_WINDOWS,
        "rps ladder --domain wide hostile --worlds 10000 --seed 69 --laws learned "
        "runs/ppo/policy.npz sweeps/learned/weights.py:Weights,runs/windows/tuned.json",
        gpu=15,
        section=rows.comparison,
    ),
    "sb3": recipe(f"rps sweeps/learned/sb3.py {_MACHINE}", cores=3),
    "learned_test": recipe(*_LEARNED, gpu=4, section=rows.beside_first, labels=(*_WIDE, "real")),
    "learned_tasks": recipe(
        *(
            f"rps sweep {options} --seed 7301 --laws {_FORMER} learned"
            for options in _BETWEEN_WALLS.values()
        ),
        cores=20,
        section=rows.beside_first,
        labels=tuple(_BETWEEN_WALLS),
    ),
    "learned_failures": recipe(
        *_LEARNED[1:],
        *(
            f"rps ceiling runs/learned_{name} --sample 0 --lost-by learned --samples 16 --rounds 5"
            for name in ("hostile", "real")
        ),
        gpu=4,
        section="A planner that knows the world",
        labels=("", "", "hostile", "real"),
    ),
    # --- speed, with nothing else running ---
    "speed": recipe(
        "rps sweeps/speed --names 'C in closed loop' 'fused standard' 'fused fast' quasistatic "
        "--worlds 64 4096 262144 --at-once 16",
        gpu=6,
        section="Simulated seconds in a second",
    ),
    "speed_cores": recipe(
        "rps sweeps/speed --names 'fused standard' 'C in closed loop' 'C, mj_step alone' "
        "'mjx standard' --worlds 24 64",
        cores=3,
        section="Simulated seconds in a second",
    ),
    "commands": recipe(f"rps sweeps/speed/commands.py {_MACHINE}", cores=14),
    "stages": recipe(f"rps sweeps/speed/stages.py {_MACHINE}", cores=1),
    "stages_gpu": recipe(
        f"rps sweeps/speed/stages.py --commands '{_SWEPT} --worlds 1000' '{_SWEPT} --worlds 10000' "
        f"--file stages_gpu {_MACHINE}",
        gpu=1,
    ),
    "compilers": recipe(f"rps sweeps/speed/compilers.py {_MACHINE}", cores=5),
    "compilers_gpu": recipe(
        f"rps sweeps/speed/compilers.py --against cpu --worlds 4000 --file compilers_gpu "
        f"{_MACHINE}",
        gpu=2,
    ),
    "kernel": recipe(f"rps sweeps/speed/kernel.py {_MACHINE}", gpu=3),
    "commands_gpu": recipe(
        "rps sweeps/speed/commands.py --commands "
        + " ".join(f"'{_SWEPT} --worlds {n}'" for n in (1000, 10_000, 262_144))
        + f" --gpus 1 --warm 1000 10000 --file commands_gpu {_MACHINE}",
        gpu=8,
    ),
    "gpus": recipe(  # after version 0.4.0 was checked out into checkouts/0.4.0
        "rps sweeps/speed/gpus.py --sweeps "
        + " ".join(f"{x} {x}:checkouts/0.4.0" for x in ("262144:1", "262144:2"))
        + " 1048576:1"
        + "".join(f" {x} {x}:checkouts/0.4.0" for x in ("1048576:2", "1000:1", "10000:1"))
        + f" {_MACHINE}",
        gpu=5,
    ),
    # After the installation of the third-party engines: see `speed/arena.py`.
    "arena": recipe(f"rps sweeps/speed/arena.py --peers peers {_MACHINE}", gpu=5),
    "derivatives": recipe(f"rps sweeps/speed/derivatives.py {_MACHINE}", cores=2),
    "environments": recipe(f"rps sweeps/speed/environments.py --worlds 64 {_MACHINE}", cores=3),
    "environments_gpu": recipe(
        f"rps sweeps/speed/environments.py --worlds 4096 --file environments_gpu {_MACHINE}", gpu=2
    ),
    "derivatives_gpu": recipe(
        f"rps sweeps/speed/derivatives.py --worlds 4096 --file derivatives_gpu {_MACHINE}", gpu=2
    ),
    "costs": recipe(
        "rps sweeps/speed/costs.py --names 'fused standard' 'mjx standard' --families box "
        "prism --most 3",
        cores=4,
        section="Functions",
    ),
    "levers": recipe(
        "rps sweeps/levers --program 'fused standard' --worlds 65536 --at-once 16",
        "rps sweeps/levers --program 'mjx standard' --worlds 4096 --simulated 1 --goes 3",
        gpu=8,
        section="*, box",
    ),
    "moved": recipe(f"rps sweeps/publish/moved.py {_MACHINE}", cores=1),
}

# Files of old versions; they are not computed again.
HISTORY = {
    "tuning_runs": "the runs of 0.1.0 and 0.2.0 that tuned the law",
    "learned": "the runs of 0.2.0 that trained the laws",
}
