"""Set-up of all tests: processor, fast compilation, offscreen rendering, checked shapes, cache."""

import functools
import gc
import os
import signal
from importlib import metadata
from pathlib import Path

import pytest
import tolerances

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Most of the time of the tests is compilation. It takes a third without optimisations, and two
# thirds of that with the older emitters of XLA, which JAX has up to 0.10.
FAST_COMPILATION = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "true", "NUMBA_DISABLE_JIT": "1"}
if metadata.version("jax") < "0.11":
    flags = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    FAST_COMPILATION["XLA_FLAGS"] = flags
if os.name == "posix":
    FAST_COMPILATION["RPS_COMPILER"] = str(Path(__file__).with_name("cc"))


def pytest_addoption(parser):
    ratios = "write the error over the tolerance of each numeric assertion to FILE.gw*"
    parser.addoption("--tolerances", metavar="FILE", help=ratios)
    as_users = "compile as users do: C with -O2, XLA with its optimisations"
    parser.addoption("--as-users-compile", action="store_true", help=as_users)


RATIOS = []


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item):
    for ratios in RATIOS:
        ratios.test = item.nodeid


def pytest_assertion_pass(lineno, orig, expl):
    for ratios in RATIOS:
        tolerances.compare(ratios, lineno, orig, expl)


def pytest_sessionfinish():
    for ratios in RATIOS:
        ratios.write()


def pytest_configure(config):
    if not config.getoption("--as-users-compile"):
        os.environ.update(FAST_COMPILATION | os.environ)
    if path := config.getoption("--tolerances"):
        worker = os.environ.get("PYTEST_XDIST_WORKER", "main")
        RATIOS.append(tolerances.install(Path(f"{path}.{worker}")))
    # A shell that starts pytest in the background lets it and its subprocesses ignore interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    import shapes  # and with it JAX, which reads the environment once

    shapes.install()
    import graph_verifier
    import jax

    from rps_jax.engines import device
    from rps_jax.world import rendering

    graph_verifier.install()
    rendering.choose_gl()
    device.configure_xla()
    cache = config.rootpath / ".jax_cache"
    os.environ.setdefault("RPS_CACHE", str(cache))  # of commands, also in subprocesses
    jax.config.update("jax_compilation_cache_dir", os.environ["RPS_CACHE"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


# Slow files start first; a slow file at the end would leave processors idle.
LONGEST = """
    derivatives push_page pose replay lowering sweep export native faults view bags cli learning
    benchmark finger tune smooth contact_derivatives rooms library examples drives fit
    drive_commands mjx_gradients failures support robot ros2 task_commands trial rivals video film
    tasks house package_laws ground gpu_writer gallery gym descent cluster shell ladder study
    programs evaluate scene env random_laws law_files figures footprint planning skin feet floors
    limits law notebooks transformations physics fused walls publish quasistatic
"""


def pytest_collection_modifyitems(items):
    rank = {f"test_{name}": i for i, name in enumerate(LONGEST.split())}
    items.sort(key=lambda item: rank.get(item.path.stem, len(rank)))


def pytest_collection_finish(session):
    # Python's collector takes a tenth of the time of the tests: it searches modules and programs,
    # which stay, for each few hundred objects that are created.
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture(autouse=True, scope="module")
def frozen_programs():
    """Hide the programs of earlier files from the collector."""
    gc.collect()  # frozen garbage would stay
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def few_pictures():
    """Render the first picture of each name, and only draw the others, which is faster."""
    from rps_jax.analysis.report import Picture

    render, rendered = Picture.png, {}

    def png(picture):
        """Return a PNG file of the picture's name."""
        if picture.name in rendered:
            picture.draw()
        else:
            rendered[picture.name] = render(picture)
        return rendered[picture.name]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Picture, "png", png)
        yield


@functools.cache
def why_no_drawing():
    """Sentence that says how this machine would learn to draw; empty if it can."""
    from rps_jax.world import rendering

    try:
        rendering.check_rendering()
    except rendering.VideoError as error:
        return str(error)
    return ""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """Skip a test that failed since this machine cannot draw, in CI excepted."""
    report = yield
    if report.failed and os.environ.get("CI") != "true":
        fix = why_no_drawing()
        if fix and fix[:30] in report.longreprtext + report.capstderr:
            report.outcome, report.longrepr = "skipped", (str(item.path), None, fix)
    return report


@pytest.fixture
def compiled():
    """Durations [s] of the compilations of this test so far."""
    from jax import monitoring

    durations = []

    def note(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            durations.append(duration)

    monitoring.register_event_duration_secs_listener(note)
    yield durations
    monitoring.unregister_event_duration_listener(note)


@pytest.fixture(scope="module")
def optimised():
    """Compile with optimisations in tests of a file that run longer than they compile."""
    import jax

    jax.config.update("jax_disable_most_optimizations", False)
    yield
    is_disabled = os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS") == "true"
    jax.config.update("jax_disable_most_optimizations", is_disabled)


@pytest.fixture
def registries():
    """Restore the registries of extensions after a test."""
    from helpers import temporary_names

    with temporary_names():
        yield
