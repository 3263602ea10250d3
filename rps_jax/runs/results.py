"""Outcomes on their way into the parts of a sweep, and the parts into one labelled Dataset."""

import importlib.util
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax.errors import InputError
from rps_jax.record import files
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.runs.plan import Plan
from rps_jax.runs.question import with_coordinates
from rps_jax.trials.results import UNITS, variable
from rps_jax.trials.trial import Outcome
from rps_jax.world.domain import LABELS, unit_of

ResultChunk = Mapping[str, np.ndarray]  # columns of some trials, whose numbers are `trial`
Keep = Callable[[int, ResultChunk], Any]  # called with the number of a part
Columns = Mapping[str, tuple[np.ndarray, str]]  # what was drawn: values (n,) and unit, by name
# Of an outcome; the others are float32.
_TYPES: dict[str, type] = dict.fromkeys(("success", "tipped", "diverged", "stalled"), np.int8)
_REMOVED = "overflows"  # column of a version with the engine warp
_HDF5 = b"\x89HDF"  # with which a NetCDF file begins


def encoded(part: ResultChunk) -> bytes:
    """The file of a part: a NumPy archive, which is made much faster than NetCDF."""
    return files.encode_arrays(**part)


def decoded(number: int, content: bytes) -> ResultChunk:
    """A part from its file; InputError if it is damaged, or of another version."""
    try:
        columns = files.decode_arrays(content)
    except ValueError as error:
        if content.startswith(_HDF5):
            raise _of_another_version(number, "it is a NetCDF file") from error
        raise files.CorruptFileError(f"part {number}", error) from error
    return {name: values for name, values in columns.items() if name != _REMOVED}


def _of_another_version(number: int, why: str) -> InputError:
    return InputError(
        f"part {number} of the run was made by another version ({why}): use that version."
    )


def name_of(part: int) -> str:
    """What a part of a sweep is called in its run folder."""
    return f"{part:07d}"


class Collector:
    """Trials on their way into the files of their parts."""

    def __init__(self, plan: Plan, keep: Keep):
        """For the parts of a plan, each handed to `keep` when it is complete."""
        self._keep = keep
        self._parts = plan.chunks
        self._part_of = np.empty(plan.num_trials, np.int32)
        for number, trials in plan.chunks.items():
            self._part_of[trials] = number
        self._open: dict[int, dict[str, np.ndarray]] = {}
        self._missing = {number: trials.size for number, trials in plan.chunks.items()}
        self.drawn: dict[int, Columns] = {}  # for the worlds of a part, to stand in its file

    def collect(self, numbers: np.ndarray, outcomes: Outcome) -> None:
        """Outcomes of trials that ended; the parts that are complete with them are kept."""
        part_of = self._part_of[numbers]
        for part in map(int, np.unique(part_of)):
            ended = part_of == part
            trials = self._parts[part]
            rows = self._open.setdefault(part, {})
            at = np.searchsorted(trials, numbers[ended])
            for name, leaf in outcomes._asdict().items():
                if name not in rows:
                    shape = trials.size, *leaf.shape[1:]
                    rows[name] = np.empty(shape, _TYPES.get(name, np.float32))
                rows[name][at] = leaf[ended]
            self._missing[part] -= at.size
            if not self._missing[part]:
                drawn = self.drawn.pop(part, {}).items()
                known = {name: values.astype(np.float32) for name, (values, _) in drawn}
                self._keep(part, {"trial": trials, **self._open.pop(part), **known})


def gather(
    plan: Plan, folders: Sequence[Path], out: Path, made: dict[int, ResultChunk] | None = None
) -> xr.Dataset:
    """All parts of a plan as one Dataset, and as `results.nc` in `out`; InputError if some lack.

    What was `made` in this process is not read again; it is taken out, to spare memory.
    """
    made = made or {}
    lacking = {name_of(n): n for n in plan.chunks if n not in made}

    def contents() -> Iterator[tuple[int, ResultChunk]]:
        for number in list(made):
            yield number, made.pop(number)
        for folder in folders:
            for name, content in Checkpoints(folder).items(lacking):
                number = lacking.pop(name)
                yield number, decoded(number, content)

    results = dataset(plan, contents())
    if lacking:
        raise InputError(
            f"run = {', '.join(map(str, folders))} lacks {len(lacking)} of {len(plan.chunks)} "
            "parts: run the same command again, or give the folders of all shards."
        )
    files.write_results(out / "results.nc", results)
    return results


