"""The emitter of ONNX: a law's step as a graph of float32, its memory an input and an output."""

from __future__ import annotations

import json
import string
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun

from rps_jax import __version__, errors
from rps_jax.app.export.program import Program
from rps_jax.lowering import walk
from rps_jax.lowering.walk import PAIRED, UnsupportedError, kind_of

_OPSET, _FORMAT = 18, 9  # of ONNX, and of its files
_TYPES = {"f": np.float32, "i": np.int32, "b": np.bool_}
_PLAIN = {
    **{name: name.capitalize() for name in ("add", "sub", "mul", "div", "max", "min", "neg")},
    **{name: name.capitalize() for name in ("abs", "sqrt", "exp", "log", "sin", "cos", "tan")},
    **{name: name.capitalize() for name in ("asin", "acos", "atan", "sinh", "cosh", "tanh")},
    **{name: name.capitalize() for name in ("asinh", "acosh", "atanh", "sign", "floor", "ceil")},
    **{name: name.capitalize() for name in ("erf", "pow", "and", "or", "xor", "not")},
    "logistic": "Sigmoid",
    "lt": "Less",
    "le": "LessOrEqual",
    "gt": "Greater",
    "ge": "GreaterOrEqual",
    "eq": "Equal",
}
_REDUCED = {"add": "ReduceSum", "mul": "ReduceProd", "max": "ReduceMax", "min": "ReduceMin"}


class Tensor(NamedTuple):
    """A value of the graph."""

    name: str
    shape: tuple[int, ...]
    kind: str
    about: str = ""


