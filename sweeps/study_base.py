"""Base classes of this project's studies, and the data files of their tables.

A subclass of `Study` declares the parts of its results and its tables. Each table is a section of
the report. With the option `--machine`, tables that have a name are written to `results/NAME.json`
in the folder of the study, and `render_tables.py` shows them on the pages. `probes.py` tells
whether later code gives the same numbers.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import platform
import re
import shlex
import subprocess
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import numpy as np
import scipy.special
import xarray as xr

from rps_jax import InputError, Setting, errors, load
from rps_jax.laws import resolve_law
from rps_jax.questions import Picture, Plan, Run, Section, option
from rps_jax.record import options, provenance
from rps_jax.runs import execution
from rps_jax.runs.question import Question, QuickQuestion, TrialQuestion
from rps_jax.runs.results import PlanRequest, Results
from rps_jax.trials.batch import run_batch
from rps_jax.trials.progress import Progress, ProgressCallback, SequentialProgress, no_progress
from rps_jax.trials.trial import Outcome
from rps_jax.worlds import DomainLike, parse_domain
from sweeps import probes, render_tables

T = TypeVar("T", covariant=True)
Rows = list[list[str]]
Parts = Mapping[Any, Callable[[], xr.Dataset]]  # functions that compute the parts of results
RANDOM_OBJECTS = ("random_box", "random_cylinder", "random_prism")
_PACKAGES = ("rps_jax", "jax", "mujoco", "mujoco-mjx")  # whose versions a data file has


# --- tables ---------------------------------------------------------------------------------


class Table(NamedTuple):
    """A table of a study: a section of its report, and a data file if it has a name."""

    rows: Sequence[Sequence[Any]]  # the first has the names of the columns
    note: str = ""  # explains the numbers to their reader
    columns: Sequence[Mapping[str, Any]] = ()  # formats, by default none; rows then have no header
    merge: str | None = None  # name of the column that shows repeated texts once
    name: str = ""  # of the data file
    title: str = ""  # of the section; by default from the name
    text: str = ""  # of the section; by default the note
    picture: Picture | None = None  # of the section

    def columns_and_rows(self) -> tuple[list[Mapping[str, Any]], list[Sequence[Any]]]:
        """Return columns and rows as a data file has them."""
        if self.columns:
            return list(self.columns), list(self.rows)
        header, *rows = self.rows
        return [
            {"name": name} | ({"merge": True} if name == self.merge else {}) for name in header
        ], rows

    @property
    def section(self) -> Section:
        """Section of the report."""
        title = self.title or self.name.replace("_", " ").capitalize()
        rows = self.rows
        if self.columns:
            cells = [zip(row, self.columns, strict=True) for row in rows]
            texts = [[render_tables.text(*cell) for cell in row] for row in cells]
            rows = [[column["name"] for column in self.columns], *texts]
        return Section(title, self.text or self.note, rows, self.picture)


def records(results: xr.Dataset, *dims: str) -> Iterator[dict[str, Any]]:
    """Yield the scalars of a dataset at each index of some dimensions, the last one fastest."""
    for index in np.ndindex(*(results.sizes[dim] for dim in dims)):
        row = results.isel(dict(zip(dims, index, strict=True)))
        yield {str(name): value.item() for name, value in row.variables.items() if not value.ndim}


def text_table(columns: Mapping[str, str], rows: Iterable[Mapping[str, Any]]) -> Rows:
    """Return a header and a row of texts for each record.

    `columns` has the format of each column, such as "{rate:,.0f} s". A cell with NaN is empty.
    """
    texts = [[form.format(**row) for form in columns.values()] for row in rows]
    return [list(columns), *(["" if re.search(r"\bnan\b", x) else x for x in row] for row in texts)]


def mean_interval(values: np.ndarray) -> list[float]:
    """Return the mean of independent values (n,) and the limits of its 95 % interval."""
    mean, count = float(values.mean()), values.size
    if count < 2:
        return [mean]
    half = values.std(ddof=1) / np.sqrt(count) * float(scipy.special.stdtrit(count - 1, 0.975))
    return [mean, mean - half, mean + half]


def median_interval(values: np.ndarray, resamples: int = 2000) -> tuple[float, float, float]:
    """Return the median of values (n,) and its 95 % interval by a bootstrap."""
    drawn = np.random.default_rng(0).choice(values, (resamples, values.size))
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return float(np.median(values)), float(low), float(high)


# --- studies --------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Study(Question[T]):
    """Base class of the studies of this project."""

    machine: str = ""
    """Machine that runs the study, in words; with it the tables are published."""

    CHOICES: ClassVar[Mapping[str, Collection[Any]]] = {}  # known names of fields
    DIMENSION: ClassVar[str] = ""  # along which the parts are joined
    GROWS: ClassVar[tuple[str, ...]] = ()  # options that may change when a run is continued
    PRESETS: ClassVar[Mapping[str, Any]] = {}  # physics and laws that code names, not options
    RESULTS: ClassVar[str] = "results"  # folder of the data files, relative to the study's folder

    # --- for subclasses to override --------------------------------------------------------

    def parts(self, run: Run) -> Parts:
        """Return the function that computes each part of the results, by its coordinate."""
        return {}

    def report_tables(self, results: Any) -> Sequence[Table]:
        """Return the tables of the report."""
        return ()

    def publish(self, results: Any, run_folder: Path) -> None:
        """Write the data files and the pictures of the tables that have a name."""
        runs = self.records(run_folder)
        for table in filter(lambda table: table.name, self.report_tables(results)):
            path = self.folder / self.RESULTS / f"{table.name}.json"
            write_table(path, runs, self.machine, table)
            if table.picture:
                (self.folder / f"{table.picture.name}.png").write_bytes(table.picture.png())

    def records(self, run_folder: Path) -> list[Mapping[str, Any]]:
        """Return the provenance of the runs behind the tables."""
        return [provenance.read_environment(run_folder)]

    # --- as questions ----------------------------------------------------------------------

    def check(self) -> None:
        """Check that the names exist, and that each occurs once."""
        for field, known in self.CHOICES.items():
            value = getattr(self, field)
            values = [value] if isinstance(value, str) else value
            for name in values:
                errors.check_name(field, str(name), [*map(str, known)])
            if value != getattr(type(self)(), field):  # some defaults are empty: all names
                errors.check_each_once(field, values)

    def num_trials(self) -> int | None:
        """Return the number of parts."""
        return len(self.parts(Run(None, no_progress))) or None

    def configuration(self) -> dict[str, Any]:
        """Return everything that the parts of the run depend on, as JSON."""
        fields = super().configuration()
        fields |= {"presets": options.to_json(self.PRESETS)} if self.PRESETS else {}
        return {k: v for k, v in fields.items() if k not in (*self.GROWS, "machine")}

    def answer(self, run: Run) -> Any:
        """Compute the parts that are missing, and join them."""
        return run_parts(run, self.DIMENSION, self.parts(run))

    def report(self, results: Any, run: Run) -> Sequence[Section]:
        """Return a section for each table."""
        return [table.section for table in self.report_tables(results)]

    @property
    def folder(self) -> Path:
        """Folder of the study's source file."""
        return Path(inspect.getfile(type(self))).parent

    def execute(self, callback: ProgressCallback) -> T:
        """Run the study, and publish its tables if a machine is named."""
        results = super().execute(callback)
        if self.machine and self.out is not None:
            self.publish(results, Path(self.out))
        return results


