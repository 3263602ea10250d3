"""Results of a plan: outcomes collected into chunks, chunks joined into a labelled dataset, tables.

`Collector` fills chunks with the outcomes of trials as they end, `dataset` joins chunks, `gather`
does so for the chunks of run folders and writes `results.nc`, and `load` reads it.
"""

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

ResultChunk = Mapping[str, np.ndarray]  # columns of a chunk's trials, with their indices `trial`
StoreChunk = Callable[[int, ResultChunk], object]  # called with the number of a chunk
Columns = Mapping[str, tuple[np.ndarray, str]]  # drawn quantities: values (n,) and unit, by name
# Types of an outcome's columns; the rest are float32.
_TYPES: dict[str, type] = dict.fromkeys(("success", "tipped", "diverged", "stalled"), np.int8)
_REMOVED = "overflows"  # column of a version with the engine warp
_HDF5 = b"\x89HDF"  # with which a NetCDF file begins


def encoded(chunk: ResultChunk) -> bytes:
    """Encode a chunk as a NumPy archive, which is much faster to write than NetCDF."""
    return files.encode_arrays(**chunk)


def decoded(number: int, content: bytes) -> ResultChunk:
    """Decode a chunk; raise InputError if it is damaged, or of another version."""
    try:
        columns = files.decode_arrays(content)
    except ValueError as error:
        if content.startswith(_HDF5):
            raise _of_another_version(number, "it is a NetCDF file") from error
        raise files.CorruptFileError(f"part {number}", error) from error
    return {name: values for name, values in columns.items() if name != _REMOVED}


def _of_another_version(number: int, why: str) -> InputError:
    return InputError(
        f"part {number} of the run was written by another version ({why}): use that version."
    )


def name_of(chunk: int) -> str:
    """Return the name of a chunk's checkpoint in the run folder."""
    return f"{chunk:07d}"


class Collector:
    """Outcomes of trials that end in any order, collected into complete chunks."""

    def __init__(self, plan: Plan, store: StoreChunk):
        """Collect for the chunks of a plan; each is passed to `store` when it is complete."""
        self._store, self._chunks = store, plan.chunks
        self._chunk_of = np.empty(plan.num_trials, np.int32)  # of each trial
        for number, trials in plan.chunks.items():
            self._chunk_of[trials] = number
        self._open: dict[int, dict[str, np.ndarray]] = {}  # columns of incomplete chunks
        self._missing = {number: trials.size for number, trials in plan.chunks.items()}
        self.drawn: dict[int, Columns] = {}  # drawn quantities to store with a chunk

    def collect(self, indices: np.ndarray, outcomes: Outcome) -> None:
        """Add the outcomes of trials, and store the chunks that are complete with them."""
        chunk_of = self._chunk_of[indices]
        for number in map(int, np.unique(chunk_of)):
            members = chunk_of == number
            trials = self._chunks[number]
            columns = self._open.setdefault(number, {})
            at = np.searchsorted(trials, indices[members])
            for name, leaf in outcomes._asdict().items():
                if name not in columns:
                    shape = trials.size, *leaf.shape[1:]
                    columns[name] = np.empty(shape, _TYPES.get(name, np.float32))
                columns[name][at] = leaf[members]
            self._missing[number] -= at.size
            if not self._missing[number]:
                drawn = self.drawn.pop(number, {}).items()
                quantities = {name: values.astype(np.float32) for name, (values, _) in drawn}
                self._store(number, {"trial": trials, **self._open.pop(number), **quantities})


def gather(
    plan: Plan,
    folders: Sequence[Path],
    out: Path,
    chunks: dict[int, ResultChunk] | None = None,
) -> xr.Dataset:
    """Join all chunks of a plan, and write them as `results.nc` into the folder `out`.

    The `chunks` that are in memory are not read from `folders`; they are removed one by one, so
    that memory does not hold all results twice.

    Raises:
      InputError: chunks are missing.
    """
    chunks = chunks or {}
    missing = {name_of(n): n for n in plan.chunks if n not in chunks}

    def all_chunks() -> Iterator[tuple[int, ResultChunk]]:
        for number in list(chunks):
            yield number, chunks.pop(number)
        for folder in folders:
            for name, content in Checkpoints(folder).items(missing):
                number = missing.pop(name)
                yield number, decoded(number, content)

    results = dataset(plan, all_chunks())
    if missing:
        raise InputError(
            f"run = {', '.join(map(str, folders))} lacks {len(missing)} of {len(plan.chunks)} "
            "parts: run the same command again, or give the folders of all shards."
        )
    files.write_results(out / "results.nc", results)
    return results


def dataset(plan: Plan, chunks: Iterable[tuple[int, ResultChunk]]) -> xr.Dataset:
    """Return chunks as one dataset: outcomes (law, world), and drawn quantities (world)."""
    worlds = np.arange(plan.worlds)
    attrs = {"units": "1", "long_name": "index of the object in the coordinate object"}
    objects = plan.object_of(worlds).astype(np.int16)
    columns = {"which_object": xr.Variable("world", objects, attrs)}
    for name in UNITS:
        shape = (len(plan.laws), plan.worlds, 3)[: 3 if name.endswith("pose") else 2]
        values = np.zeros(shape, _TYPES.get(name, np.float32))
        columns[name] = variable(name, ("law", "world"), values)
    for number, chunk in chunks:
        law, _ = plan.law_and_object(number)
        _check_chunk(plan, number, chunk)
        world = plan.chunks[number] % plan.worlds
        for name in UNITS:
            columns[name].values[law, world] = chunk[name]
        for name in _drawn_names(chunk):
            if name not in columns:
                columns[name] = _quantity_column(name, plan.worlds)
            columns[name].values[world] = chunk[name]
    for column in columns.values():
        column.encoding["_FillValue"] = None  # every number is a result
    labels = {
        "law": (list(plan.laws), "what decides"),
        "object": (list(plan.domain.objects), "name of the object"),
        "world": (worlds, "index of the world"),
    }
    coordinates = {
        name: xr.Variable(name, values, {"long_name": meaning})
        for name, (values, meaning) in labels.items()
    }
    return xr.Dataset(columns, coordinates)


