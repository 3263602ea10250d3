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
from collections import namedtuple
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import numpy as np
import xarray as xr

from rps_jax import InputError, Setting
from rps_jax.app.export import program
from rps_jax.physics import PHYSICS
from rps_jax.questions import Run, call_of, option
from rps_jax.world import paper
from rps_jax.worlds import Case, DomainLike, parse_domain
from sweeps.export import loop, native
from sweeps.study_base import QuickStudy, Table, records, run_parts, text_table

TableName = Literal["inputs", "trials", "paper", "worlds", "bags", "odd", "speed"]
_TABLES: tuple[TableName, ...] = ("speed", "inputs", "trials", "paper", "worlds", "bags", "odd")
_FORMS: tuple[native.Form, ...] = ("double", "float", "onnx")
_PRECISIONS: tuple[native.Precision, ...] = ("double", "float")
_WORDS = {"double": "C, double", "float": "C, float", "onnx": "ONNX, float"}


_Trials = namedtuple("_Trials", "trials steps greatest told beyond parted in_jax")


@dataclass(frozen=True)
class Export(QuickStudy[xr.DataTree]):
    """Compare exported laws with those in JAX, and time them.

    The answer is a tree with the values of each table by law.
    """

    TITLE = "Laws in C and ONNX beside those in JAX"
    GROWS = ("laws", "tables", "in_worlds")
    PRESETS: ClassVar = PHYSICS["default"]
    QUICK: ClassVar = {
        "laws": ("rps_plus",),
        **{"inputs": 20_000, "states": 20_000, "worlds": 4, "bags": 1},
    }

    laws: tuple[str, ...] = ("rps", "rps_tuned", "rps_plus", "learned_small", "learned")
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
    domain: DomainLike = "real"
    """Domain of these worlds."""

    def check(self) -> None:
        """Check that the laws can be exported, and that a compiler is installed."""
        for law in self.laws:
            program.program(law)
        if shutil.which("gcc") is None:
            raise InputError("gcc is not installed: install it to compile the exported laws.")

    def answer(self, run: Run) -> xr.DataTree:
        """Compute the tables that are missing, law by law."""
        by_table = {}
        for table in self.tables:
            compute = getattr(self, f"_{table}")
            laws = [law for law in self.laws if table != "worlds" or law in self.in_worlds]
            parts = {f"{table}-{law}": partial(self._compute, compute, law) for law in laws}
            if parts:
                by_table[table] = run_parts(run, "law", parts).assign_coords(law=laws)
        return xr.DataTree.from_dict(by_table)

    def _compute(self, compute: Callable[[str, Path], xr.Dataset], law: str) -> xr.Dataset:
        with tempfile.TemporaryDirectory() as folder:
            results = compute(law, Path(folder))
        jax.clear_caches()  # all programs together exceed the memory mappings of a process
        return results

    # --- the tables of one law ---

    def _inputs(self, law: str, folder: Path) -> xr.Dataset:
        counts: dict[native.Form, int] = {
            form: self.states if form == "onnx" or law.startswith("learned") else self.inputs
            for form in _FORMS
        }
        rows = [native.agreement(law, form, count, folder) for form, count in counts.items()]
        return _columns(rows, "form", _FORMS, but=("law", "form"))

    def _trials(self, law: str, folder: Path) -> xr.Dataset:
        cases = [
            [Case(name, "S1", target, law=law) for target in paper.FEW_TARGETS]
            for name in parse_domain("paper").objects
        ]
        trials = [trial for group in cases for trial in loop.recorded(group, Setting("fused"))]
        rows = []
        for form in _FORMS:
            errors = map(np.concatenate, native.trial_errors(law, form, trials, folder))
            free, synchronised, in_jax = errors
            parted = [(x > native.JUMP).sum() for x in (free, in_jax)]
            beyond = (free > native.TOLERANCE[form]).sum()
            rows.append(
                _Trials(len(trials), free.size, free.max(), synchronised.max(), beyond, *parted)
            )
        return _columns(rows, "form", _FORMS)

    def _paper(self, law: str, folder: Path) -> xr.Dataset:
        return _columns([loop.papers_trials(law, Setting("fused"), folder)])

    def _worlds(self, law: str, folder: Path) -> xr.Dataset:
        setting = Setting("fused")
        outcomes = loop.random_worlds(law, self.domain, self.worlds, setting, folder)
        return _columns([outcomes])

    def _bags(self, law: str, folder: Path) -> xr.Dataset:
        bags = loop.bags(law, self.domain, self.bags, Setting("fused"), folder)
        return _columns([bags])

    def _odd(self, law: str, folder: Path) -> xr.Dataset:
        exported, compilers = program.program(law), native.COMPILERS
        rows = []
        for compiler in compilers:
            results = [native.fuzzed(exported, compiler, p, 200_000, folder) for p in _PRECISIONS]
            if faults := [result for result in results if result.fault]:
                raise AssertionError(f"{law}, {compiler}: {faults}")
            rows.append(native.Fuzzed(*(a + b for a, b in zip(*results, strict=True))))
        return _columns(rows, "compiler", compilers, but=("said", "fault"))

    def _speed(self, law: str, folder: Path) -> xr.Dataset:
        times = [native.latency(law, precision, folder) for precision in _PRECISIONS]
        latency = ("precision", "of", "share"), times, {"units": "us"}
        coords = {"precision": list(_PRECISIONS), "share": [0.5, 0.999]}
        return xr.Dataset({"latency": latency, "load": os.getloadavg()[0]}, coords)

    def report_tables(self, results: xr.DataTree) -> Sequence[Table]:
        """Return all tables."""
        functions = {
            "speed": _speed_table,
            "inputs": _input_table,
            "trials": _trial_table,
            "paper": _paper_table,
            "worlds": partial(_world_table, self.domain),
            "bags": partial(_bag_table, self.domain),
            "odd": _odd_table,
        }
        return [
            functions[name](node.to_dataset())._replace(name=f"export_{name}")
            for name, node in results.children.items()
        ]


