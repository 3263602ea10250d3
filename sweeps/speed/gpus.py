"""Duration of whole sweeps on several GPUs of one host, and the timeline of their slots.

Every sweep runs in a new process that sees some of the GPUs, with the code of this checkout or of
another one. First all sweeps fill their caches together. `JAX_PLATFORMS=cpu` makes the timing
process leave the GPUs to them.

    JAX_PLATFORMS=cpu rps sweeps/speed/gpus.py --machine "eight NVIDIA H100"
    JAX_PLATFORMS=cpu rps sweeps/speed/gpus.py --sweeps 1000:1 1000:1:checkouts/0.4.0
"""

from __future__ import annotations

import json
import os
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import xarray as xr

import rps_jax
from rps_jax import InputError, errors
from rps_jax.analysis.figures.style import Figure, words
from rps_jax.questions import Picture, Run, call_of
from rps_jax.worlds import parse_domain
from sweeps.speed.commands import TIMING, printed
from sweeps.study_base import Parts, SpeedStudy, Table, part_name, records, text_table

_LIMIT = 600.0  # [s] of a sweep
_MAX_SEGMENTS = 10_000  # of a sweep
_COLUMNS = {
    "worlds": "{worlds:,}",
    "GPUs": "{gpus}",
    "version": "{version}",
    "whole command": "{whole:.1f} s",
    "one GPU over it": "{gain:.2f}",
    "of it compile": "{compile:.1f} s",
    "run": "{run:.1f} s",
    "simulated s/s": "{rate:,.0f}",
    "GPUs idle": "{idle:.0f} %",
}
# A sweep that prints device, start, end and live trials of each object of its segments.
_TRACED = (
    "import json, rps_jax\n"
    "noted = []\n"
    "rps_jax.sweep({!r}, 'wide', worlds={}, report_to=lambda x: noted.append(x.segment))\n"
    "rows = [[*x[:3], *(x.live.get(i, 0) for i in range({}))] for x in noted if x is not None]\n"
    "print(json.dumps(rows, default=int))\n"
)
_OBJECTS = [words(name) for name in parse_domain("wide").objects]


