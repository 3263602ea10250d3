"""Agreement of laws in C and ONNX with those in JAX, and their speed.

    rps sweeps/export

compares each law in C (float and double) and in ONNX with JAX: for random inputs, in whole trials,
and with C in the loop of the paper's trials and of random worlds. It runs the C with odd inputs
under sanitizers, and times it on one core.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import numpy as np
import xarray as xr

from rps_jax.analysis.report import Section
from rps_jax.app.export import program
from rps_jax.control.learned import policy
from rps_jax.errors import InputError
from rps_jax.record.options import option
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.case import Case
from rps_jax.trials.progress import Progress
from rps_jax.trials.setting import Setting
from rps_jax.world import paper
from rps_jax.world.objects import PAPER_OBJECTS
from sweeps.export import loop, native
from sweeps.study_base import Study, Table

TableName = Literal["inputs", "trials", "paper", "worlds", "bags", "odd", "speed"]
_TABLES: tuple[TableName, ...] = ("speed", "inputs", "trials", "paper", "worlds", "bags", "odd")
_FORMS: tuple[native.Form, ...] = ("double", "float", "onnx")
_PRECISIONS: tuple[native.Precision, ...] = ("double", "float")
_WORDS = {"double": "C, double", "float": "C, float", "onnx": "ONNX, float"}


@dataclass(frozen=True)
class Export(Study[xr.Dataset]):
    """Compare exported laws with those in JAX, and time them."""

    TITLE: ClassVar[str] = "Laws in C and ONNX beside those in JAX"
    GROWS: ClassVar[tuple[str, ...]] = ("laws", "tables", "in_worlds")
    QUICK: ClassVar[Mapping[str, Any]] = {
        "laws": ("rps_plus",),
        **{"inputs": 20_000, "states": 20_000, "worlds": 4, "bags": 1},
    }

    laws: tuple[str, ...] = ("rps", "rps_tuned", "rps_plus", "learned_mlp", "learned_gru")
    """Laws to compare."""
    tables: tuple[TableName, ...] = _TABLES
    """Tables to compute: random inputs, whole trials, the paper's trials and random worlds with C
    in the loop, bags of random worlds, odd inputs, and speed."""
    in_worlds: tuple[str, ...] = ("rps_plus",)
    """Laws that also run in the loop of random worlds."""
    inputs: int = option(10_000_000, 100, 10**9)
    """Number of random inputs of each law of equations, for C in either precision."""
    states: int = option(1_000_000, 100, 10**9)
    """Number of random inputs of each learned law, and of each law in ONNX."""
    worlds: int = option(1000, 1, 1_000_000)
    """Number of random worlds with C in the loop."""
    bags: int = option(4, 1, 1000)
    """Number of random worlds that are recorded as bags, for each law."""
    domain: str = "real"
    """Domain of these worlds."""
    quick: bool = False
    """Whether to make a small run of minutes on two cores; explicit options keep their values."""

    def check(self) -> None:
        """Check that the laws can be exported, and that a compiler is installed."""
        for law in self.laws:
            program.program(law)
        if shutil.which("gcc") is None:
            raise InputError("gcc is not installed: install it to compile the exported laws.")

    def answer(self, run: Run) -> xr.Dataset:
        """Compute the tables that are missing, law by law."""
        by_table: list[xr.Dataset] = []
        for table in self.tables:
            compute = getattr(self, f"_{table}")
            rows = []
            laws = [x for x in self.laws if table != "worlds" or x in self.in_worlds]
            for law in laws:
                rows.append(run.checkpoint(f"{table}-{law}", partial(self._compute, compute, law)))
                run.callback(Progress(len(rows), 0.0))
            if rows:
                joined = xr.concat(rows, "law")
                assert isinstance(joined, xr.Dataset)
                by_table.append(joined.assign_coords(law=laws))
        results = xr.merge(by_table, join="outer").reindex(law=list(self.laws))
        assert isinstance(results, xr.Dataset)
        return results

    def _compute(self, compute: Callable[[str, Path], xr.Dataset], law: str) -> xr.Dataset:
        with tempfile.TemporaryDirectory() as folder:
            results = compute(law, Path(folder))
        jax.clear_caches()  # all programs together exceed the memory mappings of a process
        return results

    # --- the tables of one law ---

    def _inputs(self, law: str, folder: Path) -> xr.Dataset:
        rows = []
        for form in _FORMS:
            is_slow = form == "onnx" or law in policy.SHIPPED
            rows.append(
                native.agreement(law, form, self.states if is_slow else self.inputs, folder)
            )
        return _columns("inputs", rows, "form", _FORMS, but=("law", "form"))

    def _trials(self, law: str, folder: Path) -> xr.Dataset:
        cases = [
            [Case(name, "S1", target, law=law) for target in paper.FEW_TARGETS]
            for name in PAPER_OBJECTS
        ]
        trials = [trial for group in cases for trial in loop.recorded(group, Setting("fused"))]
        rows = []
        for form in _FORMS:
            errors = native.trial_errors(law, form, trials, folder)
            free, synchronised, in_jax = map(np.concatenate, errors)
            rows.append(
                (len(trials), free.size, free.max(), synchronised.max(),
                 (free > native.TOLERANCE[form]).sum(), (free > native.JUMP).sum(),
                 (in_jax > native.JUMP).sum())
            )  # fmt: skip
        names = ("trials", "steps", "greatest", "told", "beyond", "parted", "in_jax")
        columns = zip(names, np.transpose(rows), strict=True)
        return xr.Dataset(
            {f"trials_{name}": ("form", values) for name, values in columns},
            {"form": list(_FORMS)},
        )

    def _paper(self, law: str, folder: Path) -> xr.Dataset:
        return _columns("paper", [loop.papers_trials(law, Setting("fused"), folder)])

    def _worlds(self, law: str, folder: Path) -> xr.Dataset:
        setting = Setting("fused")
        outcomes = loop.random_worlds(law, self.domain, self.worlds, setting, folder)
        return _columns("worlds", [outcomes])

    def _bags(self, law: str, folder: Path) -> xr.Dataset:
        bags = loop.bags(law, self.domain, self.bags, Setting("fused"), folder)
        return _columns("bags", [bags])

    def _odd(self, law: str, folder: Path) -> xr.Dataset:
        exported, compilers = program.program(law), native.COMPILERS
        rows = []
        for compiler in compilers:
            results = [native.fuzzed(exported, compiler, p, 200_000, folder) for p in _PRECISIONS]
            if faults := [result for result in results if result.fault]:
                raise AssertionError(f"{law}, {compiler}: {faults}")
            rows.append(native.Fuzzed(*(a + b for a, b in zip(*results, strict=True))))
        return _columns("odd", rows, "compiler", compilers, but=("said", "fault"))

    def _speed(self, law: str, folder: Path) -> xr.Dataset:
        times = [native.latency(law, precision, folder) for precision in _PRECISIONS]
        return xr.Dataset(
            {
                "speed_latency": (("precision", "of", "share"), times, {"units": "us"}),
                "speed_load": os.getloadavg()[0],
            },
            {"precision": list(_PRECISIONS), "share": [0.5, 0.999]},
        )

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return all tables."""
        return {
            f"export_{name}": Table(rows, note)
            for name, (_, note, rows) in tables(results, self).items()
        }

    def report(self, results: Any, run: Run) -> Sequence[Section]:
        """Return one section per table."""
        return [Section(title, note, rows) for title, note, rows in tables(results, self).values()]


