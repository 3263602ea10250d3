"""Shared by all tests: the processor, a cache of compiled programs, and a small run."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
if not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")


def pytest_configure(config):
    import jax

    jax.config.update("jax_compilation_cache_dir", str(config.rootpath / ".jax_cache"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
