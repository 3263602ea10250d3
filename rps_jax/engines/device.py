"""The device that steps worlds: its choice, its processors and its C compiler."""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Literal

from rps_jax.errors import InputError
from rps_jax.record import provenance
from rps_jax.record.files import JsonObject

Device = Literal["auto", "cpu", "gpu", "xla"]


def configure_xla() -> None:
    """Set flags of XLA: deterministic sums, no preallocation of GPU memory, no fused multiply-add.

    Deterministic sums make commands repeatable. Preallocation takes a second. From JAX 0.12 on, XLA
    fuses multiply-add in the body of a vectorised loop but not in its remainder, so that bits would
    depend on a trial's slot; AVX has no such instruction.
    """
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    flags = {"--xla_gpu_deterministic_ops": "true"}
    release = tuple(map(int, metadata.version("jax").split(".")[:2]))
    if release >= (0, 12) and platform.machine().lower() in ("x86_64", "amd64"):
        flags["--xla_cpu_max_isa"] = "AVX"
    text = os.environ.get("XLA_FLAGS", "").strip()
    if text and not text.startswith("-"):  # the name of a file of flags
        with contextlib.suppress(OSError):
            os.environ["XLA_FLAGS"] = " ".join(Path(text).read_text().split())
    for flag, value in flags.items():
        if flag not in (flags_before := os.environ.get("XLA_FLAGS", "")):
            os.environ["XLA_FLAGS"] = f"{flags_before} {flag}={value}".strip()


def has_started() -> bool:
    """Return whether JAX has started its devices in this process."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return bridge is not None and bridge.backends_are_initialized()


_forks = list[bool]()  # whether JAX had started, for each fork that led to this process
if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=lambda: _forks.append(has_started()))


def check_process() -> None:
    """Raise InputError in the fork of a process in which JAX had started: it would hang."""
    if any(_forks):
        raise InputError(
            "this process is a fork of one in which JAX runs, whose threads it lacks, so that it "
            "would hang: start workers with the context 'spawn', as multiprocessing.get_context"
            "('spawn'), or with vector_kwargs={'context': 'spawn'} in gymnasium.make_vec."
        )


def check_eager(name: str, inputs: object) -> None:
    """Raise InputError for traced inputs of a function, or within `jit`, `vmap` or `grad`."""
    import jax
    from jax.extend.core import find_top_trace

    trace = find_top_trace(())  # which starts no device
    with jax.core.eval_context():
        is_traced = trace is not find_top_trace(())
    if is_traced or any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(inputs)):
        raise InputError(
            f"{name} returns numbers of the host: call it outside of jit, vmap and grad, or "
            "transform a function that calls rps_jax.rollout."
        )


@contextlib.contextmanager
def standard_jax() -> Iterator[None]:
    """Run with JAX's default checks in this thread, whatever the user's own code needs.

    The engines mix types by design, move arrays implicitly, and use NaN and infinity as values.
    Also a decorator.
    """
    import jax

    with contextlib.ExitStack() as stack:
        for context in (
            jax.numpy_dtype_promotion("standard"),
            jax.numpy_rank_promotion("allow"),
            jax.transfer_guard("allow"),
            jax.disable_jit(False),
            jax.no_tracing(False),
            jax.debug_nans(False),
            jax.debug_infs(False),
            jax.check_tracer_leaks(False),
            jax.legacy_prng_key("allow"),
            jax.enable_custom_prng(False),
        ):
            stack.enter_context(context)
        yield


def choose(name: Device) -> None:
    """Make JAX use a kind of device; `xla` is the processor without the C compiler.

    Raises:
      InputError: the device is not available.
    """
    import jax

    platforms = jax.config.jax_platforms
    if name == "auto":
        try:
            jax.devices()
        except (RuntimeError, AssertionError) as error:  # JAX raises either
            variable = "JAX_PLATFORMS" if platforms else "JAX_PLATFORM_NAME"
            platform_name = platforms or os.environ.get(variable)
            message = f"{variable} = {platform_name} is not available: name another, or none."
            raise InputError(message) from error
        return
    jax.config.update("jax_platforms", "cuda" if name == "gpu" else "cpu")
    with contextlib.suppress(RuntimeError, AssertionError):  # JAX raises either
        if jax.default_backend() == ("cpu" if name == "xla" else name):
            if name == "xla":
                os.environ["RPS_COMPILER"] = "none"
            return
    jax.config.update("jax_platforms", platforms)
    raise InputError(
        f"device = {name} is not available: install rps_jax[cuda] on a machine with an NVIDIA GPU, "
        "or choose cpu."
    )


def find_compiler() -> str | None:
    """Return the path of the C compiler of native functions; None: XLA compiles them.

    The environment variable RPS_COMPILER names another one, or `none`.
    """
    name = os.environ.get("RPS_COMPILER", "cc" if os.name == "posix" else "none")
    return None if name == "none" else shutil.which(name)


def _compiler_version() -> str | None:
    """Return the first line that the C compiler prints about itself."""
    if (name := find_compiler()) is None:
        return None
    done = subprocess.run([name, "--version"], capture_output=True, text=True, timeout=60)
    return done.stdout.partition("\n")[0] or name


def count_processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def collect_environment() -> JsonObject:
    """Return the record of this process: command, versions, commit, device and compiler."""
    import jax

    used = jax.devices()[0]
    return provenance.collect_environment(
        processors=count_processors(),
        device={"platform": used.platform, "kind": used.device_kind, "count": jax.device_count()},
        x64=bool(jax.config.jax_enable_x64),
        compiler=_compiler_version() if used.platform in ("cpu", "gpu") else None,
    )
