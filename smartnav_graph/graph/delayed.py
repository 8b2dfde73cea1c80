"""Rows that become known after the time they speak of, in replay.

A row with `arrival_ns` after its own stamp makes no keyframe at that stamp, as nobody knew of it then, but one as it
arrives. It is handed to the window that ends there, together with the window it speaks of. Batch knows everything and
has no late rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.graph.windows import DelayedRow, Window
from smartnav_graph.session.streams import Stream


def is_late(stream: Stream, merge_ns: int) -> NDArray[np.bool_]:
    """Mask (n,) of the rows that became known more than `merge_ns` after their time."""
    return stream.available_ns - stream.t_ns > merge_ns


def arrange(
    windows: Sequence[Window], streams: Mapping[str, Stream], merge_ns: int
) -> tuple[list[Window], dict[str, int]]:
    """The windows with every late row moved to the one in which it arrives; how many never arrive, by stream."""
    masks = {name: mask for name, stream in streams.items() if (mask := is_late(stream, merge_ns)).any()}
    if not masks:
        return list(windows), {}
    ends = np.array([window.t1_ns for window in windows], dtype=np.int64)
    late: list[dict[str, list[DelayedRow]]] = [{} for _ in windows]
    lost: dict[str, int] = {}
    for name, mask in masks.items():
        rows, stamps, known = np.flatnonzero(mask), streams[name].t_ns, streams[name].available_ns
        rows = rows[np.argsort(known[rows], kind="stable")]
        arrives = np.searchsorted(ends, known[rows])
        speaks = np.searchsorted(ends, stamps[rows], side="right")
        if (count := int((arrives == len(ends)).sum())) > 0:
            lost[name] = count
        for row, k, j in zip(rows.tolist(), arrives.tolist(), speaks.tolist(), strict=True):
            if k < len(ends):
                late[k].setdefault(name, []).append(DelayedRow(row, int(stamps[row]), windows[j]))
    return [_arranged(window, late[k], masks) for k, window in enumerate(windows)], lost


def _arranged(
    window: Window, late: Mapping[str, Sequence[DelayedRow]], masks: Mapping[str, NDArray[np.bool_]]
) -> Window:
    """One window without the rows that are not known at its end, with those that arrive in it."""
    rows = {name: found[~masks[name][found]] if name in masks else found for name, found in window.rows.items()}
    return replace(window, rows={name: found for name, found in rows.items() if len(found)}, late=late)


def forget(windows: Sequence[Window], streams: Mapping[str, Stream], now_ns: int) -> list[Window]:
    """The windows without the rows that were not known yet at `now_ns`."""
    masks = {name: stream.available_ns > now_ns for name, stream in streams.items()}
    return [_arranged(window, {}, masks) for window in windows]