class Graph(walk.Target):
    """The target of tensors."""

    compiler = "the ONNX exporter"

    def __init__(self, onnx: Any) -> None:
        """Begin without nodes."""
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: dict[Any, Any] = {}

    def tensor(self, value: Any) -> Tensor:
        """A value as a tensor; a constant becomes one."""
        if isinstance(value, Tensor):
            return value
        array = np.asarray(value)
        kind = kind_of(array.dtype)
        return self.held(array.astype(_TYPES[kind]), kind)

    def held(self, array: np.ndarray, kind: str = "") -> Tensor:
        """A constant."""
        array = np.ascontiguousarray(array).reshape(array.shape)
        key = (array.tobytes(), array.shape, array.dtype.str)
        if key not in self.constants:
            name = f"constant_{len(self.constants)}"
            self.constants[key] = self.onnx.numpy_helper.from_array(array, name)
        return Tensor(self.constants[key].name, array.shape, kind)

    def node(
        self, op: str, inputs: Sequence[Tensor], shape: Sequence[int], kind: str, **attributes: Any
    ) -> Tensor:
        """The result of an operation."""
        out = Tensor(f"value_{len(self.nodes)}", tuple(shape), kind)
        names = [one.name for one in inputs]
        self.nodes.append(self.onnx.helper.make_node(op, names, [out.name], **attributes))
        return out

    def shaped(self, value: Any, shape: Sequence[int]) -> Tensor:
        """Give numbers another shape."""
        tensor = self.tensor(value)
        if tensor.shape == tuple(shape):
            return tensor
        wanted = self.held(np.array(shape, np.int64))
        return self.node("Reshape", [tensor, wanted], shape, tensor.kind)

    def moved(self, values: Sequence[Any], places: np.ndarray, like: Any) -> Tensor:
        """Numbers at other places: a reshape or an expansion where that is all."""
        flat = [self.shaped(one, (int(np.prod(one.shape, dtype=int)),)) for one in values]
        kind, size = kind_of(like.dtype), sum(one.shape[0] for one in flat)
        whole = flat[0] if len(flat) == 1 else self.node("Concat", flat, (size,), kind, axis=0)
        if size == 1 and places.size > 1:
            wanted = self.held(np.array(places.shape, np.int64))
            return self.node("Expand", [whole, wanted], places.shape, kind)
        if places.size != size or (places.reshape(-1) != np.arange(size)).any():
            at = self.held(places.reshape(-1).astype(np.int64))
            whole = self.node("Gather", [whole, at], (places.size,), kind, axis=0)
        return self.shaped(whole, places.shape)

    def emit(self, name: str, values: Sequence[Any], params: Mapping[str, Any], out: Any) -> Tensor:
        """Apply a primitive."""
        x, shape, kind = [self.tensor(value) for value in values], out.shape, kind_of(out.dtype)

        def make(op: str, *inputs: Tensor, to: str = kind, **attributes: Any) -> Tensor:
            return self.node(op, inputs, shape, to, **attributes)

        def number(value: float) -> Tensor:
            return self.held(np.asarray(value, _TYPES[x[0].kind]), x[0].kind)

        if name in _PLAIN:
            return make(_PLAIN[name], *x)
        if name == "ne":
            return make("Not", make("Equal", *x))
        if name == "select_n" and x[0].kind == "b":
            if kind != "b":
                return make("Where", x[0], x[2], x[1])
            yes, no = make("And", x[0], x[2]), make("And", make("Not", x[0]), x[1])
            return make("Or", yes, no)
        if name == "convert_element_type":
            return self._cast(x[0], kind)
        if name == "clamp":
            return make("Min", make("Max", x[1], x[0]), x[2])
        if name == "rem":
            return make("Mod", *x, fmod=1)
        if name == "rsqrt":
            return make("Reciprocal", make("Sqrt", x[0]))
        if name in ("integer_pow", "square"):
            found, y = x[0], params.get("y", 2)
            for _ in range(abs(y) - 1):
                found = make("Mul", found, x[0])
            return (
                make("Reciprocal", found) if y < 0 else found if y else make("Pow", x[0], number(0))
            )
        if name == "round" and int(params["rounding_method"]) == 1:
            return make("Round", x[0])
        if name == "is_finite":
            odd = make("Or", make("IsInf", x[0], to="b"), make("IsNaN", x[0], to="b"), to="b")
            return make("Not", odd)
        if name == "atan2":
            y, at = x
            zero, pi = number(0), number(np.pi)
            upright = make("Mul", make("Sign", y), number(np.pi / 2))
            behind = make("Where", make("Less", y, zero, to="b"), make("Neg", pi), pi)
            turn = make("Where", make("Less", at, zero, to="b"), behind, zero)
            angle = make("Add", make("Atan", make("Div", y, at)), turn)
            return make("Where", make("Equal", at, zero, to="b"), upright, angle)
        if name in PAIRED and "axes" in params:
            return self._reduced(PAIRED[name], x[0], params["axes"], shape, kind)
        if name in ("argmax", "argmin"):
            op = "ArgMax" if name == "argmax" else "ArgMin"
            place = make(op, x[0], axis=params["axes"][0], keepdims=0)
            return self._cast(place, "i")
        if name == "cumsum":
            axis = self.held(np.array(params["axis"], np.int64))
            return make("CumSum", x[0], axis, reverse=int(params["reverse"]))
        if name == "dot_general":
            return make("Einsum", *x, equation=_equation(x, params["dimension_numbers"]))
        raise UnsupportedError(name)

    def _cast(self, x: Tensor, kind: str) -> Tensor:
        return self.node("Cast", [x], x.shape, kind, to=self.type_of(kind))

    def type_of(self, kind: str) -> Any:
        """The type of ONNX of a kind of numbers."""
        return self.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(_TYPES[kind]))

    def _reduced(self, op: str, x: Tensor, axes: Any, shape: Sequence[int], kind: str) -> Tensor:
        over = self.held(np.array(axes, np.int64))
        if op in ("and", "or"):
            whole = self._cast(x, "i")
            least = "ReduceMin" if op == "and" else "ReduceMax"
            return self._cast(self.node(least, [whole, over], shape, "i", keepdims=0), "b")
        return self.node(_REDUCED[op], [x, over], shape, kind, keepdims=0)


