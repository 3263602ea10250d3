"""Faults of input and environment: no command ends in a traceback, hangs, or prints two errors.

pytest -m "slow or not slow" tests/test_faults.py    # all environments: a minute
"""

import dataclasses
import inspect
import os
import re
import runpy
import subprocess
import sys

import fuzz
import numpy as np
import pytest
from helpers import ROOT, one_sentence, output_of, refusing, slow

import rps_jax
from rps_jax.app.cli import environment
from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import options

SHARE = {"values": 15, "laws": 120, "edits": 2}


@pytest.mark.parametrize("name", SHARE)
def test_faults_are_reported_in_one_sentence(name, registries):
    run, _ = fuzz.CLASSES[name]
    bad: list[str] = []
    counts = run(SHARE[name], 1, bad.append)
    assert not bad, "\n\n".join(bad)
    assert counts["refused"] >= SHARE[name] // 10


# --- types of arguments ----------------------------------------------------------------------

COMMANDS = {
    "push": {},
    "table": {},
    "sweep": {},
    "replay": {"run": "/nowhere"},
    "hardware": {},
    "sensitivity": {},
    "tune_es": {},
    "learn": {},
    "Setting": {},
    "Domain": {},
    "PushEnv": {},
    "evaluate": {"law": "rps"},
    "load": {},
    "stack": {},
    "use_cache": {},
}
WRONG = {
    "a nested list": [[1, 2], 3],
    "a matrix": np.zeros((2, 2)),
    "an object": object(),
    "a set": {0.5},
    "a complex number": 1j,
    "bytes": b"box",
}


@pytest.mark.parametrize("value", WRONG.values(), ids=WRONG)
@pytest.mark.parametrize("name", COMMANDS)
def test_values_of_a_wrong_type_are_refused_in_one_sentence(name, value):
    call = getattr(rps_jax, name)
    function = inspect.unwrap(call)
    if dataclasses.is_dataclass(function):
        names = [field.name for field in dataclasses.fields(function)]
    else:
        names = list(inspect.signature(function).parameters)
    with fuzz.never_stepping():
        for field in names:
            with pytest.raises(InputError) as refused:
                call(**COMMANDS[name] | {field: value})
            assert str(refused.value).endswith(".")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"target": 2}, "target = 2 is not allowed: give 2 numbers"),
        ({"target": (1, 2, 3)}, r"target = \(1, 2, 3\) is not allowed: give 2 numbers"),
        ({"target": ("a", "b")}, r"target = \('a', 'b'\) is not allowed: give 2 numbers"),
        ({"target": (float("nan"), 0)}, "target x = nan is not allowed"),
        ({"object": 3}, "object = 3 is not allowed: give a text"),
        ({"friction": 0.3}, "friction = 0.3 is not allowed: give a text or a Friction or 2 num"),
        ({"skin": 3}, "skin = 3 is not allowed: give a text or an IdealSkin"),
        ({"out": 3}, "out = 3 is not allowed: give a path or a text"),
        ({"quick": 1}, "quick = 1 is not allowed: give True or False"),
        ({"gap": True}, "gap = True is not allowed: it must be a number"),
        ({"slots": True}, "slots = True is not allowed: it must be a whole number"),
        ({"report_to": 3}, "report_to = 3 is not allowed: give a function"),
    ],
)
def test_a_wrong_type_is_named_with_the_right_one(arguments, message):
    with refusing(message):
        rps_jax.push(**arguments)


def test_one_name_for_several_is_refused_with_an_example():
    with refusing(r"objects = 'box' .*: give several texts, as \['box'\]"):
        rps_jax.table(objects="box")


def test_sequences_may_be_tuples_lists_or_arrays():
    @dataclasses.dataclass(frozen=True)
    class Record:
        pair: tuple[float, float] = (0, 0)
        names: tuple[str, ...] = ()

    for pair in ((1, 2), [1.0, 2], np.array([1, 2]), np.float32([1, 2])):
        options.check_fields(Record(pair, ["a", np.str_("b")]))


# --- the environment -------------------------------------------------------------------------

