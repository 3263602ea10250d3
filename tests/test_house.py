"""The package as a whole: its docstrings, public names, and examples of extensions."""

import inspect
import os
import pkgutil
import re
import tomllib
from importlib import import_module

import jax
import pytest
from helpers import ROOT, addresses, inner_names, printed, rps

import rps_jax

PACKAGE = ROOT / "rps_jax"
MAX_INNER = 100  # names; it only goes down
MAX_ANY = 250  # lines


def test_each_private_interface_has_a_test_that_notices_a_change():
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("### Private interfaces")[2]
    rows = [line.split("|")[3:5] for line in table.split("\n\n")[2].splitlines()[2:]]
    assert len(rows) >= 5
    for sources, test in rows:
        assert all((PACKAGE / name).exists() for name in re.findall(r"`(.*?)`", sources))
        file, name = test.strip().strip("`").split("::")
        assert f"def {name}(" in (ROOT / "tests" / file).read_text()


def test_xla_compiles_as_the_set_up_of_the_tests_says():
    """JAX reads the environment when something first imports it."""
    is_fast = os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS") == "true"
    assert jax.config.read("jax_disable_most_optimizations") == is_fast


def test_a_public_method_has_or_inherits_a_docstring():
    packages = pkgutil.walk_packages(rps_jax.__path__, "rps_jax.")
    modules = [import_module(x.name) for x in packages if not x.name.endswith("__main__")]
    methods = [
        method
        for module in modules
        for kind in vars(module).values()
        if inspect.isclass(kind) and kind.__module__ == module.__name__ and kind.__name__[0] != "_"
        for name, method in vars(kind).items()
        if inspect.isfunction(method) and name[0] != "_"
    ]
    assert len(methods) > 300
    assert [method.__qualname__ for method in methods if not inspect.getdoc(method)] == []


def test_ci_runs_the_test_command_of_the_readme_without_variables():
    """CI reads the line from the README, so that no option or variable is added."""
    of_ci = (ROOT / ".ci" / "run").read_text()
    pattern = re.search(r"^line=\$\(grep -m 1 '(.*)' README.md\)$", of_ci, re.M)[1]
    lines = (ROOT / "README.md").read_text().splitlines()
    (command,) = [line for line in lines if re.search(pattern, line)]
    assert command.startswith("python3 -m venv .venv && ")
    assert 'eval "${line% && *}"' in of_ci
    assert '"${line##*&& }" &' in of_ci
    exports = ["DEBIAN_FRONTEND=noninteractive", "PYTHONPATH=$PWD/.venv/site NO_MKDOCS_2_WARNING=1"]
    assert re.findall(r"^ *export (.*)", of_ci, re.M) == exports  # of other processes


def test_notebooks_and_examples_use_only_public_names():
    scripts = sorted((ROOT / "notebooks").rglob("*.py"))
    assert len(scripts) > 20
    assert {str(path): names for path in scripts if (names := inner_names(path))} == {}


def exceptions():
    """Inner names that a folder of studies may use, by folder."""
    file = tomllib.loads((ROOT / "sweeps" / "inner_names.toml").read_text())
    reasons = {folder: entry.pop("reason") for folder, entry in file.items()}
    assert all(len(reason.split()) > 4 for reason in reasons.values())
    return {
        folder: {f"rps_jax.{module}.{name}" for module, names in entry.items() for name in names}
        for folder, entry in file.items()
    }


def test_studies_use_public_names_and_listed_exceptions():
    """The list is exact: a name that a study no longer uses is removed from it."""
    listed, used = exceptions(), {}
    for path in (ROOT / "sweeps").rglob("*.py"):
        folder = f"sweeps/{path.relative_to(ROOT / 'sweeps').parts[0]}"
        shared = {x for x in inner_names(path) if x in listed["sweeps"]}
        used["sweeps"] = used.get("sweeps", set()) | shared
        used[folder] = used.get(folder, set()) | (inner_names(path) - shared)
    for path in (PACKAGE / "studies").glob("*.py"):
        names = {x for x in inner_names(path) if not x.startswith("rps_jax.studies.")}
        used["rps_jax/studies"] = used.get("rps_jax/studies", set()) | names
    assert {folder: names for folder, names in used.items() if names} == listed
    assert len(set().union(*(listed[x] for x in listed if x != "rps_jax/studies"))) <= MAX_INNER


def test_few_types_are_any():
    lines = (line for path in PACKAGE.rglob("*.py") for line in path.read_text().splitlines())
    assert sum(bool(re.search(r"\bAny\b", line)) for line in lines) <= MAX_ANY