export = call_of(Export)


def _columns(
    table: TableName, rows: Sequence[Any], dim: str = "", names: Sequence[str] = (),
    but: Sequence[str] = (),
) -> xr.Dataset:  # fmt: skip
    """Return the fields of named tuples as variables, along dimension `dim` if it has a name."""
    fields = [name for name in rows[0]._fields if name not in but]
    if not dim:
        return xr.Dataset({f"{table}_{name}": float(getattr(rows[0], name)) for name in fields})
    return xr.Dataset(
        {f"{table}_{n}": (dim, [float(getattr(row, n)) for row in rows]) for n in fields},
        {dim: list(names)},
    )


def _share(part: Any, whole: Any) -> str:
    """Format a count as a share, with two significant digits."""
    part, whole = int(part), int(whole)
    return "0" if part == 0 else f"{100 * part / whole:.2g} %"


def tables(results: xr.Dataset, study: Export) -> dict[str, tuple[str, str, list[list[str]]]]:
    """Return title, note, header and rows of each table, by name."""
    functions = {
        "speed": _speed_rows, "inputs": _input_rows, "trials": _trial_rows, "paper": _paper_rows,
        "worlds": partial(_world_rows, study.domain), "bags": partial(_bag_rows, study.domain),
        "odd": _odd_rows,
    }  # fmt: skip
    return {name: functions[name](results) for name in study.tables}


def _rows_of(results: xr.Dataset, table: TableName, dim: str) -> list[tuple[str, str, Any]]:
    """Return law, coordinate along `dim` and values of each row of a table."""
    prefix = f"{table}_"
    selected = results[[name for name in map(str, results) if name.startswith(prefix)]]
    selected = selected.rename({name: str(name).removeprefix(prefix) for name in selected})
    return [
        (str(law), str(name), selected.sel({"law": law, dim: name}))
        for law in results.law.values
        for name in results[dim].values
    ]