# Commands of a shell, in which `push` is a short one without a film, and their exit codes and
# output.
SHELL = [
    # Streams that nobody reads.
    ("rps --help >&-", 0, ""),
    ("rps --help | head -1 >&2", 0, "usage"),
    ("rps psh >&- 2>&-", 2, ""),
    # Variables.
    ("JAX_ENABLE_X64=maybe push", 2, "jax cannot be imported .*JAX_ENABLE_X64.*: correct or"),
    (
        "MPLBACKEND=Qt9Agg TERM=dumb COLUMNS=0 LC_ALL=C PYTHONUTF8=0 PYTHONIOENCODING=ascii "
        "push --object Körper/Fuß.xml >&2",
        0,
        "not reached at 1.0 s, never touched",
    ),
]
MORE = [
    ("MUJOCO_GL=vulkan push", 2, "MUJOCO_GL = vulkan is not allowed .* set it to egl"),
    ("XLA_FLAGS=--xla_nonsense=1 push", 2, "XLA_FLAGS = --xla_nonsense=1 .*Unknown flag"),
    ("rps psh 2>/dev/full", 2, ""),
    ("rps psh 2>&1 | true", 2, ""),
    ("MUJOCO_GL=vulkan rps doctor >&2", 0, "FAILS: MUJOCO_GL = vulkan is not allowed"),
    ("rps sweep --help | head -1 >&2", 0, "usage"),
    ("rps doctor >&-", 0, ""),
    ("push >&- 2>&- <&-", 0, ""),
    ("push | true", 0, ""),
    ("push >/dev/full", 2, "No space left on device"),
    ("MPLBACKEND=nonsense push", 0, ""),
    ("MUJOCO_GL=wgl push", 2, "MUJOCO_GL = wgl is not allowed"),
    ("MUJOCO_GL=disable push", 0, ""),
    ("PYOPENGL_PLATFORM=x film >&2", 0, "no film: MuJoCo cannot draw"),
    ("IMAGEIO_FFMPEG_EXE=/nowhere/x film >&2", 0, "no film: IMAGEIO_FFMPEG_EXE = /nowhere/x"),
    ("XLA_FLAGS=nonsense push", 2, 'XLA_FLAGS = nonsense .*Could not open file "nonsense"'),
    ("XLA_FLAGS=--xla_force_host_platform_device_count=abc push", 2, "cannot read the value of a"),
    ("XLA_FLAGS=--xla_nonsense=1 rps doctor >&2", 0, "FAILS: XLA_FLAGS = --xla_nonsense"),
    ("XLA_FLAGS=flags.txt push", 0, ""),
    ("JAX_PLATFORMS=cpu,nonsense push", 2, "JAX_PLATFORMS = cpu,nonsense is not available"),
    ("JAX_PLATFORMS=nonsense rps doctor >&2", 0, "FAILS: JAX_PLATFORMS = nonsense"),
    ("JAX_NUMPY_DTYPE_PROMOTION=maybe push", 2, "jax cannot be imported"),
    ("TQDM_MININTERVAL=abc push", 2, "tqdm cannot be imported .*: correct or unset"),
    ("JAX_NUMPY_DTYPE_PROMOTION=strict JAX_NUMPY_RANK_PROMOTION=raise push", 0, ""),
    ("JAX_TRANSFER_GUARD=disallow JAX_DEBUG_NANS=1 JAX_DEBUG_INFS=1 push", 0, ""),
    ("JAX_CHECK_TRACER_LEAKS=1 JAX_ENABLE_CHECKS=1 JAX_LEGACY_PRNG_KEY=error push", 0, ""),
    ("JAX_ENABLE_X64=1 JAX_ENABLE_CUSTOM_PRNG=1 JAX_NO_TRACING=1 push", 0, ""),
    ("JAX_DISABLE_JIT=1 push", 0, ""),
    ("RPS_CACHE=/etc/passwd push", 0, ""),
    ("HOME=/nowhere RPS_CACHE= push", 0, ""),
    ("TMPDIR=/nowhere film", 0, ""),
    ("COLUMNS=-5 rps push --help >&2", 0, "--target"),
    ("LC_ALL=C PYTHONUTF8=0 rps push --object Ö.xml", 2, "cannot be read"),
    ("MPLCONFIGDIR=/proc/x push", 0, ""),
    ("RPS_COMPILER=/nowhere/cc rps doctor", 0, ""),
    ("PATH=/usr/bin:/bin RPS_COMPILER=/bin/false rps doctor", 0, ""),
    ("mkdir gone; cd gone; rmdir ../gone; push", 2, "the current folder was deleted: change"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with an object of a name that is not ASCII, and a file of flags."""
    folder = tmp_path_factory.mktemp("environment")
    (folder / "Körper").mkdir()
    (folder / "Körper" / "Fuß.xml").write_bytes((ROOT / "mjcf" / "cylinder.xml").read_bytes())
    (folder / "flags.txt").write_text("--xla_cpu_enable_fast_math=false\n")
    return folder


SHORT = "push --object cylinder --target 1 0 --engine quasistatic --horizon 1 --overwrite"


@pytest.mark.parametrize(
    ("line", "code", "output"),
    [*SHELL, *(slow(*case) for case in MORE)],
)
def test_a_command_survives_its_environment(folder, line, code, output):
    line = re.sub(r"\bfilm\b(?=[^:]*$)", f"rps {SHORT} --film-length 0.2", line)
    line = re.sub(r"(?<!rps )\bpush\b", f"rps {SHORT} --no-video", line)
    line = line.replace("rps ", f"{sys.executable} -m rps_jax ")
    env = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    shell = ["bash", "-o", "pipefail", "-c", line]
    done = subprocess.run(shell, cwd=folder, env=env, capture_output=True, timeout=120)
    error = done.stderr.decode(errors="replace")
    assert "Traceback" not in error
    assert done.returncode == code, error
    assert re.search(output, error), error
    if code == 2 and error:
        one_sentence(error)


def test_flags_that_xla_refuses_are_unset_with_the_reason(monkeypatch):
    monkeypatch.setattr(device, "has_started", lambda: False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    assert environment.unset_bad_variables() == []
    monkeypatch.setenv("XLA_FLAGS", "--xla_nonsense=1")
    (fault,) = environment.unset_bad_variables()
    assert "Unknown flag in XLA_FLAGS: --xla_nonsense=1; correct or unset it." in fault
    assert "XLA_FLAGS" not in os.environ


SCRIPTS = ("docs/push/make.py", "sweeps/speed/racers.py", "tests/command_line.py")


@pytest.mark.parametrize("path", SCRIPTS)
def test_a_script_explains_itself_and_writes_nothing(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for words, code, output in ((["--help"], 0, "usage: "), (["--nonsense"], 2, "usage: ")):
        monkeypatch.setattr(sys, "argv", [path, *words])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(str(ROOT / path), run_name="__main__")
        assert end.value.code == code
        assert output in "".join(capsys.readouterr())
    assert not list(tmp_path.iterdir())


LIBRARY = """
import rps_jax
from rps_jax.world import rendering
brief = rps_jax.Setting("quasistatic", rules=rps_jax.Rules(horizon=1.0))
trace = rps_jax.push("cylinder", target=(1.0, 0.0), setting=brief)
for call in (trace.plot, rendering.check_rendering, lambda: rps_jax.attack):
    try:
        call()
    except rps_jax.InputError as error:
        print(error)
"""


def test_the_library_needs_opengl_and_a_backend_for_figures_alone():
    env = os.environ | {"MUJOCO_GL": "vulkan", "MPLBACKEND": "Qt9Agg", "PYTHONPATH": str(ROOT)}
    lines = output_of(sys.executable, "-c", LIBRARY, env=env).splitlines()
    names = [line.partition(" is not allowed")[0] for line in lines]
    assert names == ["MPLBACKEND = Qt9Agg", "MUJOCO_GL = vulkan", "MPLBACKEND = Qt9Agg"]


def test_one_module_imports_mujoco():
    """It says what is wrong with MUJOCO_GL, whichever module is imported first."""
    pattern = re.compile(r"^(import mujoco|from mujoco import)", re.MULTILINE)
    paths = (ROOT / "rps_jax").rglob("*.py")
    assert not [path for path in paths if pattern.search(path.read_text())]
