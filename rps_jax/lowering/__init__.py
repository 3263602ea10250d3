"""Compiler from jaxprs to SIMD C, scalar C, CUDA, JavaScript and ONNX.

`walk` reads a jaxpr and calls a target for each primitive. `nodes` are the targets that build a
graph of arrays. `writer` and `gpu_writer` print this graph as C and CUDA; `nvrtc` compiles CUDA.
"""
