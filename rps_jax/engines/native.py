"""Functions of one world that are compiled with a C compiler or NVRTC instead of XLA.

XLA starts each operation on a few worlds separately, which takes longer than the operation itself.
Here `lowering` prints a function of one world as one C function with a vector lane for each world,
or as one CUDA kernel. The compiled library is stored in the program cache, under a key of its
text, the compiler and the device, with a checksum. Derivatives are compiled in the same way. XLA
compiles the function where there is no compiler, and in double precision.

Derivatives need linear maps with given transposes. `jax.custom_jvp` alone cannot say how a tangent
map is transposed, and `jax.custom_vjp` has no forward mode. The primitive of `linear_map` has both,
and `jax.vmap` maps it. `once_differentiable` refuses second derivatives where they would be wrong.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import itertools
import operator
import os
import platform
import re
import subprocess
import tempfile
import threading
import warnings
from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from rps_jax.engines import device
from rps_jax.geometry import vectors
from rps_jax.geometry.arrays import Array, Pytree
from rps_jax.lowering import nvrtc
from rps_jax.lowering.gpu import WARP, GpuWriter, shared_size
from rps_jax.lowering.graph import CompilerError, TooLargeError, UnsupportedError, first_array
from rps_jax.lowering.walk import Rows
from rps_jax.lowering.writer import HANDLER, SimdWriter
from rps_jax.record import cache

if TYPE_CHECKING:
    from rps_jax.engines.base import Stage

Function: TypeAlias = Callable[..., Pytree]
# XLA, too, fuses a sum with the product before it. No other optimisation may change results.
_FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-w")
# Without these passes the compiler takes half of the time, and the functions are as fast.
_FLAGS += ("-fno-gcse", "-fno-rerun-cse-after-loop", "-fno-tree-dse")
_FLAGS += ("--param", "sccvn-max-alias-queries-per-access=30")
if platform.machine() in ("x86_64", "AMD64"):  # GCC splits vectors where it prefers shorter ones
    _FLAGS += ("-mprefer-vector-width=512",)
_NAME = "rps_native_"
_THREADS = (4, 16)  # of a GPU that compute a world: the second if shared memory is short
_PLATFORMS = {"cpu": "cpu", "gpu": "CUDA"}
libraries: dict[str, ctypes.CDLL] = {}  # of the functions that XLA can call, by name
# Compilers run while JAX traces the next functions.
_COMPILATIONS = ThreadPoolExecutor(4, "compiler")
_locks: defaultdict[str, threading.RLock] = defaultdict(threading.RLock)


def compiles(*stages: Stage) -> bool:
    """Whether worlds of these stages are compiled one by one here."""
    return all(stage.native for stage in stages) and is_available()


def is_available() -> bool:
    """Whether functions are compiled here: with a compiler, in float, and not within another.

    Warns if a GPU has no compiler, unless the user chose so by `RPS_COMPILER=none`.
    """
    if jax.config.jax_enable_x64 or vectors.ONE_WORLD.get():
        return False
    if target() is not None:
        return True
    if jax.default_backend() == "gpu" and os.environ.get("RPS_COMPILER") != "none":
        missing = "a C compiler (apt install gcc) or NVRTC (pip install nvidia-cuda-nvrtc)"
        warnings.warn(
            f"{missing} is not installed, so XLA compiles, which is much slower", stacklevel=2
        )
    return False


@functools.cache
def _macros(compiler: str) -> str | None:
    """Return a digest of the compiler, its flags and macros for this processor; None: it fails."""
    command = [compiler, *_FLAGS, "-dM", "-E", "-x", "c", os.devnull]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        macros = subprocess.run(command, capture_output=True, check=True, timeout=60).stdout
        return hashlib.sha256(repr((compiler, _FLAGS)).encode() + macros).hexdigest()
    return None


def target() -> str | None:
    """Return an identifier of the compiler and the device; None without a compiler."""
    if (compiler := device.find_compiler()) is None or (macros := _macros(compiler)) is None:
        return None
    if jax.default_backend() == "cpu":
        return macros
    return (gpu := nvrtc.target()) and f"{macros} {gpu}"


def batched(function: Function, fallback: Function, has_residuals: bool = False) -> Function:
    """Return a function of a batch of worlds (B, ...) that runs world by world.

    Its derivatives in both modes are compiled as the function itself is.

    Args:
      function: the function of one world; pure.
      fallback: the same function of a batch, which XLA compiles where `function` is not compiled.
      has_residuals: whether `function` is a function of a tuple of arguments and of residuals, and
        returns results and residuals: numbers that it computes if it gets (), and from which, as
        constants, its derivatives are faster. Where it is not differentiated it gets None.
    """
    if not is_available():
        return fallback

    def evaluate(arguments: Pytree, residuals: Pytree) -> tuple[Pytree, Pytree]:
        return function(arguments, residuals) if has_residuals else (function(*arguments), ())

    def with_residuals(*arguments: Pytree) -> tuple[Pytree, Pytree]:
        return evaluate(arguments, ())

    def plain(*arguments: Pytree) -> Pytree:
        return evaluate(arguments, None)[0]

    @jax.custom_jvp
    def call(*arguments: Pytree) -> Pytree:
        return _computed(plain, arguments, fallback)

    def rule(primals: Pytree, tangents: Pytree) -> tuple[Pytree, Pytree]:
        results, saved = call(*primals), ()
        if has_residuals:
            results, saved = _computed(with_residuals, primals)
        leaves, tree = jax.tree.flatten((primals, saved))
        varied = varied_indices(directions := jax.tree.leaves(tangents))
        maps = _maps(lambda values: evaluate(*tree.unflatten(values))[0], varied, results)
        forward, transpose = (batched(f, jax.vmap(f)) for f in maps)
        vectors = [directions[i] for i in varied]
        return results, _tangents(forward, transpose, leaves, vectors, results)

    call.defjvp(rule, symbolic_zeros=True)
    return call


def _computed(
    function: Function,
    arguments: Sequence[Pytree],
    fallback: Function | None = None,
    strict: bool = False,
) -> Pytree:
    """Return the results of a batch for a function of one world: see `concurrent`."""
    in_xla = fallback or jax.vmap(function)
    return concurrent([function], lambda x: [in_xla(*x)], strict=strict)(tuple(arguments))[0]


def compared(function: Function, types: Sequence[Pytree], compare: Callable[[], str]) -> str:
    """Return the result of comparing a function with XLA's; it is cached with the function.

    Args:
      function: the function of one world that `batched` compiles.
      types: shapes and dtypes of its arguments, of a batch of worlds.
      compare: runs both and returns the difference as a text, which is empty if there is none.
    """
    leaves, tree = jax.tree.flatten(tuple(types))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the run itself says why XLA compiles
        library = _compiled([_Function(function, tree, [(x.shape, x.dtype) for x in leaves], None)])
    if library is None:
        return ""
    path = _cache_path(f"{library.name}_compared")
    result = path and cache.read(path, "compared", bytes.decode)
    if result is None:
        result = compare()
        cache.write(path, result.encode())
    return result


def mapped(function: Function, axes: Sequence[int | None]) -> Function:
    """Return `jax.vmap(function, axes)`, compiled and differentiated world by world.

    An argument of axis None is repeated for each world.
    """

    def call(*arguments: Pytree) -> Pytree:
        size = len(jax.tree.leaves(arguments[0])[0])
        trees = list(map(jax.tree.structure, arguments))

        # Records check the shapes of a world: a batch is passed as leaves.
        def single(*leaves: Sequence[Pytree]) -> Pytree:
            return function(*(tree.unflatten(x) for tree, x in zip(trees, leaves, strict=True)))

        inputs = [
            [x if axis == 0 else jnp.broadcast_to(x, (size, *jnp.shape(x))) for x in leaves]
            for leaves, axis in zip(map(jax.tree.leaves, arguments), axes, strict=True)
        ]
        return batched(single, jax.vmap(single))(*inputs)

    return call


def scan(
    step: Callable[[Pytree, Pytree, Pytree], tuple[tuple[Pytree, Pytree], Pytree]],
    state: Pytree,
    constants: Pytree,
    length: int,
) -> tuple[Pytree, Pytree]:
    """Return `jax.lax.scan` of a batch of worlds (B, ...) by one native function for all steps.

    Its derivatives in each mode are one native function, too.

    Args:
      step: of one world, from state, constants and the residuals of `batched`. It returns state
        and output, and the residuals.
      state: first state.
      constants: pytree of arrays that do not change.
      length: number of steps.

    Raises:
      TooLargeError: the step is not compiled here.
    """

    def run(inputs: tuple[Pytree, Pytree], residuals: Pytree) -> tuple[Pytree, Pytree]:
        def whole(state: Pytree, constants: Pytree) -> tuple[Pytree, Pytree]:
            def next_row(state: Pytree, _: None) -> tuple[Pytree, Pytree]:
                (end, output), computed = step(state, constants, residuals)
                return end, output if residuals is None else (output, (state, computed))

            return jax.lax.scan(next_row, state, length=length)

        return _computed(whole, inputs, strict=True)

    call = jax.custom_jvp(lambda *inputs: run(inputs, None))

    def rule(primals: Pytree, tangents: Pytree) -> Pytree:
        states, constants = (jax.tree.leaves(x) for x in primals)
        end, (outputs, rows) = run(primals, ())
        saved, tree = jax.tree.flatten((rows, primals[1]))
        varied = varied_indices(directions := jax.tree.leaves(tangents))
        carried, scanned = _real_indices(states), len(saved) - len(constants)
        vectors = [directions[i] if i in varied else jnp.zeros_like(states[i]) for i in carried]
        vectors += [directions[i] for i in varied if i >= len(states)]
        fixed = [i - len(states) + scanned for i in varied if i >= len(states)]
        count = len(carried)

        def results(values: Sequence[Pytree]) -> Pytree:
            (state, residuals), constants = tree.unflatten(values)
            return step(state, constants, residuals)[0]

        push, pull = _maps(results, [*carried, *fixed], (end, outputs))

        def push_all(saved: Sequence[Pytree], vectors: Sequence[Pytree]) -> Pytree:
            def push_row(moved: Pytree, row: Pytree) -> tuple[Pytree, Pytree]:
                moved = push([*row, *saved[scanned:]], [*moved, *vectors[count:]])
                return moved[:count], moved[count:]

            end, outputs = jax.lax.scan(push_row, [*vectors[:count]], saved[:scanned])
            return *end, *outputs

        def pull_all(saved: Sequence[Pytree], start: Pytree, rows: Sequence[Pytree]) -> Pytree:
            def pull_row(carry: list[Pytree], row: Pytree) -> tuple[list[Pytree], Pytree]:
                moved = pull([*row[0], *saved[scanned:]], [*carry[:count], *row[1]])
                return [*moved[:count], *map(operator.add, carry[count:], moved[count:])], ()

            return jax.lax.scan(pull_row, start, (saved[:scanned], rows), reverse=True)[0]

        def forward(saved: Sequence[Array], vectors: Sequence[Array]) -> list[Array]:
            return _computed(push_all, (saved, vectors))

        def transpose(saved: Sequence[Array], vectors: Sequence[Array]) -> list[Array]:
            start = [*vectors[:count], *(jnp.zeros_like(saved[i]) for i in fixed)]
            return _computed(pull_all, (saved, start, vectors[count:]))

        return (end, outputs), _tangents(forward, transpose, saved, vectors, (end, outputs))

    call.defjvp(rule, symbolic_zeros=True)
    end, outputs = call(*jax.tree.map(jnp.asarray, (state, constants)))
    return end, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), outputs)


def _maps(function: Function, varied: Sequence[int], results: Pytree) -> tuple[Map, Map]:
    """Return the tangent map of a function of a list of values of one world, and its transpose.

    They map vectors of the `varied` values to those of its real results, and back.
    """
    real = _real_indices(jax.tree.leaves(results))

    def real_results(values: Sequence[Pytree]) -> list[Pytree]:
        leaves = jax.tree.leaves(function(values))
        return [leaves[i] for i in real]

    def push(values: Sequence[Pytree], vectors: Sequence[Pytree]) -> list[Pytree]:
        of_varied, point = restrict(real_results, values, varied)
        return jax.jvp(of_varied, (point,), (list(vectors),))[1]

    def pull(values: Sequence[Pytree], vectors: Sequence[Pytree]) -> list[Pytree]:
        of_varied, point = restrict(real_results, values, varied)
        return jax.vjp(of_varied, point)[1](list(vectors))[0]

    return push, pull


def _real_indices(arrays: Sequence[Array]) -> list[int]:
    return [i for i, x in enumerate(arrays) if jnp.issubdtype(x.dtype, jnp.floating)]


def _tangents(
    forward: Map, transpose: Map, saved: Sequence[Array], vectors: Sequence[Array], results: Pytree
) -> Pytree:
    """Return the tangents of results: those of the real ones by a linear map of vectors."""
    leaves, tree = jax.tree.flatten(results)
    real = _real_indices(leaves)
    outputs = linear_map(forward, transpose, saved, vectors, [leaves[i] for i in real])
    values = dict(zip(real, outputs, strict=True))
    zeros = [np.zeros(x.shape, jax.dtypes.float0) for x in leaves]
    return tree.unflatten([values.get(i, x) for i, x in enumerate(zeros)])


def concurrent(
    functions: Sequence[Function],
    fallback: Callable[..., Sequence[Pytree]],
    sort_by: Callable[..., Array] | None = None,
    strict: bool = False,
) -> Callable[..., Pytree]:
    """Return functions of batches of worlds as one function; a GPU runs them at the same time.

    Args:
      functions: of one world each; pure.
      fallback: all their results from a tuple of arguments for each; XLA compiles it where
        `functions` are not compiled.
      sort_by: returns keys (B,) of a batch's worlds. Worlds with similar keys are computed side by
        side, which changes only how long it takes.
      strict: raise TooLargeError instead of calling `fallback`.
    """
    if not is_available():
        return fallback

    @functools.cache
    def compiled(
        types: Sequence[tuple[Pytree, Sequence[Pytree]]],
    ) -> tuple[list[_Function], Pytree]:
        calls = [_Function(f, *x, sort_by) for f, x in zip(functions, types, strict=True)]
        groups = [calls] if jax.default_backend() == "gpu" else [[call] for call in calls]
        return calls, [(group, _compiled(group)) for group in groups]

    @jax.custom_jvp
    def run(*arguments: Pytree) -> list[Pytree]:
        flat = [jax.tree.flatten(jax.tree.map(jnp.asarray, x)) for x in arguments]
        types = tuple((tree, tuple((x.shape, x.dtype) for x in leaves)) for leaves, tree in flat)
        calls, groups = compiled(types)
        if any(library is None for _, library in groups):
            if strict:
                raise TooLargeError("XLA compiles this function to faster code.")
            return list(fallback(*arguments))
        inputs = [leaves for leaves, _ in flat]
        if sort_by is not None:
            orders = [jnp.argsort(sort_by(*x)).astype(jnp.int32) for x in arguments]
            inputs = [[*x, order] for x, order in zip(inputs, orders, strict=True)]
        flat_inputs, inputs_tree = jax.tree.flatten(inputs)

        def run_libraries(values: Sequence[Pytree], _: Pytree) -> list[Array]:
            """Call the libraries, for which it waits until they are compiled."""
            leaves = inputs_tree.unflatten(values)
            try:
                names = [library.ready() for _, library in groups]
            except CompilerError as error:
                compiler, reason = error.args
                warnings.warn(f"{compiler} fails, so XLA compiles: {reason}", stacklevel=2)
                pairs = zip(types, leaves, strict=True)
                trees = [tree.unflatten(x[: len(kinds)]) for (tree, kinds), x in pairs]
                return jax.tree.leaves(list(fallback(*trees)))
            owners, results = iter(leaves), list[Array]()
            for (group, _), name in zip(groups, names, strict=True):
                shapes = [x for call in group for x in call.shapes]
                run_library = jax.ffi.ffi_call(name, shapes, vmap_method="broadcast_all")
                results += run_library(*(x for _ in group for x in next(owners)))
            return results

        shapes = [x for call in calls for x in call.shapes]
        # As a map of no vectors it has a message where it is differentiated twice.
        label = " ".join(library.name for _, library in groups)
        results = iter(linear_map(run_libraries, None, flat_inputs, [], shapes, label))
        return [x.trace.structure.unflatten([next(results) for _ in x.shapes]) for x in calls]

    run.defjvp(lambda primals, tangents: jax.jvp(lambda *x: list(fallback(*x)), primals, tangents))
    return run


class _Library(NamedTuple):
    """A library that XLA can call, or that is being compiled."""

    name: str
    compilation: Future[None] | None = None

    def ready(self) -> str:
        """Return its name when it is compiled.

        Raises:
          CompilerError: the compiler fails.
        """
        if self.compilation is not None:
            self.compilation.result()
        return self.name


@dataclass(frozen=True)
class Keyed:
    """Function of one world that is traced and printed once for all functions of an equal key."""

    key: Hashable
    function: Function = field(compare=False)

    def __call__(self, *arguments: Pytree) -> Pytree:
        return self.function(*arguments)


class _Trace:
    """The jaxpr of a function of one world."""

    def __init__(self, function: Function, tree: Pytree, types: Sequence[Pytree]) -> None:
        self.inputs = list(itertools.starmap(jax.ShapeDtypeStruct, types))
        with vectors.trace_one_world():
            world = tree.unflatten(self.inputs)
            self.jaxpr, out = jax.make_jaxpr(function, return_shape=True)(*world)
        self.results, self.structure = jax.tree.flatten(out)
        self.texts: dict[Pytree, str] = {}

    def text(self, is_sorted: bool, printer: Callable[..., SimdWriter], *options: int) -> str:
        """Return the text that a printer with these options writes."""
        if (key := (is_sorted, printer, *options)) not in self.texts:
            inputs = self.jaxpr, self.inputs, self.results, is_sorted
            self.texts[key] = printer(*options).source(*inputs)
        return self.texts[key]


_trace_keyed = functools.lru_cache(256)(_Trace)


class _Function:
    """A function of one world, and the shapes of the results of a batch."""

    def __init__(
        self,
        function: Function,
        tree: Pytree,
        types: Sequence[tuple[Pytree, Pytree]],
        sort_by: Callable[..., Array] | None,
    ) -> None:
        trace: Any = _trace_keyed if isinstance(function, Keyed) else _Trace
        self.trace = trace(function, tree, tuple((shape[1:], dtype) for shape, dtype in types))
        self.is_sorted, count = sort_by is not None, types[0][0][0]
        results = self.trace.results
        self.shapes = [jax.ShapeDtypeStruct((count, *x.shape), x.dtype) for x in results]


def _compiled(functions: Sequence[_Function]) -> _Library | None:
    """Start to compile functions, or load them from the cache; None: XLA compiles them."""
    on_gpu = jax.default_backend() == "gpu"
    try:
        threads, texts = _texts(functions) if on_gpu else (1, _printed(functions, SimdWriter))
    except UnsupportedError as error:
        message = f"{error} XLA compiles this law, which is some ten times slower."
        warnings.warn(message, stacklevel=2)
        return None
    except (TooLargeError, jax.errors.TracerArrayConversionError):
        return None  # XLA is faster, or the law holds a value that is being traced
    key = repr((texts, on_gpu and (nvrtc.LAUNCH, nvrtc.FLAGS), target(), jax.__version__))
    name = _NAME + hashlib.sha256(key.encode()).hexdigest()[:32]

    def compilation() -> None:
        with _locks[name]:
            if name in libraries:
                return
            if on_gpu:
                body = _kernels(name, texts, functions, WARP // threads)
            else:
                body = _library(texts[0].replace(HANDLER, name), name)
            cache.write(_cache_path(name), body)
            _register(name, body)

    return _Library(name, None if load(name) else _COMPILATIONS.submit(compilation))


def _texts(functions: Sequence[_Function]) -> tuple[int, list[str]]:
    """Return the number of threads of a world, and the kernels.

    Raises:
      TooLargeError: a kernel needs too much shared memory.
    """
    fewest, largest = _THREADS
    if Rows.from_jaxpr(functions[0].trace.jaxpr).length > 1:
        fewest *= 2  # gradients are of too few worlds to fill a GPU
    with contextlib.suppress(TooLargeError):
        return fewest, _printed(functions, GpuWriter, fewest)
    return largest, _printed(functions, GpuWriter, largest)


def _printed(
    functions: Sequence[_Function], printer: Callable[..., SimdWriter], *options: int
) -> list[str]:
    """Return the texts of functions."""
    with jax.ensure_compile_time_eval():
        return [x.trace.text(x.is_sorted, printer, *options) for x in functions]


def _library(text: str, name: str) -> bytes:
    """Compile C to a shared library.

    Raises:
      CompilerError: the compiler fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / f"{name}.c", Path(folder) / f"{name}.so"
        source.write_text(text)
        command = [str(device.find_compiler()), *_FLAGS, "-shared", "-fPIC"]
        command += [f"-I{jax.ffi.include_dir()}", str(source), "-o", str(library), "-lm", "-ldl"]
        process = subprocess.run(command, capture_output=True, text=True)
        if process.returncode:
            raise CompilerError(command[0], [*process.stderr.splitlines(), "no message"][0])
        return library.read_bytes()