@dataclass(frozen=True, kw_only=True)
class CollectedStudy(Study[xr.Dataset]):
    """Base class of studies whose parts may run apart, each in a separate run folder."""

    runs: tuple[str, ...] = option((), positional=True)
    """Run folders of this study, to collect their results."""

    def answer(self, run: Run) -> xr.Dataset:
        """Compute the missing parts, or collect the results of other run folders."""
        if not self.runs:
            return super().answer(run)
        try:
            return xr.concat([load(x) for x in self.runs], self.DIMENSION, join="exact")
        except ValueError as error:
            raise errors.not_allowed("runs", self.runs, "their options differ") from error

    def records(self, run_folder: Path) -> list[Mapping[str, Any]]:
        """Return the provenance of the runs behind the tables."""
        return [provenance.read_environment(Path(x)) for x in (*self.runs, run_folder)]


@dataclass(frozen=True, kw_only=True)
class QuickStudy(Study[T], QuickQuestion[T]):
    """Base class of studies that have a small run."""


@dataclass(frozen=True, kw_only=True)
class TrialStudy(Study[T], TrialQuestion[T]):
    """Base class of studies that run trials with several settings."""


@dataclass(frozen=True, kw_only=True)
class PlanStudy(Question[T]):
    """Base class of questions whose trials are those of several plans."""

    @cached_property
    def plans(self) -> dict[str, Plan]:
        """Plans by name."""
        raise NotImplementedError

    def check(self) -> None:
        """Check that the engines can step these worlds here."""
        super().check()
        for plan in self.plans.values():
            plan.check_here()

    def num_trials(self) -> int | None:
        """Return the number of trials."""
        return sum(plan.num_trials for plan in self.plans.values())


