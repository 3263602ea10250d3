"""Do the laws in C and ONNX do what they do in JAX, and how fast?

    rps sweeps/export

compares each law in C (float and double) and as ONNX with that in JAX: at chance inputs, over whole
trials, and with the C in the loop of the paper's trials and of random worlds. It feeds odd inputs
to the C under sanitizers, and times it on one core.
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
    """Laws that are compared."""
    tables: tuple[TableName, ...] = _TABLES
    """What is asked: chance inputs, whole trials, the paper's trials and random worlds with C in
    the loop, bags of random worlds, odd inputs, and speed."""
    in_worlds: tuple[str, ...] = ("rps_plus",)
    """Those of the laws that are in the loop of random worlds, too."""
    inputs: int = option(10_000_000, 100, 10**9)
    """Number of chance inputs of each law that is an equation, for C in either precision."""
    states: int = option(1_000_000, 100, 10**9)
    """Number of chance inputs of each learned law, and of each law as ONNX."""
    worlds: int = option(1000, 1, 1_000_000)
    """Number of random worlds with C in the loop."""
    bags: int = option(4, 1, 1000)
    """Number of random worlds that become bags, for each law."""
    domain: str = "real"
    """Domain of these worlds."""
    quick: bool = False
    """Whether to make a small run of minutes on two cores: what is not asked for becomes small."""

    def check(self) -> None:
        """Check that the laws can be exported, and that a compiler is there."""
        for law in self.laws:
            program.program(law)
        if shutil.which("gcc") is None:
            raise InputError("gcc is not installed: install it to compile what was exported.")

    def answer(self, run: Run) -> xr.Dataset:
        """Answer table by table and law by law."""
        found: list[xr.Dataset] = []
        for table in self.tables:
            make = getattr(self, f"_{table}")
            rows = []
            laws = [x for x in self.laws if table != "worlds" or x in self.in_worlds]
            for law in laws:
                rows.append(run.checkpoint(f"{table}-{law}", partial(self._kept, make, law)))
                run.callback(Progress(len(rows), 0.0))
            if rows:
                joined = xr.concat(rows, "law")
                assert isinstance(joined, xr.Dataset)
                found.append(joined.assign_coords(law=laws))
        whole = xr.merge(found, join="outer").reindex(law=list(self.laws))
        assert isinstance(whole, xr.Dataset)
        return whole

    def _kept(self, make: Callable[[str, Path], xr.Dataset], law: str) -> xr.Dataset:
        with tempfile.TemporaryDirectory() as where:
            found = make(law, Path(where))
        jax.clear_caches()  # the programs of all tables take more mappings than a process may have
        return found

    # --- what is asked of each law ---

    def _inputs(self, law: str, where: Path) -> xr.Dataset:
        rows = []
        for form in _FORMS:
            few = form == "onnx" or law in policy.SHIPPED
            rows.append(native.agreement(law, form, self.states if few else self.inputs, where))
        return _columns("inputs", rows, "form", _FORMS, but=("law", "form"))

    def _trials(self, law: str, where: Path) -> xr.Dataset:
        cases = [
            [Case(thing, "S1", target, law=law) for target in paper.FEW_TARGETS]
            for thing in PAPER_OBJECTS
        ]
        seen = [one for some in cases for one in loop.recorded(some, Setting("fused"))]
        found = []
        for form in _FORMS:
            errors = native.trial_errors(law, form, seen, where)
            own, told, in_jax = map(np.concatenate, errors)
            found.append(
                (len(seen), own.size, own.max(), told.max(),
                 (own > native.TOLERANCE[form]).sum(), (own > native.JUMP).sum(),
                 (in_jax > native.JUMP).sum())
            )  # fmt: skip
        names = ("trials", "steps", "greatest", "told", "beyond", "parted", "in_jax")
        columns = zip(names, np.transpose(found), strict=True)
        return xr.Dataset(
            {f"trials_{name}": ("form", values) for name, values in columns},
            {"form": list(_FORMS)},
        )

    def _paper(self, law: str, where: Path) -> xr.Dataset:
        return _columns("paper", [loop.papers_trials(law, Setting("fused"), where)])

    def _worlds(self, law: str, where: Path) -> xr.Dataset:
        setting = Setting("fused")
        ends = loop.random_worlds(law, self.domain, self.worlds, setting, where)
        return _columns("worlds", [ends])

    def _bags(self, law: str, where: Path) -> xr.Dataset:
        found = loop.bags(law, self.domain, self.bags, Setting("fused"), where)
        return _columns("bags", [found])

    def _odd(self, law: str, where: Path) -> xr.Dataset:
        made, compilers = program.program(law), native.COMPILERS
        rows = []
        for compiler in compilers:
            both = [native.fuzzed(made, compiler, p, 200_000, where) for p in _PRECISIONS]
            if wrong := [one for one in both if one.fault]:
                raise AssertionError(f"{law}, {compiler}: {wrong}")
            rows.append(native.Fuzzed(*(a + b for a, b in zip(*both, strict=True))))
        return _columns("odd", rows, "compiler", compilers, but=("said", "fault"))

    def _speed(self, law: str, where: Path) -> xr.Dataset:
        found = [native.latency(law, precision, where) for precision in _PRECISIONS]
        return xr.Dataset(
            {
                "speed_latency": (("precision", "of", "share"), found, {"units": "us"}),
                "speed_load": os.getloadavg()[0],
            },
            {"precision": list(_PRECISIONS), "share": [0.5, 0.999]},
        )

    # --- how it is told ---

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return all tables."""
        return {
            f"export_{name}": Table(rows, note)
            for name, (_, note, rows) in tables(results, self).items()
        }

    def report(self, results: Any, run: Run) -> Sequence[Section]:
        """One section for each table."""
        return [Section(title, note, rows) for title, note, rows in tables(results, self).values()]


