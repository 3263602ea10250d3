"""Each back end gives JAX's result of each operation, for NaN, infinities and integer bounds."""

import ctypes
import functools
import inspect
import itertools
import json
import re
import runpy
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ROOT, output_of, slow
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive
from test_gpu_writer import Emulated

from rps_jax.engines import device, native
from rps_jax.lowering import c, graph, js, operations, walk
from rps_jax.lowering.builder import SimdBuilder
from rps_jax.lowering.compounds import COMPOUNDS
from rps_jax.lowering.gpu import GpuWriter
from rps_jax.lowering.graph import UnsupportedError
from rps_jax.lowering.onnx import Graph, Tensor
from rps_jax.lowering.routine import routine
from rps_jax.lowering.writer import SimdWriter

MAKE = runpy.run_path(str(ROOT / "docs" / "push" / "make.py"))  # with the printer of a page
REALS = [0.0, -0.0, 0.5, -1.5, 2.5, 7.0, 1e30, -1e30, np.inf, -np.inf, np.nan]
BOUNDS = [2147483520.0, -2147483520.0, 2147483648.0, -2147483648.0, -2147483904.0, 3e9]
DOUBLES = [2147483647.0, -2147483647.0, 2147483647.5, -2147483648.5]
INTEGERS = [0, 1, -1, 2, -3, 7, 2**31 - 1, -(2**31)]
MATRIX = np.arange(6.0).reshape(3, 2)
CASES = {  # besides those of `generated`
    "where": lambda x, i: (jnp.where(x > 1, x, i.astype(x.dtype)), jnp.where(x > 1, i > 0, x < 0)),
    "a choice of three": lambda x, i: lax.select_n(i % 3, x, -x, 2 * x),
    "a switch": lambda x, i: lax.switch(i[0], [lambda: x, lambda: -x, lambda: 2 * x]),
    "sums and a product": lambda x, i: (x[:2].sum(), jnp.stack([x, x]).sum(0), x.prod()),
    "a sum of many": lambda x, i: (x[0] * jnp.arange(1.0, 8, dtype=x.dtype)).sum(),
    # XLA itself drops some NaN in a reduction of a tile.
    "a maximum of many": lambda x, i: jnp.tile(jnp.where(x == x, x, 0), 4).max(),
    "all and any": lambda x, i: ((x > 0).all(), (x > 0).any(), (jnp.tile(x, 3) > 0).any()),
    "argmax": lambda x, i: jnp.argmax(jnp.stack([x, jnp.roll(x, 1), x[::-1]]), axis=0),
    "argmin": lambda x, i: jnp.argmin(jnp.stack([x, jnp.roll(x, 1), x[::-1]]), axis=0),
    "cumulative": lambda x, i: (jnp.cumsum(i), lax.cummax(x, reverse=True), lax.cummin(x)),
    "an index": lambda x, i: jnp.stack([x, -x])[jnp.clip(i[0], 0, 1), i[1] % 3],
    "an index out of bounds": lambda x, i: (x.at[i].get(), x.at[i].get(mode="clip")),
    "a slice": lambda x, i: lax.dynamic_slice(jnp.stack([x, 2 * x, -x]), (i[0], i[1]), (2, 2)),
    "a table of bools": lambda x, i: jnp.tile(x > 0, 2) ^ jnp.array([True, False] * 3),
    "a table": lambda x, i: jnp.array([1.0, 5.0, -2.0, 7.5], x.dtype)[i % 4],
    "sorts": lambda x, i: (jnp.sort(x), jnp.argsort(x, descending=True), jnp.lexsort((x, i % 2))),
    "a sort of rows": lambda x, i: jnp.sort(jnp.stack([x, -x, x * 0, x[::-1], -x[::-1]]), axis=0),
    "a sort of many": lambda x, i: lax.sort((jnp.tile(i, 5), jnp.arange(15)), is_stable=True),
    "a sort by two keys": lambda x, i: lax.sort((jnp.tile(i % 2, 2), jnp.tile(x, 2)), num_keys=2),
    "medians": lambda x, i: (jnp.median(x), jnp.nanmedian(x), jnp.median(jnp.tile(i % 9, 2)[1:])),
    "the largest": lambda x, i: lax.top_k(jnp.concatenate([x, x[1:]]), 4),
    "chosen numbers": lambda x, i: jnp.select([x > 1, i > 0], [x, 2 * x]),
    "rows by index": lambda x, i: jnp.take_along_axis(jnp.stack([x, x[::-1]]), i[None] % 3, 1),
    "an index beyond": lambda x, i: (
        x.at[jnp.array([1, 7])].get(mode="fill", fill_value=5),
        x.at[i].get(mode="fill", fill_value=-1),
    ),
    "changes": lambda x, i: (x.at[i].set(7), x.at[i % 3].add(i), x.at[i[0] % 3].mul(2)),
    "an array and one of its elements": lambda x, i: (
        y := 0.5 * jnp.tile(x, 3) + 1,
        y + y[4],
        2 * x - (2 * x)[0],
        jnp.tile(i + 1, 3) * (i + 1)[2],
    ),
    "one of the carried numbers": lambda x, i: lax.fori_loop(
        0, 3, lambda _, y: (jnp.broadcast_to(y[0][1], (3,)), y[1] + i[0]), (x, i + 1)
    ),
    "a loop of no iterations": lambda x, i: lax.fori_loop(0, 0, lambda _, y: y + i[0], x),
    "small reals": lambda x, i: x.astype(jnp.float16).astype(x.dtype),
    "small integers": lambda x, i: i.astype(jnp.int8).astype(jnp.int32),
    "further changes": lambda x, i: (
        x.at[i % 3].subtract(i),
        x.at[i[1] % 3].max(1),
        i.at[i].max(2),
    ),
    "further moves": lambda x, i: (
        jnp.stack([x, -x]).T,
        jnp.split(x, [1]),
        jnp.copy(x),
        lax.optimization_barrier(x),
        lax.dynamic_update_slice(jnp.stack([x, -x]), x[None, :2], (i[0], i[1])),
    ),
    "changed rows": lambda x, i: jnp.stack([x, -x]).at[i % 2, i[::-1] % 3].min(i),
    "searches": lambda x, i: (
        jnp.searchsorted(jnp.sort(i), i[0]),
        jnp.searchsorted(jnp.sort(x), x, side="right"),
    ),
    "interpolation": lambda x, i: jnp.interp(i[0] % 7 / 2, jnp.array([0.0, 1, 2.5]), i % 5.0),
    "moves": lambda x, i: jnp.concatenate([x[::-1], jnp.pad(x, 1), x.at[1].set(3)]),
    "an update": lambda x, i: x.at[1:].add(jnp.ones(2, x.dtype)),
    "a loop": lambda x, i: lax.fori_loop(0, 5, lambda k, y: 0.5 * y + k * x, x),
    "a swap in a loop": lambda x, i: lax.fori_loop(0, 3, lambda _, y: (y[1], y[0]), (x, -x)),
    "a loop with a condition": lambda x, i: lax.while_loop(
        lambda s: s[0] < jnp.clip(i[0], 0, 5), lambda s: (s[0] + 1, 0.5 * s[1] + x), (0, x)
    ),
    "many moves": lambda x, i: 2 * jnp.tile(-x, 6)[2:],
    "a scan": lambda x, i: lax.scan(lambda s, y: (0.5 * s + y, s), x[0], x)[1],
    "a matrix": lambda x, i: jnp.where(jnp.abs(x) < 9, x, 1) @ MATRIX.astype(x.dtype),
    "nothing": lambda x, i: (x[:0], x[:0].sum(), jnp.concatenate([x[:0], x]), i[:0] + 1),
}
DTYPES = {"b": np.bool_, "i": np.int32, "u": np.uint32, "f": np.float32}
SHAPES = [[(3,)] * 3, [(), (3,), (3,)]]  # vectors, a scalar and vectors
# XLA's older emitters cannot clamp bools, and its newer ones order vectors of them wrongly.
WITHOUT_REFERENCE = {"lax.clamp of b b b"}
NOT_OF_NUMBERS = {"shape_as_value", "broadcast_like", "full_like", "stage", "optimization_barrier"}
# Static parameters of functions of `lax` that have no defaults.
STATIC = {
    **{f"reduce_{name}": [{"axes": (0,)}] for name in ("max", "min", "sum", "prod")},
    **{f"reduce_{name}": [{"axes": (0,)}] for name in ("and", "or", "xor")},
    "argmax": [{"axis": 0, "index_dtype": np.int32}],
    "argmin": [{"axis": 0, "index_dtype": np.int32}],
    "convert_element_type": (TYPES := [{"new_dtype": dtype} for dtype in DTYPES.values()]),
    "bitcast_convert_type": TYPES,
    **{"top_k": [{"k": 2}], "integer_pow": [{"y": y} for y in (-2, 0, 3)]},
    **{"round": [{"rounding_method": method} for method in lax.RoundingMethod]},
    **{"reduce_precision": [{"exponent_bits": 8, "mantissa_bits": 23}], "sort": [{}]},
}