def _drawn_names(chunk: ResultChunk) -> list[str]:
    """Return the names of the drawn quantities that are stored with a chunk."""
    return [name for name in chunk if name not in ("trial", *UNITS)]


def _check_chunk(plan: Plan, number: int, chunk: ResultChunk) -> None:
    """Raise InputError unless a chunk has all columns of its trials, and nothing but numbers."""
    trials, drawn = plan.chunks[number], _drawn_names(chunk)
    law, _ = plan.law_and_object(number)
    missing = {"trial", *UNITS} - set(chunk) | ({"drawn"} if not (law or drawn) else set())
    if missing:
        raise _of_another_version(number, f"it lacks {', '.join(sorted(missing))}")
    for name, values in chunk.items():
        shape = (trials.size, 3) if name.endswith("_pose") and name in UNITS else (trials.size,)
        if values.shape != shape or values.dtype.kind not in "biuf":
            raise files.CorruptFileError(f"part {number}", f"{name} is not numbers of {shape}")
    if not np.array_equal(chunk["trial"], trials):
        raise files.CorruptFileError(f"part {number}", "it holds other trials")


def _quantity_column(name: str, worlds: int) -> xr.Variable:
    """Return an empty column of a drawn quantity."""
    attrs = {"units": unit_of(name), "long_name": LABELS.get(name, name.replace("_", " "))}
    return xr.Variable("world", np.zeros(worlds, np.float32), attrs)


def long_table(results: xr.Dataset) -> pd.DataFrame:
    """Return one row for each law and world of a sweep: its outcomes and drawn quantities.

    Columns are law, world, object, the outcomes (poses as base_x, base_y [m], base_yaw [rad], and
    so on) and the drawn quantities. `attrs["columns"]` holds the unit and the meaning of each.
    """
    axes = {"x": "m", "y": "m", "yaw": "rad"}
    flat = results.reset_coords().drop_vars(["which_object", "object", "pose"], errors="ignore")
    objects = results.object.values[results.which_object.values]
    columns: dict[str, Any] = {"object": ("world", objects, {"long_name": "name of the object"})}
    for name in map(str, flat.data_vars):
        values = flat[name]
        if values.dims == ("law", "world", "pose"):
            body = name.removesuffix("_pose")
            for i, (axis, unit) in enumerate(axes.items()):
                attrs = {
                    "units": unit,
                    "long_name": f"{axis} of the {body} in the world at the end",
                }
                columns[f"{body}_{axis}"] = (("law", "world"), values.values[..., i], attrs)
        elif set(values.dims) <= {"law", "world"}:
            columns[name] = values
    labels = {name: (name, results[name].values, results[name].attrs) for name in ("law", "world")}
    whole = xr.Dataset(columns, labels)
    frame = whole.to_dataframe(dim_order=["law", "world"]).reset_index()
    attrs = {str(name): whole[name].attrs for name in frame.columns}
    frame.attrs["columns"] = {
        name: [attr.get("units", ""), attr.get("long_name", name.replace("_", " "))]
        for name, attr in attrs.items()
    }
    return frame


def check_table(path: Path) -> None:
    """Raise InputError unless a table can be written there: .csv, or .parquet with pyarrow."""
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"table = {path} is not allowed: name a file NAME.csv or NAME.parquet.")
    if path.suffix == ".parquet" and not importlib.util.find_spec("pyarrow"):
        raise InputError(
            f"table = {path} needs pyarrow, which is not installed: run pip install pyarrow, or "
            "name a .csv file."
        )
    if not path.parent.is_dir():
        raise InputError(f"table = {path} is not allowed: {path.parent} is not a folder.")


def write_table(results: xr.Dataset, path: Path) -> None:
    """Write `long_table` as CSV or Parquet, and NAME.columns.csv with units and meanings."""
    frame = long_table(results)
    rows = [[name, *words] for name, words in frame.attrs.pop("columns").items()]
    header = pd.DataFrame(rows, columns=["column", "unit", "meaning"])
    write = frame.to_parquet if path.suffix == ".parquet" else frame.to_csv
    files.write_atomically(path, lambda partial: write(partial, index=False))
    columns = path.with_suffix(".columns.csv")
    files.write_atomically(columns, lambda partial: header.to_csv(partial, index=False))


def load(run: str | Path) -> xr.Dataset:
    """Load the results of a run folder; those of a sweep have the drawn quantities as coordinates.

    Raises:
      InputError: the folder holds no results, or its file is damaged.

    Example:
      >>> import tempfile
      >>> import rps_jax
      >>> drums, rules = rps_jax.Domain(("random_cylinder",)), rps_jax.Rules(horizon=2.0)
      >>> setting = rps_jax.Setting("quasistatic", rules=rules)
      >>> with tempfile.TemporaryDirectory() as run:
      ...     results = rps_jax.sweep("rps", drums, worlds=8, setting=setting, out=run)
      ...     loaded = rps_jax.load(run)
      >>> loaded.equals(results)
      True
    """
    return with_coordinates(files.read_results(Path(run)))
