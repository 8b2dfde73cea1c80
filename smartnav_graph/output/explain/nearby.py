"""What lies around an instant: gaps, rejections, standstills, the measurements in use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.timebase import seconds_since
from smartnav_graph.evaluation.influence import CALIBRATION, Measurements
from smartnav_graph.output.run_folder import StoredRun


@dataclass(frozen=True)
class Stretch:
    """A stretch of time: start and length in s; away_s: from the instant, negative before it, zero inside."""

    start_s: float
    length_s: float
    away_s: float
    kind: str


@dataclass(frozen=True)
class Around:
    """Measurements of one source in use: seconds to the last one before (or at) the instant and to the next one after,
    None where there is none."""

    before_s: float | None
    after_s: float | None


@dataclass(frozen=True)
class Nearby:
    """The nearest of each kind, None where the run has none; rejection: a row of `rejections` with `away_s`."""

    gap: Stretch | None
    standstill: Stretch | None
    rejection: Mapping[str, Any] | None
    used: Mapping[str, Around]


def nearby(run: StoredRun, measurements: Measurements, t_s: float) -> Nearby:
    """Around `t_s` seconds after time zero."""
    told = run.summary
    gaps = [(gap["start_s"], gap["length_s"], str(gap["kind"])) for gap in told.get("gaps", ())]
    rests = [(a, b - a, "standstill") for a, b in told.get("standstills", {}).get("spans_s", ())]
    rejected = [dict(one) | {"away_s": round(one["t_s"] - t_s, 4)} for one in told.get("rejections", ())]
    seconds = seconds_since(measurements.t_ns, run.solution.t0_ns)
    names = sorted({str(name) for name in measurements.source} - {"imu", "prior", CALIBRATION})
    return Nearby(
        gap=_nearest(gaps, t_s),
        standstill=_nearest(rests, t_s),
        rejection=min(rejected, key=lambda one: abs(one["away_s"]), default=None),
        used={name: _around(seconds[measurements.source == name], t_s) for name in names},
    )


def _nearest(spans: Sequence[tuple[float, float, str]], t_s: float) -> Stretch | None:
    found = [
        Stretch(start, length, round(max(start - t_s, 0.0) - max(t_s - start - length, 0.0), 4), kind)
        for start, length, kind in spans
    ]
    return min(found, key=lambda one: abs(one.away_s), default=None)


def _around(seconds: NDArray[np.float64], t_s: float) -> Around:
    before, after = t_s - seconds[seconds <= t_s + 1e-6], seconds[seconds > t_s + 1e-6] - t_s
    nearest = [round(max(float(side.min()), 0.0), 4) if len(side) else None for side in (before, after)]
    return Around(*nearest)