def operand(kind, shape, position, x, i):
    """Return an operand of a kind: the numbers of a row, from a position on."""
    source = i if kind in "iu" else x
    source = source.astype(np.uint32) if kind == "u" else source > 0 if kind == "b" else source
    return source[position] if shape == () else jnp.roll(source, -position)


def result_types(function, kinds, shapes):
    """Return the types of a function's results; none if JAX refuses operands of these types."""
    operands = zip(shapes, kinds, strict=False)
    types = [jax.ShapeDtypeStruct(shape, DTYPES[kind]) for shape, kind in operands]
    try:
        return {x.dtype for x in jax.tree.leaves(jax.eval_shape(function, *types))}
    except Exception:  # of many classes
        return set()


def count_operands(function, static):
    """Return the number of arrays that a function needs, if it needs nothing else."""
    parameters = inspect.signature(function).parameters.values()
    needed = [p for p in parameters if p.default is p.empty and p.name not in static]
    count = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in needed)
    return count + 2 * any(p.kind is p.VAR_POSITIONAL for p in needed)


def apply_all(function, kinds, shapes, x, i):
    """Apply a function to operands of each of some shapes."""
    return [
        function(*(operand(kind, shape, k, x, i) for k, (kind, shape) in enumerate(operands)))
        for operands in (zip(kinds, form, strict=False) for form in shapes)
    ]


