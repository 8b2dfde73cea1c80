"""Docstrings in the reference of the documentation: ``name : text`` of a parameter is a description, not a type."""

from __future__ import annotations

import re

import griffe

SECTION = re.compile(r"(?ms)^(Parameters\n-+\n)(.*?)(?=^\w[^\n]*\n-+\n|\Z)")
ITEM = re.compile(r"(?m)^(\*{0,2}\w+(?:, \w+)*) : (.+)$")


class DescribedParameters(griffe.Extension):
    """Put the text behind the colon below the name; types are those of the signature."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Change the docstring of one object."""
        if obj.docstring is not None:
            text = obj.docstring.value
            obj.docstring.value = SECTION.sub(lambda m: m.group(1) + ITEM.sub(r"\1\n    \2", m.group(2)), text)
