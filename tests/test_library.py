"""The library as a user calls it: labelled data, the same as on the command line."""

import doctest
import inspect
import pkgutil
import re
import sys

import pytest
import xarray as xr
from helpers import (
    PAPER,
    SLOTS,
    addresses,
    docstrings,
    output_of,
    rps,
    setting_of,
    slow,
)
from numpy.testing import assert_array_equal

import rps_jax
from rps_jax.analysis import figures
from rps_jax.engines.base import Engine
from rps_jax.geometry.footprint import polygon
from rps_jax.record import files
from rps_jax.runs.sweep import merge

LAWS = {"paper": PAPER, "slow": PAPER._replace(v_max=0.02)}
# As the examples of the docstrings, so that all share one program.
DRUMS = rps_jax.Domain(("random_cylinder",))
RULES = rps_jax.Rules(horizon=2.0)
BRIEF = {"setting": rps_jax.Setting(rules=RULES), "slots": SLOTS}


def identical(a, b):
    """Assert that variables and coordinates have equal types, labels and bits."""
    xr.testing.assert_identical(a, b)
    for name in a.variables:
        assert a[name].dtype == b[name].dtype, name
        assert_array_equal(a[name].values, b[name].values, err_msg=name)


# --- sweeps --------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["fused", slow("mujoco")])
def test_a_sweep_in_memory_is_the_same_as_one_in_a_folder(engine, tmp_path):
    setting = rps_jax.Setting(engine, rules=RULES, seed=3)
    options = {"worlds": 8, "setting": setting, "part": 4, "slots": SLOTS}
    results = rps_jax.sweep(LAWS, DRUMS, **options)
    assert results.success.dims == ("law", "world")
    assert dict(results.sizes) == {"law": 2, "world": 8, "pose": 3}
    assert results.mass.dims == results.coords["mass"].dims == ("world",)
    identical(results, rps_jax.sweep(LAWS, DRUMS, out=tmp_path, **options))
    identical(results, rps_jax.load(tmp_path))
    identical(results, rps_jax.sweep(LAWS, DRUMS, out=str(tmp_path), **options))  # already complete


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a sweep, and its results."""
    folder = tmp_path_factory.mktemp("sweep")
    return folder, rps_jax.sweep(LAWS, DRUMS, worlds=SLOTS, out=folder, **BRIEF)


FAST = {"setting": rps_jax.Setting("quasistatic", rules=RULES)}
SHARED = FAST | {"slots": SLOTS}  # with one program for all, of which no slot is empty
TUNED = {"objects": ("random_cylinder",), "tuned": ("K_h", "K_v"), "worlds": 2, "validation": SLOTS}
STORED = {  # from the run folder of a sweep and a new folder, the answer of a call
    "sweep": lambda run, out: rps_jax.sweep("rps", DRUMS, worlds=8, out=out, **SHARED),
    "score": lambda run, out: rps_jax.score("nps", domain=DRUMS, worlds=8, out=out, **SHARED),
    "regress": lambda run, out: rps_jax.regress({"mine": "rps"}, worlds=1, out=out, **SHARED),
    "push": lambda run, out: rps_jax.push("cylinder", target=(1.0, 0.5), out=out, **FAST).data,
    "replay": lambda run, out: rps_jax.replay(run, 2, out=out).data,
    "gallery": lambda run, out: rps_jax.gallery(run, out=out),
    "merge": lambda run, out: merge((run,), out=out),
    "tune_es": lambda run, out: rps_jax.tune_es(
        "rps", **TUNED, population=4, generations=1, out=out, **SHARED
    ),
}


DOMAIN_TEXTS = {"push": None, "regress": "wide", "tune_es": "wide"}  # the rest: `DRUMS`


@pytest.mark.parametrize(
    "name", [x if x in ("push", "replay", "merge") else slow(x) for x in STORED]
)
def test_stored_results_are_those_of_the_call_and_of_xarray(name, run, tmp_path):
    answer, path = STORED[name](run[0], tmp_path / "run"), tmp_path / "run" / "results.nc"
    assert {"command", "version", "seed", "engine"} <= answer.attrs.keys()
    assert answer.attrs.get("domain") == DOMAIN_TEXTS.get(name, "custom")
    assert answer.attrs["seed"] == 0
    identical(answer, rps_jax.load(tmp_path / "run"))
    with xr.open_dataset(path) as opened:
        identical(answer, opened.load())
    if "world" in answer.dims:
        drawn = {"object", "mass", "size", "friction_ground", "bearing"}
        assert drawn <= answer.coords.keys()
        assert all(answer[x].attrs["long_name"] for x in answer.coords)
        assert all("units" in answer[x].attrs for x in drawn - {"object"})
        assert set(answer.object.values) <= {"random_cylinder", "random_box", "random_prism"}


def test_candidates_are_labelled_by_their_parameters():
    laws = ["rps,K_h=0.3", "rps,K_h=0.6"]
    results = rps_jax.evaluate(laws, DRUMS, 4, split="validate", **SHARED)
    assert results.K_h.dims == ("candidate",)
    assert results.K_h.values.tolist() == [0.3, 0.6]
    assert results.swap_dims(candidate="K_h").score.sel(K_h=0.6).dims == ("world",)
    attrs = {"seed": 0, "split": "validate", "engine": "quasistatic", "law": "RPSParams"}
    assert attrs.items() <= results.attrs.items()
    assert results.mass.attrs == {"units": "kg", "long_name": "mass of the object"}


# --- a table -------------------------------------------------------------------------------


def test_a_table_equals_that_of_the_command(tmp_path):
    command = "table --objects box --laws rps nps --friction S2 0.3,0.4 --targets 0.6 0 1 1"
    assert rps(f"{command} --engine mujoco --horizon 3 --mass 5 --out", tmp_path) == 0
    options = {"objects": ["box"], "laws": ["rps", "nps"], "friction": ["S2", (0.3, 0.4)]}
    options |= {"targets": [(0.6, 0.0), (1.0, 1.0)], "mass": 5.0}
    setting = setting_of(3.0, "mujoco")
    results = rps_jax.table(**options, setting=setting)
    identical(results, files.read_results(tmp_path))
    identical(results, rps_jax.load(tmp_path))


# --- examples ------------------------------------------------------------------------------

LISTED = [(name, pkgutil.resolve_name(f"{module}.{name}")) for module, name in addresses()]
API = {  # with the members of public modules that have an example
    name: member
    for _, module in LISTED
    if inspect.ismodule(module)
    for name, member in vars(module).items()
    if getattr(member, "__module__", "") == module.__name__ and ">>>" in (member.__doc__ or "")
}
API |= {name: entry for name, entry in LISTED if not inspect.ismodule(entry)}
API |= {
    name: getattr(rps_jax, name) for name in rps_jax.__all__
}  # such as `paper`, before a module
API["polygon"] = polygon
PUBLIC = [x for x, entry in API.items() if inspect.isclass(entry) or inspect.isroutine(entry)]
OPTIONS = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL


class ExampleFinder(doctest.DocTestFinder):
    """Finds examples without their line, which Python 3.12.3 cannot tell for a wrapped class."""

    def _find_lineno(self, obj, source_lines):
        return None


def examples(name):
    """The examples of a public function, or of a class and its methods."""
    return [x for x in ExampleFinder().find(API[name], name) if x.examples]


def test_every_public_function_has_an_example():
    functions = [name for name in PUBLIC if not inspect.isclass(API[name])]
    assert {"sweep", "evaluate", "table", "push"} <= set(functions)
    assert [name for name in functions if not examples(name)] == []


def test_every_example_of_the_package_is_run():
    parse = doctest.DocTestParser().get_examples
    lines = {x.source for text in docstrings() for x in parse(text)}
    run = [x for name in PUBLIC for test in examples(name) for x in test.examples]
    assert lines == {x.source for x in run}
    assert not any(doctest.SKIP in x.options for x in run)


# Questions whose small runs take longest; other tests run them, too.
LONG = {"hardware", "learn", "ladder", "regress", "ceiling", "score", "attack", "replay"}
LONG |= {"value_and_grad", "rollout", "gallery", "fit", "paper", "tune_grad", "fit_object"}


def mark_long(name):
    return pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])


def test_jupyter_shows_the_help_of_each_argument_of_a_call():
    for call in (x for name in rps_jax.__all__ if hasattr(x := getattr(rps_jax, name), "getdoc")):
        signature = inspect.signature(call)
        documented = re.findall(r"^  (\w+): \w", call.getdoc(), re.MULTILINE)
        assert signature.parameters.keys() <= {*documented}
        assert not re.search(r"Spec\(|Named\(", str(signature))


@pytest.mark.parametrize("name", [mark_long(name) for name in PUBLIC if examples(name)])
def test_the_examples_of_docstrings_run(name, tmp_path, monkeypatch, registries):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Engine, "slots", lambda *_: SLOTS)  # for the programs of other tests
    lines = []
    runner = doctest.DocTestRunner(optionflags=OPTIONS)
    for example in examples(name):
        assert runner.run(example, out=lines.append).failed == 0, "".join(lines)


def test_the_former_name_of_a_module_of_figures_warns():
    with pytest.warns(FutureWarning, match="write sweeps"):
        assert figures.tuning.__name__ == "rps_jax.analysis.figures.sweeps"


def test_modules_of_public_names_need_no_import_of_their_own():
    """As in the sentence `rps_jax.laws.Bound(low, high)` of an error."""
    code = "import rps_jax; print(rps_jax.laws.Bound(1, 2), rps_jax.worlds.Case, rps_jax.physics)"
    assert output_of(sys.executable, "-c", code).startswith("Bound(")
