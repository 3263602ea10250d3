"""Extension of griffe: the declaration of a field (`rps_jax.spec`) is its docstring on the site."""

from __future__ import annotations

import math
import pydoc
from typing import Any, cast

import griffe

from rps_jax.spec import Spec, specs_of


class Specs(griffe.Extension):
    """Replace `Annotated[TYPE, Spec(...)]` of an attribute by its type and a docstring."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: Any) -> None:
        """Set docstring and annotation of an attribute that has a declaration."""
        parts = getattr(getattr(attr.annotation, "slice", None), "elements", None)
        owner, is_declared = attr.parent, str(attr.annotation).startswith("Annotated[")
        if parts is None or not is_declared or owner is None or not owner.is_class:
            return
        spec = specs_of(cast("type", pydoc.locate(owner.path))).get(attr.name)
        if spec and spec.about:
            attr.docstring = griffe.Docstring(text_of(spec), parent=attr)
            attr.annotation = parts[0]


def text_of(spec: Spec) -> str:
    """Return meaning, unit and limits of a declaration as a sentence."""
    bounds = spec.bounds
    unit = bounds.pop("unit", "")
    text = f"{spec.about[:1].upper()}{spec.about[1:]}".removesuffix(".")
    if unit and f"[{unit}]" not in text:
        text += f" [{unit}]"
    limits = [f"{name.replace('_', ' ')} {x:g}" for name, x in bounds.items() if abs(x) < math.inf]
    return "; ".join([text, *limits]) + "."
