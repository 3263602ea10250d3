"""Purpose and installed size of each dependency and each extra.

pip installs the package into an empty environment, within `constraints.txt`, and the additional
packages of each extra into a separate folder.

    rps sweeps/publish/dependencies.py --machine "Linux on x86-64, Python 3.11"
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import sysconfig
import tempfile
import tomllib
import venv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import xarray as xr
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from rps_jax.questions import Run, call_of
from sweeps.study_base import Rows, Study, Table, run_parts, run_process

ROOT = Path(__file__).parents[2]
PACKAGE = "rps-jax"
PURPOSE = {
    "jax": "one program for thousands of worlds, on processors and GPUs, and its derivatives",
    "flatbuffers": "programs of JAX that are cached between processes",
    "mujoco": "scenes, C MuJoCo as an engine, images; pinned to the version of mujoco-mjx (there "
    "is no 4.x)",
    "mujoco-mjx": "MuJoCo's engine in JAX, the reference of the fused engine",
    "numpy": "arrays on the host",
    "scipy": "Wilson intervals and exact tests; JAX needs it too",
    "xarray": "labelled results",
    "h5netcdf": "results as NetCDF 4 files",
    "h5py": "the HDF5 below them",
    "matplotlib": "figures",
    "contourpy": "outlines of maps that are images; matplotlib needs it too",
    "imageio-ffmpeg": "an ffmpeg for films",
    "pillow": "labels in films; matplotlib needs it too",
    "tqdm": "progress bars",
    "optax": "the optimisers of networks",
    "cmaes": "the evolution of `rps tune es`, in NumPy",
    "filelock": "one process at a time in a run folder",
    "tyro": "the command line, from typed options",
    "markdown": "`report.html` from `report.md`",
    "jaxtyping": "shapes in the types of functions and records",
}
EXTRAS = {
    "cuda": "NVIDIA GPUs: JAX's CUDA 13 plugin and NVIDIA's libraries",
    "cluster": "`rps sweep --ray` (ray)",
    "viz": "`rps view` (viser)",
    "export": "`rps export onnx` (onnx, and onnxruntime to run the exported file)",
    "bags": "`rps push --bag`, `rps shadow` and ROS maps (mcap-ros2-support, rosbags, ruamel.yaml)",
    "failures": "`rps sensitivity` (SALib) and `rps attack` (ribs, which brings numba and "
    "scikit-learn)",
    "gym": "`rps_jax/Push-v0` of Gymnasium",
    "notebooks": "JupyterLab, and notebooks as text (jupytext)",
    "docs": "the site: MkDocs Material, docstrings (mkdocstrings) and equations (latex2mathml)",
    "dev": "tests, linter, type checker, and the packages for tests of the other extras",
}
_MEGABYTES = "{:,.1f} MB"


@dataclass(frozen=True)
class Dependencies(Study[xr.Dataset]):
    """Measure the packages that pip installs for the core and for each extra.

    The results hold `size` [B] and `needs` (names separated by blanks) by (installed, package):
    the packages of the core, and those that each extra adds. Size 0: not installed.
    """

    TITLE = "Packages of the dependencies"
    CHOICES: ClassVar = {"extras": EXTRAS}
    GROWS = ("extras",)
    RESULTS = "../results"

    extras: tuple[str, ...] = tuple(EXTRAS)
    """Extras to measure; by default all."""

    def num_trials(self) -> int | None:
        """Return the number of environments."""
        return 1 + len(self.extras)

    def answer(self, run: Run) -> xr.Dataset:
        """Measure the environments that are missing."""
        with tempfile.TemporaryDirectory() as folder:
            environment = Path(folder) / "environment"
            parts = {"core": partial(_core, environment)}
            parts |= {name: partial(_extra, environment, name) for name in self.extras}
            results = run_parts(run, "installed", parts)
        return results.fillna({"size": 0.0})

    def report_tables(self, results: xr.Dataset) -> Sequence[Table]:
        """Return both tables."""
        return [Table(rows, _NOTE, name=name) for name, rows in tables(results).items()]


dependencies = call_of(Dependencies)

_NOTE = (
    "own: size of the installed files of the package, with compiled bytecode. Packages and their "
    "size: packages that no other dependency needs."
)


def declared() -> dict[str, Any]:
    """Return the table `project` of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def tables(results: xr.Dataset) -> dict[str, Rows]:
    """Return header and rows of both tables, by name."""
    core = results.sel(installed="core")
    extras = [["extra", "what it is for", "packages", "size"]]
    for name in map(str, results.installed.values[1:]):
        sizes = results["size"].sel(installed=name).values
        size = f"{sizes.sum() / 1e6:,.0f} MB"
        extras.append([name, EXTRAS[name], str(int((sizes > 0).sum())), size])
    return {
        "dependencies": _core_table(core.isel(package=core["size"].values > 0)),
        "extras": extras,
    }


