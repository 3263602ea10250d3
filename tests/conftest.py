"""Shared by all tests: the processor, offscreen drawing, and a cache of compiled programs."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")


def pytest_configure(config):
    import jax

    from rps_jax import video

    video.choose_gl()
    cache = config.rootpath / ".jax_cache"
    jax.config.update("jax_compilation_cache_dir", str(cache))
    os.environ.setdefault("WARP_CACHE_PATH", str(cache / "warp"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
