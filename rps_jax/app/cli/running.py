"""How a command runs: its device, its cache of programs, its exit code, and what it tells."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rps_jax.errors import InputError

if TYPE_CHECKING:
    from xarray import Dataset

    from rps_jax.analysis.report import Section
    from rps_jax.runs.plan import Plan
    from rps_jax.trials.setting import Timing


def guarded(action: Callable[[], object]) -> int:
    """Run a command: exit code 0, or one sentence on the error stream and 2 (130: interrupted)."""
    be_deterministic()
    try:
        action()
    except InputError as error:
        return _told(str(error))
    except OSError as error:
        mend = "make room, then run the same command again; what is done is kept"
        hint = f": {mend}" if error.errno == errno.ENOSPC else ""
        return _told(f"{error.filename or 'output'}: {error.strerror}{hint}.")
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        return _told(
            "the device is out of memory: ask for fewer worlds at once with --slots; what is done "
            "is kept."
        )
    except MemoryError:
        return _told("this machine is out of memory: ask for fewer worlds; what is done is kept.")
    except KeyboardInterrupt:
        print("rps: interrupted.", file=sys.stderr)
        return 130
    return 0


def _told(sentence: str) -> int:
    print(f"rps: error: {sentence}", file=sys.stderr)
    return 2


def be_deterministic() -> None:
    """Ask XLA for GPU sums in a fixed order: the same command must give the same results."""
    flag = "--xla_gpu_deterministic_ops"
    flags = os.environ.get("XLA_FLAGS", "")
    if flag not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {flag}=true".strip()


def cache_folder() -> Path:
    """Where compiled programs are kept between runs: $RPS_CACHE, else the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("RPS_CACHE") or Path(base) / "rps_jax")


def use_cache() -> None:
    """Keep compiled programs, if the folder can be written; a run needs no cache."""
    import jax

    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    os.environ.setdefault("WARP_CACHE_PATH", str(cache_folder() / "warp"))


def choose_device(name: str) -> None:
    """Have JAX use this kind of device.

    Raises:
      InputError: there is no such device.
    """
    import jax

    if name == "auto":
        try:
            jax.devices()
        except (RuntimeError, AssertionError) as error:  # whichever JAX raises
            asked = jax.config.jax_platforms
            raise InputError(
                f"JAX_PLATFORMS = {asked} is not there: name a device that is, or none."
            ) from error
        return
    before = jax.config.jax_platforms
    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[name])
    with contextlib.suppress(RuntimeError, AssertionError):  # whichever JAX raises
        if jax.default_backend() == name:
            return
    jax.config.update("jax_platforms", before)
    raise InputError(
        f"device = {name} is not there: install rps_jax[cuda] on a machine with an NVIDIA GPU, or "
        "choose cpu."
    )


def tell(timing: Timing, device: str | None = None) -> None:
    """Print where the time of a run went."""
    import jax

    print(
        f"compile {timing.compile:.1f} s, run {timing.run:.1f} s "
        f"({timing.simulated / max(timing.run, 1e-9):.0f} simulated s per s) on "
        f"{device or jax.devices()[0].device_kind}"
    )


def tell_sweep(
    out: Path,
    plan: Plan,
    results: Dataset | None,
    timing: Timing | None = None,
    models: Dataset | None = None,
    more: Callable[[Path, Plan, Dataset], Sequence[Section]] = lambda *_: (),
) -> None:
    """Print where the time of a sweep went, if it ran; then write and print its report."""
    from rps_jax.record import provenance
    from rps_jax.runs.report import write_report

    if timing:
        tell(timing, provenance.signed(out)["device"]["kind"])
    if results is None:
        print(f"run folder: {out}; when all shards are done: rps merge {out} --out {out}")
    else:
        print(write_report(out, plan, results, models, more(out, plan, results)).read_text())
        print(f"run folder: {out}")
