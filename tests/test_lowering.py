"""Each back end gives the results of JAX for each operation: NaN, infinities, integer bounds."""

import ctypes
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rps_jax.engines import device
from rps_jax.lowering import c
from rps_jax.lowering.routine import routine

REALS = [0.0, -0.0, 0.5, -1.5, 2.5, 7.0, 1e30, -1e30, np.inf, -np.inf, np.nan]
BOUNDS = [2147483520.0, -2147483520.0, 2147483648.0, -2147483648.0, -2147483904.0, 3e9]
DOUBLES = [2147483647.0, -2147483647.0, 2147483647.5, -2147483648.5]
CASES = {
    "int32 of a real": lambda x, i: x.astype(jnp.int32),
    "argmax": lambda x, i: jnp.argmax(jnp.stack([x, jnp.roll(x, 1), x[::-1]]), axis=0),
    "argmin": lambda x, i: jnp.argmin(jnp.stack([x, jnp.roll(x, 1), x[::-1]]), axis=0),
}
COMPILER = device.find_compiler()


def inputs(real):
    """Reals (N, 3) and integers (N, 3): all pairs, and a third number of each."""
    reals = np.array(REALS + BOUNDS + (DOUBLES if real == np.float64 else []), real)
    a, b = (x.ravel() for x in np.meshgrid(reals, reals))
    x = np.stack([a, b, np.roll(a, 1)], -1)
    whole = np.array([0, 1, -1, 2, -3, 7, 2**31 - 1, -(2**31)], np.int32)
    i, j = (np.resize(y.ravel(), len(x)) for y in np.meshgrid(whole, whole))
    return x, np.stack([i, j, i], -1)


def results(x, i):
    return {f"case_{n}": case(x, i) for n, case in enumerate(CASES.values())}


def run_c(x, i, folder):
    """Return the results of the exported C."""
    shapes = {name: {name: jax.ShapeDtypeStruct(v.shape[1:], v.dtype)} for name, v in
              (("x", x.astype(np.float64)), ("i", i))}  # fmt: skip
    traced = routine("run", lambda x, i: (results(x["x"], i["i"]),), shapes, ["out"])
    tables = {}
    body = c.statements(traced, {"x": "x->", "i": "i->"}, {"out": "out->"}, tables, "law")
    groups = {**traced.inputs, **traced.outputs}
    structs = "\n".join(c.struct("law", name, group) for name, group in groups.items())
    real = "double" if x.dtype == np.float64 else "float"
    text = f"""
#include <math.h>
typedef {real} law_real;
#define LAW_F(name) name{"f" * (real == "float")}
{c.HELPERS.format(p="law", P="LAW")}{structs}{chr(10).join(tables.values())}
void run(int n, const law_x *x, const law_i *i, law_out *out) {{
  for (int k = 0; k < n; k++, x++, i++, out++) {{
{body}
  }}
}}
"""
    source, library = folder / "run.c", folder / "run.so"
    source.write_text(text)
    flags = ["-std=c99", "-O2", "-w", "-shared", "-fPIC"]
    subprocess.run([COMPILER, *flags, str(source), "-lm", "-o", str(library)], check=True)
    kinds = {"f": x.dtype, "i": np.int32, "b": np.int32}
    fields = [(one.name, kinds[one.kind], one.shape) for one in traced.outputs["out"]]
    out = np.zeros(len(x), np.dtype(fields, align=True))
    pointers = [v.ctypes.data_as(ctypes.c_void_p) for v in (np.ascontiguousarray(x), i, out)]
    ctypes.CDLL(str(library)).run(len(x), *pointers)
    return {name: out[name] for name, *_ in fields}


@pytest.mark.skipif(shutil.which(str(COMPILER)) is None, reason="there is no C compiler")
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_exported_c_is_what_jax_says(real, tmp_path):
    x, i = inputs(real)
    with jax.enable_x64(real == np.float64):
        expected = jax.device_get(jax.jit(jax.vmap(results))(x, i))
    computed = run_c(x, i, tmp_path)
    for name, key in zip(CASES, expected, strict=True):
        np.testing.assert_allclose(computed[key], expected[key], rtol=3e-6, err_msg=name)