def dataset(plan: Plan, parts: Iterable[tuple[int, ResultChunk]]) -> xr.Dataset:
    """All results of a plan, from its parts: (law, world), and (world) drawn."""
    every = np.arange(plan.worlds)
    which = {"units": "1", "long_name": "index of the object in the coordinate object"}
    objects = plan.object_of(every).astype(np.int16)
    columns = {"which_object": xr.Variable("world", objects, which)}
    for name in UNITS:
        shape = (len(plan.laws), plan.worlds, 3)[: 3 if name.endswith("pose") else 2]
        values = np.zeros(shape, _TYPES.get(name, np.float32))
        columns[name] = variable(name, ("law", "world"), values)
    for number, part in parts:
        law, _ = plan.law_and_object(number)
        drawn = [name for name in part if name not in ("trial", *UNITS)]
        lacking = {"trial", *UNITS} - set(part) | ({"drawn"} if not (law or drawn) else set())
        if lacking:
            raise _of_another_version(number, f"it lacks {', '.join(sorted(lacking))}")
        trials = plan.chunks[number]
        for name, values in part.items():
            wanted = trials.size, *(columns[name].shape[2:] if name in UNITS else ())
            if values.shape != wanted or values.dtype.kind not in "biuf":
                raise files.CorruptFileError(f"part {number}", f"{name} is not numbers of {wanted}")
        if not np.array_equal(part["trial"], trials):
            raise files.CorruptFileError(f"part {number}", "it holds other trials")
        world = trials % plan.worlds
        for name in UNITS:
            columns[name].values[law, world] = part[name]
        for name in drawn:
            if name not in columns:
                empty = np.zeros(plan.worlds, np.float32)
                attrs = {
                    "units": unit_of(name),
                    "long_name": LABELS.get(name, name.replace("_", " ")),
                }
                columns[name] = xr.Variable("world", empty, attrs)
            columns[name].values[world] = part[name]
    for column in columns.values():
        column.encoding["_FillValue"] = None  # every number is a result
    meanings = {
        "law": (list(plan.laws), "what decides"),
        "object": (list(plan.domain.objects), "name of the object"),
        "world": (every, "index of the world"),
    }
    names = {
        name: xr.Variable(name, values, {"long_name": meaning})
        for name, (values, meaning) in meanings.items()
    }
    return xr.Dataset(columns, names)


def long_table(found: xr.Dataset) -> pd.DataFrame:
    """One row for each law and world of a sweep: its outcomes, and what was drawn.

    Columns are law, world, object, the outcomes (poses as base_x, base_y [m], base_yaw [rad], and
    so on) and the drawn quantities. `attrs["columns"]` holds the unit and the meaning of each.
    """
    pose = {"x": "m", "y": "m", "yaw": "rad"}
    flat = found.reset_coords().drop_vars(["which_object", "object", "pose"], errors="ignore")
    columns: dict[str, Any] = {"object": ("world", found.object.values[found.which_object.values])}
    for name in [str(name) for name in flat.data_vars]:
        if flat[name].dims == ("law", "world", "pose"):
            for i, (axis, unit) in enumerate(pose.items()):
                words = f"{axis} of the {name.removesuffix('_pose')} in the world at the end"
                own = flat[name].values[..., i], {"units": unit, "long_name": words}
                columns[name.replace("pose", axis)] = (("law", "world"), *own)
        elif set(flat[name].dims) <= {"law", "world"}:
            columns[name] = flat[name]
    names = {name: (name, found[name].values, found[name].attrs) for name in ("law", "world")}
    whole = xr.Dataset(columns, names)
    whole["object"].attrs["long_name"] = "name of the object"
    made = whole.to_dataframe(dim_order=["law", "world"]).reset_index()
    told = {str(name): whole[name].attrs for name in made.columns}
    made.attrs["columns"] = {
        name: [one.get("units", ""), one.get("long_name", name.replace("_", " "))]
        for name, one in told.items()
    }
    return made


def check_table(path: Path) -> None:
    """Raises InputError unless a table can be written there: .csv, or .parquet with pyarrow."""
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"table = {path} is not allowed: name a file NAME.csv or NAME.parquet.")
    if path.suffix == ".parquet" and not importlib.util.find_spec("pyarrow"):
        raise InputError(
            f"table = {path} needs pyarrow, which is not installed: run pip install pyarrow, or "
            "name a .csv file."
        )
    if not path.parent.is_dir():
        raise InputError(f"table = {path} is not allowed: {path.parent} is no folder.")


def write_table(found: xr.Dataset, path: Path) -> None:
    """Write `long_table` as CSV or Parquet, and beside it NAME.columns.csv: units and meanings."""
    made = long_table(found)
    told = [[name, *words] for name, words in made.attrs.pop("columns").items()]
    head = pd.DataFrame(told, columns=["column", "unit", "meaning"])
    if path.suffix == ".parquet":
        files.write_atomically(path, lambda partial: made.to_parquet(partial, index=False))
    else:
        files.write_atomically(path, lambda partial: made.to_csv(partial, index=False))
    files.write_atomically(
        path.with_suffix(".columns.csv"), lambda one: head.to_csv(one, index=False)
    )


def load(run: str | Path) -> xr.Dataset:
    """The results of a run folder, of a sweep with what was drawn as coordinates.

    Raises:
      InputError: the folder holds no results, or its file is damaged.

    Example:
      >>> import tempfile
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> with tempfile.TemporaryDirectory() as run:
      ...     made = rps_jax.sweep("rps", drums, worlds=8, setting=setting, out=run)
      ...     found = rps_jax.load(run)
      >>> found.equals(made)
      True
    """
    return with_coordinates(files.read_results(Path(run)))