@functools.cache
def generated():
    """Return a case of each function of `lax` and each combination of types that JAX accepts."""
    functions = {name: f for name, f in vars(lax).items() if inspect.isfunction(f)}
    functions |= {f"{x}_to": getattr(lax, f"{x}_to_p").bind for x in ("lt", "le")}
    cases, known = {}, set(map(np.dtype, DTYPES.values()))
    filtering = jax.config.jax_traceback_filtering
    jax.config.update("jax_traceback_filtering", "off")  # it takes most of the time
    for name, function in functions.items():
        for static in STATIC.get(name, [{}]):
            count = count_operands(function, static)
            if name in NOT_OF_NUMBERS or not 1 <= count <= 3:
                continue
            applied = functools.partial(function, **static)
            words = [str(getattr(value, "__name__", value)) for value in static.values()]
            combinations = itertools.product(DTYPES, repeat=count)
            of_vectors = {x: result_types(applied, x, SHAPES[0]) for x in combinations}
            for kinds, types in of_vectors.items():
                if not types <= known or (not types and any(of_vectors.values())):
                    continue
                accepted = types, result_types(applied, kinds, SHAPES[1])
                shapes = list(itertools.compress(SHAPES, accepted))
                title = " ".join([f"lax.{name}", *words, "of", *kinds])
                if shapes and title not in WITHOUT_REFERENCE:
                    case = functools.partial(apply_all, applied, kinds, shapes)
                    cases[title] = case
    jax.config.update("jax_traceback_filtering", filtering)
    return cases


