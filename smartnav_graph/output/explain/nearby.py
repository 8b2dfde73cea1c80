"""What lies near an epoch: gaps, rejections, standstills, measurements in use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import seconds_since
from smartnav_graph.evaluation.influence import CALIBRATION, Measurements
from smartnav_graph.output.run_folder import StoredRun
from smartnav_graph.output.summary_json import Summary, as_float, imu_gaps, rows_of, standstill_spans, text_of
from smartnav_graph.session.streams import POSITIONS

# Without fixes for longer than so many of their median periods, and so many seconds, is an outage.
PERIODS, LEAST_S = 3.0, 1.0


@dataclass(frozen=True)
class Span:
    """A time span: start and length in s; away_s: from the epoch to it, negative if it is earlier, zero inside."""

    start_s: float
    length_s: float
    away_s: float
    kind: str


@dataclass(frozen=True)
class Neighbours:
    """Measurements of one source in use: seconds to the last one before (or at) the instant and to the next one after,
    None where there is none."""

    before_s: float | None
    after_s: float | None


@dataclass(frozen=True)
class Rejection:
    """One rejected measurement: time and distance in time to the epoch, s; size in sigmas and, where known, in m."""

    sensor: str
    t_s: float
    away_s: float
    size_sigma: float | None
    size_m: float | None

    @classmethod
    def of(cls, row: Summary, t_s: float) -> Rejection:
        """A row of the `rejections` of a summary, seen from `t_s`."""
        at = as_float(row.get("t_s")) or 0.0
        sizes = (as_float(row.get(name)) for name in ("size_sigma", "size_m"))
        return cls(text_of(row, "sensor"), at, round(at - t_s, 4), *sizes)


@dataclass(frozen=True)
class Nearby:
    """The nearest of each kind, None where the run has none; used: by source; outages: of the position fixes, by
    source, from the last one before the instant to the next one, s, None where there is none."""

    gap: Span | None
    standstill: Span | None
    rejection: Rejection | None
    used: Mapping[str, Neighbours]
    outages: Mapping[str, tuple[float | None, float | None]]


def nearby(run: StoredRun, measurements: Measurements, t_s: float) -> Nearby:
    """Around `t_s` seconds after time zero."""
    standstills = [(start, end - start, "standstill") for start, end in standstill_spans(run.summary)]
    rejected = [Rejection.of(row, t_s) for row in rows_of(run.summary, "rejections")]
    seconds = seconds_since(measurements.t_ns, run.solution.t0_ns)
    names = sorted({str(name) for name in measurements.source[~measurements.part]} - {"imu", "prior", CALIBRATION})
    by_name = {name: seconds[(measurements.source == name) & ~measurements.part] for name in names}
    outages = {name: _outage(by_name[name], t_s) for name in POSITIONS if name in by_name and name != "control"}
    return Nearby(
        gap=_nearest(imu_gaps(run.summary), t_s),
        standstill=_nearest(standstills, t_s),
        rejection=min(rejected, key=lambda one: abs(one.away_s), default=None),
        used={name: _neighbours(times, t_s) for name, times in by_name.items()},
        outages={name: span for name, span in outages.items() if span is not None},
    )


def _nearest(spans: Sequence[tuple[float, float, str]], t_s: float) -> Span | None:
    found = [
        Span(start, length, round(max(start - t_s, 0.0) - max(t_s - start - length, 0.0), 4), kind)
        for start, length, kind in spans
    ]
    return min(found, key=lambda one: abs(one.away_s), default=None)


def _neighbours(seconds: Floats, t_s: float) -> Neighbours:
    before, after = t_s - seconds[seconds <= t_s + 1e-6], seconds[seconds > t_s + 1e-6] - t_s
    nearest = [round(max(float(side.min()), 0.0), 4) if len(side) else None for side in (before, after)]
    return Neighbours(*nearest)


def _outage(seconds: Floats, t_s: float) -> tuple[float | None, float | None] | None:
    """The ends of the time without fixes around an instant, where it is longer than usual."""
    times = np.unique(seconds)
    limit = max(LEAST_S, PERIODS * float(np.median(np.diff(times)))) if len(times) > 1 else LEAST_S
    near = _neighbours(times, t_s)
    if near.before_s == 0.0 or sum(side or 0.0 for side in (near.before_s, near.after_s)) <= limit:
        return None
    before = None if near.before_s is None else round(t_s - near.before_s, 4)
    return before, None if near.after_s is None else round(t_s + near.after_s, 4)
