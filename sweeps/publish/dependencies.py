"""What does each dependency bring, and how large is it?

The package is installed into an empty environment, by pip and `constraints.txt`, and each extra
beside it.

    rps sweeps/publish/dependencies.py --machine "Linux on x86-64, Python 3.11"
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
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

from rps_jax import errors
from rps_jax.analysis.report import Section
from rps_jax.errors import InputError
from rps_jax.runs.question import Run, call_of
from rps_jax.trials.progress import Progress
from sweeps.study_base import Study, Table

ROOT = Path(__file__).parents[2]
OWN = "rps-jax"
FOR = {
    "jax": "one program for thousands of worlds, on processors and GPUs, and its derivatives",
    "flatbuffers": "programs of JAX that are kept between processes",
    "mujoco": "scenes, C MuJoCo as an engine, pictures; pinned to the version of mujoco-mjx, which "
    "has no 4.x",
    "mujoco-mjx": "MuJoCo's own engine in JAX, to which the fused one is held",
    "numpy": "arrays on the host",
    "scipy": "Wilson intervals and exact tests; JAX needs it too",
    "xarray": "labelled results",
    "h5netcdf": "results as NetCDF 4 files",
    "h5py": "the HDF5 below them",
    "matplotlib": "figures",
    "imageio-ffmpeg": "an ffmpeg for films",
    "pillow": "labels in films; matplotlib needs it too",
    "tqdm": "progress bars",
    "optax": "the optimisers of `rps tune grad`",
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
    "export": "`rps export onnx` (onnx, and onnxruntime to run what it writes)",
    "bags": "`rps push --bag` and `rps shadow` (mcap-ros2-support)",
    "failures": "`rps sensitivity` (SALib) and `rps attack` (ribs, which brings numba and "
    "scikit-learn)",
    "gym": "`rps_jax/Push-v0` of Gymnasium",
    "notebooks": "JupyterLab, and notebooks as text (jupytext)",
    "docs": "the site: MkDocs Material, docstrings (mkdocstrings) and equations (latex2mathml)",
    "dev": "tests, linter, types, and what the tests of the other extras need",
}
_MEGABYTES = "{:,.1f} MB"


@dataclass(frozen=True)
class Dependencies(Study[xr.Dataset]):
    """Measure what pip installs of the package, and of each extra on top of it.

    The answer holds `size` [B] and `needs`, names divided by blanks, by (installed, package): the
    core, and what each extra adds to it; a package that is not installed has size 0.
    """

    TITLE: ClassVar[str] = "What the dependencies bring"
    GROWS: ClassVar[tuple[str, ...]] = ("extras",)
    RESULTS: ClassVar[str] = "../results"

    extras: tuple[str, ...] = tuple(EXTRAS)
    """Extras that are measured; by default all."""

    def check(self) -> None:
        """Check the names of the extras."""
        for name in self.extras:
            errors.check_name("extra", name, EXTRAS)

    def num_trials(self) -> int | None:
        """How many environments there are."""
        return 1 + len(self.extras)

    def answer(self, run: Run) -> xr.Dataset:
        """Measure what was not measured before."""
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "environment"
            found = {"": run.checkpoint("core", partial(_core, place))}
            for name in self.extras:
                run.callback(Progress(len(found), 0.0))
                found[name] = run.checkpoint(name, partial(_extra, place, name))
            run.callback(Progress(len(found), 0.0))
        index = xr.IndexVariable("installed", list(found))
        whole: Any = xr.concat(list(found.values()), index, join="outer", fill_value={"size": 0.0})
        return whole

    def published_tables(self, results: xr.Dataset) -> Mapping[str, Table]:
        """Return both tables."""
        return {name: Table(rows, _NOTE) for name, rows in tables(results).items()}

    def report(self, results: xr.Dataset, run: Run) -> Sequence[Section]:
        """Both tables."""
        return [Section(name.capitalize(), "", rows) for name, rows in tables(results).items()]


dependencies = call_of(Dependencies)

_NOTE = (
    "own: size of the installed files of the package itself, compiled bytecode included. packages "
    "and their size: what else would go if the dependency went, so what only it needs."
)


def declared() -> dict[str, Any]:
    """The table `project` of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def tables(found: xr.Dataset) -> dict[str, list[list[str]]]:
    """Header and rows of both tables, by name."""
    core = found.sel(installed="").isel(package=found["size"].sel(installed="").values > 0)
    extras = [["extra", "what it is for", "packages", "size"]]
    for name in map(str, found.installed.values[1:]):
        sizes = found["size"].sel(installed=name).values
        size = f"{sizes.sum() / 1e6:,.0f} MB"
        extras.append([name, EXTRAS[name], str(int((sizes > 0).sum())), size])
    return {"dependencies": _of_core(core), "extras": extras}


