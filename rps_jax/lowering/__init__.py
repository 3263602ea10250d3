"""Compiler from jaxprs to SIMD C, scalar C, CUDA, JavaScript and ONNX.

`walk` reads a jaxpr and calls a target for each primitive. `operations` is the table of operations
in all languages; `compounds` expresses by them the operations that a language does not spell. The
targets `builder`, `scalar_builder` and `gpu_builder` build a `graph` of arrays, the intermediate
code; `verifier` checks and prints it, and `passes` transform and order it. `simd_writer`,
`gpu_writer`, `c` and `js` print it. `onnx` is a target by itself; `nvrtc` compiles CUDA.
"""