# Cases that a back end refuses, with a sentence that names the operation.
SPECIAL = {"nextafter", "bessel_i0e", "bessel_i1e", "betainc", "digamma", "igamma", "igammac"}
SPECIAL |= {
    "polynomial",  # of versions of JAX from 0.12 on
    "population_count",
    "clz",
    "igamma_grad_a",
    "lgamma",
    "polygamma",
    "random_gamma_grad",
    "zeta",
    "cumlogsumexp",
}
BITS_OF_REALS = {
    f"bitcast_convert_type {kinds}" for kinds in ("int32 of f", "float32 of i", "float32 of f")
}
SMALL = {"small reals", "small integers"}
UNSIGNED = {"searches", "interpolation"}
ENDLESS = UNSIGNED | SMALL | {"a loop with a condition"}
REFUSED = {
    **dict.fromkeys(("simd", "gpu"), SMALL),
    **dict.fromkeys(("c float", "c double"), BITS_OF_REALS | {"erf_inv"} | ENDLESS),
    "js": BITS_OF_REALS | UNSIGNED | SMALL | {"erf_inv", "erf", "erfc"},
    "onnx": BITS_OF_REALS | {"erf_inv", "erfc", "log1p", "expm1", "cbrt"} | ENDLESS,
}
PRECISION = {f"lax.convert_element_type float32 of {kind}" for kind in "if"}
PRECISION |= {"lax.reduce_precision 8 23 of f"}
# Cases in which a back end differs from JAX.
DIFFERENT = {
    "gpu": {"lax.reduce_sum (0,) of f"},  # threads add in another order
    **dict.fromkeys(("c double", "js"), PRECISION),  # that of the printed code
    # It has no sign of zero.
    "onnx": {"lax.atan2 of f f", "the largest", "lax.top_k 2 of f"},
}
COMPILER = device.find_compiler()
QUICKLY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def inputs(real):
    """Return reals (N, 3) and integers (N, 3): all pairs, and a third number of each."""
    reals = np.array(REALS + BOUNDS + (DOUBLES if real == np.float64 else []), real)
    a, b = (x.ravel() for x in np.meshgrid(reals, reals))
    x = np.stack([a, b, np.roll(a, 1)], -1)
    integers = np.array(INTEGERS, np.int32)
    i, j = (np.resize(y.ravel(), len(x)) for y in np.meshgrid(integers, integers))
    return x, np.stack([i, j, np.roll(i, 3)], -1)


@functools.cache
def expected(real):
    """Return JAX's results of each case that some back end supports."""
    of_real = [back_end for back_end, (kind, *_) in BACK_ENDS.items() if kind == real]
    names = [x for x in [*CASES, *generated()] if not all(is_refused(k, x) for k in of_real)]
    run = jax.jit(jax.vmap(lambda *row: [results_of(name, *row) for name in names]))
    with jax.enable_x64(real == np.float64):
        compiled = run.lower(*inputs(real)).compile(QUICKLY)
        return dict(zip(names, jax.device_get(compiled(*inputs(real))), strict=True))


def results_of(name, x, i):
    """Return the results of a case."""
    return jax.tree.leaves((CASES.get(name) or generated()[name])(x, i))


def all_results(names, x, i):
    """Return the results of cases as one list."""
    return [leaf for name in names for leaf in results_of(name, x, i)]


def traced(names):
    """Return cases as a routine of `x` and `i`."""
    kinds = {"x": np.float64, "i": np.int32}
    shapes = {name: {name: jax.ShapeDtypeStruct((3,), kind)} for name, kind in kinds.items()}
    run = lambda x, i: (all_results(names, x["x"], i["i"]),)  # noqa: E731
    return routine("run", run, shapes, ["out"])


def jaxpr(names):
    """Return cases as a jaxpr in float32, with the types of the arguments and results."""
    shapes = [jax.ShapeDtypeStruct((3,), kind) for kind in (np.float32, np.int32)]
    run = functools.partial(all_results, names)
    closed, out = jax.make_jaxpr(run, return_shape=True)(*shapes)
    return closed, shapes, jax.tree.leaves(out)


def c_statements(names, tables):
    run = traced(names)
    groups = {"x": "reals->", "i": "integers->"}
    return run, c.statements(run, groups, {"out": "out->"}, tables, "law")


