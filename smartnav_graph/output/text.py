"""Numbers as text, and tables that render as HTML and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from io import StringIO

from smartnav_graph.output.summary_json import as_float

THIN = "\u202f"
DASH = "–"


def fixed(value: float, decimals: int) -> str:
    """Decimal number with a true minus sign and thin spaces between thousands."""
    text = f"{abs(value):,.{decimals}f}".replace(",", THIN)
    return f"−{text}" if value < 0 and float(f"{value:.{decimals}f}") != 0 else text


def number(value: object, digits: int = 3) -> str:
    """`digits` significant figures, all integer digits kept; a dash for an unknown value."""
    v = as_float(value)
    if v is None:
        return DASH
    if v == 0:
        return "0"
    exponent = math.floor(math.log10(abs(v)))
    if exponent < -4:
        mantissa, power = f"{v:.{max(digits - 2, 0)}e}".split("e")
        return f"{mantissa}e{int(power)}".replace("-", "−")
    return fixed(v, max(0, digits - 1 - exponent))


def metres(value: object) -> str:
    """A small length: to the millimetre below 1 m (to 0.1 mm below 1 cm), else three figures."""
    v = as_float(value)
    if v is None:
        return DASH
    return f"{fixed(v, 4 if abs(v) < 0.01 else 3) if abs(v) < 1 else number(v)} m"


def count(value: object) -> str:
    """A whole number."""
    v = as_float(value)
    return DASH if v is None else fixed(round(v), 0)


def seconds(value: object, decimals: int = 1) -> str:
    """A time with its unit."""
    v = as_float(value)
    return DASH if v is None else f"{fixed(v, decimals)} s"


def duration(value: object) -> str:
    """Seconds, minutes and hours: 42.1 s, 7 min 49 s, 1 h 02 min."""
    v = as_float(value)
    if v is None:
        return DASH
    if v < 60:
        return f"{fixed(v, 1)} s"
    whole = round(v)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def distance(value: object) -> str:
    """Metres below one kilometre, else kilometres."""
    v = as_float(value)
    if v is None:
        return DASH
    return f"{number(v / 1000)} km" if v >= 1000 else f"{number(v)} m"


def plural(n: object, one: str, many: str | None = None) -> str:
    """``1 fix``, ``3 fixes``."""
    return f"{count(n)} {one if as_float(n) == 1 else many or one + 's'}"


def listed(parts: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def capital(text: str) -> str:
    """The text with a capital first letter."""
    return text[:1].upper() + text[1:]


def attributes(data: Mapping[str, object]) -> str:
    """``data-`` attributes of the values that are known, numbers in full precision."""
    return "".join(f' data-{name}="{escape(str(value))}"' for name, value in data.items() if value is not None)


@dataclass(frozen=True)
class Row:
    """Cells of plain text; `data` becomes ``data-`` attributes of the HTML row."""

    cells: Sequence[str]
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Table:
    """Plain text cells. The first column is a heading, columns named in `words` are text, the others numbers."""

    header: Sequence[str]
    rows: Sequence[Row]
    words: frozenset[int] = frozenset()

    def __bool__(self) -> bool:
        return bool(self.rows)

    def html(self) -> str:
        """An HTML table in a box that scrolls on its own when it is wider than the page."""
        kind = ["" if i == 0 or i in self.words else ' class="n"' for i in range(len(self.header))]
        head = "".join(f'<th scope="col"{k}>{escape(h)}</th>' for h, k in zip(self.header, kind, strict=True))
        body = "".join(self._row(row, kind) for row in self.rows)
        top = f"<thead><tr>{head}</tr></thead>" if any(self.header) else ""
        return f'<div class="scroll"><table>{top}<tbody>{body}</tbody></table></div>'

    @staticmethod
    def _row(row: Row, kind: Sequence[str]) -> str:
        cells = "".join(f"<td{k}>{escape(c)}</td>" for c, k in zip(row.cells[1:], kind[1:], strict=True))
        return f'<tr{attributes(row.data)}><th scope="row">{escape(row.cells[0])}</th>{cells}</tr>'

    def text(self, width: int = 80) -> str:
        """A table in fixed width for terminals and pipes, cells wrapped at words."""
        from rich.console import Console
        from rich.table import Table as Grid
        from rich.text import Text

        between = 2 if len(self.header) < 8 else 1
        grid = Grid(box=None, pad_edge=False, padding=(0, between, 0, 0), header_style="")
        for i, name in enumerate(self.header):
            grid.add_column(Text(name), justify="left" if i == 0 or i in self.words else "right", vertical="bottom")
        for row in self.rows:
            grid.add_row(*map(Text, row.cells))
        console = Console(file=StringIO(), width=width, color_system=None, force_terminal=False, legacy_windows=False)
        with console.capture() as capture:
            console.print(grid)
        return "\n".join(line.rstrip() for line in capture.get().splitlines())

    def markdown(self) -> str:
        """A GitHub-flavoured Markdown table."""
        rule = [":--" if i == 0 or i in self.words else "--:" for i in range(len(self.header))]
        rows = [self.header, rule, *(row.cells for row in self.rows)]
        return "\n".join("| " + " | ".join(c.replace("|", "\\|").replace("\n", " ") for c in r) + " |" for r in rows)
