"""Measurements + config -> the windows between keyframes.

Keyframes are at the union of aiding epochs, at borders of gaps and standstills, and nowhere further apart than a
maximum spacing or turn. Inertial data are cut at keyframes by linear interpolation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Times
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS, Gap, interpolate, ns_from_seconds
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.streams import Imu

NOWHERE: Times = np.zeros(0, dtype=np.int64)


# Longest window inside a gap, s, or as a share of the gap: as fine as the error of what was not measured.
GAP_SPACING_S, GAP_SHARE = 0.5, 0.05
# Largest turn of a window, rad: the rotation vector that preintegration adds up is singular at a whole revolution.
MOST_TURN = 0.5 * np.pi


@dataclass(frozen=True)
class KeyframeConfig:
    """max_spacing_s : longest window outside data gaps; merge_s : aiding epochs closer than this share a keyframe;
    lead_s : how far keyframes reach beyond the first and the last absolute measurement.
    """

    max_spacing_s: float = 1.0
    merge_s: float = 1e-4
    lead_s: float = 60.0

    def __post_init__(self) -> None:
        if not (self.max_spacing_s > 0 and 0 <= self.merge_s < self.max_spacing_s and self.lead_s >= 0):
            raise ConfigError(
                "config [keyframes]",
                f"max_spacing_s = {self.max_spacing_s}, merge_s = {self.merge_s}",
                "max_spacing_s > merge_s >= 0 seconds",
            )


def keyframe_times(
    span_ns: tuple[int, int],
    aiding: Sequence[Times],
    gaps: Sequence[Gap],
    config: KeyframeConfig,
    standstills: Times = NOWHERE,
    *,
    causal: bool = False,
) -> Times:
    """Strictly increasing keyframe stamps (n,) from span_ns[0] to span_ns[1].

    An aiding epoch replaces every other stamp closer to it than `merge_s`.
    `standstills` are the stamps that standstills ask for: their borders, and what lies between. `causal` : a
    stamp does not depend on when the next measurement comes.
    """
    start, end = span_ns
    merge = int(config.merge_s * NS)
    borders = [b for gap in gaps for b in (gap.start_ns, gap.end_ns)]
    aided = np.unique(np.concatenate([np.zeros(0, np.int64), *aiding]))
    aided = aided[(aided >= start) & (aided <= end)]
    aided = _apart(aided, merge)
    rest = np.unique(np.concatenate([np.array([start, end, *borders], dtype=np.int64), standstills]))
    rest = rest[(rest >= start) & (rest <= end)]
    if len(aided):
        right = np.clip(np.searchsorted(aided, rest), 1, len(aided)) - 1
        near = np.minimum(np.abs(rest - aided[right]), np.abs(rest - aided[np.minimum(right + 1, len(aided) - 1)]))
        rest = rest[near > merge]
    fixed = np.union1d(aided, rest)
    return np.union1d(fixed, _fill(fixed, gaps, config.max_spacing_s, causal=causal))


def _apart(times: Times, merge: int) -> Times:
    """Those of increasing stamps that are further than `merge` ns from the last one kept."""
    if not (np.diff(times) <= merge).any():
        return times
    kept = times[:1].tolist()
    for stamp in times.tolist():
        if stamp - kept[-1] > merge:
            kept.append(stamp)
    return np.array(kept, dtype=np.int64)


def _fill(fixed: Times, gaps: Sequence[Gap], spacing_s: float, *, causal: bool) -> Times:
    """Evenly spaced stamps between those of `fixed` that are too far apart; `causal` : outside gaps, `spacing_s`
    after each other until the next comes."""
    length = np.diff(fixed)
    spacing = np.full(length.shape, spacing_s)
    for gap in gaps:
        spacing[inside([gap], fixed[:-1] + length // 2)] = max(GAP_SPACING_S, GAP_SHARE * gap.length_s)
    parts = np.maximum(np.ceil(length / NS / spacing - 1e-9).astype(np.int64), 1)
    apart = np.where(causal & (spacing == spacing_s), spacing_s, length / NS / parts)
    pieces = [
        ns_from_seconds(np.arange(1, n) * step) + begin
        for begin, step, n in zip(fixed[:-1], apart, parts, strict=True)
        if n > 1
    ]
    return np.concatenate([np.zeros(0, np.int64), *pieces])


def turn_times(times: Times, imu: Imu) -> Times:
    """Stamps (m,) of samples that part windows between `times` (n,) of more than `MOST_TURN`; one depends on earlier
    samples only."""
    step = 0.5 * np.diff(imu.t_ns)[:, None] / NS
    turn = np.concatenate([np.zeros((1, 3)), np.cumsum(step * (imu.gyro[1:] + imu.gyro[:-1]), axis=0)])
    edges, start = np.searchsorted(imu.t_ns, times), interpolate(times, imu.t_ns, turn)
    window = np.repeat(np.arange(len(times) - 1), np.diff(edges))
    wide = np.linalg.norm(turn[edges[0] : edges[-1]] - start[window], axis=1) > MOST_TURN
    found: list[int] = []
    for k in np.unique(window[wide]):
        last, at = start[k], edges[k]
        while len(over := np.flatnonzero(np.linalg.norm(turn[at : edges[k + 1]] - last, axis=1) > MOST_TURN)):
            at += max(over[0] - 1, 0)
            found.append(int(imu.t_ns[at]))
            last, at = turn[at], at + 1
    return np.array(found, dtype=np.int64)


def inside(spans: Sequence[Gap], t_ns: Times) -> NDArray[np.bool_]:
    """Mask (n,) of the stamps strictly inside one of `spans`."""
    mask = np.zeros(t_ns.shape, dtype=bool)
    for span in spans:
        mask |= (t_ns > span.start_ns) & (t_ns < span.end_ns)
    return mask


def make_windows(
    imu: Imu,
    times: Times,
    gaps: Sequence[Gap],
    aiding: Mapping[str, Times],
    config: KeyframeConfig,
    standstills: Sequence[tuple[int, int]] = (),
) -> list[Window]:
    """One window a keyframe; the first has no length.

    Parameters
    ----------
    times : (n,) keyframe stamps inside the inertial span
    gaps : stretches whose windows are of kind ``gap``
    standstills : first and last stamp of each; windows wholly inside one are of kind ``static``
    aiding : stamps of every aiding stream; each row goes to the keyframe it shares its epoch with
    """
    grid = np.sort(np.concatenate([imu.t_ns[(imu.t_ns > times[0]) & (imu.t_ns < times[-1])], times]), kind="stable")
    grid = grid[np.concatenate([[True], np.diff(grid) > 0])]
    samples = interpolate(grid, imu.t_ns, np.concatenate([imu.accel, imu.gyro], axis=1))
    means = 0.5 * (samples[1:] + samples[:-1])
    dt = np.diff(grid) / NS
    # Preintegration turns the force by the attitude at the interval's start; half the turn of the interval is missing.
    means[:, :3] += 0.5 * dt[:, None] * np.cross(means[:, 3:], means[:, :3])
    cut = np.searchsorted(grid, times)
    kinds = _kinds(times, gaps, standstills)
    rows = _rows_by_keyframe(times, aiding, int(config.merge_s * NS))

    windows = []
    for k, kind in enumerate(["first", *kinds]):
        before = max(k - 1, 0)
        span, part = (int(times[before]), int(times[k])), slice(cut[before], cut[k])
        windows.append(Window(k, *span, kind, dt[part], means[part, :3], means[part, 3:], rows.get(k, {})))
    return windows


def _kinds(times: Times, gaps: Sequence[Gap], standstills: Sequence[tuple[int, int]]) -> list[str]:
    """Kind of the window that ends at each keyframe but the first."""
    kinds = np.full(len(times) - 1, "normal", dtype=object)
    if standstills:
        start, end = np.array(standstills, dtype=np.int64).T
        at = np.searchsorted(start, times[:-1], side="right") - 1
        kinds[(at >= 0) & (times[1:] <= end[at])] = "static"
    kinds[inside(gaps, times[:-1] + np.diff(times) // 2)] = "gap"
    return list(kinds)


def _rows_by_keyframe(
    times: Times, aiding: Mapping[str, Times], merge_ns: int
) -> dict[int, dict[str, NDArray[np.intp]]]:
    table: dict[int, dict[str, NDArray[np.intp]]] = {}
    for sensor, stamps in aiding.items():
        right = np.clip(np.searchsorted(times, stamps), 0, len(times) - 1)
        left = np.maximum(right - 1, 0)
        keyframe = np.where(np.abs(stamps - times[left]) < np.abs(times[right] - stamps), left, right)
        near = np.abs(stamps - times[keyframe]) <= merge_ns
        for row in np.flatnonzero(near):
            slot = table.setdefault(int(keyframe[row]), {})
            slot[sensor] = np.append(slot.get(sensor, np.zeros(0, np.intp)), row)
    return table
