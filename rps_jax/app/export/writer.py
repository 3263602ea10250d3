"""What the writers of C and of JavaScript share: single numbers as statements, in their order."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

import numpy as np

from rps_jax.app.export.program import Field, Routine
from rps_jax.app.export.scalars import UNARY, Block, Loop, Node, ordered
from rps_jax.lowering.walk import UnsupportedError

# Inputs of a product with a matrix that are taken together: compilers then vectorise the loop over
# the outputs, and a sum is loaded and stored once for all of them.
_TOGETHER = 8
FUNCTIONS = {*UNARY, "atan2", "pow", "rem", "round", "rint", "max", "min"}
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "gt": ">"}
_INFIX |= {"ge": ">=", "eq": "==", "ne": "!=", "and": "&&", "or": "||", "xor": "!="}
_INFIX |= {"iand": "&", "ior": "|", "ixor": "^"}
FORMS = {name: f"{{0}} {sign} {{1}}" for name, sign in _INFIX.items()} | {
    "copy": "{0}",
    "neg": "-{0}",
    "not": "!{0}",
    "inot": "~{0}",
    "select": "{0} ? {2} : {1}",
    "b_of_f": "{0} != 0",
    "b_of_i": "{0} != 0",
}


class Writer:
    """One routine as statements of a language, which is what stands in these tables."""

    compiler: ClassVar[str]  # its name in errors
    forms: ClassVar[Mapping[str, str]]  # of operations that are no function
    functions: ClassVar[set[str]] = FUNCTIONS
    call: ClassVar[str]  # of a function
    heads: ClassVar[tuple[str, str]]  # of the declaration of what changes, and of a constant
    kinds: ClassVar[Mapping[str, str]] = dict.fromkeys("fib", "")  # of numbers
    index: ClassVar[str]  # how the number of a loop is declared
    flag: ClassVar[str]  # how an input is read that is a bool
    zeros: ClassVar[str]  # a matrix of zeros

    def __init__(
        self, routine: Routine, groups: Mapping[str, str], tables: dict[str, str], prefix: str = ""
    ):
        """Write it; constants join the tables.

        Args:
          routine: what is written.
          groups: how fields of each group that it takes are read, before their names.
          tables: declarations of constants, by name.
          prefix: what names begin with.
        """
        self.groups, self.tables, self.prefix = groups, tables, prefix
        self.target, found = routine.scalars(self.compiler)
        every = [node for fields in found.values() for nodes in fields for node in nodes]
        self.body = self.lines(ordered(every))
        self.results: list[tuple[str, Field, list[str]]] = [
            (group, field, list(map(self.name, nodes)))
            for group, fields in found.items()
            for field, nodes in zip(routine.found[group], fields, strict=True)
        ]

    def literal(self, value: object, kind: str) -> str:
        """A constant."""
        raise NotImplementedError

    def listed(self, texts: Iterable[str]) -> str:
        """An array of these elements."""
        raise NotImplementedError

    def packed(self, name: str, array: np.ndarray) -> str:
        """The declaration of constants that stand before the functions."""
        raise NotImplementedError

    def declared(self, name: str, kind: str, sizes: Sequence[int], constant: bool = True) -> str:
        """The left side of a declaration."""
        kind = self.kinds[kind].format(p=self.prefix)
        sized = name + "".join(f"[{size}]" for size in sizes)
        return self.heads[constant].format(kind=kind, name=name, sized=sized)

    def table(self, array: np.ndarray) -> str:
        """The name of constants that stand before the functions."""
        name = f"{self.prefix}_w_{hashlib.sha256(array.tobytes()).hexdigest()[:8]}"
        if name not in self.tables:
            self.tables[name] = self.packed(name, array)
        return name

    def name(self, node: Node) -> str:
        """How a node is read."""
        if node.op == "constant":
            text = self.literal(node.extra, node.kind)
            return f"({text})" if "-" in text.split("e")[0] else text
        if node.op == "input":
            group, field, place = node.extra
            name = f"{self.groups[group]}{field}" + "".join(f"[{i}]" for i in place)
            return self.flag.format(name) if node.kind == "b" else name
        if node.op == "part" and isinstance(node.args[0].extra, Loop):
            return self.name(node.args[0].extra.carried[node.extra])
        if node.op == "part":
            row, column = node.extra
            return f"v{node.args[0].number}[{row}][{column}]"
        return f"v{node.number}"

    def expression(self, node: Node) -> str:
        """What a node is."""
        names = [self.name(arg) for arg in node.args]
        if node.op in self.forms:
            return self.forms[node.op].format(*names, p=self.prefix, P=self.prefix.upper())
        if node.op in self.functions:
            return self.call.format(node.op, ", ".join(names), P=self.prefix.upper())
        raise UnsupportedError(node.op, self.compiler)

    def lines(self, items: Sequence[Node | Block], indent: str = "  ") -> list[str]:
        """The statements of nodes, in their order."""
        found = []
        for item in items:
            if isinstance(item, Block):
                lines = self._block(item)
            elif isinstance(item.extra, Loop):
                lines = self._loop(item)
            elif item.op == "product":
                lines = self._product(item)
            elif item.op == "take":
                lines = self._take(item)
            elif item.op in ("constant", "input", "part"):
                continue
            else:
                lines = [f"{self._declared(item)} = {self.expression(item)};"]
            found += [f"{indent}{line}" for line in lines]
        return found

    def _declared(self, node: Node, constant: bool = True) -> str:
        return self.declared(f"v{node.number}", node.kind, (), constant)

    def _block(self, block: Block) -> list[str]:
        """Statements of what is computed under a condition alone."""
        yes, no = (2, 1) if block.holds else (1, 2)
        return [
            *(f"{self._declared(n, False)} = {self.name(n.args[no])};" for n in block.choices),
            f"if ({'' if block.holds else '!'}{self.name(block.condition)}) {{",
            *self.lines(block.nodes),
            *(f"  {self.name(n)} = {self.name(n.args[yes])};" for n in block.choices),
            "}",
        ]

    def _loop(self, node: Node) -> list[str]:
        """Statements of a loop, after which the numbers that it carries are its results."""
        loop, i = node.extra, f"i{node.number}"
        starts = zip(loop.carried, node.args, strict=False)
        ends = zip(loop.carried, loop.results, strict=True)
        return [
            *(f"{self._declared(own, False)} = {self.name(start)};" for own, start in starts),
            f"for ({self.index} {i} = 0; {i} < {loop.length}; {i}++) {{",
            *self.lines(loop.nodes),
            *(f"  {self.name(own)} = {self.name(end)};" for own, end in ends if own is not end),
            "}",
        ]

    def _product(self, node: Node) -> list[str]:
        """Statements of a product of rows with a matrix, padded with zeros."""
        n, matrix = node.number, self.target.tables[node.extra]
        inputs, columns = matrix.shape
        more = -inputs % _TOGETHER
        table = self.table(np.pad(matrix, ((0, more), (0, 0))))
        names, zeros = list(map(self.name, node.args)), [self.literal(0.0, "f")] * more
        rows = [names[i : i + inputs] + zeros for i in range(0, len(names), inputs)]
        sizes = (len(rows), inputs + more)
        lines = [
            f"{self.declared(f'x{n}', 'f', sizes)} = {self.listed(map(self.listed, rows))};",
            f"{self.declared(f'v{n}', 'f', (len(rows), columns), False)} = "
            f"{self.zeros.format(len(rows), columns)};",
            f"for ({self.index} i = 0; i < {inputs + more}; i += {_TOGETHER}) {{",
            f"  for ({self.index} j = 0; j < {columns}; j++) {{",
        ]
        for r in range(len(rows)):
            terms = [f"x{n}[{r}][i + {k}] * {table}[i + {k}][j]" for k in range(_TOGETHER)]
            lines.append(f"    v{n}[{r}][j] = {' + '.join([f'v{n}[{r}][j]', *terms])};")
        return [*lines, "  }", "}"]

    def _take(self, node: Node) -> list[str]:
        """Statements that take an element at a place."""
        place, *elements = node.args
        if all(one.op == "constant" for one in elements):
            table, before = self.table(np.array([one.extra for one in elements])), []
        else:
            table = f"t{node.number}"
            head = self.declared(table, node.kind, (len(elements),))
            before = [f"{head} = {self.listed(map(self.name, elements))};"]
        return [*before, f"{self._declared(node)} = {table}[{self.name(place)}];"]
