"""The house: every module is in the README's tree, and imports run one way, down it."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "rps_jax"
OUTSIDE = {"__init__", "__main__"}


def tree():
    readme = (ROOT / "README.md").read_text()
    return re.findall(r"^  (\w+)\.py +\S", readme, flags=re.M)


def imported(path):
    """Modules of the package that a module imports when it is imported."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module == "rps_jax":
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rps_jax."):
            yield node.module.split(".")[1]


def test_every_module_is_in_the_tree():
    there = {path.stem for path in PACKAGE.glob("*.py")} - OUTSIDE
    assert sorted(tree()) == sorted(there)


def test_imports_run_one_way_down_the_tree():
    order = {name: place for place, name in enumerate(tree())}
    wrong = [
        f"{name} imports {other}"
        for name in order
        for other in imported(PACKAGE / f"{name}.py")
        if other in order and order[other] >= order[name]
    ]
    assert not wrong
