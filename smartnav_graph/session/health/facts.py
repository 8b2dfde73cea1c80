"""What the rules share: a finding, and quantities of one session that several rules need."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Mask, Times, runs
from smartnav_graph.core.timebase import NS, Gap, interpolate
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned, Stream
from smartnav_graph.session.streams import STREAMS, Imu

AIDING = tuple(name for name, kind in STREAMS.items() if kind.AIDING)
LEAST_ROWS = 10  # shorter streams are not checked
CHORD_S = 4.0  # s between the fixes of a speed
_SPEEDS = {3.6: "km/h", 1.944: "knots", 2.237: "mph", 3.281: "ft/s", 100.0: "cm/s", 1000.0: "mm/s"}
_NEAR = 0.06  # of a unit's factor
_TOGETHER = 50  # rows that may arrive together
_SPIKE_ROWS = 200
_ODD = 1.3  # a factor that slip or tyres do not explain


@dataclass(frozen=True)
class Finding:
    """One finding. level is ``error`` (no estimation possible), ``warning`` (looks wrong) or ``info``.

    verdict : what a warning makes of a run: ``good``, where the estimate takes account of it, ``doubtful``, or
    ``contradictory``, where the geometry of a sensor is wrong
    size : of the fault, in the unit of the text; start_ns, end_ns : where it is, where it is not everywhere
    convert : field of the stream `where` that is in another unit, and the factor to the right one
    """

    where: str
    text: str
    remedy: str = ""
    level: str = "warning"
    verdict: str = "doubtful"
    size: float | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    convert: tuple[str, float] | None = None

    def __str__(self) -> str:
        return f"{self.where}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class Chords:
    """Motion between fixes some seconds apart: stamps (n,) of their middle and velocity (n, 3) m/s, nav axes; sigma
    (n,) m/s of the horizontal velocity."""

    t_ns: Times
    velocity: Floats
    sigma: Floats

    @property
    def speed(self) -> Floats:
        """Horizontal speed (n,) m/s."""
        return np.asarray(np.linalg.norm(self.velocity[:, :2], axis=1))

    @property
    def clear(self) -> Mask:
        """Mask (n,) of the chords whose motion exceeds the noise."""
        return np.asarray(self.speed > np.maximum(2.0, 4.0 * self.sigma))


@dataclass(frozen=True)
class Facts:
    """Quantities of one session that several rules need."""

    session: Session
    gaps: tuple[Gap, ...]
    quiet_accel: float | None

    @property
    def imu(self) -> Imu | None:
        """The inertial stream when it is long enough to be checked."""
        imu = self.session.imu
        return imu if imu is not None and len(imu) >= LEAST_ROWS else None

    @cached_property
    def chords(self) -> Chords | None:
        """Motion between the fixes, of GNSS or else of pose fixes; None where they are too few."""
        stream = self.session.gnss if self.session.gnss is not None else self.session.pose_fixes
        if stream is None or len(stream) < 3:
            return None
        t_ns, p, sigma = stream.t_ns, self.session.nav_position(stream), fix_sigma(stream)
        other = np.searchsorted(t_ns, t_ns + round(CHORD_S * NS))
        first = np.flatnonzero(other < len(t_ns))
        last = other[first]
        length = (t_ns[last] - t_ns[first]) / NS
        whole = length < 2.0 * CHORD_S
        first, last, length = first[whole], last[whole], length[whole]
        if len(first) < 3:
            return None
        middle = t_ns[first] + (t_ns[last] - t_ns[first]) // 2
        return Chords(middle, (p[last] - p[first]) / length[:, None], np.hypot(sigma[last], sigma[first]) / length)


def fix_sigma(stream: Positioned) -> Floats:
    """Horizontal sigma (n,) m of fixes, 5 m where none is given."""
    if stream.sigma is None:
        return np.full(len(stream), 5.0)
    return np.asarray(np.linalg.norm(np.nan_to_num(stream.sigma[:, :2], nan=5.0), axis=1))


def in_another_unit(where: str, text: str, remedy: str, field: str, factor: float) -> Finding:
    """The finding of readings whose unit is known: converted on request, else not used."""
    return Finding(where, text, f"{remedy}, or add --repair units", convert=(field, factor))


def odd_speed(where: str, what: str, measured: Floats, known: Floats) -> Iterator[Finding]:
    """Speeds (n,) of a sensor, its field `what`, against those known from elsewhere (n,) m/s."""
    if len(measured) < LEAST_ROWS:
        return
    factor = float(np.median(measured / known))
    scatter = float(np.median(np.abs(measured / known - factor)))
    if 1.0 / _ODD < factor < _ODD or scatter > 0.3 * abs(factor):
        return
    text = f"{what} is {factor:.3g} times the speed of the fixes"
    for known_factor, unit in _SPEEDS.items():
        if abs(factor / known_factor - 1.0) < _NEAR:
            yield in_another_unit(where, f"{text}: it looks like {unit}", "give m/s", what, 1.0 / known_factor)
            return
    yield Finding(where, text, f"divide {what} by {factor:.4g}")


def over_chords(chords: Chords, t_ns: Times, values: Floats) -> Floats:
    """Means of a sampled signal (n,) or (n, k) over the time of each chord, by its integral."""
    dt = np.diff(t_ns, prepend=t_ns[0])[:, None] / NS
    rows = values.reshape(len(t_ns), -1)
    integral = np.cumsum(rows * dt, axis=0)
    half = round(0.5 * CHORD_S * NS)
    begin, end = (np.clip(chords.t_ns + shift, t_ns[0], t_ns[-1]) for shift in (-half, half))
    whole = interpolate(end, t_ns, integral) - interpolate(begin, t_ns, integral)
    mean = whole / np.maximum((end - begin) / NS, 1e-9)[:, None]
    return np.asarray(mean.reshape(-1, *values.shape[1:]))


def repeats(values: Floats) -> list[tuple[int, int]]:
    """First and last row of every stretch in which a signal (n,) or (n, k) repeats itself exactly."""
    rows = values.reshape(len(values), -1)
    return [(int(i), int(j)) for i, j in runs((rows[1:] == rows[:-1]).all(axis=1))]


def spike_rows(values: Floats, least: float) -> Indices:
    """Rows of a signal (n, k) that differ from their four neighbours by more than twenty times what 99 of 100 readings
    do, and by more than `least`, what a device can do from one sample to the next and back."""
    if len(values) < _SPIKE_ROWS:
        return np.zeros(0, dtype=np.int64)
    a, b, c, d = values[:-4], values[1:-3], values[3:-1], values[4:]
    lower, upper = np.minimum(a, b), np.minimum(c, d)
    high, low = np.maximum(a, b), np.maximum(c, d)
    least_of, most_of = np.minimum(lower, upper), np.maximum(high, low)
    median = 0.5 * (np.maximum(lower, upper) + np.minimum(high, low))
    apart = np.abs(values[2:-2] - median).max(axis=1)
    limit = max(least, 20.0 * float(np.quantile(apart, 0.99)))
    return np.asarray(2 + np.flatnonzero((apart > limit) & (apart > 5.0 * (most_of - least_of).max(axis=1))))


def count_of(n: int, noun: str, plural: str = "s") -> str:
    """``2 jumps``."""
    return f"{n} {noun}{'' if n == 1 else plural}"


def period(stream: Stream) -> float:
    """Median step of the stamps, s; over some rows, which may arrive together."""
    stride = min(_TOGETHER, len(stream) - 1)
    return float(np.median(stream.t_ns[stride:] - stream.t_ns[:-stride])) / stride / NS


def decimated(imu: Imu) -> Imu:
    """Every n-th row, to 50 Hz: enough for steps and turns."""
    every = min(max(1, round(0.02 / period(imu))), max(1, len(imu) // LEAST_ROWS))
    return imu.take(slice(None, None, every)) if every > 1 else imu
