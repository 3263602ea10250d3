"""Faults of all classes of `fuzz.py`: no command ends in a traceback or hangs."""

import fuzz
import pytest

from rps_jax.analysis.report import Picture

SHARE = {"values": 60, "laws": 1000, "edits": 6, "damages": 12}


@pytest.fixture
def undrawn(monkeypatch):
    """Skip the rendering of figures, which would take most of the time."""

    def png(picture):
        picture.draw()
        return b"no picture"

    monkeypatch.setattr(Picture, "png", png)


@pytest.mark.parametrize("name", SHARE)
def test_faults_are_reported_in_one_sentence(name, registries, undrawn):
    run, _ = fuzz.CLASSES[name]
    bad: list[str] = []
    counts = run(SHARE[name], 1, bad.append)
    assert not bad, "\n\n".join(bad)
    assert counts["refused"] >= SHARE[name] // 10
