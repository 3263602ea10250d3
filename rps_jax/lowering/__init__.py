"""Compiler from jaxprs to SIMD C, scalar C, CUDA, JavaScript and ONNX.

`walk` reads a jaxpr and calls a target for each primitive. `operations` is the table of operations
in all languages; `compounds` expresses by them the operations that a language does not spell. The
targets of `builder`, `scalar` and `gpu` build a `graph` of arrays, the intermediate code. `writer`
orders it and prints SIMD C, `gpu` CUDA, and `scalar` with `c` and `js` the other languages. `onnx`
is a target by itself; `nvrtc` compiles CUDA.
"""