def test_there_are_few_public_names_and_all_are_in_the_tables():
    rows = re.findall(r"^\| `(?!rps_jax)(\w+)` \|", (PACKAGE / "README.md").read_text(), re.M)
    assert sorted(rows) == rps_jax.__all__
    assert len(rows) + len(set(addresses())) <= 90
    for name in ("questions", "laws", "worlds", "physics"):
        module = import_module(f"rps_jax.{name}")
        listed = {entry for home, entry in addresses() if home == module.__name__}
        gathered = re.findall(r" as (\w+)$|^(\w+) = ", inspect.getsource(module), re.M)
        assert listed == {first or second for first, second in gathered}
    entries = [getattr(rps_jax, name) for name in rps_jax.__all__]
    assert all(entry.__doc__ or not callable(entry) for entry in entries)


# --- extensions, executed from the README --------------------------------------------------------

EXTENSIONS = {  # by heading: the file, whose name is in the command of the README
    "A law": "my_law.py",
    "A question": "my_study.py",
    "An engine": "my_engine.py",
    "A drawn quantity": "my_quantity.py",
    "A task": "band.py",
}
EVERYWHERE = """
import my_engine, my_quantity, my_law, band
import numpy as np
import rps_jax
from rps_jax.studies.ladder import Ladder
from rps_jax.world import domain, points

print(rps_jax.__file__)
rules = rps_jax.Rules(horizon=0.5)
dummy, default = rps_jax.Setting("dummy", rules=rules), rps_jax.Setting(rules=rules)
drums = "wide,objects=random_cylinder,threshold=0.1:0.5"
options = {"worlds": 8, "task": "band,half_width=0.2"}
found = rps_jax.sweep("ahead,gain=0.2", drums, setting=dummy, **options)
drawn = found.threshold
assert drawn.attrs == {"units": "1", "long_name": "threshold of the skin"}
assert ((drawn >= 0.1) & (drawn <= 0.5)).all() and drawn.std() > 0.05, drawn
assert found.off_line.attrs["long_name"] == "largest distance from the line to the target"
fused = rps_jax.sweep("ahead,gain=0.2", drums, setting=default, **options)
np.testing.assert_array_equal(found.min_distance, fused.min_distance)
ranges = domain.parse_domain(drums)
worlds = points.worlds_at(ranges, points.points_of(ranges, np.arange(8)))
again = rps_jax.sweep("ahead", drums, points=worlds, setting=default)
np.testing.assert_array_equal(again.threshold, drawn)
assert domain.from_json(domain.to_json(ranges)) == ranges
custom = rps_jax.Domain(custom={"threshold": rps_jax.Range(0.1, 0.5)})
assert custom.range_of("threshold").high == 0.5
skins = rps_jax.draw_worlds(drums, 8).worlds.skin
np.testing.assert_allclose(skins.threshold, drawn, rtol=1e-6)
assert "ahead" in Ladder(domain="wide").chosen
for bad in ("wide,threshold=0.01:0.5", "wide,treshold=0.1:0.5"):
    try:
        rps_jax.sweep("ahead", bad, 1)
    except rps_jax.InputError as error:
        print(error)
"""


@pytest.fixture(scope="module")
def extensions(tmp_path_factory):
    """Folder with the examples of the package's README, outside of the package."""
    folder = tmp_path_factory.mktemp("extensions")
    page = (PACKAGE / "README.md").read_text().partition("## How to add\n")[2]
    for heading, name in EXTENSIONS.items():
        section = page.partition(f"### {heading}\n")[2].partition("\n### ")[0]
        code = section.partition("```python\n")[2].partition("```")[0]
        assert name in section, heading
        (folder / name).write_text(code)
    return folder


def test_examples_of_extensions_work_from_python(extensions, registries, monkeypatch, capsys):
    """A law, an engine, a quantity and a task are used together, in sweeps and in points."""
    monkeypatch.syspath_prepend(extensions)
    exec(EVERYWHERE, {})
    text = capsys.readouterr().out
    assert text.startswith(str(PACKAGE))
    assert "domain threshold (low) = 0.01 is not allowed: it must be a number and at least" in text
    assert "did you mean 'threshold'?" in text


def test_examples_of_extensions_work_on_the_command_line(
    extensions, registries, monkeypatch, capsys
):
    """Files before the command register what its options name, and its help lists them."""
    monkeypatch.chdir(extensions)
    shell = "my_engine.py my_quantity.py band.py sweep"
    helped = printed(capsys, f"{shell} --help")
    assert "quasistatic,dummy}" in re.sub(r"\s", "", helped)
    options = "--worlds 8 --horizon 0.3 --engine dummy --task band --out run"
    options += " --domain wide,objects=random_cylinder,threshold=0.1:0.5"
    assert rps(f"{shell} --laws my_law.py:AheadParams,gain=0.2 {options}") == 0
    results = rps_jax.load(extensions / "run")
    assert {"off_line", "threshold"} <= {*map(str, results.variables)}
    study = "my_study.py --law rps --worlds 2 --horizon 0.3 --engine quasistatic"
    assert "of 2 succeeded" in printed(capsys, study)
