"""The exported ONNX model of a law's step, whose memory is an input and an output."""

from __future__ import annotations

import json

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from rps_jax import __version__
from rps_jax.app.export.program import Program
from rps_jax.lowering import walk
from rps_jax.lowering.onnx import Graph, Tensor


def models(program: Program, prefix: str, batch: int | None = None) -> dict[str, str | bytes]:
    """Return the file of the model, by its name.

    Raises:
      InputError: ONNX is not installed, or it lacks an operation.
    """
    target, closed = Graph(), program.step.jaxpr
    groups, lead = program.groups, () if batch is None else (batch,)
    params = [np.asarray(field.value, float) for field in groups["params"]]
    if batch is not None:
        closed = _batched(closed, len(params), batch)

    def tensors(mark: str, group: str) -> list[Tensor]:
        return [Tensor(mark + x.name, (*lead, *x.shape), x.kind, x.about) for x in groups[group]]

    inputs = [*tensors("memory_", "memory"), *tensors("", "observation")]
    outputs = [*tensors("next_memory_", "memory"), *tensors("", "twist")]
    arguments = [np.zeros(x.shape) if 0 in x.shape else x for x in inputs]
    results = walk.walk(closed, [*params, *arguments], target)
    inputs = [x for x in inputs if 0 not in x.shape]
    pairs = [(x, value) for x, value in zip(outputs, results, strict=True) if 0 not in x.shape]
    model = target.model(
        prefix,
        inputs,
        pairs,
        producer_name="rps_jax",
        producer_version=__version__,
        doc_string=f"One control step of the law {program.label}; it checks no input.",
    )
    memory = [field for field in groups["memory"] if field.size]
    start = {f"memory_{x.name}": np.asarray(x.value).tolist() for x in memory}
    units = {x.name: x.about for x in (*inputs, *(x for x, _ in pairs))}
    values = {field.name: np.asarray(field.value).tolist() for field in groups["params"]}
    about = {"law": program.label, "robot": program.robot, "params": json.dumps(values)}
    about |= {} if program.axle is None else {"axle": program.about_axle("{}").strip()}
    about |= {"memory_at_the_start": json.dumps(start), "units": json.dumps(units)}
    target.onnx.helper.set_model_props(model, about)
    target.onnx.checker.check_model(model, full_check=True)
    return {f"{prefix}.onnx": model.SerializeToString()}


def _batched(closed: ClosedJaxpr, fixed: int, batch: int) -> ClosedJaxpr:
    """Return the step of a batch of worlds, whose first `fixed` arguments are shared."""
    axes = [None] * fixed + [0] * (len(closed.in_avals) - fixed)
    with jax.enable_x64(True):
        function = jax.vmap(jaxpr_as_fun(closed), in_axes=axes)
    pairs = zip([() if axis is None else (batch,) for axis in axes], closed.in_avals, strict=True)
    shapes = [jax.ShapeDtypeStruct((*lead, *x.shape), x.dtype) for lead, x in pairs]
    return walk.traced(function, *shapes)[0]