def plan_of(
    law: str,
    domain: DomainLike,
    worlds: int,
    setting: Setting,
    robot: str | None = None,
    task: str | Mapping[str, Any] | None = None,
) -> Plan:
    """Return the plan of a law in worlds of a domain, with a robot and a task."""
    ranges = parse_domain(domain, robot, task)
    return Plan(ranges, worlds, dict([resolve_law(law)]), setting.with_robot(ranges.robot))


@dataclass(frozen=True, kw_only=True)
class SpeedStudy(Study[T]):
    """Base class of studies that measure this machine."""

    def intro(self, results: Any) -> str:
        """Return the device of the measurement."""
        return f"On {machine()}."


def run_process(words: Sequence[str | Path], problem: str, folder: Path | None = None) -> str:
    """Run a process, by default in the current folder, and return its output.

    Raises:
      InputError: the process failed; the sentence starts with the `problem`.
    """
    process = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if process.returncode:
        last = (process.stderr or process.stdout).strip().splitlines()[-1:]
        raise InputError(f"{problem}: {' '.join(last)}")
    return process.stdout


def use_processors() -> None:
    """Let JAX of a new process run on processors, beside one that may hold the GPU."""
    jax.config.update("jax_platforms", "cpu")


def machine() -> str:
    """Return a description of the device of this process."""
    used, count = jax.devices()[0], len(os.sched_getaffinity(0))
    if used.platform != "cpu":
        return f"one {used.device_kind} and {count} processors"
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    for line in cpuinfo.read_text().splitlines() if cpuinfo.exists() else ():
        if line.startswith("model name"):
            model = line.partition(":")[2].strip()
            break
    return f"{count} of {os.cpu_count()} processors, {model}"


def part_name(*labels: object) -> str:
    """Return the name of a part of a run folder."""
    return re.sub(r"\W+", "_", "_".join(map(str, labels)))


def part_of(label: str, *options: object) -> str:
    """Return the name of a part of a run folder that other options would not give."""
    return part_name(label, hashlib.sha256(repr(options).encode()).hexdigest()[:8])


def stored_parts(run: Run) -> Collection[str]:
    """Return the names of the parts that the run folder has."""
    return () if run.checkpoints is None else run.checkpoints.paths()


