"""Compiler from jaxprs to SIMD C, scalar C, CUDA, JavaScript and ONNX.

`walk` reads a jaxpr and calls a target for each primitive. `operations` is the table of operations
in all languages; `compounds` expresses by them what a language does not spell. `nodes` are the
targets that build a graph of arrays. `writer` and `gpu_writer` print this graph as C and CUDA;
`nvrtc` compiles CUDA.
"""
