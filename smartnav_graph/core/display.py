"""Large values in one line, and as a small table in a notebook."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


class Summarised:
    """Base of classes that hold arrays: printed by a few `facts` instead of all their fields."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        cls.__repr__ = Summarised.__repr__  # type: ignore[method-assign]  # a dataclass makes none where there is one

    def facts(self) -> Mapping[str, str]:
        """What is shown of the value: name of a quantity, its value as text."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}({'; '.join(f'{name} {text}' for name, text in self.facts().items())})"

    def _repr_html_(self) -> str:
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(text)}</td></tr>'
            for name, text in self.facts().items()
        )
        return f"<table><caption>{escape(type(self).__name__)}</caption>{rows}</table>"