export = call_of(Export)


def _columns(
    rows: Sequence[Any], dim: str = "", names: Sequence[str] = (), but: Sequence[str] = ()
) -> xr.Dataset:
    """Return the fields of named tuples as variables, along dimension `dim` if it has a name."""
    fields = [name for name in rows[0]._fields if name not in but]
    if not dim:
        return xr.Dataset({name: float(getattr(rows[0], name)) for name in fields})
    return xr.Dataset(
        {n: (dim, [float(getattr(row, n)) for row in rows]) for n in fields},
        {dim: list(names)},
    )


def _share(part: float, whole: float) -> str:
    """Format a count as a share, with two significant digits."""
    return f"{100 * part / whole:.2g} %" if part else "0"


def _input_table(results: xr.Dataset) -> Table:
    rows = [
        [
            "law",
            "form",
            "inputs",
            "greatest difference",
            "beyond the goal",
            "flips",
            "unexplained",
            "beyond 1e-6 of float64",
            "JAX's float32 is",
        ],
    ]
    for row in records(results, "law", "form"):
        beyond, *in_float = (
            _share(row[name], row["inputs"]) for name in ("beyond", "off", "off_in_jax")
        )
        rows.append(
            [
                row["law"],
                _WORDS[row["form"]],
                f"{row['inputs']:,.0f}",
                f"{row['greatest']:.1e}",
                beyond,
                f"{row['flips']:.0f}",
                f"{row['unexplained']:.0f}",
                *(in_float if row["form"] != "double" else ["", ""]),
            ]
        )
    note = (
        "The goal is 1e-12 in double and 1e-6 in float. Differences are shares of the greatest "
        "speed and turning rate, or of the memory."
    )
    return Table(rows, note, title="Random inputs")


