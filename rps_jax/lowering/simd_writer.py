"""Printer of SIMD C: the function that XLA calls with a batch of worlds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jax.extend.core import ClosedJaxpr

from rps_jax.lowering.builder import GraphBuilder, SimdBuilder, results
from rps_jax.lowering.graph import DynamicSlice, Input, Node, Result, live_nodes
from rps_jax.lowering.operations import SIMD_HEADER
from rps_jax.lowering.target import Typed, first_array, kind_of
from rps_jax.lowering.writer import Writer, literal

HANDLER = "rps_native"  # placeholder of the name by which XLA calls the function
STORED = {"f": "float", "i": "int", "u": "unsigned", "b": "unsigned char"}  # of a number of a world
# Placeholders in capitals are lines that are printed for a function.
_FUNCTION = """\

{TABLES}
static void run_lanes(void **inputs, void **outputs, int64_t first, int64_t worlds) {{
  int64_t at[LANES];
  for (int l = 0; l < LANES; l++) {{
    const int64_t index = first + l < worlds ? first + l : worlds - 1;
    at[l] = {WORLD};
  }}
{LINES}
}}

XLA_FFI_Error *{NAME}(XLA_FFI_CallFrame *frame) {{
  if (answers_version(frame)) return 0;
  void *inputs[{INPUTS}], *outputs[{OUTPUTS}];
  for (int i = 0; i < {INPUTS}; i++) inputs[i] = ((XLA_FFI_Buffer *)frame->args.args[i])->data;
  for (int i = 0; i < {OUTPUTS}; i++) outputs[i] = ((XLA_FFI_Buffer *)frame->rets.rets[i])->data;
  const int64_t worlds = count_worlds(frame->args.args[{SIZED}], {SIZE});
  for (int64_t first = 0; first < worlds; first += LANES) run_lanes(inputs, outputs, first, worlds);
  return 0;
}}
"""


class SimdWriter(Writer):
    """Printer of nodes as C with a vector lane for each world."""

    table_type = "static const"
    function, inputs = _FUNCTION, "inputs"
    builder: type[GraphBuilder] = SimdBuilder

    def constant(self, text: str, kind: str) -> str:
        return f"all_{kind}({text})"

    def table_declaration(self, name: str, array: np.ndarray) -> str:
        kind = kind_of(array.dtype)
        texts = self.array_literal(literal(x, kind) for x in array.reshape(-1))
        stored = "int" if kind == "b" else STORED[kind]
        return f"{self.table_type} {stored} {name}[{array.size}] = {texts};"

    def single(self, node: Node) -> list[str]:
        offset = f"* {node.size} + i]"
        if isinstance(node.op, Input):
            text = f"((const {STORED[node.kind]} *)inputs[{node.op.index}])[at[l] {offset}"
            text = f"-(int){text}" if node.kind == "b" else text
        elif isinstance(node.op, DynamicSlice):
            index, source = node.operands
            row, table = self.read(index, 1), self.table(np.array(node.op.windows))
            text = f"{source.node.name}[{table}[{row}[l] {offset}][l]"
        else:
            return super().single(node)
        line = f"  for (int l = 0; l < LANES; l++) {self.element(node)}[l] = {text};"
        return [self.declare(node), *self.elements(node.size, [line])]

    def end(self, result: Result) -> list[str]:
        """Return the statements that store a result."""
        position, a, size, kind = result
        stored, truth = STORED[kind], " != 0" * (kind == "b")
        lines = [
            f"  {self.declaration(kind, 'e')} = {self.read(a, size)};",
            "  for (int l = 0; l < LANES && first + l < worlds; l++)",
            f"    (({stored} *)outputs[{position}])[at[l] * {size} + i] = e[l]{truth};",
        ]
        return self.elements(size, lines)

    def source(
        self,
        closed: ClosedJaxpr,
        shapes: Sequence[Typed],
        outs: Sequence[Typed],
        sorted_worlds: bool = False,
    ) -> str:
        """Return the function of a closed jaxpr that runs all worlds: `HANDLER`, or `step` of CUDA.

        Args:
          closed: the function of one world.
          shapes: types of its arguments.
          outs: types of its results.
          sorted_worlds: whether one more argument has the order of the worlds.

        Raises:
          UnsupportedError: it has an operation that is not in the headers.
          TooLargeError: a kernel needs too much shared memory.
        """
        returned, roots = results(closed, shapes, outs, self.builder())
        nodes, (sized, size) = live_nodes(roots), first_array(shapes)
        self.assign_storage(nodes, returned)
        lines = self.lines(nodes, roots)
        for result in returned:
            lines += self.end(result)
        order = f"((const int *){self.inputs}[{len(shapes)}])[index]"
        return self.preamble() + self.function.format(
            TABLES="\n".join(self.tables.values()),
            LINES="\n".join(f"  {line}" for line in lines),
            WORLD=order if sorted_worlds else "index",
            INPUTS=len(shapes) + sorted_worlds,
            OUTPUTS=len(outs),
            NAME=HANDLER,
            SIZED=sized,
            SIZE=size,
        )

    def assign_storage(self, nodes: Iterable[Node], returned: Iterable[Result]) -> None:
        """Choose where arrays are stored."""

    def preamble(self) -> str:
        """Return the text before the function, after its statements are printed."""
        return SIMD_HEADER
