"""The package as a whole: its rooms, docstrings, public names and examples, and a custom engine."""

import inspect
import os
import pkgutil
import re
import shutil
import sys
import tomllib
from importlib import import_module

import pytest
from helpers import ROOT, addresses, inner_names, output_of

import rps_jax

PACKAGE = ROOT / "rps_jax"
MAX_INNER = 175  # names; it only goes down


def test_each_private_interface_has_a_test_that_notices_a_change():
    table = (ROOT / "CONTRIBUTING.md").read_text().partition("### Private interfaces")[2]
    rows = [line.split("|")[3:5] for line in table.split("\n\n")[2].splitlines()[2:]]
    assert len(rows) >= 5
    for sources, test in rows:
        assert all((PACKAGE / name).exists() for name in re.findall(r"`(.*?)`", sources))
        file, name = test.strip().strip("`").split("::")
        assert f"def {name}(" in (ROOT / "tests" / file).read_text()


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


DUMMY = '''"""The quasi-static engine under another name."""

from rps_jax.engines.quasistatic import QuasistaticEngine


class Dummy(QuasistaticEngine):
    """A custom engine."""

    name = "dummy"


ENGINE = Dummy()
'''
QUANTITY = """    max_compression: Range | None = drawn(
        None, 46, "1", 0.01, 0.99, "greatest compression", "skin", "max_compression"
    )

"""
EVERYWHERE = """
import rps_jax
from rps_jax.app import cli
from rps_jax.studies.ladder import Ladder
print(rps_jax.__file__)
setting = rps_jax.Setting("dummy", rules=rps_jax.Rules(horizon=0.5))
drums = "wide,objects=random_cylinder,max_compression=0.3:0.9"
found = rps_jax.sweep("straight,K_h=0.5", drums, worlds=8, setting=setting)
drawn = found.max_compression
assert drawn.attrs["units"] == "1" and drawn.attrs["long_name"] == "greatest compression"
assert ((drawn >= 0.3) & (drawn <= 0.9)).all() and drawn.std() > 0.1, drawn
assert "straight" in Ladder(domain="wide").chosen
for ask in (lambda: rps_jax.sweep("strait", "wide", 1), lambda: rps_jax.attack("strait", "wide")):
    try:
        ask()
    except rps_jax.InputError as error:
        print(error)
cli.main(["sweep", "--help"])
"""


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Output of a copy of the package with another law, quantity and engine."""
    folder = tmp_path_factory.mktemp("copy")
    package = folder / "rps_jax"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "mjcf", folder / "mjcf")
    laws = package / "control" / "laws"
    law = (laws / "pursuit.py").read_text().replace("PursuitParams", "StraightParams")
    (laws / "straight.py").write_text(law.replace('"pursuit"', '"straight"'))
    (package / "engines" / "dummy.py").write_text(DUMMY)
    for path, anchor, more in (
        ("world/domain.py", "    def __post_init__(self) -> None:\n", QUANTITY + "{}"),
        ("engines/__init__.py", '"quasistatic"]', '"quasistatic", "dummy"]'),
    ):
        text = (package / path).read_text()
        (package / path).write_text(text.replace(anchor, more.format(anchor), 1))
    environment = os.environ | {"PYTHONPATH": str(folder)}
    first, _, rest = output_of(
        sys.executable, "-c", EVERYWHERE, cwd=folder, env=environment
    ).partition("\n")
    assert first == str(package / "__init__.py")
    return rest


def test_a_law_is_one_file_and_a_quantity_one_declaration(printed):
    """Sweeps, ladders, attacks and errors know them with no other change."""
    assert printed.partition("usage:")[0].count("straight") == 4


def test_a_custom_engine_is_one_file_and_one_line(printed):
    """It then works from Python and on the command line, which lists it."""
    assert "quasistatic,dummy}" in re.sub(r"\s", "", printed)
