"""What the writers of C and of JavaScript share: single numbers as statements, in their order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from rps_jax.app.export.program import Field, Routine
from rps_jax.app.export.scalars import UNARY, Block, Loop, Node, Scalars, ordered
from rps_jax.app.export.walk import unsupported

_FUNCTIONS = {*UNARY, "atan2", "pow", "rem", "round", "rint", "max", "min"}
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
    """One routine as lines of a language."""

    forms: ClassVar[Mapping[str, str]] = FORMS
    index: ClassVar[str]  # how the number of a loop is declared

    def __init__(
        self,
        groups: Mapping[str, str],
        target: Scalars | None = None,
        prefix: str = "",
        own: str = "",
    ):
        """Take how groups are read, whose tables are written, and how names of it begin."""
        self.groups, self.target, self.prefix = groups, target or Scalars(), prefix
        self.own = own  # of the routine, after the prefix

    def literal(self, value: object, kind: str) -> str:
        """A constant."""
        raise NotImplementedError

    def flag(self, name: str) -> str:
        """An input that is a bool."""
        raise NotImplementedError

    def declared(self, node: Node, constant: bool = True) -> str:
        """The left side of a declaration."""
        raise NotImplementedError

    def called(self, name: str, arguments: str) -> str:
        """A call of a function."""
        raise NotImplementedError

    def product(self, node: Node, indent: str) -> list[str]:
        """Statements of a product with a matrix."""
        raise NotImplementedError

    def taken(self, node: Node, indent: str) -> list[str]:
        """Statements that take an element at a place."""
        raise NotImplementedError

    def name(self, node: Node) -> str:
        """How a node is read."""
        if node.op == "constant":
            text = self.literal(node.extra, node.kind)
            return f"({text})" if "-" in text.split("e")[0] else text
        if node.op == "input":
            group, field, place = node.extra
            name = f"{self.groups[group]}{field}" + "".join(f"[{i}]" for i in place)
            return self.flag(name) if node.kind == "b" else name
        if node.op == "part" and isinstance(node.args[0].extra, Loop):
            return self.name(node.args[0].extra.carried[node.extra])
        if node.op == "part":
            return f"v{node.args[0].number}[{node.extra}]"
        return f"v{node.number}"

    def expression(self, node: Node) -> str:
        """What a node is."""
        names = [self.name(arg) for arg in node.args]
        if node.op in self.forms:
            return self.forms[node.op].format(*names, p=self.prefix)
        if node.op in _FUNCTIONS:
            return self.called(node.op, ", ".join(names))
        raise unsupported(node.op)

    def loop(self, node: Node, indent: str) -> list[str]:
        """Statements of a loop, after which the numbers that it carries are its results."""
        loop, i = node.extra, f"i{node.number}"
        pairs = list(zip(loop.carried, loop.results, strict=True))
        return [
            *(
                f"{indent}{self.declared(own, False)} = {self.name(start)};"
                for own, start in zip(loop.carried, node.args, strict=False)
            ),
            f"{indent}for ({self.index} {i} = 0; {i} < {loop.length}; {i}++) {{",
            *self.lines(loop.nodes, indent + "  "),
            *(
                f"{indent}  {self.name(own)} = {self.name(result)};"
                for own, result in pairs
                if own is not result
            ),
            f"{indent}}}",
        ]

    def lines(self, items: Sequence[Node | Block], indent: str = "  ") -> list[str]:
        """The statements of nodes, in their order."""
        found = []
        for item in items:
            if isinstance(item, Block):
                yes, no = (2, 1) if item.holds else (1, 2)
                for node in item.choices:
                    start = self.name(node.args[no])
                    found.append(f"{indent}{self.declared(node, False)} = {start};")
                condition = ("" if item.holds else "!") + self.name(item.condition)
                found.append(f"{indent}if ({condition}) {{")
                found += self.lines(item.nodes, indent + "  ")
                for node in item.choices:
                    found.append(f"{indent}  v{node.number} = {self.name(node.args[yes])};")
                found.append(f"{indent}}}")
            elif isinstance(item.extra, Loop):
                found += self.loop(item, indent)
            elif item.op == "product":
                found += self.product(item, indent)
            elif item.op == "take":
                found += self.taken(item, indent)
            elif item.op not in ("constant", "input", "part"):
                found.append(f"{indent}{self.declared(item)} = {self.expression(item)};")
        return found


def computed(
    kind: type[Writer], routine: Routine, groups: Mapping[str, str], prefix: str = ""
) -> tuple[Writer, list[str], list[tuple[str, Field, list[str]]]]:
    """The writer of a routine, its statements, and of each result its group, field and numbers."""
    target, results = routine.scalars()
    every = [node for fields in results.values() for nodes in fields for node in nodes]
    writer = kind(groups, target, prefix, routine.name)
    lines = writer.lines(ordered(every))
    return (
        writer,
        lines,
        [
            (group, field, list(map(writer.name, nodes)))
            for group, fields in results.items()
            for field, nodes in zip(routine.found[group], fields, strict=True)
        ],
    )
