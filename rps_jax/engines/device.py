"""On which device worlds are stepped, and where its compiled programs are kept between runs."""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import warnings
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from rps_jax import engines
from rps_jax.errors import InputError
from rps_jax.record import files

MOST = 512 * 2**20  # bytes of a kind that are kept
_DIGEST = hashlib.sha256().digest_size
Device = Literal["auto", "cpu", "gpu", "xla"]


def configure_xla() -> None:
    """Ask XLA for sums in a fixed order, and to take a GPU's memory as it is needed.

    The same command must give the same results. To take most of the memory at once takes a second.
    From JAX 0.12 on it multiplies and adds in one step in the body of a vectorised loop, but not in
    its remainder, so that bits would depend on a trial's slot: AVX has no such instruction.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    flags = {"--xla_gpu_deterministic_ops": "true"}
    release = tuple(map(int, metadata.version("jax").split(".")[:2]))
    if release >= (0, 12) and platform.machine().lower() in ("x86_64", "amd64"):
        flags["--xla_cpu_max_isa"] = "AVX"
    for flag, value in flags.items():
        if flag not in (before := os.environ.get("XLA_FLAGS", "")):
            os.environ["XLA_FLAGS"] = f"{before} {flag}={value}".strip()


def cache_folder() -> Path:
    """Where compiled programs are kept between runs: $RPS_CACHE, else the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("RPS_CACHE") or Path(base) / "rps_jax")


def use_cache(folder: str | Path | None = None) -> Path | None:
    """Keep compiled programs between processes, so that each compiles once on a machine.

    The command line does this by itself. A library call does it if the environment variable
    RPS_CACHE names a folder.

    Args:
      folder: where they are kept; by default $RPS_CACHE, else `rps_jax` in the user's cache.

    Returns:
      The folder, or None if it cannot be written: a run needs no cache.

    Example:
      >>> import rps_jax
      >>> folder = rps_jax.use_cache("programs")
      >>> folder.name
      'programs'
    """
    import jax

    where = (cache_folder() if folder is None else Path(folder)).absolute()
    try:
        where.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(where))
    # Many programs of ours are small, and compile in less than JAX thinks worth keeping.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return where


def use_cache_if_asked() -> None:
    """Keep compiled programs if RPS_CACHE is set and no other cache is in use."""
    import jax

    if os.environ.get("RPS_CACHE") and not jax.config.jax_compilation_cache_dir:
        use_cache()


def kind() -> str:
    """What JAX computes on, in words."""
    import jax

    return jax.devices()[0].device_kind


def choose(name: Device) -> None:
    """Have JAX use this kind of device; `xla` is the processor without the C compiler.

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
    jax.config.update("jax_platforms", "cuda" if name == "gpu" else "cpu")
    with contextlib.suppress(RuntimeError, AssertionError):  # whichever JAX raises
        if jax.default_backend() == ("cpu" if name == "xla" else name):
            if name == "xla":
                os.environ["RPS_COMPILER"] = "none"
            return
    jax.config.update("jax_platforms", before)
    raise InputError(
        f"device = {name} is not there: install rps_jax[cuda] on a machine with an NVIDIA GPU, or "
        "choose cpu."
    )


def suits_processors(question: Any) -> bool:
    """Whether processors answer a question sooner than a GPU, as its engine says."""
    import jax

    setting = getattr(question, "setting", None)
    if setting is None or jax.config.jax_platforms:
        return False
    return engines.get(setting.engine).suits_processors(question.num_trials())


def kept(path: Path, done: str, read: Callable[[bytes], Any]) -> Any:
    """What `keep` kept, as it is read; None if it is not there, or damaged: then it is dropped."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    body = content[:-_DIGEST]
    try:
        if hashlib.sha256(body).digest() != content[-_DIGEST:]:
            raise ValueError("its checksum differs")
        found = read(body)
    except Exception as error:  # whatever a damaged file leads to
        warnings.warn(f"{path} is dropped, and {done} again: {error}", stacklevel=2)
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return found


def keep(path: Path | None, body: bytes) -> None:
    """Keep bytes and drop what was not used for longest; a run needs neither."""
    if path is None:
        return
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_bytes(path, body + hashlib.sha256(body).digest())
        every = sorted(path.parent.iterdir(), key=lambda one: -one.stat().st_mtime)
        total = 0
        for one in every:
            total += one.stat().st_size
            if total > MOST:
                one.unlink()
