"""The command line: whole runs, repeatable files, and helpful errors."""

import gc
import json
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import command_line
import numpy as np
import pytest
import xarray as xr
from helpers import ROOT, printed, refusal, refusing, rps, setting_of

import rps_jax
from rps_jax.app.cli import flags, names, running
from rps_jax.control import registry
from rps_jax.control.registry import LAWS
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.robot.robot import ROBOTS
from rps_jax.robot.skin import SKINS
from rps_jax.runs.question import OutputCommand, QuickQuestion
from rps_jax.runs.sweep import merge
from rps_jax.trials.results import DIMS
from rps_jax.tuning.evolution import TuneES
from rps_jax.world import paper
from rps_jax.world.domain import DOMAINS
from rps_jax.world.tasks import TASKS

PAGES = [
    page
    for folder in ("docs", "notebooks", "rps_jax", "sweeps")
    for page in (ROOT / folder).rglob("*.md")
]
COMMAND = re.compile(
    rf"(?:^|`|&& )(?:\.venv/bin/)?rps ({'|'.join(sorted(names.known(), reverse=True))})"
    r" ([^`\n|>]*)(?:`|$)",
    re.M,
)
SMALL = "table --targets 0.6 0 0.62 0.03 --horizon 18 --slots 8 --workers 1 --laws rps nps"
SMALL += " --objects box nonuniform_box --out"


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folders of two runs of one small table."""
    folders = [tmp_path_factory.mktemp("table") / name for name in ("first", "second")]
    for folder in folders:
        assert rps(SMALL, folder) == 0
    return folders


def test_a_table_run_leaves_a_labelled_run_folder(runs):
    results = files.read_results(runs[0])
    assert results.success.dims == DIMS
    assert results.sizes == {"law": 2, "object": 2, "friction": 2, "target": 2, "pose": 3}
    assert list(results.object.values) == ["box", "nonuniform_box"]
    assert results.time.attrs["units"] == "s"
    assert results.success.sel(law="rps", object="box").all()
    assert (results.min_distance.where(results.success == 1).fillna(0) < 0.05).all()
    config = json.loads((runs[0] / "manifest.json").read_text())
    assert config["question"] == "table"
    assert config["laws"]["rps"]["eta"] == 10.0
    assert config["laws"]["nps"]["reactive"] == 0.0
    environment = json.loads((runs[0] / "environment.json").read_text())
    assert environment["packages"]["mujoco"] == "3.17.0"
    assert (runs[0] / "min_distance.png").stat().st_size > 10_000
    report = (runs[0] / "report.md").read_text()
    assert "| RPS | ours" in report


def test_the_same_command_gives_the_same_results_bit_for_bit(runs):
    assert (runs[0] / "results.nc").read_bytes() == (runs[1] / "results.nc").read_bytes()


def test_another_run_is_not_written_over_it_unasked(runs, capsys):
    content = (runs[0] / "results.nc").read_bytes()
    error = refusal(capsys, SMALL, runs[0], "--seed", 1)
    assert "holds another run (setting.seed = 0 there, 1 asked for)" in error
    assert "--overwrite" in error
    assert (runs[0] / "results.nc").read_bytes() == content


QUICK_PUSH = "push --object cylinder --engine quasistatic --horizon 1 --no-video --target"
QUASISTATIC = "--engine quasistatic --horizon 8 --slots 8 --workers 1"


def test_other_options_get_a_numbered_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for target, folder in (("1 0", "push"), ("2 0", "push-2"), ("1 0", "push"), ("2 1", "push-3")):
        text = printed(capsys, f"{QUICK_PUSH} {target}")
        assert text.splitlines()[-1] == f"run folder: runs/{folder}"
        assert ("holds another run" in text) == (folder != "push")
    (first,) = tmp_path.glob("runs/push/results.nc")
    assert "holds another run" in refusal(capsys, f"{QUICK_PUSH} 3 0 --out runs/push")
    assert rps(f"{QUICK_PUSH} 3 0 --overwrite") == 0
    assert xr.load_dataset(first).p_world_target.values.tolist() == [3, 0]
    assert not (tmp_path / "runs" / "push-4").exists()


def test_every_question_offers_and_every_call_accepts_overwrite(tmp_path):
    for name in names.known():
        question = names.question_type(name)
        expected = ["--overwrite"] if issubclass(question, OutputCommand) else []
        flag_names = [
            flag
            for kind in (question, flags.session_type(question))
            for flag in flags._flag_names(kind)
        ]
        assert [flag for flag in flag_names if flag == "--overwrite"] == expected, name
    setting = setting_of(1.0)
    first = rps_jax.push("cylinder", target=(1.0, 0.0), setting=setting, out=tmp_path)
    with refusing(r"holds another run .* overwrite=True"):
        rps_jax.push("cylinder", target=(2.0, 0.0), setting=setting, out=tmp_path)
    second = {"target": (2.0, 0.0), "setting": setting, "out": tmp_path, "overwrite": True}
    assert not rps_jax.push("cylinder", **second).data.equals(first.data)
    (tmp_path / "inner").mkdir()
    with refusing("overwrite would remove the run that is read"):
        merge((tmp_path / "inner",), out=tmp_path, overwrite=True)
    assert rps_jax.load(tmp_path).sizes["time"]


@pytest.mark.slow
def test_the_commands_of_a_report_reproduce_the_run(tmp_path, capsys, monkeypatch):
    """The first is that of the run; others replay its worlds, or look at its failures."""
    monkeypatch.chdir(tmp_path)
    drums = "--domain wide,objects=random_cylinder --worlds 2"
    for command in (
        f"sweep --laws rps rps,v_max=0.02 {drums} --seed 5 {QUASISTATIC} --out a",
        f"score rps,v_max=0.02 {drums} --seed 7 {QUASISTATIC} --laws rps --out b",
        "gallery a --each 1 --law rps,v_max=0.02 --out c",
    ):
        monkeypatch.setattr(sys, "argv", ["rps", *command.split()])
        text = printed(capsys, command)
        seeds = re.findall(r"seed (\d+)", text)
        assert set(seeds) == set(re.findall(r"--seed (\d+)", command)), seeds
        out = Path(command.split()[-1])
        results = rps_jax.load(out)
        made_by, *replays = dict.fromkeys(re.findall(r"`rps ([^`]+)`", text))
        assert made_by == command == results.attrs["command"].removeprefix("rps ")
        assert replays
        monkeypatch.setattr(sys, "argv", ["rps", *made_by.split()])
        assert rps(made_by, "--overwrite") == 0
        xr.testing.assert_identical(rps_jax.load(out), results)
        assert rps(replays[0], "--no-video", "--out", out / "again") == 0
        _, folder, world, _, law = replays[0].split()
        trial = rps_jax.load(folder).sel(world=int(world), law=law)
        trace = rps_jax.load(out / "again")
        assert int(trace.outcome_success) == int(trial.success)
        assert float(trace.outcome_time) == pytest.approx(float(trial.time), abs=0.5)
        capsys.readouterr()


SUGGESTIONS = {
    "sweep --wolds 3": "--worlds",
    "shadow a.mcap --overwrit": "--overwrite",
    "swep": "sweep",
    "push --engine MuJoCo": "mujoco",
    "push --object cylindr": "cylinder",
    "push --skin idael": "ideal",
    "sweep --domain wyde": "wide",
    "sweep --domain wide,objects=random_bx": "random_box",
    "sweep --robot MPO-500": "mpo_500",
    "tune es --objects random_boxx": "random_box",
    "table --objects nonuniform-box": "nonuniform_box",
}


@pytest.mark.parametrize("words", SUGGESTIONS)
def test_the_nearest_name_is_suggested(words, capsys):
    error = refusal(capsys, words)
    assert f"(did you mean '{SUGGESTIONS[words]}'?)" in error
    for option, file in {"object": "xml", "robot": "json", "domain": "json"}.items():
        assert f"unknown {option} '" not in error or f"or give FILE.{file}" in error


PUSH = "push --target 0.6 0 --engine fused --horizon 18 --film-length 0.4 --out"


def test_a_push_draws_and_films_a_trial(tmp_path, capsys):
    text = printed(capsys, PUSH, tmp_path)
    assert "reached at" in text
    assert "Stepped by the engine fused." in text
    trace = xr.load_dataset(tmp_path / "results.nc", engine="h5netcdf")
    assert trace.sizes["time"] > 100
    assert int(trace.outcome_success) == 1
    assert (tmp_path / "trial.png").stat().st_size > 10_000
    assert (tmp_path / "push.mp4").stat().st_size > 1_000
    text, page = ((tmp_path / f"report.{kind}").read_text() for kind in ("md", "html"))
    assert '<video src="push.mp4"' in text
    assert "![Film](stills.png)" in text
    assert (tmp_path / "stills.png").stat().st_size > 10_000
    assert page.count('src="data:image/png;base64,') == 2
    assert page.count('src="data:video/mp4;base64,') == 1


def test_a_push_without_ffmpeg_explains_the_fix_and_does_the_rest(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    text = printed(capsys, PUSH, tmp_path)
    assert "There is no film: " in text
    assert "pip install imageio-ffmpeg" in text
    assert (tmp_path / "trial.png").exists()
    assert not (tmp_path / "push.mp4").exists()


def test_the_doctor_names_versions_device_cache_rendering_and_ffmpeg(capsys):
    text = printed(capsys, "doctor")
    for word in ("python", "mujoco-mjx", "device", "cache", "rendering", "ffmpeg"):
        assert word in text


def test_commands_flags_and_defaults_equal_the_record():
    """`python tests/command_line.py` updates the record after an intended change."""

    def defaults(commands):
        return {
            name: {flag: field["default"] for flag, field in flags.items()}
            for name, flags in commands.items()
        }

    recorded = json.loads(command_line.RECORD.read_text())
    assert defaults(command_line.all_flags()) == defaults(recorded)


REGISTRIES = {"--task": TASKS, "--robot": ROBOTS, "--domain": DOMAINS, "--skin": SKINS}


@pytest.mark.parametrize(("flag", "registry"), REGISTRIES.items())
def test_help_names_all_that_is_registered(flag, registry):
    commands = command_line.all_flags()
    assert "fixed to" not in json.dumps(commands)  # of a field that no text can set
    texts = {c: f[flag]["help"] for c, f in commands.items() if flag in f}
    assert texts
    for text in texts.values():
        assert set(registry) <= set(text.partition(" Names: ")[2].rstrip(".").split(", "))


IMPORT = """
import os, sys
before = dict(os.environ)
import rps_jax
import jax
from jax._src import xla_bridge
rps_jax.RPSParams.paper(), rps_jax.Robot, rps_jax.Domain, rps_jax.sweep
assert not xla_bridge._backends, "a device was touched"
assert dict(os.environ) == before, "flags were set"
assert not jax.config.jax_compilation_cache_dir and not jax.config.jax_enable_x64
"""


def test_importing_sets_no_flags_prints_nothing_and_touches_no_device(tmp_path):
    command = [sys.executable, "-c", IMPORT]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


def test_the_papers_totals_and_targets():
    # 88.19, 15.97 and 5.56 % of 144 (Sec. III-B).
    totals = [sum(n for (s, *_), n in paper.TABLE_II.items() if s == w) for w in paper.LAWS]
    assert totals == [127, 23, 8]
    assert len(set(paper.TARGETS)) == 24
    assert np.abs(paper.TARGETS).max() == 2


def test_a_quick_run_keeps_an_explicit_value_that_equals_the_default():
    words = ["--quick", "--engine", "fused", "--worlds=512", "--horizon", "300.0"]
    default = TuneES()
    assert (default.setting.engine, default.worlds) == ("fused", 512)
    quick, small = flags.parse(TuneES, "tune es", words)[0], default.quick_values()
    assert quick.setting == default.setting
    assert (quick.worlds, quick.validation) == (512, TuneES.QUICK["validation"])
    assert quick.population == small["population"] < default.population
    robot = ["--domain", "real,robot=ridgeback"]
    flags.parse(TuneES, "tune es", [*words[:3], *robot])[0].validate()
    with refusing(f"engine = {small['setting.engine']}"):
        flags.parse(TuneES, "tune es", ["--quick", *robot])[0].validate()
    # From Python a value that equals the default is no explicit one.
    called = TuneES(quick=True, worlds=7, tuned=("logistic",)).with_quick_values()
    assert (called.worlds, called.tuned, called.population) == (7, ("logistic",), quick.population)
    assert called.setting.engine == small["setting.engine"]
    assert default.with_quick_values() == default


def test_each_command_with_a_quick_run_has_a_smaller_one():
    kinds = map(names.question_type, names.known())
    quick = {x().name: x() for x in kinds if issubclass(x, QuickQuestion)}
    assert {x for x, command in quick.items() if not command.quick_values()} == {"push", "paper"}


@pytest.mark.parametrize("name", [x for x, law in LAWS.items() if registry.law_of(law).bounds])
@pytest.mark.parametrize("command", ["tune es", "tune grad"])
def test_quick_suits_each_law(command, name):
    law = registry.law_of(LAWS[name])
    robot = f"ideal,drive={law.drives[0]}" + ",turning_radius=0.5" * (law.drives[0] == "car")
    words = [
        "--quick",
        "--law",
        name,
        "--robot",
        robot,
        "--task",
        "pose" if law.heading else "reach",
    ]
    question = flags.parse(names.question_type(command), command, words)[0]
    question.validate()
    assert (
        question
        == type(question)(law=name, robot=robot, task=question.task, quick=True).with_quick_values()
    )


def test_files_of_equal_names_are_distinguished_by_their_folders(tmp_path):
    texts = []
    for folder, gain in {"es": 0.3, "grad": 0.4}.items():
        path = tmp_path / folder / "tuned.json"
        path.parent.mkdir()
        path.write_text(json.dumps({"K_h": gain, "saturate_first": 1}))
        texts.append(f"rps,{path}")
    assert list(registry.resolve_laws(["rps", texts[0]])) == ["rps", "rps,tuned"]
    assert list(registry.resolve_laws(["rps", *texts])) == ["rps", *texts]


BRIEF = "--engine quasistatic --horizon 2"


def test_an_interrupted_run_prints_one_line(tmp_path):
    """The interrupt may come at any time; here it comes while threads compile programs."""
    command = f"-m rps_jax sweep --worlds 64 --domain wide,objects=random_cylinder {BRIEF} --out"
    command = [sys.executable, *command.split(), str(tmp_path / "run")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    deadline = time.monotonic() + 120
    while not (tmp_path / "run" / "manifest.json").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=60)[1].decode()
    assert process.returncode == 130
    assert error.splitlines()[-1] == "rps: interrupted."
    assert "Traceback" not in error


def test_an_interrupt_during_garbage_collection_is_raised_again(capsys):
    def swallowed(phase, _):
        gc.callbacks.remove(swallowed)
        raise KeyboardInterrupt

    def action():
        gc.callbacks.append(swallowed)
        gc.collect()
        for _ in range(2000):
            time.sleep(0.01)

    start_time = time.monotonic()
    assert running.exit_code(action) == 130
    assert time.monotonic() - start_time < 15
    assert capsys.readouterr().err.endswith("rps: interrupted.\n")


def test_pages_name_options_that_exist():
    lines = {
        line
        for page in [ROOT / "README.md", *PAGES]
        for line in COMMAND.findall(page.read_text(encoding="utf-8").replace("\\\n", " "))
    }
    assert len(lines) > 50
    unknown = list[str]()
    for name, options in sorted(line for line in lines if "--help" not in line[1]):
        try:
            flags.parse(names.question_type(name), name, shlex.split(options, comments=True))
        except InputError as error:
            text = str(error)
            unknown += [text] * (text.startswith("unknown option") or "be parsed" in text)
    assert not unknown
