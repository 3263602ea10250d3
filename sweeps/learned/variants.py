"""Compare variants of learning at equal wall clock.

    rps sweeps/learned/variants.py --variants warm --out runs/warm
    rps sweeps/learned/variants.py --variants scratch --out runs/scratch
    rps sweeps/learned/variants.py runs/warm runs/scratch --machine "one H100 each"

Each variant is a run of `rps learn` in the folder of its name, and its law is judged in worlds for
validation. The last command collects the results of other run folders.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr

from rps_jax import Setting, evaluate
from rps_jax.analysis import statistics
from rps_jax.app.cli import flags
from rps_jax.questions import Run, call_of, option
from sweeps.study_base import CollectedStudy, Parts, QuickStudy, Table

# Variants start with `learned_gru.npz` and `learned_mlp.npz`, the laws of 0.3, or `learned` of 0.4.
DOMAINS = ("wide", "hostile", "real")
SHARED = (
    "rps learn --domain wide hostile real --num-envs 1024 --drawn 8192 --validation 128 --every 1.5"
    " --horizon 300 --max-lost 150 --prioritised 0.5 --success 2 --failure 1 --anneal 0.4"
    " --ema-updates 100"
)
_WARM = "--initial sweeps/learned/learned_gru.npz --action-std 0.25 --learning-rate 2e-4"
_LIMITS = "robot_force=150:800,robot_traction=0.3:0.8,robot_lag=0:0.5,robot_acceleration=0.1:1"
_HARD = f"--domain hostile real hostile,{_LIMITS}"
_FORMER = "--initial sweeps/learned/learned_0_4.npz --action-std 0.2 --learning-rate 2e-4"
_CONTINUED = f"{_FORMER} {_HARD}"
VARIANTS = {  # options after the shared ones
    "scratch": "",
    "warm": _WARM,
    "wide and hostile": f"{_WARM} --domain wide hostile",
    "hard domains": f"{_WARM} {_HARD}",
    "with tasks": f"{_WARM} --domain wide hostile real wide,task=path wide,task=corridor",
    "uniform worlds": f"{_WARM} --prioritised 0",
    "reward of 0.2.0": f"{_WARM} --success 1 --failure 0",
    "failures cost 3": f"{_WARM} --failure 3",
    "trials of 120 s": f"{_WARM} --horizon 120 --max-lost 30",
    "not annealed": f"{_WARM} --anneal 0 --ema-updates 20",
    "4,096 worlds": f"{_WARM} --num-envs 4096 --num-minibatches 16",
    "long credit": f"{_WARM} --discount-time 100 --gae-time 10",
    "small steps": f"{_WARM} --target-kl 0.004",
    "width 128": "--width 128",
    "hold 0.1 s": "--hold 0.1",
    "mlp": "--network mlp --initial sweeps/learned/learned_mlp.npz --action-std 0.25"
    " --learning-rate 2e-4",
    "mlp, width 32": "--network mlp --width 32",
    "continued": _CONTINUED,
    "continued, 4,096 worlds": f"{_CONTINUED} --num-envs 4096 --num-minibatches 16 --seed 1",
    "continued, failures cost 2": f"{_CONTINUED} --num-envs 4096 --num-minibatches 16 --seed 2"
    " --failure 2 --prioritised 0.7",
}
_QUICK_DOMAIN = "wide,objects=random_cylinder"  # also for judging
QUICK = (
    f" --domain {_QUICK_DOMAIN} --num-envs 4 --drawn 8 --validation 4 --num-steps 2"
    " --num-minibatches 1 --engine quasistatic --horizon 4 --max-lost 4 --updates 2"
)
_COLUMNS = (
    {"name": "variant"},
    {"name": "changed options"},
    {"name": "updates", "format": "{:,}"},
    {"name": "simulated", "format": "{:,.0f} h"},
    {"name": "compilation", "format": "{:.0f} s"},
    *({"name": name, "format": "{:.2f} %", "rest": " [{:.2f}, {:.2f}]"} for name in DOMAINS),
    {"name": "median time in wide", "format": "{:.1f} s"},
)


@dataclass(frozen=True)
class Variants(CollectedStudy, QuickStudy[xr.Dataset]):
    """Compare variants of learning at equal wall clock, in worlds for validation.

    The answer has the `successes` and the `median_time` [s] of each law (variant, domain), and the
    numbers of its run (variant).
    """

    TITLE = "Variants of learning"
    CHOICES: ClassVar = {"variants": VARIANTS}
    QUICK: ClassVar = {"variants": ("scratch", "mlp"), "worlds": 4}
    DIMENSION = "variant"
    REPORTS_TIMES = True

    variants: tuple[str, ...] = tuple(VARIANTS)
    """Names of the variants to run."""
    minutes: float = option(6.0, 0, 1e5, unit="min")
    """Wall clock of each variant [min], with compilation."""
    worlds: int = option(2000, 1, 1_000_000)
    """Number of worlds for validation of each domain."""
    file: str = "learned_variants"
    """Name of the data file."""
    out: Path | str | None = field(default="runs/variants", kw_only=True)
    """Run folder; each variant has a folder there."""

    def command(self, name: str) -> str:
        """Return the command of a variant, without its limits and its folder."""
        return f"{SHARED} {VARIANTS[name]}{QUICK if self.quick else ''}".replace("  ", " ").strip()

    def configuration(self) -> dict[str, Any]:
        """Return everything that the parts depend on, with all options of learning."""
        questions = [self._question(name).configuration() for name in self.variants]
        return super().configuration() | {"learn": questions}

    def _question(self, name: str, *options: str) -> Any:
        """Return the run of a variant, with further options."""
        return flags.read([*shlex.split(self.command(name))[1:], *options])[0]

    def parts(self, run: Run) -> Parts:
        """Return the run of each variant, by its name."""
        folder = Path(str(self.out))
        names = () if self.runs else self.variants
        return {name: partial(self._learn, name, folder / _folder(name)) for name in names}

    def _learn(self, name: str, folder: Path) -> xr.Dataset:
        """Learn a law, and judge it in each domain."""
        minutes = 0 if self.quick else self.minutes
        question = self._question(name, "--minutes", str(minutes), "--out", str(folder))
        curve = question()
        last, successes, times = curve.isel(update=-1), list[int](), list[float]()
        for domain in DOMAINS:
            ranges = _QUICK_DOMAIN if self.quick else domain
            setting = Setting("quasistatic" if self.quick else "fused")
            law = str(folder / "policy.npz")
            scores = evaluate(
                law, ranges, self.worlds, split="validate", setting=setting, progress=False
            )
            success = scores.success.values[0] > 0
            successes.append(int(success.sum()))
            times.append(
                float(np.median(scores.time.values[0][success])) if any(success) else np.nan
            )
        scalars = {
            "updates": float(curve.sizes["update"]),
            "simulated": float(last.simulated),
            "compile": float(curve.attrs["compile"]),
            "tried": float(self.worlds),
        }
        return xr.Dataset(
            {key: ((), value) for key, value in scalars.items()}
            | {"successes": ("domain", successes), "median_time": ("domain", times)},
            {"domain": list(DOMAINS)},
        )

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return the table of the variants."""
        note = (
            "Success in worlds for validation by the paper's rules, with Wilson intervals. All "
            f"variants have `{SHARED}` and the changed options."
        )
        rows = [_row(results.sel(variant=name)) for name in results.variant.values.tolist()]
        return [Table(rows, note, _COLUMNS, name=self.file, title="Variants")]


variants = call_of(Variants)


def _folder(name: str) -> str:
    """Return the name of the folder of a variant."""
    return "".join(x if x.isalnum() else "_" for x in name)


def _changes(name: str) -> str:
    """Return the changed options of a variant; most have those of `warm`, too."""
    first = "those of `warm`, and " if name != "warm" and _WARM in VARIANTS[name] else ""
    options = VARIANTS[name].removeprefix(_WARM if first else "").strip()
    return f"{first}`{options}`" if options else ""


def _row(result: xr.Dataset) -> list[Any]:
    """Return the row of a variant."""
    name, tried = str(result.variant.item()), int(result.tried)
    rates: list[list[float]] = []
    for count in map(int, result.successes.values):
        rates.append([100 * x for x in (count / tried, *statistics.wilson(count, tried))])
    return [
        name,
        _changes(name),
        int(result.updates),
        float(result.simulated) / 3600,
        float(result.compile),
        *rates,
        float(result.median_time.values[0]),
    ]
