"""The doctor: a report of what works on this machine, with a fix for the rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from rps_jax.engines import device, native
from rps_jax.errors import InputError
from rps_jax.lowering import nvrtc
from rps_jax.record import cache
from rps_jax.record import folder as run_folder
from rps_jax.record.options import option
from rps_jax.runs.question import Command, call_of
from rps_jax.trials.progress import ProgressCallback
from rps_jax.world import video


@dataclass(frozen=True)
class Doctor(Command[None]):
    """Print versions, devices and folders, and a fix for each check that fails."""

    out: Path | str | None = option(None, kw_only=True, hidden=True)
    faults: Sequence[str] = option((), kw_only=True, hidden=True)
    """Faults of the environment."""

    def with_faults(self, faults: Sequence[str]) -> Self:
        return replace(self, faults=faults)

    def execute(self, callback: ProgressCallback) -> None:
        """Print the report."""
        print(report(cache.default_folder(), self.faults))


doctor = call_of(Doctor)


def report(cache: Path, faults: Sequence[str] = ()) -> str:
    """Return versions, devices, folders and the checks of rendering, one line each."""
    fixes = {f"fault {i}": fault for i, fault in enumerate(faults, 1)}
    fixes |= {"cache": _check_cache(cache), **video.check()}
    environment = device.collect_environment()
    hardware = environment["device"]
    rows = {
        "python": f"{environment['python']} on {environment['platform']}",
        **{name: version or "not installed" for name, version in environment["packages"].items()},
        "device": f"{hardware['count']} x {hardware['kind']} ({hardware['platform']}), "
        f"{environment['processors']} processors",
        "compiler": environment["compiler"]
        or "none: XLA steps the fused engine, more slowly than a C compiler's program would",
        "kernels": _kernels(hardware["platform"]),
        "commit": environment["commit"] or "not in a checkout",
        "cached in": str(cache),
        **{name: f"FAILS: {fix}" if fix else "ok" for name, fix in fixes.items()},
    }
    return "\n".join(f"{name:<12}{text}" for name, text in rows.items())


def _kernels(platform: str) -> str:
    if platform != "gpu":
        return "none: JAX finds no GPU"
    target = native.target() and nvrtc.target()
    return f"by NVRTC {target}" if target else "none: XLA steps the fused engine, many times slower"


def _check_cache(folder: Path) -> str:
    """Return how to fix a cache that cannot be written; an empty text if it can."""
    try:
        run_folder.ensure_writable(folder)
    except InputError:
        return f"{folder} cannot be written: set RPS_CACHE to a writable folder"
    return ""
