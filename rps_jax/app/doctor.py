"""What works on this machine, and how to mend what does not."""

from __future__ import annotations

from pathlib import Path

from rps_jax.analysis import video
from rps_jax.errors import InputError
from rps_jax.record import folder as run_folder
from rps_jax.record import provenance


def report(cache: Path) -> str:
    """Versions, devices, folders and the state of rendering, one line each."""
    checks = [("cache", *_writable(cache)), *video.check()]
    environment = provenance.environment()
    device = environment["device"]
    rows = {
        "python": f"{environment['python']} on {environment['platform']}",
        **{name: version or "not installed" for name, version in environment["packages"].items()},
        "device": f"{device['count']} x {device['kind']} ({device['platform']}), "
        f"{environment['processors']} processors",
        "commit": environment["commit"] or "not in a checkout",
        "cached in": str(cache),
        **{what: "ok" if works else f"FAILS: {mend}" for what, works, mend in checks},
    }
    return "\n".join(f"{name:<12}{text}" for name, text in rows.items())


def _writable(folder: Path) -> tuple[bool, str]:
    try:
        run_folder.writable(folder)
    except InputError:
        return False, f"{folder} cannot be written: set RPS_CACHE to a writable folder"
    return True, ""
