"""The study of variants of learning."""

import shlex

import pytest
from helpers import ROOT

from rps_jax.app.cli import flags
from sweeps.learned.variants import VARIANTS, Variants, variants


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_has_valid_options(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    flags.read(shlex.split(Variants().command(name))[1:])[0].validate()


@pytest.mark.slow
def test_runs_of_variants_are_collected(tmp_path):
    """Each run has one variant; a third run has the rows of both."""
    for name in ("scratch", "mlp"):
        variants(quick=True, variants=(name,), worlds=2, out=tmp_path / name)
    runs = tuple(str(tmp_path / name) for name in ("scratch", "mlp"))
    results = variants(runs=runs, out=tmp_path / "all")
    assert results.variant.values.tolist() == ["scratch", "mlp"]
    assert results.updates.values.tolist() == [2, 2]
    (table,) = Variants().report_tables(results)
    assert [row[0] for row in table.rows] == ["scratch", "mlp"]
    assert int(results.tried[0]) == 2