def run_c(names, real, folder):
    """Return the results of scalar C."""
    tables, kind = {}, "double" if real == np.float64 else "float"
    run, body = c_statements(names, tables)
    groups = {**run.inputs, **run.outputs}
    structs = "\n".join(c.struct("law", name, group) for name, group in groups.items())
    text = f"""
#include <math.h>
typedef {kind} law_real;
#define LAW_F(name) name{"##f" * (kind == "float")}
{c.HELPERS.format(p="law", P="LAW")}{structs}{chr(10).join(tables.values())}
void run(int n, const law_x *reals, const law_i *integers, law_out *out);
void run(int n, const law_x *reals, const law_i *integers, law_out *out) {{
  for (int k = 0; k < n; k++, reals++, integers++, out++) {{
{body}
  }}
}}
"""
    source, library = folder / "run.c", folder / "run.so"
    source.write_text(text)
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    output_of(COMPILER, *flags, source, "-lm", "-o", library)
    x, i = inputs(real)
    kinds = {"f": real, "i": np.int32, "b": np.int32}
    fields = [
        (field.name, kinds[field.kind], field.shape) for field in run.outputs["out"] if field.size
    ]
    out = np.zeros(len(x), np.dtype(fields, align=True))
    pointers = [np.ascontiguousarray(v).ctypes.data_as(ctypes.c_void_p) for v in (x, i, out)]
    ctypes.CDLL(str(library)).run(len(x), *pointers)
    return [
        out[field.name] if field.size else np.zeros((len(x), *field.shape))
        for field in run.outputs["out"]
    ]


def run_js(names, real, folder):
    """Return the results of JavaScript."""
    tables = {}
    text = MAKE["function"]("run", traced(names), tables)
    x, i = inputs(real)
    main = (
        f"const rows = {json.dumps(list(zip(x.tolist(), i.tolist(), strict=True)))};\n"
        "const out = rows.map(([x, i]) => Object.values(run({ x }, { i }).out));\n"
        "const text = (_, v) => typeof v === 'number' && !Number.isFinite(v) ? `<${v}>` : v;\n"
        'console.log(JSON.stringify(out, text).replace(/"<|>"/g, ""));'
    )
    (folder / "run.cjs").write_text("\n".join([js.HELPERS, *tables.values(), text, main]))
    rows = json.loads(output_of("node", folder / "run.cjs"))
    return [np.array(column, float) for column in zip(*rows, strict=True)]


def onnx_graph(names):
    target, run = Graph(), traced(names)
    arguments = [Tensor("x", (3,), "f"), Tensor("i", (3,), "i")]
    return target, arguments, run, walk.walk(run.jaxpr, arguments, target)


def run_onnx(names, real, folder):
    """Return the results of ONNX."""
    runtime = pytest.importorskip("onnxruntime")
    target, arguments, run, values = onnx_graph(names)
    fields = run.outputs["out"]
    pairs = [
        (Tensor(field.name, field.shape, field.kind), value)
        for field, value in zip(fields, values, strict=True)
        if field.size
    ]
    model = target.model("run", arguments, pairs).SerializeToString()
    session = runtime.InferenceSession(model, providers=["CPUExecutionProvider"])
    rows = [session.run(None, {"x": a, "i": b}) for a, b in zip(*inputs(real), strict=True)]
    columns = iter(np.stack(column) for column in zip(*rows, strict=True))
    count = len(rows)
    return [next(columns) if field.size else np.zeros((count, *field.shape)) for field in fields]


def run_simd(names, real, folder):
    """Return the results of SIMD C."""
    run = native.batched(
        functools.partial(all_results, names), lambda *_: pytest.fail("it was not compiled")
    )
    return jax.device_get(jax.jit(run)(*inputs(real)))


def run_gpu(names, real, folder):
    """Return the results of CUDA on an emulated warp."""
    x, i = inputs(real)
    run = Emulated(functools.partial(all_results, names), (x[0], i[0]), folder, 4)
    return run(x, i)


# Name of each back end, precision, function that raises for a case, and function that runs cases.
BACK_ENDS = {
    "simd": (np.float32, lambda names: SimdWriter().source(*jaxpr(names)), run_simd),
    "gpu": (np.float32, lambda names: GpuWriter(4).source(*jaxpr(names)), run_gpu),
    "c float": (np.float32, lambda names: c_statements(names, {}), run_c),
    "c double": (np.float64, lambda names: c_statements(names, {}), run_c),
    "js": (np.float64, lambda names: MAKE["function"]("run", traced(names), {}), run_js),
    "onnx": (np.float32, onnx_graph, run_onnx),
}
NEEDS = {"gpu": "g++", "js": "node", "simd": str(COMPILER)}


