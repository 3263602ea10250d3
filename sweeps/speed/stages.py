"""Stages of whole commands, from the start of Python to its end, by samples of the main thread.

Each command runs twice in a new process, and the second one is sampled: every 5 ms the innermost
stage on the stack gets the time since the last sample. So the stages sum to the whole. While the
main thread waits for threads that compile or simulate, the stage is the run.

    rps sweeps/speed/stages.py --machine "2 cores of an AMD EPYC"
"""

from __future__ import annotations

import json
import shlex
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr

from rps_jax.questions import Run, call_of, option
from sweeps.speed.commands import printed
from sweeps.study_base import Parts, SpeedStudy, Table

# Functions by stage. The first part of an import's name decides its stage.
STAGES = {
    "import JAX": ("import jax", "import jaxlib", "import numpy", "import scipy"),
    "import MuJoCo": ("import mujoco", "import etils"),
    "import tables and files": ("import pandas", "import xarray", "import h5netcdf"),
    "import plots": ("import matplotlib", "import PIL"),
    "import, other": ("import",),
    "options": ("rps_jax.app.cli.flags.parse", "rps_jax.app.cli.names"),
    "environment": ("rps_jax.app.cli.environment", "rps_jax.engines.device"),
    "devices": ("jax._src.xla_bridge.backends", "jax._src.xla_bridge.local_devices"),
    "worlds": ("rps_jax.runs.results.PlanRequest", "rps_jax.world.draws", "rps_jax.world.domain"),
    "programs": ("rps_jax.trials.batch._schedule", "rps_jax.lowering"),
    "run": ("rps_jax.trials.batch.run", "rps_jax.trials.pushes"),
    "files": ("rps_jax.record",),
    "figures": ("rps_jax.analysis.report.png", "rps_jax.analysis.report.Picture.png"),
    "report": ("rps_jax.app.cli.running._report",),
}
FIRST, LAST = "start of Python", "end of the process"  # before and after the samples
OTHER = "other"  # time without a stage
SAMPLER = Path(__file__).with_name("sampler.py")


@dataclass(frozen=True)
class Stages(SpeedStudy[xr.Dataset]):
    """Divide the duration of whole commands into stages.

    The results hold `seconds` (command, stage).
    """

    TITLE = "Stages of whole commands"
    DIMENSION = "command"
    GROWS = ("commands",)

    commands: tuple[str, ...] = (
        "push --object box --target -2 0 --no-video",
        "sweep --laws rps_tuned --domain wide --worlds 100",
        "sweep --laws rps_tuned --domain wide --worlds 1000",
    )
    """Arguments of `rps`."""
    limit: float = option(1800.0, 1, 86400)
    """Time limit of a command [s]."""
    file: str = "stages"
    """Name of the data file."""

    def parts(self, run: Run) -> Parts:
        """Return the function that divides each command."""
        return {f"`rps {x}`": partial(divided, x, self.limit) for x in self.commands}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the seconds of each stage, and their sum."""
        seconds = results.seconds.transpose("stage", "command")
        rows = [
            [stage, *(f"{x:.2f} s" for x in row)]
            for stage, row in zip(seconds.stage.values.tolist(), seconds.values, strict=True)
            if row.max() >= 0.005
        ]
        total = ["whole", *(f"{x:.2f} s" for x in seconds.values.sum(0))]
        header = ["stage", *seconds.command.values.tolist()]
        return [Table([header, *rows, total], name=self.file, title="Stages")]


stages = call_of(Stages)


def divided(command: str, limit: float) -> xr.Dataset:
    """Return the seconds (stage,) of the second run of a command."""
    with tempfile.TemporaryDirectory() as folder:
        samples, started, ended = Path(folder, "samples.json"), 0.0, 0.0
        for i in range(2):
            words = [str(SAMPLER), str(samples), *shlex.split(command), "--out", f"{folder}/{i}"]
            started = time.time()
            printed(words, command, folder, limit)
            ended = time.time()
        first, last, stacks = json.loads(samples.read_text())
    seconds = dict.fromkeys([FIRST, *STAGES, OTHER, LAST], 0.0)
    seconds |= {FIRST: first - started, LAST: ended - last}
    for names, duration in stacks:
        seconds[stage_of(names)] += duration
    stage = {"stage": list(seconds)}
    return xr.Dataset({"seconds": ("stage", np.array(list(seconds.values())))}, stage)


def stage_of(names: Sequence[str]) -> str:
    """Return the stage of the innermost function of a stack that has one; outermost name first."""
    for name in reversed(names):
        for stage, prefixes in STAGES.items():
            if name.startswith(prefixes):
                return stage
    return OTHER
