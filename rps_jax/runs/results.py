"""Request and results of a plan: chunks of trials to run, and their outcomes as a dataset.

`PlanRequest` yields the worlds of chunks, `Results` collects outcomes, and `load` reads
`results.nc`. A chunk is stored as a NumPy archive of the columns of its trials, which is much
faster to write than NetCDF.
"""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import files, options
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.record.files import Arrays
from rps_jax.runs.plan import Plan, chunks_by_key, draw
from rps_jax.spec import specs_of
from rps_jax.trials.results import POSE, WORLD, variable
from rps_jax.trials.setting import Setting
from rps_jax.trials.trial import Outcome
from rps_jax.trials.worlds import Job, WorldBatch, drawn_worlds
from rps_jax.world import draws, points

# Types of an outcome's columns; the rest are float32.
_FLAGS = ("success", "tipped", "diverged", "nan_twist", "stalled", "unfelt")
_TYPES: dict[str, type] = dict.fromkeys(_FLAGS, np.int8)
_LATER = {"repositions", "contact_lost_path"}  # outcomes that version 0.4.0 does not store
StoreChunk = Callable[[int, bytes], object]  # called with the number of a chunk and its content
_PREFETCH = 16384  # worlds of one program that are built before they are needed, about
_FIRST = 64  # worlds of the first batch: programs are loaded while the others are built


def name_of(chunk: int) -> str:
    """Return the name of a chunk's checkpoint in the run folder."""
    return f"{chunk:07d}"


def store_chunk(folder: Path, chunk: int, content: bytes) -> Path:
    """Write the file of a chunk into a run folder, atomically."""
    return Checkpoints(folder).put(name_of(chunk), content, ".npz", new=True)


@dataclass(frozen=True)
class PlanRequest:
    """Request of a batch run of some chunks of a plan.

    The number of slots depends on the whole plan alone. So a chunk has the same bits whoever runs
    it, and whichever other chunks run beside it.
    """

    plan: Plan
    chunks: Sequence[int]
    results: Results  # which get the drawn quantities

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (law, world) of the outcomes."""
        return self.results.shape

    def jobs(self, setting: Setting) -> Iterator[Job]:
        """Yield the chunks to run; their worlds are built chunk by chunk."""
        ahead = max(1, _PREFETCH // self.plan.part)
        by_key = chunks_by_key(self.plan, self.plan.chunks)
        for key, chunks in chunks_by_key(self.plan, self.chunks).items():
            num_trials = sum(self.plan.chunks[chunk].size for chunk in by_key[key])
            parts = [self.plan.chunks[chunk] for chunk in chunks]
            if setting.simulator.traced:
                parts[:1] = filter(np.size, np.split(parts[0], [_FIRST]))
            yield Job(key, num_trials, _prefetch(map(self._build, parts), ahead))

    def _build(self, trials: np.ndarray) -> WorldBatch:
        """Build the worlds of trials; those of the first law record the drawn quantities."""
        law, worlds = np.divmod(trials, self.plan.worlds)
        drawn = draw(self.plan, worlds)
        if law[0] == 0:
            table = draws.table(drawn)
            self.results.put_drawn(worlds, {name: values for name, (values, _) in table.items()})
        batch = drawn_worlds(self.plan.domain, drawn, self.plan.setting)
        params = list(self.plan.laws.values())[law[0]]
        return batch._replace(indices=trials).with_params(params)


class Results:
    """Outcomes and drawn quantities of a plan, which fill as trials end or stored chunks are read.

    The memory of a column is claimed when it is filled.
    """

    def __init__(self, plan: Plan, store: StoreChunk | None = None):
        """Prepare the columns of all trials; `store` is called with each chunk that is complete."""
        self.plan, self._store = plan, store
        self.shape = (len(plan.laws), plan.worlds)
        self._outcomes: Arrays = {}  # (law, world, ...)
        for name in (*specs_of(Outcome), *plan.domain.task.outcomes):
            axes = (3,) if name.endswith("_pose") else ()
            self._outcomes[name] = np.zeros((*self.shape, *axes), _TYPES.get(name, np.float32))
        self._drawn: Arrays = {}  # (world,) drawn quantities
        self.missing = {chunk: trials.size for chunk, trials in plan.chunks.items()}  # trials

    @functools.cached_property
    def _chunk_of(self) -> np.ndarray:
        """Number of the chunk of each trial."""
        chunk_of = np.empty(self.plan.num_trials, np.int32)
        for chunk, trials in self.plan.chunks.items():
            chunk_of[trials] = chunk
        return chunk_of

    def put_drawn(self, worlds: np.ndarray, columns: Arrays) -> None:
        """Insert the drawn quantities of worlds."""
        for name, values in columns.items():
            self._drawn.setdefault(name, np.zeros(self.plan.worlds, np.float32))[worlds] = values

    def put(self, indices: np.ndarray, outcomes: Outcome) -> None:
        """Insert the outcomes of trials, and store the chunks that are complete with them."""
        at = np.unravel_index(indices, self.shape)
        for name, leaf in outcomes.columns().items():
            self._outcomes[name][at] = leaf
        chunks, counts = np.unique(self._chunk_of[indices], return_counts=True)
        for chunk, count in zip(chunks.tolist(), counts.tolist(), strict=True):
            self.missing[chunk] -= count
            if not self.missing[chunk]:
                del self.missing[chunk]
                if self._store is not None:
                    self._store(chunk, self._encode(chunk))

    def _encode(self, chunk: int) -> bytes:
        """Return the content of a chunk's file."""
        trials = self.plan.chunks[chunk]
        law, worlds = at = np.unravel_index(trials, self.shape)
        outcomes = {name: column[at] for name, column in self._outcomes.items()}
        drawn = {name: x[worlds] for name, x in self._drawn.items() if law[0] == 0}
        return files.encode_arrays(trial=trials, **outcomes, **drawn)

    # --- stored chunks ---------------------------------------------------------------------

    def read(self, folder: Path, chunks: Iterable[int]) -> None:
        """Insert those of some chunks that a run folder holds."""
        names = {name_of(chunk): chunk for chunk in chunks}
        for name, content in Checkpoints(folder).items(names):
            self._insert(names[name], content)

    def read_all(self, folders: Sequence[Path]) -> xr.Dataset:
        """Insert the chunks that were not run, from run folders, and return the dataset.

        Raises:
          InputError: chunks are missing.
        """
        for folder in folders:
            self.read(folder, list(self.missing))
        if self.missing:
            raise InputError(
                f"run = {', '.join(map(str, folders))} lacks {len(self.missing)} of "
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
        known = {"trial", *self._outcomes}
        drawn = set(columns) - known
        needed = {*known, *(() if law[0] or drawn else ("drawn",))} - _LATER
        if missing := needed - set(columns):
            raise InputError(
                f"part {chunk} of the run was written by another version (it lacks "
                f"{', '.join(sorted(missing))}): use that version."
            )
        for name, values in columns.items():
            axes = self._outcomes[name].shape[2:] if name in self._outcomes else ()
            if values.shape != worlds.shape + axes or values.dtype.kind not in "biuf":
                shape = worlds.shape + axes
                raise files.CorruptFileError(source, f"{name} is not numbers of {shape}")
        if not np.array_equal(columns["trial"], self.plan.chunks[chunk]):
            raise files.CorruptFileError(source, "it holds other trials")
        for name, column in self._outcomes.items():
            column[at] = columns.get(name, np.nan)
        self.put_drawn(worlds, {name: columns[name] for name in columns if name in drawn})
        self.missing.pop(chunk, None)

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
