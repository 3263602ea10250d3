"""Laws outside of JAX: C99, JavaScript and ONNX, all written from the jaxpr of law and skin."""
