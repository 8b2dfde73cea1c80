"""Delayed measurements in replay: rows that become known after their measurement time.

A row with `arrival_ns` later than its timestamp makes no keyframe at that timestamp but one when it arrives. The window
that ends there gets it, together with the window of its measurement time. Batch knows all rows and delays none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from smartnav_graph.core.arrays import Mask
from smartnav_graph.graph.windows import DelayedRow, Window
from smartnav_graph.session.stream import Stream


def is_delayed(stream: Stream, merge_ns: int) -> Mask:
    """Mask (n,) of the rows that became known more than `merge_ns` after their time."""
    return np.asarray(stream.available_ns - stream.t_ns > merge_ns)


def assign(
    windows: Sequence[Window], streams: Mapping[str, Stream], merge_ns: int
) -> tuple[list[Window], dict[str, int]]:
    """The windows with every delayed row in the one in which it arrives; how many never arrive, by stream."""
    masks = {name: mask for name, stream in streams.items() if (mask := is_delayed(stream, merge_ns)).any()}
    if not masks:
        return list(windows), {}
    ends = np.array([window.t1_ns for window in windows], dtype=np.int64)
    arrived: list[dict[str, list[DelayedRow]]] = [{} for _ in windows]
    lost: dict[str, int] = {}
    for name, mask in masks.items():
        rows, stamps, known = np.flatnonzero(mask), streams[name].t_ns, streams[name].available_ns
        rows = rows[np.argsort(known[rows], kind="stable")]
        arrives = np.searchsorted(ends, known[rows])
        measured = np.searchsorted(ends, stamps[rows], side="right")
        if (count := int((arrives == len(ends)).sum())) > 0:
            lost[name] = count
        for row, k, j in zip(rows.tolist(), arrives.tolist(), measured.tolist(), strict=True):
            if k < len(ends):
                arrived[k].setdefault(name, []).append(DelayedRow(row, int(stamps[row]), windows[j]))
    return [_with_rows(window, arrived[k], masks) for k, window in enumerate(windows)], lost


def _with_rows(window: Window, arrived: Mapping[str, Sequence[DelayedRow]], unknown: Mapping[str, Mask]) -> Window:
    """A window without the rows that are unknown at its end, with those that arrive in it."""
    rows = {name: found[~unknown[name][found]] if name in unknown else found for name, found in window.rows.items()}
    return replace(window, rows={name: found for name, found in rows.items() if len(found)}, delayed=arrived)


def drop_unknown(windows: Sequence[Window], streams: Mapping[str, Stream], now_ns: int) -> list[Window]:
    """The windows without the rows that were still unknown at `now_ns`."""
    masks = {name: stream.available_ns > now_ns for name, stream in streams.items()}
    return [_with_rows(window, {}, masks) for window in windows]
