"""The page about the session folder: every stream, column, unit, and key of session.toml, from the code itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import MISSING, Field

from smartnav_graph.core.frames import Origin
from smartnav_graph.session import repair
from smartnav_graph.session.folder import HEADER_KEYS, SCHEMA
from smartnav_graph.session.session import EPOCHS, MOUNTINGS, VEHICLES, Device, Mount
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import STREAMS

# Ends of column names -> unit; the longest that fits.
UNITS = {
    "_ns": "ns",
    "_ns_1": "ns",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_m_s2": "m/s^2",
    "_m_s": "m/s",
    "_m": "m",
    "_ut": "uT",
    "_hpa": "hPa",
    "_c": "deg C",
    "_deg": "deg",
    "_px": "px",
    "_n": "1",
}
_KINDS = {"float": "number", "int": "whole number", "text": "text"}
_TABLES: dict[str, type] = {"device": Device, "origin": Origin, "sensors.NAME": Mount}
_CHOICES = {"vehicle": VEHICLES, "mounting": MOUNTINGS, "forward": ("+x", "-x", "+y", "-y", "+z", "-z")}
_CHOICES["up"] = _CHOICES["forward"]
_TOML = str.maketrans("()'", '[]"')
_HEAD = """# The session folder

`session.toml` and one Parquet file a stream, named after it. A folder of CSV files with the same columns is imported by
`smartnav import FOLDER --out SESSION`. Times are whole nanoseconds of the source's own clock, one clock a session.
Specific force at rest is +9.81 m/s^2 on the axis that points up. Columns that are not listed are kept, and not used.

This page is written by `smartnav formats --columns`.
"""


def format_page() -> str:
    """Markdown about every stream and every key of session.toml."""
    streams = "\n".join(_stream(name, kind) for name, kind in STREAMS.items())
    return f"{_HEAD}\n## session.toml\n\n{_header()}\n\n## Streams\n\n{streams}"


def unit_of(column: str) -> str:
    """The unit that the end of a column's name gives; empty where it gives none."""
    ends = [end for end in UNITS if column.endswith(end)]
    return UNITS[max(ends, key=len)] if ends else ""


def _header() -> str:
    lines = ["| key | meaning |", "|---|---|"]
    for key, meaning in HEADER_KEYS.items():
        lines.append(f"| `{key}` | {meaning} |")
    values = {"schema": str(SCHEMA), "repair": ", ".join(repair.REPAIRS), "[clock] epoch": ", ".join(EPOCHS)}
    lines += ["", *(f"`{key}`: {value}." for key, value in values.items())]
    for table, kind in _TABLES.items():
        lines += ["", f"`[{table}]` {_text(kind)}", "", "| key | default | values |", "|---|---|---|"]
        lines += [_key(spec) for spec in dataclasses.fields(kind)]
    return "\n".join(lines)


def _text(kind: type) -> str:
    """The docstring of a class, in one line."""
    return " ".join((kind.__doc__ or "").split())


def _key(spec: Field[object]) -> str:
    default = "required" if spec.default is MISSING else repr(spec.default).translate(_TOML)
    return f"| `{spec.name}` | {default} | {', '.join(_CHOICES.get(spec.name, ()))} |"


def _stream(name: str, kind: type[Stream]) -> str:
    lines = [f"### {name}.parquet", "", _text(kind), "", "| column | unit | type | required |", "|---|---|---|---|"]
    return "\n".join([*lines, *_columns(kind), ""])


def _columns(kind: type[Stream]) -> Iterator[str]:
    for spec in kind.specs():
        names, nan = spec.metadata["columns"], spec.metadata["nan"]
        for column in names:
            if spec.name in kind.ONE_OF:
                needed = "latitude, longitude and height, or east, north and up"
            else:
                needed = "yes" if spec.default is MISSING else "no"
            if len(names) > 1 and needed == "no":
                needed = f"no, or all of {', '.join(names)}"
            cells = "; cells may be empty" if nan is True or nan == column else ""
            yield f"| `{column}` | {unit_of(column)} | {_KINDS[spec.metadata['kind']]} | {needed}{cells} |"