def _equation(x: Sequence[Tensor], numbers: Any) -> str:
    """A product as `Einsum` writes it."""
    (left, right), (left_batch, right_batch) = numbers
    letters = iter(string.ascii_lowercase)
    a = [next(letters) for _ in x[0].shape]
    b = [next(letters) for _ in x[1].shape]
    for i, j in zip((*left, *left_batch), (*right, *right_batch), strict=True):
        b[j] = a[i]
    out = [a[i] for i in left_batch]
    out += [c for i, c in enumerate(a) if i not in (*left, *left_batch)]
    out += [c for j, c in enumerate(b) if j not in (*right, *right_batch)]
    return f"{''.join(a)},{''.join(b)}->{''.join(out)}"


def models(program: Program, prefix: str, batch: int | None = None) -> dict[str, str | bytes]:
    """The model's file.

    Raises:
      InputError: ONNX is not installed, or an operation has no form in it.
    """
    onnx = errors.require("onnx", "export")
    groups, lead = program.groups, () if batch is None else (batch,)
    target, closed = Graph(onnx), program.step.jaxpr
    params = [np.asarray(one.value, float) for one in groups["params"]]
    if batch is not None:
        closed = _batched(closed, len(params), batch)

    def tensors(mark: str, group: str) -> list[Tensor]:
        return [
            Tensor(mark + one.name, (*lead, *one.shape), one.kind, one.about)
            for one in groups[group]
        ]

    def infos(those: Sequence[Tensor]) -> list[Any]:
        types = [target.type_of(one.kind) for one in those]
        make = onnx.helper.make_tensor_value_info
        return [make(x.name, to, x.shape, x.about) for x, to in zip(those, types, strict=True)]

    inputs = [*tensors("memory_", "memory"), *tensors("", "observation")]
    outputs = [*tensors("next_memory_", "memory"), *tensors("", "twist")]
    given = [np.zeros(one.shape) if 0 in one.shape else one for one in inputs]
    found = walk.walk(closed, [*params, *given], target)
    inputs, kept = ([x for x in those if 0 not in x.shape] for those in (inputs, outputs))
    for out, value in zip(outputs, found, strict=True):
        if 0 not in out.shape:
            name = target.tensor(value).name
            target.nodes.append(onnx.helper.make_node("Identity", [name], [out.name]))
    graph = onnx.helper.make_graph(
        target.nodes,
        prefix,
        infos(inputs),
        infos(kept),
        list(target.constants.values()),
        doc_string=f"One control step of the law {program.label}; it checks no input.",
    )
    opset = onnx.helper.make_opsetid("", _OPSET)
    model = onnx.helper.make_model(
        graph, opset_imports=[opset], ir_version=_FORMAT, producer_name="rps_jax",
        producer_version=__version__,
    )  # fmt: skip
    start = {
        f"memory_{one.name}": np.asarray(one.value).tolist() for one in groups["memory"] if one.size
    }
    units = {one.name: one.about for one in (*inputs, *kept)}
    chosen = {one.name: np.asarray(one.value).tolist() for one in groups["params"]}
    about = {"law": program.label, "robot": program.robot, "params": json.dumps(chosen)}
    about |= {"memory_at_the_start": json.dumps(start), "units": json.dumps(units)}
    onnx.helper.set_model_props(model, about)
    onnx.checker.check_model(model, full_check=True)
    return {f"{prefix}.onnx": model.SerializeToString()}


def _batched(closed: Any, fixed: int, batch: int) -> Any:
    """The step of many worlds with one set of parameters, so many numbers."""
    axes = [None] * fixed + [0] * (len(closed.in_avals) - fixed)
    with jax.enable_x64(True):
        function = jax.vmap(jaxpr_as_fun(closed), in_axes=axes)
    shapes = [
        jax.ShapeDtypeStruct(one.shape if axis is None else (batch, *one.shape), one.dtype)
        for axis, one in zip(axes, closed.in_avals, strict=True)
    ]
    return walk.traced(function, *shapes)[0]