def _core_table(core: xr.Dataset) -> Rows:
    """Return a header, one row per dependency, and their sum."""
    names = [canonicalize_name(Requirement(text).name) for text in declared()["dependencies"]]
    sizes = dict(zip(map(str, core.package.values), core["size"].values / 1e6, strict=True))
    needs = {str(name): str(core.needs.sel(package=name).item()).split() for name in sizes}
    installed = with_dependencies(needs, names)
    rows = [["dependency", "what it is for", "own", "packages only it brings", "and their size"]]
    for name in names:
        rest = with_dependencies(needs, [other for other in names if other != name])
        exclusive = installed - rest - {name}
        purpose = PURPOSE[name]
        if name == "jax":
            purpose += f" (with jaxlib: {_MEGABYTES.format(sizes['jax'] + sizes['jaxlib'])})"
        size = _MEGABYTES.format(sum(sizes[other] for other in exclusive))
        rows.append([name, purpose, _MEGABYTES.format(sizes[name]), str(len(exclusive)), size])
    whole = _MEGABYTES.format(sum(sizes[name] for name in installed))
    return [*rows, ["all of the core", "", "", str(len(installed)), whole]]


def with_dependencies(needs: Mapping[str, Sequence[str]], names: Sequence[str]) -> set[str]:
    """Return packages together with all packages that they need, directly or indirectly."""
    packages, queue = set(), list(names)
    while queue:
        name = queue.pop()
        if name not in packages and name in needs:
            packages.add(name)
            queue += needs[name]
    return packages


# --- environments --------------------------------------------------------------------------


def _core(environment: Path) -> xr.Dataset:
    """Return the packages of the core, in an environment that is created once."""
    if not environment.exists():
        venv.create(environment, with_pip=True)
        _pip(environment, "install", "--quiet", str(ROOT))
    return _packages(Path(sysconfig.get_path("purelib", "venv", {"base": str(environment)})))


def _extra(environment: Path, name: str) -> xr.Dataset:
    """Return the packages that an extra adds to the core, installed into a separate folder."""
    _core(environment)
    target, report = environment.with_name(name), str(environment.with_name(f"{name}.json"))
    _pip(environment, "install", "--quiet", "--dry-run", "--report", report, f"{ROOT}[{name}]")
    new = [item["metadata"] for item in json.loads(Path(report).read_text())["install"]]
    names = [(canonicalize_name(item["name"]), item["version"]) for item in new]
    pinned = [f"{name}=={version}" for name, version in names if name != PACKAGE]
    _pip(environment, "install", "--quiet", "--no-deps", "--target", str(target), *pinned)
    packages = _packages(target)
    shutil.rmtree(target)
    return packages


def _pip(environment: Path, *words: str) -> None:
    """Run pip in an environment, within the versions of constraints.txt.

    Raises:
      InputError: pip failed.
    """
    python = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
    command = [python, "-m", "pip", *words, "-c", str(ROOT / "constraints.txt")]
    run_process(command, f"pip {words[0]} failed")


def _packages(site: Path) -> xr.Dataset:
    """Return sizes [B] and needs of the packages in a folder, except this package and pip."""
    sizes, needs = {}, {}
    for package in importlib.metadata.distributions(path=[str(site)]):
        name = canonicalize_name(package.metadata["Name"])
        if name in (PACKAGE, "pip", "setuptools"):
            continue
        paths = [Path(str(file.locate())) for file in package.files or ()]
        sizes[name] = float(sum(path.stat().st_size for path in paths if path.is_file()))
        requirements = [Requirement(text) for text in package.requires or ()]
        used = [r for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]
        needs[name] = " ".join(sorted({canonicalize_name(r.name) for r in used}))
    size = ("package", list(sizes.values()), {"units": "B", "long_name": "of the installed files"})
    return xr.Dataset(
        {"size": size, "needs": ("package", list(needs.values()))}, {"package": list(sizes)}
    )