def _kernels(name: str, texts: Sequence[str], functions: Sequence[_Function], worlds: int) -> bytes:
    """Compile kernels with so many `worlds` in a warp, and the library that launches them.

    Raises:
      CompilerError: the compiler fails.
    """
    shapes = [
        (
            len(x.trace.inputs) + x.is_sorted,
            len(x.shapes),
            *first_array(x.trace.inputs),
            4 * worlds * shared_size(text),
        )
        for x, text in zip(functions, texts, strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.cubin" for k in range(len(texts))]
        for path, image in zip(paths, nvrtc.images(texts), strict=True):
            path.write_bytes(image)
        return _library(nvrtc.launcher(name, paths, shapes, worlds), name)


def called_names(program: bytes) -> list[str]:
    """Return the names of the functions that a program calls."""
    return sorted({x.decode() for x in re.findall(rf"{_NAME}[0-9a-f]{{32}}".encode(), program)})


def load(name: str) -> bool:
    """Load a function from the cache and register it with XLA; return whether it is there."""
    with _locks[name]:
        if name not in libraries and (path := _cache_path(name)):
            cache.read(path, "compiled", functools.partial(_register, name))
        return name in libraries


def _cache_path(name: str) -> Path | None:
    """Return the path of a compiled function; None without a cache."""
    folder = jax.config.jax_compilation_cache_dir
    return Path(folder) / "native" / name if folder else None


def _register(name: str, body: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.so"
        path.write_bytes(body)
        library = ctypes.CDLL(str(path))
    function = jax.ffi.pycapsule(getattr(library, name))
    jax.ffi.register_ffi_target(name, function, platform=_PLATFORMS[jax.default_backend()])
    libraries[name] = library


# --- linear maps ---------------------------------------------------------------------------------

# Of residuals (on which the map depends) and of vectors: tuples of arrays.
Map: TypeAlias = Callable[[Sequence[Pytree], Sequence[Pytree]], Sequence[Array]]
Maps: TypeAlias = tuple[Map, Map | None]


def linear_map(
    forward: Map,
    transpose: Map | None,
    residuals: Sequence[Pytree],
    vectors: Sequence[Pytree],
    like: Pytree,
    label: str = "",
) -> list[Array]:
    """Return `forward(residuals, vectors)`, linear in the vectors, with a given transpose.

    Args:
      forward: the map.
      transpose: from residuals and vectors of the results to vectors of the arguments; None of a
        map without vectors, a function of the residuals.
      residuals: arrays that are not differentiated.
      vectors: arrays.
      like: results have the shapes and types of these arrays.
      label: name of the map in a jaxpr.
    """
    outs = tuple(jax.core.ShapedArray(x.shape, x.dtype) for x in like)
    static = {"maps": (forward, transpose), "count": len(residuals), "outs": outs}
    return _primitive.bind(*residuals, *vectors, **static, label=label)


def varied_indices(tangents: Sequence[object]) -> list[int]:
    """Return the indices of the tangents that are not zero, in a rule with `symbolic_zeros`."""
    return [i for i, x in enumerate(tangents) if not isinstance(x, SymbolicZero)]


def restrict(
    function: Callable[[list[Pytree]], Pytree], values: Sequence[Pytree], indices: Sequence[int]
) -> tuple[Callable[[list[Pytree]], Pytree], list[Pytree]]:
    """Return a function of some entries of its list, the others constant, and these entries."""

    def restricted(entries: list[Pytree]) -> Pytree:
        replaced = dict(zip(indices, entries, strict=True))
        return function([replaced.get(i, x) for i, x in enumerate(values)])

    return restricted, [values[i] for i in indices]


def once_differentiable(x: object) -> object:
    """Return a leaf of a pytree by which JAX refuses second derivatives."""
    is_real = isinstance(x, jax.core.Tracer) and jnp.issubdtype(x.dtype, jnp.inexact)
    return _once.bind(x, derived=False) if is_real else x


_primitive = Primitive("linear_map")
_primitive.multiple_results = True


@_primitive.def_impl
def _run(*arrays: Pytree, maps: Maps, count: int, **_: object) -> list[Array]:
    return list(maps[0](arrays[:count], arrays[count:]))


_primitive.def_abstract_eval(lambda *_, outs, **__: outs)


def _transpose(
    cotangents: Pytree, *arrays: Pytree, maps: Maps, count: int, outs: Pytree, label: str
) -> Pytree:
    vectors = [
        jnp.zeros(out.shape, out.dtype) if isinstance(x, ad.Zero) else x
        for x, out in zip(cotangents, outs, strict=True)
    ]
    like = [x.aval for x in arrays[count:]]
    forward, transpose = maps
    assert transpose is not None  # a map without vectors is not transposed
    moved = linear_map(transpose, forward, arrays[:count], vectors, like, label)
    return [None] * count + moved


def _batch(
    arrays: Pytree, axes: Pytree, *, maps: Maps, count: int, outs: Pytree, label: str
) -> Pytree:
    size = next(x.shape[i] for x, i in zip(arrays, axes, strict=True) if i is not None)
    whole = [
        jnp.broadcast_to(x, (size, *x.shape)) if i is None else jnp.moveaxis(x, i, 0)
        for x, i in zip(arrays, axes, strict=True)
    ]
    like = [jax.ShapeDtypeStruct((size, *out.shape), out.dtype) for out in outs]
    forward, transpose = jax.vmap(maps[0]), maps[1] and jax.vmap(maps[1])
    results = linear_map(forward, transpose, whole[:count], whole[count:], like, label)
    return results, [0] * len(outs)


def _refuse(*_: object, **__: Pytree) -> Pytree:
    raise NotImplementedError(
        "trials have no second derivatives: differentiate once, or take differences of gradients."
    )


ad.primitive_jvps[_primitive] = _refuse
ad.primitive_transposes[_primitive] = _transpose
batching.primitive_batchers[_primitive] = _batch
mlir.register_lowering(_primitive, mlir.lower_fun(_run, multiple_results=True))


def _jvp_once(primals: Pytree, tangents: Pytree, derived: bool) -> tuple[Array, Pytree]:
    return _refuse() if derived else (_once.bind(*primals, derived=True), *tangents)


_once = Primitive("once_differentiable")
_once.def_impl(lambda x, **_: x)
_once.def_abstract_eval(lambda x, **_: x)
ad.primitive_jvps[_once] = _jvp_once
batching.defvectorized(_once)
mlir.register_lowering(_once, lambda _, x, **__: [x])
