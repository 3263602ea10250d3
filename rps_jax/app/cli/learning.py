"""The command that learns a law: learn."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rps_jax.app.cli import parsing, running
from rps_jax.app.cli.options import Device, Engine, Fidelity

if TYPE_CHECKING:
    from xarray import Dataset


@dataclass(frozen=True)
class Learn:
    """Learn a law from touch by PPO; the run can be continued, and leaves policy.npz."""

    domain: tuple[str, ...] = ("wide",)
    """Domains to learn in: wide, real, prisms, hostile, or JSON files of ranges."""
    objects: tuple[str, ...] = ("random_box", "random_cylinder", "random_prism")
    """Shapes of the objects of these domains."""
    network: Literal["mlp", "gru"] = "gru"
    """The network: mlp, two layers without a memory; or gru, with a recurrent layer."""
    width: int = 64
    """Pairs of units in a hidden layer; each pair stands for a world and its mirror image."""
    minutes: float = 10.0
    """Wall clock after which it ends [min], with compilation, counted over all processes that
    continued the run; 0 stands for no bound."""
    updates: int = 0
    """Number of updates after which it ends; 0 stands for no bound."""
    worlds: int = 1024
    """Number of worlds of each shape (and domain) that are stepped at once."""
    drawn: int = 4096
    """Number of random worlds of each shape and domain, of which every trial takes one."""
    validation: int = 128
    """Number of worlds for validation of each shape and domain."""
    hold: float = 0.2
    """Time for which an action is carried out [s]."""
    decisions: int = 32
    """Number of decisions of each world in an update."""
    epochs: int = 4
    """Number of passes over the decisions of an update."""
    batches: int = 8
    """Number of batches of worlds in a pass, each of which is a step of the optimiser."""
    foresight: float = 30.0
    """Time after which a reward counts 1/e of what it counts at once [s]."""
    credit: float = 5.0
    """Time over which rewards are summed before the value function stands for the rest [s]."""
    entropy: float = 0.005
    """Bonus for the entropy of the actions."""
    learning_rate: float = 1e-3
    """Learning rate of the first step; it follows the divergence of the policies."""
    level: float = 0.15
    """Share of the domain's bearings and distances with which the curriculum begins, up to 1."""
    horizon: float = 120.0
    """Time after which a trial in which the law is learned ends [s]; it is judged by 300 s."""
    every: float = 1.0
    """Wall clock between two moments at which the run is kept [min]."""
    fidelity: Fidelity = "fast"
    engine: Engine = "fused"
    seed: int = 0
    """Seed of the weights and the actions, and of the worlds for tuning and validation."""
    device: Device = "auto"
    quick: bool = False
    """Whether to learn something small in minutes on two cores. What is not asked for becomes
    small: an mlp of 32 pairs learns with boxes in 256 worlds."""
    out: Path = Path("runs/learn")
    """Run folder; a run that was killed is continued there."""

    def run(self) -> None:
        """Learn, then print what was learned and where the time went."""
        from rps_jax.tuning.learn import Lessons, learn, open_run
        from rps_jax.tuning.ppo import PPO

        asked = self._quickly() if self.quick else self

        def of(kind: Any, **others: Any) -> Any:
            same = {field.name for field in dataclasses.fields(kind)} & set(asked.__dict__)
            return kind(**{name: getattr(asked, name) for name in same} | others)

        how = of(PPO)
        several = tuple(parsing.domain_of(text) for text in asked.domain)
        lessons = of(Lessons, domains=several)
        running.choose_device(asked.device)
        open_run(asked.out, how, lessons, asked.minutes, asked.updates)
        running.use_cache()
        with _watched(asked.minutes, asked.updates) as watch:
            curve = learn(
                several, asked.out, how, minutes=asked.minutes, updates=asked.updates,
                lessons=lessons, every=asked.every, watch=watch,
            )  # fmt: skip
        _tell(asked.out, curve)

    def _quickly(self) -> Learn:
        """The options with what is small, where nothing else than the default was asked for."""
        small = {
            "objects": ("random_box",), "network": "mlp", "width": 32, "worlds": 256,
            "drawn": 1024, "validation": 64, "batches": 4, "minutes": 5.0,
        }  # fmt: skip
        default = type(self)()
        free = {name for name in small if getattr(self, name) == getattr(default, name)}
        return dataclasses.replace(self, **{name: small[name] for name in free})


@contextlib.contextmanager
def _watched(minutes: float, updates: int) -> Iterator[Callable[[dict[str, float]], None]]:
    """A bar over wall clock or updates."""
    from tqdm import tqdm

    total, unit = (updates, "update") if updates else (round(60 * minutes), "s")
    with tqdm(total=total, unit=unit, desc="compile", mininterval=0.5) as bar:
        count = simulated = 0.0

        def watch(told: dict[str, float]) -> None:
            nonlocal count, simulated
            count += 1
            simulated = simulated or told["simulated"]
            bar.set_description("learn", refresh=False)
            bar.set_postfix_str(
                f"{told['simulated']:.3g} s simulated, level {100 * told['level']:.0f} %, "
                f"success {100 * told['success']:.0f} %",
                refresh=False,
            )
            bar.update((count if updates else min(round(told["time"]), total)) - bar.n)

        yield watch


def _tell(out: Path, curve: Dataset) -> None:
    """A few lines on what was learned."""
    import jax
    import numpy as np

    compile_, run = curve.attrs["compile"], curve.attrs["run"]
    simulated = float(curve.simulated[-1]) if curve.sizes["update"] else 0.0
    judged = curve.validation.dropna("update")
    print(
        f"compile {compile_:.1f} s, run {run:.1f} s ({simulated / max(run, 1e-9):.0f} simulated s "
        f"per s) on {jax.devices()[0].device_kind}"
    )
    for update, rate in zip(judged["update"].values, judged.values, strict=True):
        at = curve.sel(update=update)
        print(
            f"update {update}, {float(at.time) / 60:.1f} min: success in validation "
            f"{100 * rate:.1f} % in {float(at.validation_time):.0f} s, curriculum at "
            f"{100 * float(at.level):.0f} %"
        )
    best = np.max(judged.values, initial=0.0)
    print(f"policy: {out / 'policy.npz'} ({100 * best:.1f} %), for rps ladder --laws")
    print(f"run folder: {out}, with curve.nc and curve.png")
