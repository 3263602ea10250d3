"""Who may have the engine warp; what it computes is tested by `with_warp.py`."""

import pytest

from rps_jax import engines
from rps_jax.app import cli
from rps_jax.engines import warp
from rps_jax.engines.mjx_colliders import mjx
from rps_jax.errors import InputError
from rps_jax.world.physics import Physics

WANTED = [
    ("table",),
    ("push",),
    ("hardware",),
    ("sweep", "--domain", "paper"),
    ("tune", "es"),
    ("ladder", "--domain", "paper"),
]


@pytest.mark.parametrize("command", WANTED, ids=" ".join)
def test_without_an_nvidia_gpu_it_is_refused_before_anything_compiles(
    command, capsys, monkeypatch, tmp_path
):
    """In one sentence."""
    monkeypatch.setattr(mjx.warp, "WARP_INSTALLED", True)
    monkeypatch.setattr("jax.stages.Lowered.compile", lambda *_: pytest.fail("compiled"))
    assert cli.main([*command, "--engine", "warp", "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "engine = warp is not there (no NVIDIA GPU" in error
    assert not (tmp_path / "run").exists()


def test_without_warp_lang_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(warp, "on_nvidia", lambda: True)
    monkeypatch.setattr(mjx.warp, "WARP_INSTALLED", True)
    engines.get("warp").check(["box", "cylinder"])
    monkeypatch.setattr(mjx.warp, "WARP_INSTALLED", False)
    with pytest.raises(InputError, match=r"\(no warp-lang\): pip install 'rps_jax\[cuda,warp\]'"):
        engines.get("warp").check()


def test_prisms_are_refused(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(warp, "on_nvidia", lambda: True)
    run = ["sweep", "--domain", "wide", "--engine", "warp", "--out", str(tmp_path / "run")]
    assert cli.main(run) == 2
    assert "not allowed for prisms" in capsys.readouterr().err
    with pytest.raises(InputError, match="not allowed for prisms"):
        engines.get("warp").stage_of_solids("prism", *[None] * 2, Physics())
