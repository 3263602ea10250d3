"""Results of a plan: outcomes collected into chunks, chunks joined into a labelled dataset, tables.

A chunk is a NumPy archive of the columns of its trials, which is much faster to write than NetCDF.
`Results` runs chunks, inserts stored ones and returns the dataset, and `load` reads `results.nc`.
"""

import functools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import files, options
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.record.files import Arrays
from rps_jax.record.table import check_parquet
from rps_jax.runs.plan import Plan, chunks_by_key, draw
from rps_jax.spec import specs_of
from rps_jax.trials.batch import Job, WorldBatch
from rps_jax.trials.results import POSE, WORLD, labelled, variable
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import drawn_worlds
from rps_jax.world import draws, points

StoreChunk = Callable[[int, bytes], object]  # called with the number of a chunk and its content
# Types of an outcome's columns; the rest are float32.
_FLAGS = ("success", "tipped", "diverged", "nan_twist", "stalled", "unfelt")
_TYPES: dict[str, type] = dict.fromkeys(_FLAGS, np.int8)
_PREFETCH = 16384  # worlds of one program that are built before they are needed, about


def name_of(chunk: int) -> str:
    """Return the name of a chunk's checkpoint in the run folder."""
    return f"{chunk:07d}"


class Results:
    """Results of a plan, which fill as trials end or as stored chunks are inserted.

    It is the request of a rollout of some chunks, and collects their outcomes. The number of slots
    depends on the whole plan alone. So a chunk has the same bits whoever runs it, and whichever
    other chunks run beside it.
    """

    def __init__(self, plan: Plan, chunks: Sequence[int] = (), store: StoreChunk | None = None):
        """Prepare to run chunks; each is passed to `store` when it is complete."""
        self.plan, self._chunks, self._store = plan, chunks, store
        self.shape = len(plan.laws), plan.worlds
        self._names = (*specs_of(Outcome), *plan.domain.task.OUTCOMES)
        self._outcomes = {name: self._empty(name) for name in self._names}  # (law, world, ...)
        self._drawn: Arrays = {}  # (world,) drawn quantities
        self._running = {chunk: plan.chunks[chunk].size for chunk in chunks}  # trials

    def _empty(self, name: str) -> np.ndarray:
        """Return an empty column of outcomes; its memory is claimed when it is filled."""
        axes = (3,) if name.endswith("_pose") else ()
        return np.zeros((*self.shape, *axes), _TYPES.get(name, np.float32))

    @functools.cached_property
    def _chunk_of(self) -> np.ndarray:
        """Number of the chunk of each trial."""
        chunk_of = np.empty(self.plan.num_trials, np.int32)
        for chunk, trials in self.plan.chunks.items():
            chunk_of[trials] = chunk
        return chunk_of

    # --- a rollout -------------------------------------------------------------------------

    def jobs(self, setting: Setting) -> Iterator[Job]:
        """Yield the chunks to run; their worlds are built chunk by chunk."""
        ahead = max(1, _PREFETCH // self.plan.part)
        by_key = chunks_by_key(self.plan, self.plan.chunks)
        for key, chunks in chunks_by_key(self.plan, self._chunks).items():
            trials = sum(self.plan.chunks[chunk].size for chunk in by_key[key])
            yield Job(key, trials, _prefetch(map(self._build, chunks), ahead))

    def _build(self, chunk: int) -> WorldBatch:
        """Build the worlds of a chunk; those of the first law record the drawn quantities."""
        law, worlds = np.divmod(self.plan.chunks[chunk], self.plan.worlds)
        drawn = draw(self.plan, worlds)
        if law[0] == 0:
            for name, (values, _) in draws.table(drawn).items():
                self._put_drawn(name, worlds, values)
        batch = drawn_worlds(self.plan.domain, drawn, self.plan.setting)
        params = list(self.plan.laws.values())[law[0]]
        return batch._replace(indices=self.plan.chunks[chunk]).with_params(params)

    def _put_drawn(self, name: str, worlds: np.ndarray, values: np.ndarray) -> None:
        self._drawn.setdefault(name, np.zeros(self.plan.worlds, np.float32))[worlds] = values

    def collect(self, indices: np.ndarray, outcomes: Outcome) -> None:
        """Add the outcomes of trials, and store the chunks that are complete with them."""
        at = np.unravel_index(indices, self.shape)
        for name, leaf in outcomes.columns().items():
            self._outcomes[name][at] = leaf
        for chunk in self._chunk_of[indices].tolist():
            self._running[chunk] -= 1
            if not self._running[chunk] and self._store is not None:
                self._store(chunk, files.encode_arrays(**self._columns(chunk)))

    def _columns(self, chunk: int) -> Arrays:
        """Return the columns of a chunk to store."""
        trials = self.plan.chunks[chunk]
        law, worlds = at = np.unravel_index(trials, self.shape)
        drawn = self._drawn if law[0] == 0 else {}
        outcomes = {name: column[at] for name, column in self._outcomes.items()}
        return {"trial": trials, **outcomes, **{name: x[worlds] for name, x in drawn.items()}}

    # --- stored chunks ---------------------------------------------------------------------

    def read(self, folder: Path, chunks: Sequence[int]) -> list[int]:
        """Insert those of some chunks that a run folder holds; return the numbers of the rest."""
        missing = dict(zip(map(name_of, chunks), chunks, strict=True))
        for name, content in Checkpoints(folder).items(missing):
            self._insert(missing.pop(name), content)
        return list(missing.values())

    def read_all(self, folders: Sequence[Path]) -> xr.Dataset:
        """Insert the chunks that were not run, from run folders, and return the dataset.

        Raises:
          InputError: chunks are missing.
        """
        missing = [chunk for chunk in self.plan.chunks if chunk not in self._running]
        for folder in folders:
            missing = self.read(folder, missing)
        if missing:
            raise InputError(
                f"run = {', '.join(map(str, folders))} lacks {len(missing)} of "
                f"{len(self.plan.chunks)} parts: run the same command again, or give the folders "
                "of all shards."
            )
        return self.dataset()

    def _insert(self, chunk: int, content: bytes) -> None:
        """Insert a stored chunk; raise InputError if it is damaged, or of another version."""
        at = law, worlds = np.unravel_index(self.plan.chunks[chunk], self.shape)
        source = f"part {chunk}"
        try:
            columns = files.decode_arrays(content)
        except ValueError as error:
            raise files.CorruptFileError(source, error) from error
        known = {"trial", *self._names}
        drawn = set(columns) - known
        if missing := {*known, *(() if law[0] or drawn else ("drawn",))} - set(columns):
            raise InputError(
                f"part {chunk} of the run was written by another version (it lacks "
                f"{', '.join(sorted(missing))}): use that version."
            )
        for name, values in columns.items():
            shape = worlds.shape + (
                self._outcomes[name].shape[2:] if name in self._outcomes else ()
            )
            if values.shape != shape or values.dtype.kind not in "biuf":
                raise files.CorruptFileError(source, f"{name} is not numbers of {shape}")
        if not np.array_equal(columns["trial"], self.plan.chunks[chunk]):
            raise files.CorruptFileError(source, "it holds other trials")
        for name in self._names:
            self._outcomes[name][at] = columns[name]
        for name in columns:
            if name in drawn:
                self._put_drawn(name, worlds, columns[name])

    # --- the dataset -----------------------------------------------------------------------

    def dataset(self) -> xr.Dataset:
        """Return outcomes (law, world), with the drawn quantities (world) as coordinates."""
        worlds, dims = np.arange(self.plan.worlds), ("law", "world")
        columns = {name: variable(name, dims, values) for name, values in self._outcomes.items()}
        drawn = points.drawn_variables(self.plan.domain, self.plan.object_of(worlds), self._drawn)
        for column in (*columns.values(), *drawn.values()):
            column.encoding["_FillValue"] = None  # every number is a result
        coordinates = {
            "law": xr.Variable("law", list(self.plan.laws), {"long_name": "control law"}),
            "world": xr.Variable("world", worlds, {"long_name": WORLD}),
        }
        return xr.Dataset(columns, coordinates | drawn | {"pose": POSE})


def _prefetch(batches: Iterator[WorldBatch], count: int) -> Iterator[WorldBatch]:
    """Build up to `count` batches ahead in a thread, while earlier ones run."""
    with ThreadPoolExecutor(1) as builder:
        following: Callable[..., WorldBatch | None] = device.standard_jax()(next)
        build = functools.partial(builder.submit, following, batches, None)
        queue = deque(build() for _ in range(count))
        while (worlds := queue.popleft().result()) is not None:
            queue.append(build())
            yield worlds


def check_table(path: Path) -> None:
    """Raise InputError unless a table can be written there: .csv, or .parquet with pyarrow."""
    is_csv = files.suffix_of(files.unpacked(path)) == ".csv"
    if not is_csv and files.suffix_of(path) != ".parquet":
        raise InputError(f"table = {path} is not allowed: name a file NAME.csv or NAME.parquet.")
    check_parquet("table", path)
    if not path.parent.is_dir():
        raise InputError(f"table = {path} is not allowed: {path.parent} is not a folder.")


def write_table(results: xr.Dataset, path: Path) -> None:
    """Write one row for each law and world of a sweep, as CSV or Parquet.

    Columns are law, world, object, the outcomes (poses as base_x, base_y [m], base_yaw [rad], and
    so on) and the drawn quantities. NAME.columns.csv has the unit and the meaning of each.
    """
    flat = results.reset_coords().drop_vars("pose", errors="ignore")
    columns = {"object": results.object.variable}
    for name, values in ((str(name), values) for name, values in flat.items()):
        if values.dims == ("law", "world", "pose"):
            body = name.removesuffix("_pose")
            for i, (axis, unit) in enumerate({"x": "m", "y": "m", "yaw": "rad"}.items()):
                meaning = f"{axis} of the {body} in the world at the end"
                column = ("law", "world"), values.values[..., i], unit, meaning
                columns |= labelled(**{f"{body}_{axis}": column})
        elif set(values.dims) <= {"law", "world"}:
            columns[name] = values.variable
    labels = {name: (name, results[name].values, results[name].attrs) for name in ("law", "world")}
    whole = xr.Dataset(columns, labels)
    frame = whole.to_dataframe(dim_order=["law", "world"]).reset_index()
    attrs = {str(name): whole[name].attrs for name in frame.columns}
    rows = [
        [name, attr.get("units", ""), attr.get("long_name", name.replace("_", " "))]
        for name, attr in attrs.items()
    ]
    header = pd.DataFrame(rows, columns=["column", "unit", "meaning"])
    write = frame.to_parquet if files.suffix_of(path) == ".parquet" else frame.to_csv
    files.write_atomically(path, lambda partial: write(partial, index=False))
    columns_path = files.unpacked(path).with_suffix(".columns.csv")
    files.write_atomically(columns_path, lambda partial: header.to_csv(partial, index=False))


def load(run: str | Path) -> xr.Dataset:
    """Load the results of a run folder, as `xarray.open_dataset` reads its `results.nc`.

    Those of a sweep have the drawn quantities as coordinates. The checksum of the file is verified.

    Raises:
      InputError: the folder holds no results, or its file is damaged.

    Examples:
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
    options.check_arguments(load, {"run": run})
    return files.read_results(Path(run))