def is_refused(name, case):
    """Whether a back end refuses a case; only vectors and CUDA have unsigned integers."""
    refused = REFUSED.get(name, set())
    if not case.startswith("lax."):
        return case in refused
    function, _, kinds = case[4:].partition(" of ")
    operands = set(kinds.split())
    if name not in ("simd", "gpu") and ("u" in operands or "uint32" in function):
        return True
    if function == "dot":  # of bools or of different types
        return operands not in ({"i"}, {"u"}, {"f"})
    return function in SPECIAL or not refused.isdisjoint({function, case[4:]})


COMPILED_AS_USERS_DO = pytest.param("simd", marks=pytest.mark.parity)
# With -O2 products are fused with sums, and do not overflow.
FUSED = {"lax.dot of f f"}


@pytest.mark.parametrize(
    "name", [COMPILED_AS_USERS_DO, "gpu", slow("c float"), "c double", "js", "onnx"]
)
def test_operations_are_those_of_jax(name, tmp_path_factory):
    if shutil.which(NEEDS.get(name, str(COMPILER))) is None:
        pytest.skip("the compiler of this back end is not installed")
    if name == "onnx":
        pytest.importorskip("onnx")
    real, lower, run = BACK_ENDS[name]
    supported, wrong = [], {}
    for case in [*CASES, *generated()]:
        if is_refused(name, case):
            with pytest.raises(UnsupportedError):
                lower([case])
        else:
            supported.append(case)
    # A compiler takes longer for one long function.
    parts = [supported[first : first + 60] for first in range(0, len(supported), 60)]
    folder = tmp_path_factory.mktemp
    computed = iter([x for part in parts for x in run(part, real, folder("part"))])
    for case in supported:
        for leaf in expected(real)[case]:
            value = np.asarray(next(computed), float).reshape(leaf.shape)
            rtol = 0 if leaf.dtype.kind != "f" else 1e-12 if real == np.float64 else 4e-6
            limits = {"rtol": rtol, "atol": 1e-30 if rtol else 0, "equal_nan": True}
            equal = np.isclose(value, leaf.astype(float), **limits)
            if not equal.all():
                at = tuple(np.argwhere(~equal)[0])
                x, i = inputs(real)
                wrong[case] = (x[at[0]].tolist(), i[at[0]].tolist(), value[at], leaf[at])
    assert set(wrong) - FUSED == DIFFERENT.get(name, set()), wrong


def test_the_languages_have_the_operations_of_the_headers():
    """Excluded are operations on unsigned integers, bits and random numbers; no law needs them."""
    excluded = re.compile(
        r"bits_|all_|threefry|shift_|u_of|lt_to|in_total|.*(_u|_of_u)$|(erf_inv_f|truncate_f|quotient_i|any)$"
    )
    names = {name for name in SimdBuilder.operations if not excluded.match(name)}
    assert names <= set(operations.spelled("c"))
    assert names - {"erf_f", "erfc_f"} <= {*operations.spelled("js"), "exp2_f", "round_f"}


def primitive_names(jaxpr):
    """Return the names of all primitives of a jaxpr and of those that it contains."""
    names = {eqn.primitive.name for eqn in jaxpr.eqns}
    params = jax.tree.leaves([list(eqn.params.values()) for eqn in jaxpr.eqns])
    inner = [getattr(x, "jaxpr", x) for x in params if isinstance(x, ClosedJaxpr | Jaxpr)]
    return names.union(*map(primitive_names, inner))


def test_each_primitive_of_jax_that_the_compiler_knows_has_a_case():
    known = {*COMPOUNDS, *walk._MOVES, *walk._IDENTITIES, *graph.REDUCTIONS}
    known |= {operation.rpartition("_")[0] for operation in {*SimdBuilder.operations, *COMPOUNDS}}
    primitives = {x.name for x in vars(lax).values() if isinstance(x, Primitive)}
    closed, *_ = jaxpr([*CASES, *generated()])
    assert known & primitives <= primitive_names(closed.jaxpr)
