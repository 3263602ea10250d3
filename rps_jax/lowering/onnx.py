"""Target that builds a graph of ONNX in float32: each value is a tensor of the graph."""

from __future__ import annotations

import string
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rps_jax import errors
from rps_jax.lowering.graph import (
    DTYPES,
    REDUCTIONS,
    Params,
    Shape,
    Target,
    Typed,
    UnsupportedError,
    Value,
    Values,
    kind_of,
    operation_of,
    size_of,
)
from rps_jax.lowering.operations import spelled
from rps_jax.lowering.walk import reduced_by_rows, sliding_windows

_OPSET, _FORMAT = 18, 9  # versions of the operators and of the file
_OPERATORS = spelled("onnx")
_REDUCED = {"add": "ReduceSum", "mul": "ReduceProd", "max": "ReduceMax", "min": "ReduceMin"}


class Tensor(NamedTuple):
    """A value of the graph."""

    name: str
    shape: Shape
    kind: str
    about: str = ""

    @property
    def dtype(self) -> np.dtype:
        """Type of the numbers."""
        return np.dtype(DTYPES[self.kind])


class Graph(Target):
    """Target that builds a graph of ONNX."""

    operations = _OPERATORS

    def __init__(self) -> None:
        """Build a graph without nodes.

        Raises:
          InputError: ONNX is not installed.
        """
        self.onnx: Any = errors.require("onnx", "export")
        self.nodes: list[Any] = []
        self.constants: dict[Hashable, Any] = {}

    def tensor(self, value: Value) -> Tensor:
        """Return a value as a tensor."""
        if isinstance(value, Tensor):
            return value
        array = np.asarray(value)
        kind = kind_of(array.dtype)
        return self.constant(array.astype(DTYPES[kind]), kind)

    def constant(self, array: np.ndarray, kind: str = "") -> Tensor:
        """Return a constant as a tensor."""
        array = np.ascontiguousarray(array).reshape(array.shape)
        key = (array.tobytes(), array.shape, array.dtype.str)
        if key not in self.constants:
            name = f"constant_{len(self.constants)}"
            self.constants[key] = self.onnx.numpy_helper.from_array(array, name)
        return Tensor(self.constants[key].name, array.shape, kind)

    def node(
        self,
        op: str,
        inputs: Sequence[Tensor],
        shape: Sequence[int],
        kind: str,
        **attributes: object,
    ) -> Tensor:
        """Return the result of an operator."""
        out = Tensor(f"value_{len(self.nodes)}", tuple(shape), kind)
        names = [tensor.name for tensor in inputs]
        self.nodes.append(self.onnx.helper.make_node(op, names, [out.name], out.name, **attributes))
        return out

    def reshaped(self, value: Value, shape: Sequence[int]) -> Tensor:
        """Return a value in another shape."""
        tensor = self.tensor(value)
        if tensor.shape == tuple(shape):
            return tensor
        to = self.constant(np.array(shape, np.int64))
        return self.node("Reshape", [tensor, to], shape, tensor.kind)

    def gather(self, values: Values, indices: np.ndarray, template: Typed) -> Value:
        """Gather numbers at constant indices: a reshape or an expansion where that suffices."""
        if not indices.size:
            return np.zeros(indices.shape, template.dtype)
        flat = [self.reshaped(value, (size_of(value.shape),)) for value in values]
        kind, size = kind_of(template.dtype), sum(tensor.shape[0] for tensor in flat)
        whole = flat[0] if len(flat) == 1 else self.node("Concat", flat, (size,), kind, axis=0)
        if size == 1 and indices.size > 1:
            to = self.constant(np.array(indices.shape, np.int64))
            return self.node("Expand", [whole, to], indices.shape, kind)
        if indices.size != size or (indices.reshape(-1) != np.arange(size)).any():
            at = self.constant(indices.reshape(-1).astype(np.int64))
            whole = self.node("Gather", [whole, at], (indices.size,), kind, axis=0)
        return self.reshaped(whole, indices.shape)

    def apply(self, name: str, values: Values, params: Params, out: Typed) -> Tensor:
        x, shape, kind = [self.tensor(value) for value in values], out.shape, kind_of(out.dtype)
        if name in REDUCTIONS:
            return self._reduced(REDUCTIONS[name], x[0], params["axes"], out, kind)
        if name == "dynamic_slice":
            return self._slice(x[0], values[1:], params["slice_sizes"], out)
        if name == "dot_general":
            equation = _equation(x, params["dimension_numbers"])
            return self.node("Einsum", x, shape, kind, equation=equation)
        operator = _OPERATORS.get(operation_of(name, x, params, out))
        if operator is None:
            raise UnsupportedError(name)
        if operator == "BitShift":  # of unsigned integers alone
            bits = [self._cast(tensor, "u") for tensor in x]
            direction = "LEFT" if name == "shift_up" else "RIGHT"
            return self._cast(self.node(operator, bits, shape, "u", direction=direction), kind)
        if name == "select_n":
            x = [x[0], x[2], x[1]]
        attributes = {"Mod": {"fmod": 1}, "Cast": {"to": self._type(kind)}}
        return self.node(operator, x, shape, kind, **attributes.get(operator, {}))

    def _slice(self, x: Tensor, starts: Values, sizes: Sequence[int], out: Typed) -> Tensor:
        """Slice a tensor at an index that is known at run time, clamped to the tensor."""
        index, table = sliding_windows(self, x.shape, starts, sizes)
        windows, size = self.constant(table.astype(np.int64)), size_of(sizes)
        indices = self.node("Gather", [windows, self.tensor(index)], (size,), "i", axis=0)
        flat = self.reshaped(x, (size_of(x.shape),))
        window = self.node("Gather", [flat, indices], (size,), x.kind, axis=0)
        return self.reshaped(window, out.shape)

    def _cast(self, x: Tensor, kind: str) -> Tensor:
        return self.node("Cast", [x], x.shape, kind, to=self._type(kind))

    def _type(self, kind: str) -> int:
        return self.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(DTYPES[kind]))

    def _reduced(
        self, binary: str, x: Tensor, axes: Sequence[int], out: Typed, kind: str
    ) -> Tensor:
        over, shape = self.constant(np.array(axes, np.int64)), out.shape
        if binary == "xor" or (kind == "i" and binary not in ("max", "min")):
            # Its sums of integers do not wrap around.
            return reduced_by_rows(self, binary, x, axes, out)
        if kind == "b":
            whole = self._cast(x, "i")
            op = "ReduceMin" if binary == "and" else "ReduceMax"
            return self._cast(self.node(op, [whole, over], shape, "i", keepdims=0), "b")
        reduced = self.node(_REDUCED[binary], [x, over], shape, kind, keepdims=0)
        if kind != "f" or binary not in ("max", "min"):
            return reduced
        # The runtime drops some NaN.
        flags = self._cast(self.node("IsNaN", [x], x.shape, "b"), "i")
        any_nan = self._cast(self.node("ReduceMax", [flags, over], shape, "i", keepdims=0), "b")
        nan = self.constant(np.asarray(np.nan, np.float32), "f")
        return self.node("Where", [any_nan, nan, reduced], shape, "f")

    def model(
        self,
        name: str,
        inputs: Sequence[Tensor],
        outputs: Sequence[tuple[Tensor, Value]],
        **names: str,
    ) -> Any:
        """Return the graph as a model of ONNX; `names` are its text fields."""
        make = self.onnx.helper
        for out, value in outputs:
            self.nodes.append(make.make_node("Identity", [self.tensor(value).name], [out.name]))

        def infos(tensors: Sequence[Tensor]) -> list[Any]:
            return [
                make.make_tensor_value_info(x.name, self._type(x.kind), x.shape, x.about)
                for x in tensors
            ]

        graph = make.make_graph(
            self.nodes,
            name,
            infos(inputs),
            infos([out for out, _ in outputs]),
            list(self.constants.values()),
            doc_string=names.pop("doc_string", ""),
        )
        opset = make.make_opsetid("", _OPSET)
        return make.make_model(graph, opset_imports=[opset], ir_version=_FORMAT, **names)


def _equation(x: Sequence[Tensor], dimensions: Any) -> str:
    """Return a product as an equation of `Einsum`."""
    (lhs, rhs), (lhs_batch, rhs_batch) = dimensions
    letters = iter(string.ascii_lowercase)
    a = [next(letters) for _ in x[0].shape]
    b = [next(letters) for _ in x[1].shape]
    for i, j in zip((*lhs, *lhs_batch), (*rhs, *rhs_batch), strict=True):
        b[j] = a[i]
    out = [a[i] for i in lhs_batch]
    out += [c for c in (*a, *b) if (c in a) != (c in b)]
    return f"{''.join(a)},{''.join(b)}->{''.join(out)}"