def _trial_table(results: xr.Dataset) -> Table:
    rows = [
        [
            "law",
            "form",
            "steps",
            "greatest difference",
            "from JAX's memory",
            "steps beyond the goal",
            "beyond 1e-3",
            "JAX's float32 is",
        ]
    ]
    for row in records(results, "law", "form"):
        *shares, in_jax = (
            _share(row[name], row["steps"]) for name in ("beyond", "parted", "in_jax")
        )
        rows.append(
            [
                row["law"],
                _WORDS[row["form"]],
                f"{row['steps']:,.0f}",
                f"{row['greatest']:.1e}",
                f"{row['told']:.1e}",
                *shares,
                in_jax if row["form"] != "double" else "",
            ]
        )
    note = (
        f"{int(results.trials.max())} trials of each law. Each law remembers by itself from "
        "the first step to the last; from JAX's memory, it is given that before each step. JAX's "
        "float32 is compared with JAX's float64."
    )
    return Table(rows, note, title="Whole trials")


_ENDS = {
    "law": "{law}",
    "succeed with JAX": "{in_jax:.0f} of {trials:.0f}",
    "with C in the loop": "{in_c:.0f} of {trials:.0f}",
    "with JAX, roundings off": "{nudged:.0f} of {trials:.0f}",
    "C ends alike": "{alike:.0f} of {trials:.0f}",
    "roundings off end alike": "{nudged_alike:.0f} of {trials:.0f}",
    "99 % of times are within": "{apart:.2g} s",
}


def _paper_table(results: xr.Dataset) -> Table:
    note = (
        "Fused engine, float. Roundings off: every twist is greater or less by 1, 2, 4 or 8 parts "
        "in 2^23, and the least of these eight is told. Times are those of trials in which JAX and "
        "C both succeed."
    )
    rows = text_table(_ENDS, records(results, "law"))
    return Table(rows, note, title="The paper's trials")


def _world_table(domain: DomainLike, results: xr.Dataset) -> Table:
    note = f"The same worlds of `{domain}` for both; one rounding off; fused engine, float."
    return Table(text_table(_ENDS, records(results, "law")), note, title="Random worlds")


_BAGS = {
    "law": "{law}",
    "bags": "{bags:,.0f}",
    "commands": "{commands:,.0f}",
    "greatest difference": "{greatest:.1e}",
    "beyond 1e-6": "{beyond:.0f}",
    "greatest in m/s and rad/s": "{plain:.1e}",
    "read otherwise by rosbags": "{strange:.0f}",
}


def _bag_table(domain: DomainLike, results: xr.Dataset) -> Table:
    note = (
        f"Worlds of `{domain}`, fused engine. Each law is fed its own bag. The goal is 1e-6, of "
        "differences as shares of the greatest speed and turning rate."
    )
    return Table(text_table(_BAGS, records(results, "law")), note, title="Bags")


def _odd_table(results: xr.Dataset) -> Table:
    rows = [["law", "compiler", "inputs", "refused (not finite)", "no finite twist", "faults"]]
    for row in records(results, "law", "compiler"):
        counts = [int(row[name]) for name in ("taken", "refused", "no_result")]
        cells = [f"{n:,}" for n in (sum(counts), *counts[1:])]
        rows.append([row["law"], row["compiler"], *cells, "0"])
    note = "A fault would have ended the run without a table. Both precisions are counted together."
    if missing := [x for x in native.ALL_COMPILERS if x not in results.compiler.values]:
        note += f" Not installed, so not tested: {', '.join(missing)}."
    return Table(rows, note, title="Odd inputs")


def _speed_table(results: xr.Dataset) -> Table:
    rows = [["law", "form", "median", "99.9th percentile", "of five runs, from", "to"]]
    for law, precision in product(results.law.values, results.precision.values):
        latency = results.latency.sel(law=law, precision=precision)
        median, slow = (np.sort(latency.sel(share=share).values) for share in (0.5, 0.999))
        middle = len(slow) // 2
        texts = [f"{x:.2f} us" for x in (median[middle], slow[middle], slow[0], slow[-1])]
        rows.append([str(law), _WORDS[str(precision)], *texts])
    load = float(results["load"].max())  # `results.load` is a method
    note = (
        "gcc -O2, 200,000 steps of skin and law in a run, on one core; the median of five runs. "
        f"The load of the machine was {load:.1f} at most."
    )
    return Table(rows, note, title="Speed")
