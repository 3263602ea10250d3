"""The cache of compiled programs between processes: its folder, and files with a checksum."""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from rps_jax.record import files
from rps_jax.record.options import check_arguments

T = TypeVar("T")
MAX_BYTES = 512 * 2**20  # [bytes] of the files in one folder of the cache
_DIGEST = hashlib.sha256().digest_size


def default_folder() -> Path:
    """Return the folder of the cache: $RPS_CACHE, else `rps_jax` in the user's cache."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(os.environ.get("RPS_CACHE") or Path(base) / "rps_jax")


def use_cache(folder: str | Path | None = None) -> Path | None:
    """Cache compiled programs between processes, so that a machine compiles each once.

    The command line always does this. A library call does it if the environment variable RPS_CACHE
    names a folder.

    Args:
      folder: of the cache; by default $RPS_CACHE, else `rps_jax` in the user's cache.

    Returns:
      The folder, or None if it cannot be written: a run needs no cache.

    Examples:
      >>> import rps_jax
      >>> folder = rps_jax.use_cache("programs")
      >>> folder.name
      'programs'
    """
    import jax

    check_arguments(use_cache, {"folder": folder})
    path = (default_folder() if folder is None else Path(folder)).absolute()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    # By default JAX does not cache programs that are small or compile fast.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return path


def use_cache_if_requested() -> None:
    """Cache compiled programs if RPS_CACHE is set and JAX has no cache yet."""
    import jax

    if os.environ.get("RPS_CACHE") and not jax.config.jax_compilation_cache_dir:
        use_cache()


def read(path: Path, done: str, parse: Callable[[bytes], T]) -> T | None:
    """Return the parsed content of a cached file; None if it is missing or damaged.

    A damaged file is deleted, with a warning that its program is `done` (compiled, traced) again.
    """
    try:
        content = path.read_bytes()
    except OSError:
        return None
    body = content[:-_DIGEST]
    try:
        if hashlib.sha256(body).digest() != content[-_DIGEST:]:
            raise ValueError("its checksum differs")
        parsed = parse(body)
    except Exception as error:  # a damaged file can raise anything
        warnings.warn(f"{path} is dropped, and {done} again: {error}", stacklevel=2)
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return parsed


def write(path: Path | None, body: bytes) -> None:
    """Write a file with its checksum and delete the least recently used ones beyond MAX_BYTES.

    Failures are ignored: a run needs no cache.
    """
    if path is None:
        return
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_bytes(path, body + hashlib.sha256(body).digest())
        newest_first = sorted(path.parent.iterdir(), key=lambda file: -file.stat().st_mtime)
        total = 0
        for file in newest_first:
            total += file.stat().st_size
            if total > MAX_BYTES:
                file.unlink()
