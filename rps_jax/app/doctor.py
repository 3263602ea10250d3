"""What works on this machine, and how to mend what does not."""

from dataclasses import dataclass
from pathlib import Path

from rps_jax.engines import device, native
from rps_jax.errors import InputError
from rps_jax.lowering import nvrtc
from rps_jax.record import cache
from rps_jax.record import folder as run_folder
from rps_jax.record.options import option
from rps_jax.runs.question import Question, call_of
from rps_jax.world import video


@dataclass(frozen=True)
class Doctor(Question[str]):
    """Print versions, devices and folders, and what does not work with its mend."""

    out: Path | str | None = option(None, kw_only=True, hidden=True)

    def in_shell(self) -> None:
        """Print the report."""
        print(report(cache.default_folder()))


doctor = call_of(Doctor)


def report(cache: Path) -> str:
    """Versions, devices, folders and the state of rendering, one line each."""
    checks = [("cache", *_writable(cache)), *video.check()]
    environment = device.collect_environment()
    found = environment["device"]
    rows = {
        "python": f"{environment['python']} on {environment['platform']}",
        **{name: version or "not installed" for name, version in environment["packages"].items()},
        "device": f"{found['count']} x {found['kind']} ({found['platform']}), "
        f"{environment['processors']} processors",
        "compiler": environment["compiler"]
        or "none: XLA steps the fused engine, more slowly than a C compiler's program would",
        "kernels": _kernels(found["platform"]),
        "commit": environment["commit"] or "not in a checkout",
        "cached in": str(cache),
        **{what: "ok" if works else f"FAILS: {mend}" for what, works, mend in checks},
    }
    return "\n".join(f"{name:<12}{text}" for name, text in rows.items())


def _kernels(platform: str) -> str:
    if platform != "gpu":
        return "none: JAX finds no GPU"
    made = native.target() and nvrtc.target()
    return f"by NVRTC {made}" if made else "none: XLA steps the fused engine, many times slower"


def _writable(folder: Path) -> tuple[bool, str]:
    try:
        run_folder.ensure_writable(folder)
    except InputError:
        return False, f"{folder} cannot be written: set RPS_CACHE to a writable folder"
    return True, ""
