"""Typed reading of summary.json; a part that is missing reads as empty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, SupportsFloat

import numpy as np

Summary = Mapping[str, object]

# Kinds of IMU data gaps, as shown.
GAP_KINDS = {"bridged": "linearly interpolated", "missing": "no samples"}


class ImuGap(NamedTuple):
    """One IMU data gap: start and length in s; kind ``bridged`` (linearly interpolated) or ``missing`` (no samples)."""

    start_s: float
    length_s: float
    kind: str


def as_float(value: object) -> float | None:
    """A finite float, or None for anything else (absent, null, NaN, text)."""
    if isinstance(value, bool) or not isinstance(value, SupportsFloat):
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def table_of(summary: Summary, key: str) -> Summary:
    """A sub-table; empty where it is absent or no table."""
    value = summary.get(key)
    return value if isinstance(value, Mapping) else {}


def list_of(summary: Summary, key: str) -> list[object]:
    """The items of a list; a single value is a list of one, an absent one is empty."""
    value = summary.get(key)
    return list(value) if isinstance(value, list | tuple) else [] if value is None else [value]


def rows_of(summary: Summary, key: str) -> list[Summary]:
    """The tables of a list of tables."""
    return [row for row in list_of(summary, key) if isinstance(row, Mapping)]


def numbers_of(summary: Summary, key: str) -> dict[str, float]:
    """The numbers of a sub-table by name; what is no number is left out."""
    known = {name: as_float(value) for name, value in table_of(summary, key).items()}
    return {name: value for name, value in known.items() if value is not None}


def text_of(summary: Summary, key: str) -> str:
    """A text; empty where it is absent."""
    value = summary.get(key)
    return "" if value is None else str(value)


def imu_gaps(summary: Summary) -> list[ImuGap]:
    """The IMU data gaps."""
    found = [(as_float(g.get("start_s")), as_float(g.get("length_s")), g.get("kind")) for g in rows_of(summary, "gaps")]
    return [
        ImuGap(start, length, str(kind)) for start, length, kind in found if start is not None and length is not None
    ]


def standstill_spans(summary: Summary) -> list[tuple[float, float]]:
    """Start and end (s) of the standstills."""
    spans = np.array(list_of(table_of(summary, "standstills"), "spans_s"), dtype=np.float64).reshape(-1, 2)
    return [(start, end) for start, end in spans.tolist()]


def verdict_lines(summary: Summary) -> list[str]:
    """The verdict and its reasons."""
    found = table_of(summary, "verdict")
    lines = [f"verdict: {text_of(found, 'level')}"] if found else []
    for reason in rows_of(found, "reasons"):
        start, end = (as_float(reason.get(name)) for name in ("start_s", "end_s"))
        when = "" if start is None else f" from {start:.1f} s" + ("" if end is None else f" to {end:.1f} s")
        lines.append(f"{reason['level']}: {reason['sensor']}{when}: {reason['text']}; {reason['remedy']}")
    return lines


def other_warnings(summary: Summary) -> list[str]:
    """The warnings that are no reason of the verdict."""
    reasons = [f"{one['sensor']}: {one['text']}" for one in rows_of(table_of(summary, "verdict"), "reasons")]
    return [text for text in map(str, list_of(summary, "warnings")) if not text.startswith(tuple(reasons))]


def run_warnings(summary: Summary) -> list[str]:
    """A verdict that is not ``good`` with its reasons, and the other warnings."""
    verdict = verdict_lines(summary)
    doubted = text_of(table_of(summary, "verdict"), "level") not in ("", "good")
    return [*(["\n  ".join(verdict)] if doubted else []), *other_warnings(summary)]


def plain(value: object) -> object:
    """Plain JSON types: no NumPy scalar, and null for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
