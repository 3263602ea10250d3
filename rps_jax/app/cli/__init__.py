"""The command line: `rps table`, `rps push`, `rps sweep` and the others.

Every command is a thin face of a library call. Input is checked, and folders are tried, before
anything compiles. Heavy modules are imported by the commands, so that `rps --help` answers at once
and MuJoCo finds its rendering backend chosen.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from rps_jax.app.cli import failing, learning, looking, replicating, sweeping, tuning
from rps_jax.app.cli.running import guarded

Command = (
    Annotated[replicating.Table, tyro.conf.subcommand("table")]
    | Annotated[replicating.Push, tyro.conf.subcommand("push")]
    | Annotated[replicating.Hardware, tyro.conf.subcommand("hardware")]
    | Annotated[replicating.Paper, tyro.conf.subcommand("paper")]
    | Annotated[sweeping.Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[sweeping.Ladder, tyro.conf.subcommand("ladder")]
    | Annotated[sweeping.Ceiling, tyro.conf.subcommand("ceiling")]
    | Annotated[sweeping.Merge, tyro.conf.subcommand("merge")]
    | Annotated[sweeping.Replay, tyro.conf.subcommand("replay")]
    | Annotated[looking.Film, tyro.conf.subcommand("film")]
    | Annotated[looking.Gallery, tyro.conf.subcommand("gallery")]
    | Annotated[looking.View, tyro.conf.subcommand("view")]
    | Annotated[failing.Sensitivity, tyro.conf.subcommand("sensitivity")]
    | Annotated[failing.Rare, tyro.conf.subcommand("rare")]
    | Annotated[failing.Attack, tyro.conf.subcommand("attack")]
    | Annotated[failing.Regress, tyro.conf.subcommand("regress")]
    | Annotated[tuning.Tune, tyro.conf.subcommand("tune")]
    | Annotated[learning.Learn, tyro.conf.subcommand("learn")]
    | Annotated[looking.Doctor, tyro.conf.subcommand("doctor")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `rps` and `python -m rps_jax`: exit code 0, or 2 for bad input."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        prog="rps",
        args=arguments or ["--help"],
        description="Pushing unknown objects by touch: the Reactive Pushing Strategy in MuJoCo.",
    )
    from rps_jax.analysis import video

    video.choose_gl()
    return guarded(command.run)
