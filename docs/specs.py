"""Extension of griffe: the declaration of a field (`rps_jax.spec`) is its docstring on the site."""

from __future__ import annotations

import ast
import textwrap
from typing import Any

import griffe

_LIMITS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}


class Specs(griffe.Extension):
    """Replace `Annotated[TYPE, Spec(...)]` of an attribute by its type and a docstring."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Set docstring and annotation of an attribute that has a declaration."""
        parts = getattr(getattr(attr.annotation, "slice", None), "elements", None)
        if parts is None or not str(attr.annotation).startswith("Annotated["):
            return
        # Of the source: griffe takes texts in annotations for types.
        (field,) = ast.parse(textwrap.dedent(attr.source)).body
        for call in (x for x in ast.walk(field) if isinstance(x, ast.Call)):
            if ast.unparse(call.func) in ("Spec", "Quantity", "tunable"):
                attr.docstring = griffe.Docstring(text_of(call), parent=attr)
                attr.annotation = parts[0]
                return


def text_of(call: ast.Call) -> str:
    """Return meaning, unit and limits of a declaration as a sentence."""
    unit, about = [*(x.value for x in call.args if isinstance(x, ast.Constant)), "", ""][:2]
    keywords = {x.arg: ast.unparse(x.value) for x in call.keywords if x.arg in _LIMITS}
    if ast.unparse(call.func) == "tunable":  # its other arguments are the interval of tuners
        first = {} if "gt" in keywords else {"ge": "0"}
    else:
        first = dict(zip(("ge", "le"), map(ast.unparse, call.args[2:4]), strict=False))
    limits = [f"{_LIMITS[name]} {x}" for name, x in (first | keywords).items() if x != "None"]
    text = f"{str(about)[:1].upper()}{str(about)[1:]}".removesuffix(".")
    if unit not in ("", "1") and f"[{unit}]" not in text:
        text += f" [{unit}]"
    return "; ".join([text, *limits]) + "."