@dataclass(frozen=True)
class Gpus(SpeedStudy[xr.Dataset]):
    """Time whole sweeps of `wide` on some GPUs of this host, with a filled cache.

    The results hold, by sweep, its duration, the times that it prints and, of the fewest worlds on
    the most GPUs and on the fewest, its `segments`: device, start, end and live trials by object.
    """

    TITLE = "Sweeps on several GPUs"
    DIMENSION = "sweep"
    GROWS = ("sweeps",)

    law: str = "rps_tuned"
    """Law to run."""
    sweeps: tuple[str, ...] = ("262144:1", "262144:2", "1048576:1", "1048576:2")
    """Sweeps in their order, each with its numbers of worlds and GPUs, as 262144:2, and optionally
    the folder of another checkout, whose name is its version. The GPUs must be of this host."""

    def check(self) -> None:
        """Check the form of the sweeps."""
        for text in self.sweeps:
            if not re.fullmatch(r"\d+:[1-9]\d?(:.+)?", text):
                raise errors.not_allowed("sweeps", text, "write WORLDS:GPUS or WORLDS:GPUS:FOLDER")

    def parts(self, run: Run) -> Parts:
        """Return the function that times each sweep."""
        return {text: partial(self._timed, text) for text in self.sweeps}

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the durations, with the timeline of the traced sweeps."""
        rows, traces = [*records(results, "sweep")], {}
        for i, row in enumerate(rows):
            same = (x for x in rows if all(x[k] == row[k] for k in ("worlds", "version")))
            single = next((x["whole"] for x in same if x["gpus"] == 1), np.nan)
            row |= {"gain": single / row["whole"], "idle": np.nan}
            segments = results.segments[i].dropna("segment").values
            if len(segments):
                run = segments[:, 2].max() * row["gpus"]
                row["idle"] = 100 * (1 - busy_time(segments) / run)
                traces[f"{row['gpus']} GPUs".replace("1 GPUs", "1 GPU")] = segments
        picture = Picture("gpus", partial(timeline, traces))
        return [Table(text_table(_COLUMNS, rows), name="gpus", merge="worlds", picture=picture)]

    @cached_property
    def _caches(self) -> tempfile.TemporaryDirectory[str]:
        """Folder of the caches, which all sweeps fill at the same time."""
        folder = tempfile.TemporaryDirectory()
        fill = partial(self._swept, folder.name, options=" --horizon 0.02")
        with ThreadPoolExecutor(len(self.sweeps)) as pool:
            list(pool.map(fill, self.sweeps))
        return folder

    def _swept(self, folder: str, sweep: str, options: str = "") -> str:
        """Return the output of a sweep with its cache in a folder."""
        worlds = _split(sweep)[0]
        command = f"sweep --laws {self.law} --domain wide --worlds {worlds}{options}"
        command += f" --out {tempfile.mkdtemp(dir=folder)}/run"
        return _printed(folder, sweep, ["-m", "rps_jax", *command.split()], command)

    def _is_traced(self, worlds: int, gpus: int) -> bool:
        """Whether a sweep of this checkout has the fewest worlds of those on the most GPUs."""
        own = [(n, x) for x, n, folder in map(_split, self.sweeps) if not folder]
        fewest, most = min(own)[0], max(own)[0]
        return gpus in (fewest, most) and worlds == min(x for n, x in own if n == most)

    def _timed(self, sweep: str) -> xr.Dataset:
        """Return the times and the segments of a sweep."""
        folder, rows, (worlds, gpus, other) = self._caches.name, [], _split(sweep)
        start = time.perf_counter()
        output = self._swept(folder, sweep)
        whole = time.perf_counter() - start
        if (match := TIMING.search(output)) is None:
            raise InputError(f"the sweep of {worlds} worlds printed no time of its run.")
        if not other and self._is_traced(worlds, gpus):
            call = _TRACED.format(self.law, worlds, len(_OBJECTS))
            rows = json.loads(_printed(folder, sweep, ["-c", call], call).splitlines()[-1])
        values = dict(zip(("compile", "run", "rate"), map(float, match.groups()), strict=True))
        version = Path(other).name if other else rps_jax.__version__
        sizes = {"worlds": worlds, "gpus": gpus, "version": version, "whole": whole}
        segments = np.full((_MAX_SEGMENTS, 3 + len(_OBJECTS)), np.nan)
        if rows:
            segments[: len(rows)] = rows
        return xr.Dataset(sizes | values | {"segments": (("segment", "column"), segments)})


gpus = call_of(Gpus)


def _split(sweep: str) -> tuple[int, int, str]:
    """Return numbers of worlds and GPUs, and the folder of another checkout or ""."""
    worlds, count, *folder = sweep.split(":", 2)
    return int(worlds), int(count), "".join(folder)


def _printed(folder: str, sweep: str, words: Sequence[str], label: str) -> str:
    """Return what Python prints with GPUs, code and cache of a sweep."""
    cache = Path(folder, part_name(sweep))
    cache.mkdir(exist_ok=True)
    _, count, other = _split(sweep)
    path = os.pathsep.join([other, os.environ.get("PYTHONPATH", "")])
    environment = {"PYTHONPATH": path, "PYTHONSAFEPATH": "1"} if other else None
    return printed(words, label, str(cache), _LIMIT, count, environment)[0]


def busy_time(segments: np.ndarray) -> float:
    """Return the time [s] in which segments (n, ...) run, summed over devices."""
    total = 0.0
    for device in np.unique(segments[:, 0]):
        start, end = segments[segments[:, 0] == device][:, 1:3].T
        order = np.argsort(start)
        start, end = start[order], end[order]
        previous = np.maximum.accumulate(np.append(0.0, end[:-1]))
        total += float(np.maximum(end - np.maximum(start, previous), 0.0).sum())
    return total


def timeline(traces: Mapping[str, np.ndarray]) -> Figure:
    """Plot the busy slots of each device over time, by object; rows are runs and their devices."""
    rows = [(run, device) for run, x in traces.items() for device in np.unique(x[:, 0]).astype(int)]
    figure = Figure(figsize=(9.0, 1.0 + 1.3 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), sharex=True, squeeze=False)[:, 0]
    for ax, (run, device) in zip(axes, rows, strict=True):
        _, start, end, *live = traces[run][traces[run][:, 0] == device].T
        base = np.zeros(start.size)
        for name, trials in zip(_OBJECTS, live, strict=True):
            ax.bar(start, trials / 1000, end - start, base, align="edge", label=name)
            base = base + trials / 1000
        ax.set_ylabel(f"{run}: {device}", rotation=0, ha="right")
        ax.set_xlim(left=0.0)
        ax.grid(alpha=0.3)
    axes[-1].set_xlabel("time since the start of the run [s]")
    figure.suptitle("busy slots of each GPU [thousands]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
