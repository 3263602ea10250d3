"""The command line as a user meets it: whole runs, repeatable files, and teaching errors."""

import json
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from helpers import refusal, rps

from rps_jax.app.cli import parsing
from rps_jax.app.cli.tuning import TuneES
from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.trials.results import DIMS
from rps_jax.world import paper

SMALL = [
    *("table", "--targets", "0.6", "0", "0.62", "0.03", "--horizon", "18", "--slots", "4"),
    *("--objects", "box", "nonuniform_box", "--workers", "1", "--strategies", "rps", "nps"),
]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The same small table, run twice."""
    folders = [tmp_path_factory.mktemp("table") / name for name in ("first", "second")]
    for folder in folders:
        assert rps(*SMALL, "--out", folder) == 0
    return folders


def test_a_table_run_leaves_a_labelled_run_folder(runs):
    results = files.read_results(runs[0])
    assert results.success.dims == DIMS
    assert results.sizes == {"strategy": 2, "object": 2, "friction": 2, "target": 2, "pose": 3}
    assert list(results.object.values) == ["box", "nonuniform_box"]
    assert results.time.attrs["units"] == "s"
    assert results.success.sel(strategy="rps", object="box").all()
    assert (results.min_distance.where(results.success == 1).fillna(0) < 0.05).all()
    config = json.loads((runs[0] / "config.json").read_text())
    assert config["params"]["rps"]["eta"] == 10.0
    assert config["params"]["nps"]["reactive"] == 0.0
    environment = json.loads((runs[0] / "environment.json").read_text())
    assert environment["packages"]["mujoco"] == "3.17.0"
    assert (runs[0] / "min_distance.png").stat().st_size > 10_000
    assert "| RPS | ours" in (runs[0] / "table.txt").read_text()


def test_the_same_command_gives_the_same_results_bit_for_bit(runs):
    assert (runs[0] / "results.nc").read_bytes() == (runs[1] / "results.nc").read_bytes()


def test_a_run_is_not_overwritten_unasked(runs, capsys):
    before = (runs[0] / "results.nc").read_bytes()
    assert "--overwrite" in refusal(capsys, *SMALL, "--out", runs[0])
    assert (runs[0] / "results.nc").read_bytes() == before


def test_a_push_draws_and_films_a_trial(tmp_path, capsys):
    out = tmp_path / "push"
    arguments = ("--target", 0.6, 0, "--horizon", 18, "--film-length", 0.4, "--out", out)
    assert rps("push", "--engine", "fused", *arguments) == 0
    assert "reached at" in capsys.readouterr().out
    trace = xr.load_dataset(out / "results.nc", engine="h5netcdf")
    assert trace.sizes["time"] > 100
    assert int(trace.outcome_success) == 1
    assert (out / "trial.png").stat().st_size > 10_000
    assert (out / "push.mp4").stat().st_size > 1_000


def test_a_push_that_cannot_be_filmed_says_how_and_does_the_rest(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    out = tmp_path / "push"
    arguments = ("--engine", "fused", "--horizon", 18, "--out", out)
    assert rps("push", "--target", 0.6, 0, *arguments) == 0
    printed = capsys.readouterr().out
    assert "no video: " in printed
    assert "pip install imageio-ffmpeg" in printed
    assert (out / "trial.png").exists()
    assert not (out / "push.mp4").exists()


def test_the_doctor_names_versions_device_cache_rendering_and_ffmpeg(capsys):
    assert rps("doctor") == 0
    printed = capsys.readouterr().out
    for word in ("python", "mujoco-mjx", "device", "cache", "rendering", "ffmpeg"):
        assert word in printed


IMPORT = """
import os, sys
before = dict(os.environ)
import rps_jax
import jax
from jax._src import xla_bridge
rps_jax.RPSParams.paper(), rps_jax.Case, rps_jax.CapacitiveSkin, rps_jax.OBJECTS
assert not xla_bridge._backends, "a device was touched"
assert dict(os.environ) == before, "flags were set"
assert not jax.config.jax_compilation_cache_dir and not jax.config.jax_enable_x64
"""


def test_importing_sets_no_flags_prints_nothing_and_touches_no_device(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", IMPORT], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


def test_the_papers_totals_and_targets():
    # 88.19, 15.97 and 5.56 % of 144 (Sec. III-B).
    totals = [sum(n for (s, *_), n in paper.TABLE_II.items() if s == w) for w in paper.STRATEGIES]
    assert totals == [127, 23, 8]
    assert len(set(paper.TARGETS)) == 24
    assert np.abs(paper.TARGETS).max() == 2


def test_a_quick_run_makes_small_only_what_was_not_asked_for():
    asked = TuneES(quick=True, worlds=7, tuned=("logistic",))
    quick = asked.quickly(worlds=16, population=10)
    assert (quick.worlds, quick.tuned) == (7, ("logistic",))
    assert (quick.population, quick.engine, quick.horizon) == (10, "quasistatic", 150.0)
    assert quick.generations == asked.generations


def test_files_of_the_same_name_are_told_apart_by_their_folders():
    runs = ("paper", "runs/es/tuned.json", "runs/grad/tuned.json")
    assert parsing.labels_of("params", runs) == ["paper", "es/tuned", "grad/tuned"]
    assert parsing.labels_of("params", runs[:2]) == ["paper", "tuned"]
    for bad in ((), ("paper", "paper"), ("a/es/tuned.json", "b/es/tuned.json")):
        with pytest.raises(InputError, match="name each once"):
            parsing.labels_of("params", bad)
