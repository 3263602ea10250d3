"""What do a robot's limits cost the law: force, lag, acceleration, size, the pitch of its skin?

    python sweeps/limits.py --worlds 2000 --out runs/limits

pushes with every robot, and with the ideal base, in the same random worlds; prints where each law
has lost 1 and 10 points of its success, and draws success over each limit. A second figure shows
what acceleration makes of the law's turns. It can be killed; the same command continues.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from rps_jax import errors
from rps_jax.analysis import figures, tables
from rps_jax.app.cli.parsing import compared_arms
from rps_jax.app.cli.running import guarded, use_cache
from rps_jax.record import files, folder, provenance
from rps_jax.robot.robot import Robot
from rps_jax.studies import limits
from rps_jax.trials.setting import progress_bar

TURNING = {
    "no limit": Robot(),
    "1 rad/s² (1 m/s²)": Robot(acceleration_max=(1.0, 1.0)),
    "0.2 rad/s² (0.1 m/s²)": Robot(acceleration_max=(0.1, 0.2)),
    "lag 0.3 s": Robot(lag=0.3),
}


@dataclass(frozen=True)
class Options:
    """Which limits, and in which worlds."""

    limits: tuple[str, ...] = tuple(limits.LIMITS)
    """Names of the limits: force, lag, acceleration, half_width, pitch; by default all."""
    domain: str = "wide"
    """The worlds, by name."""
    params: tuple[str, ...] = ("paper", "tuned")
    """Parameters of the law: paper, tuned, or JSON files."""
    worlds: int = 2000
    """How many."""
    seed: int = 11
    """Of the worlds."""
    slots: int | None = None
    """Worlds stepped at once; by default as suits the device."""
    out: Path = Path("runs/limits")
    """Run folder; a run that was killed is continued there."""


def main(options: Options) -> None:
    """Run the robots that are missing, then print, draw and write."""
    errors.check_each_once("limits", options.limits)
    arms = compared_arms(("rps",), options.params)
    for name in options.limits:
        errors.check_name("limit", name, limits.LIMITS)
    use_cache()
    out = folder.writable(options.out)
    trials = limits.count(options.limits, len(arms), options.worlds)
    with folder.hold(out), progress_bar(trials) as report:
        provenance.sign(out)
        found = limits.run(
            options.limits,
            arms,
            options.worlds,
            options.seed,
            out,
            domain=options.domain,
            report=report,
            slots=options.slots,
        )
    for name, one in found.items():
        files.write_results(out / f"{name}.nc", one)
    figures.limits(found, out / "limits.png")
    figures.turning(limits.turning(TURNING, arms["paper"]), out / "turning.png")
    text = "\n\n".join(
        tables.markdown(rows)
        for rows in (limits.losses(found), limits.successes(found))
        if len(rows) > 1
    )
    files.write_text(out / "limits.md", text + "\n")
    print(text)


if __name__ == "__main__":
    sys.exit(guarded(lambda: main(tyro.cli(Options, description=__doc__))))