export = call_of(Export)


def _columns(
    table: TableName, rows: Sequence[Any], dim: str = "", names: Sequence[str] = (),
    but: Sequence[str] = (),
) -> xr.Dataset:  # fmt: skip
    """Rows of named tuples as variables of their fields, along a dimension if it has a name."""
    kept = [name for name in rows[0]._fields if name not in but]
    if not dim:
        return xr.Dataset({f"{table}_{name}": float(getattr(rows[0], name)) for name in kept})
    return xr.Dataset(
        {f"{table}_{n}": (dim, [float(getattr(one, n)) for one in rows]) for n in kept},
        {dim: list(names)},
    )


def _share(part: Any, whole: Any) -> str:
    """A count as a share, with enough digits to tell it from nothing."""
    part, whole = int(part), int(whole)
    return "0" if part == 0 else f"{100 * part / whole:.2g} %"


def tables(found: xr.Dataset, asked: Export) -> dict[str, tuple[str, str, list[list[str]]]]:
    """Title, note, header and rows of each table, by name."""
    made = {
        "speed": _speed_rows, "inputs": _input_rows, "trials": _trial_rows, "paper": _paper_rows,
        "worlds": partial(_world_rows, asked.domain), "bags": partial(_bag_rows, asked.domain),
        "odd": _odd_rows,
    }  # fmt: skip
    return {name: made[name](found) for name in asked.tables}


def _each(found: xr.Dataset, table: TableName, dim: str) -> list[tuple[str, str, Any]]:
    """Law, name along a dimension, and the numbers of a table there."""
    prefix = f"{table}_"
    own = found[[name for name in map(str, found) if name.startswith(prefix)]]
    own = own.rename({name: str(name).removeprefix(prefix) for name in own})
    return [
        (str(law), str(one), own.sel({"law": law, dim: one}))
        for law in found.law.values
        for one in found[dim].values
    ]