def run_parts(run: Run, dim: str, parts: Parts, trials: int = 1) -> xr.Dataset:
    """Compute the parts that the run folder lacks, and join all of them along a dimension.

    Each part counts as a number of `trials` in the progress.
    """
    computed: list[xr.Dataset] = []
    for label, compute in parts.items():
        computed.append(run.checkpoint(part_name(label), compute))
        run.callback(Progress(trials * len(computed), 0.0))
    return xr.concat(computed, xr.IndexVariable(dim, list(parts)))


def run_plans(run: Run, plans: Mapping[str, Plan]) -> dict[str, xr.Dataset]:
    """Run what the run folder lacks of several plans; return their results."""
    progress, results = SequentialProgress(run.callback), {}
    options = run._replace(callback=progress).batch_options
    for name, plan in plans.items():
        folder = None if run.folder is None else run.folder / part_name(name)
        results[name] = execution.run_plan(plan, folder, **options)
        progress.finish(plan.num_trials)
    return results


def run_together(plans: Sequence[Plan], run: Run) -> list[xr.Dataset]:
    """Run plans of one setting and equal shapes in one rollout; return the results of each."""
    results = list(map(Results, plans))
    requests = [PlanRequest(x.plan, list(x.plan.chunks), x) for x in results]
    last = np.cumsum([plan.num_trials for plan in plans])

    def collect(indices: np.ndarray, outcomes: Outcome) -> None:
        owners = np.searchsorted(last, indices, side="right")
        for owner in np.unique(owners).tolist():
            mask, first = owners == owner, last[owner] - plans[owner].num_trials
            columns = {name: x[mask] for name, x in outcomes.columns().items()}
            results[owner].put(indices[mask] - first, Outcome.of_columns(columns))

    run_batch(requests, plans[0].setting, collect, **run.batch_options)
    return [x.dataset() for x in results]


# --- data files -----------------------------------------------------------------------------


def write_table(path: Path, runs: Sequence[Mapping[str, Any]], device: str, table: Table) -> Path:
    """Write the data file of a table.

    Args:
      path: `results/NAME.json` in the folder of a study.
      runs: provenance of the runs behind the table, as `provenance.read_environment` returns it.
        Where commits or versions differ, also those of a run that was continued, all are written.
      device: device of the runs, in words.
      table: header, rows and note.
    """
    signed = [run for last in runs for run in (*last.get("before", ()), last)]
    with_folders = [run["command"] for run in runs]
    commands = [_without_unread_folder(command, with_folders) for command in with_folders]
    columns, rows = table.columns_and_rows()
    data = {
        "command": [shlex.join(command) for command in commands],
        "device": device,
        "versions": {
            name: _all_of([run["packages"][name] for run in signed]) for name in _PACKAGES
        },
        "commit": _all_of([x["commit"] for x in signed]),
        "probes": probes.stored_ids(path.stem),
        "date": runs[-1]["time"][:10],
        **({"note": table.note} if table.note else {}),
        "columns": columns,
        "rows": rows,
    }
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    return path


def _all_of(values: Sequence[Any]) -> Any:
    """Return the value, or the list of all where they differ."""
    distinct = list(dict.fromkeys(values))
    return distinct if len(distinct) > 1 else distinct[0]


def split_folder(command: Sequence[str]) -> tuple[list[str], str]:
    """Return the words of a command without its run folder, and the run folder."""
    if "--out" not in command:
        return list(command), ""
    i = list(command).index("--out")
    return [*command[:i], *command[i + 2 :]], "".join(command[i + 1 : i + 2])


def _reads_folder(words: Sequence[str], folder: str = "runs") -> bool:
    """Return whether a command reads a run folder, or a file in one."""
    return any(re.search(rf"(^|,){re.escape(folder)}(/|$)", word) for word in words)


def _without_unread_folder(command: Sequence[str], commands: Sequence[Sequence[str]]) -> list[str]:
    """Return the words of a command, without its run folder unless another command reads it."""
    words, folder = split_folder(command)
    is_read = folder and any(_reads_folder(split_folder(c)[0], folder) for c in commands)
    return list(command) if is_read else words