def _of_core(core: xr.Dataset) -> list[list[str]]:
    """Header and a row for each dependency, and for all of them."""
    names = [canonicalize_name(Requirement(one).name) for one in declared()["dependencies"]]
    sizes = dict(zip(map(str, core.package.values), core["size"].values / 1e6, strict=True))
    needs = {str(name): str(core.needs.sel(package=name).item()).split() for name in sizes}
    kept = reached(needs, names)
    rows = [["dependency", "what it is for", "own", "packages only it brings", "and their size"]]
    for name in names:
        gone = kept - reached(needs, [one for one in names if one != name]) - {name}
        words = FOR[name]
        if name == "jax":
            words += f" (with jaxlib: {_MEGABYTES.format(sizes['jax'] + sizes['jaxlib'])})"
        size = _MEGABYTES.format(sum(sizes[one] for one in gone))
        rows.append([name, words, _MEGABYTES.format(sizes[name]), str(len(gone)), size])
    whole = _MEGABYTES.format(sum(sizes[one] for one in kept))
    return [*rows, ["all of the core", "", "", str(len(kept)), whole]]


def reached(needs: Mapping[str, Sequence[str]], names: Sequence[str]) -> set[str]:
    """What some packages bring: themselves, and all that these need."""
    found, waiting = set(), list(names)
    while waiting:
        name = waiting.pop()
        if name not in found and name in needs:
            found.add(name)
            waiting += needs[name]
    return found


# --- environments --------------------------------------------------------------------------


def _core(place: Path) -> xr.Dataset:
    """The packages of the core, in an environment that is made if it is not there."""
    if not place.exists():
        venv.create(place, with_pip=True)
        _pip(place, "install", "--quiet", str(ROOT))
    return _packages(Path(sysconfig.get_path("purelib", "venv", {"base": str(place)})))


def _extra(place: Path, name: str) -> xr.Dataset:
    """The packages that an extra adds to the core, which are installed beside its environment."""
    _core(place)
    beside, report = place.with_name(name), str(place.with_name(f"{name}.json"))
    _pip(place, "install", "--quiet", "--dry-run", "--report", report, f"{ROOT}[{name}]")
    new = [one["metadata"] for one in json.loads(Path(report).read_text())["install"]]
    names = [(canonicalize_name(one["name"]), one["version"]) for one in new]
    pinned = [f"{name}=={version}" for name, version in names if name != OWN]
    _pip(place, "install", "--quiet", "--no-deps", "--target", str(beside), *pinned)
    found = _packages(beside)
    shutil.rmtree(beside)
    return found


def _pip(place: Path, *words: str) -> None:
    """Run pip of an environment, within the versions of constraints.txt.

    Raises:
      InputError: it failed.
    """
    command = [place / ("Scripts" if os.name == "nt" else "bin") / "python", "-m", "pip", *words]
    ended = subprocess.run(
        [*command, "-c", str(ROOT / "constraints.txt")], capture_output=True, text=True, check=False
    )
    if ended.returncode:
        raise InputError(f"pip {words[0]} failed: {' '.join(ended.stderr.strip().split()[-40:])}")


def _packages(site: Path) -> xr.Dataset:
    """Sizes [B] and needs of the packages of a folder, but for this one and pip."""
    sizes, needs = {}, {}
    for one in importlib.metadata.distributions(path=[str(site)]):
        name = canonicalize_name(one.metadata["Name"])
        if name in (OWN, "pip", "setuptools"):
            continue
        paths = [Path(str(file.locate())) for file in one.files or ()]
        sizes[name] = float(sum(path.stat().st_size for path in paths if path.is_file()))
        asked = [Requirement(text) for text in one.requires or ()]
        used = [r for r in asked if r.marker is None or r.marker.evaluate({"extra": ""})]
        needs[name] = " ".join(sorted({canonicalize_name(r.name) for r in used}))
    size = ("package", list(sizes.values()), {"units": "B", "long_name": "of the installed files"})
    return xr.Dataset(
        {"size": size, "needs": ("package", list(needs.values()))}, {"package": list(sizes)}
    )