def _input_rows(results: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [
        ["law", "form", "inputs", "greatest difference", "beyond the goal", "flips", "unexplained",
         "beyond 1e-6 of float64", "JAX's float32 is"],
    ]  # fmt: skip
    for law, form, row in _rows_of(results, "inputs", "form"):
        shares = ["", ""] if form == "double" else [_share(row.off, row.inputs),
                                                  _share(row.off_in_jax, row.inputs)]  # fmt: skip
        rows.append(
            [law, _WORDS[form], f"{int(row.inputs):,}", f"{float(row.greatest):.1e}",
             _share(row.beyond, row.inputs), f"{int(row.flips)}", f"{int(row.unexplained)}",
             *shares]
        )  # fmt: skip
    note = (
        "The goal is 1e-12 in double and 1e-6 in float. Differences are shares of the greatest "
        "speed and turning rate, or of the memory."
    )
    return "Chance inputs", note, rows


def _trial_rows(results: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "form", "steps", "greatest difference", "from JAX's memory",
             "steps beyond the goal", "beyond 1e-3", "JAX's float32 is"]]  # fmt: skip
    for law, form, row in _rows_of(results, "trials", "form"):
        in_jax = "" if form == "double" else _share(row.in_jax, row.steps)
        rows.append(
            [law, _WORDS[form], f"{int(row.steps):,}", f"{float(row.greatest):.1e}",
             f"{float(row.told):.1e}", _share(row.beyond, row.steps),
             _share(row.parted, row.steps), in_jax]
        )  # fmt: skip
    note = (
        f"{int(results.trials_trials.max())} trials of each law. Each law remembers by itself from "
        "the first step to the last; from JAX's memory, it is given that before each step. JAX's "
        "float32 is compared with JAX's float64."
    )
    return "Whole trials", note, rows


def _end_rows(results: xr.Dataset, table: TableName) -> list[list[str]]:
    rows = [["law", "succeed with JAX", "with C in the loop", "with JAX, roundings off",
             "C ends alike", "roundings off end alike", "99 % of times are within"]]  # fmt: skip
    counts = ("in_jax", "in_c", "nudged", "alike", "nudged_alike")
    for law in map(str, results.law.values):
        row = {
            name: float(results[f"{table}_{name}"].sel(law=law)) for name in loop.Outcomes._fields
        }
        if np.isfinite(row["trials"]):
            cells = [f"{row[name]:.0f} of {row['trials']:.0f}" for name in counts]
            rows.append([law, *cells, f"{row['apart']:.2g} s"])
    return rows


def _paper_rows(results: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    note = (
        "Fused engine, float. Roundings off: every twist is greater or less by 1, 2, 4 or 8 parts "
        "in 2^23, and the least of these eight is told. Times are those of trials in which JAX and "
        "C both succeed."
    )
    return "The paper's trials", note, _end_rows(results, "paper")


def _world_rows(domain: str, results: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    note = f"The same worlds of `{domain}` for both; one rounding off; fused engine, float."
    return "Random worlds", note, _end_rows(results, "worlds")


def _bag_rows(domain: str, results: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "bags", "commands", "greatest difference", "beyond 1e-6",
             "greatest in m/s and rad/s", "read otherwise by rosbags"]]  # fmt: skip
    for law in map(str, results.law.values):
        row = {name: float(results[f"bags_{name}"].sel(law=law)) for name in loop.Bags._fields}
        counts = [f"{row[name]:,.0f}" for name in ("bags", "commands")]
        beyond, strange = (f"{row[name]:.0f}" for name in ("beyond", "strange"))
        shares = f"{row['greatest']:.1e}", beyond, f"{row['plain']:.1e}"
        rows.append([law, *counts, *shares, strange])
    note = (
        f"Worlds of `{domain}`, fused engine. Each law is fed its own bag. The goal is 1e-6, of "
        "differences as shares of the greatest speed and turning rate."
    )
    return "Bags", note, rows


def _odd_rows(results: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "compiler", "inputs", "refused (not finite)", "no finite twist", "faults"]]
    for law, compiler, row in _rows_of(results, "odd", "compiler"):
        counts = [int(row[name]) for name in ("taken", "refused", "no_result")]
        rows.append([law, compiler, *(f"{n:,}" for n in (sum(counts), *counts[1:])), "0"])
    note = "A fault would have ended the run without a table. Both precisions are counted together."
    return "Odd inputs", note, rows


def _speed_rows(results: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "form", "median", "99.9th percentile", "of five runs, from", "to"]]
    for law, precision, row in _rows_of(results, "speed", "precision"):
        median, slow = (np.sort(row.latency.sel(share=share).values) for share in (0.5, 0.999))
        middle = len(slow) // 2
        texts = [f"{x:.2f} us" for x in (median[middle], slow[middle], slow[0], slow[-1])]
        rows.append([law, _WORDS[precision], *texts])
    load = float(results.speed_load.max())
    note = (
        "gcc -O2, 200,000 steps of skin and law in a run, on one core; the median of five runs. "
        f"The load of the machine was {load:.1f} at most."
    )
    return "Speed", note, rows