def _input_rows(found: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [
        ["law", "form", "inputs", "greatest difference", "beyond the goal", "flips", "unexplained",
         "beyond 1e-6 of float64", "JAX's float32 is"],
    ]  # fmt: skip
    for law, form, one in _each(found, "inputs", "form"):
        wide = ["", ""] if form == "double" else [_share(one.off, one.inputs),
                                                  _share(one.off_in_jax, one.inputs)]  # fmt: skip
        rows.append(
            [law, _WORDS[form], f"{int(one.inputs):,}", f"{float(one.greatest):.1e}",
             _share(one.beyond, one.inputs), f"{int(one.flips)}", f"{int(one.unexplained)}", *wide]
        )  # fmt: skip
    note = (
        "The goal is 1e-12 in double and 1e-6 in float. Differences are shares of the greatest "
        "speed and turning rate, or of the memory."
    )
    return "Chance inputs", note, rows


def _trial_rows(found: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "form", "steps", "greatest difference", "from JAX's memory",
             "steps beyond the goal", "beyond 1e-3", "JAX's float32 is"]]  # fmt: skip
    for law, form, one in _each(found, "trials", "form"):
        in_jax = "" if form == "double" else _share(one.in_jax, one.steps)
        rows.append(
            [law, _WORDS[form], f"{int(one.steps):,}", f"{float(one.greatest):.1e}",
             f"{float(one.told):.1e}", _share(one.beyond, one.steps),
             _share(one.parted, one.steps), in_jax]
        )  # fmt: skip
    note = (
        f"{int(found.trials_trials.max())} trials of each law. Each law remembers by itself from "
        "the first step to the last; from JAX's memory, it is given that before each step. JAX's "
        "float32 is compared with JAX's float64."
    )
    return "Whole trials", note, rows


def _end_rows(found: xr.Dataset, table: TableName) -> list[list[str]]:
    rows = [["law", "succeed with JAX", "with C in the loop", "with JAX, roundings off",
             "C ends alike", "roundings off end alike", "99 % of times are within"]]  # fmt: skip
    counts = ("in_jax", "in_c", "nudged", "alike", "nudged_alike")
    for law in map(str, found.law.values):
        one = {name: float(found[f"{table}_{name}"].sel(law=law)) for name in loop.Ends._fields}
        if np.isfinite(one["trials"]):
            told = [f"{one[name]:.0f} of {one['trials']:.0f}" for name in counts]
            rows.append([law, *told, f"{one['apart']:.2g} s"])
    return rows


def _paper_rows(found: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    note = (
        "Fused engine, float. Roundings off: every twist is greater or less by 1, 2, 4 or 8 parts "
        "in 2^23, and the least of these eight is told. Times are those of trials in which JAX and "
        "C both succeed."
    )
    return "The paper's trials", note, _end_rows(found, "paper")


def _world_rows(domain: str, found: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    note = f"The same worlds of `{domain}` for both; one rounding off; fused engine, float."
    return "Random worlds", note, _end_rows(found, "worlds")


def _bag_rows(domain: str, found: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "bags", "commands", "greatest difference", "beyond 1e-6",
             "greatest in m/s and rad/s", "read otherwise by rosbags"]]  # fmt: skip
    for law in map(str, found.law.values):
        one = {name: float(found[f"bags_{name}"].sel(law=law)) for name in loop.Bags._fields}
        counts = [f"{one[name]:,.0f}" for name in ("bags", "commands")]
        beyond, strange = (f"{one[name]:.0f}" for name in ("beyond", "strange"))
        shares = f"{one['greatest']:.1e}", beyond, f"{one['plain']:.1e}"
        rows.append([law, *counts, *shares, strange])
    note = (
        f"Worlds of `{domain}`, fused engine. Each law is fed its own bag. The goal is 1e-6, of "
        "differences as shares of the greatest speed and turning rate."
    )
    return "Bags", note, rows


def _odd_rows(found: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "compiler", "inputs", "refused (not finite)", "no finite twist", "faults"]]
    for law, compiler, one in _each(found, "odd", "compiler"):
        counts = [int(one[name]) for name in ("taken", "refused", "no_result")]
        rows.append([law, compiler, *(f"{n:,}" for n in (sum(counts), *counts[1:])), "0"])
    note = "A fault would have ended the run without a table. Both precisions are counted together."
    return "Odd inputs", note, rows


def _speed_rows(found: xr.Dataset) -> tuple[str, str, list[list[str]]]:
    rows = [["law", "form", "median", "99.9th percentile", "of five runs, from", "to"]]
    for law, precision, one in _each(found, "speed", "precision"):
        median, slow = (np.sort(one.latency.sel(share=share).values) for share in (0.5, 0.999))
        middle = len(slow) // 2
        texts = [f"{x:.2f} us" for x in (median[middle], slow[middle], slow[0], slow[-1])]
        rows.append([law, _WORDS[precision], *texts])
    load = float(found.speed_load.max())
    note = (
        "gcc -O2, 200,000 steps of skin and law in a run, on one core; the median of five runs. "
        f"The load of the machine was {load:.1f} at most."
    )
    return "Speed", note, rows
