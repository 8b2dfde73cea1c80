"""Steps of a pedestrian from the specific force, and the length travelled up to any time.

The magnitude of the specific force, low-passed and less its mean, swings once a step. A step ends where it rises
again; its length in units of the step factor is Weinberg's (max - min)^(1/4). A result at t depends on data up to
t + `LOOKAHEAD_S`.

Source: Weinberg (2002), Using the ADXL202 in pedometer and personal navigation applications, AN-602.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Times
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.session.streams import Imu

RATE_HZ = 50.0
CUTOFF_HZ = 3.0  # people walk at 1.4 to 2.5 steps per second
HALF_S = 0.2  # half length of the low-pass filter
MEAN_S = 2.0  # the mean of so many seconds before is subtracted
RISE = 0.2  # m/s^2 above the mean that ends a step, after as much below it
LEAST_SWING = 0.75  # m/s^2 from the least to the largest: a slow pedestrian who writes swings by 1
SHORTEST_S, LONGEST_S = 0.25, 0.75  # of a step: what lies longer before its end is no part of it
LONGEST_PERIOD_S, RUN, RATIO = 1.0, 6, 0.25  # of a regular walk: seconds per step, steps in a row, change of period
LOOKAHEAD_S = HALF_S + 1.0 / RATE_HZ + LONGEST_S


@dataclass(frozen=True)
class Steps:
    """Steps in time order: start_ns (n,), end_ns (n,) what each spans; swing (n,) m/s^2, its largest minus its
    smallest force."""

    start_ns: Times
    end_ns: Times
    swing: Floats

    def __len__(self) -> int:
        return len(self.end_ns)

    @property
    def length(self) -> Floats:
        """(n,) Weinberg's length, metres once multiplied by a step factor of about 0.45."""
        return np.asarray(self.swing**0.25)

    @cached_property
    def _knots(self) -> tuple[Times, Floats]:
        """Where the travelled length bends, and its values there."""
        total = np.cumsum(self.length)
        values = np.stack([total - self.length, total], axis=1).ravel()
        return np.stack([self.start_ns, self.end_ns], axis=1).ravel(), values

    def travelled(self, t_ns: Times) -> Floats:
        """Length of all steps up to the stamps (m,), each growing evenly over its span."""
        knots, values = self._knots
        if not len(knots):
            return np.zeros(len(t_ns))
        zero = int(knots[0])  # nanoseconds since 1970 would lose their last digits as floats
        return np.asarray(np.interp((t_ns - zero) / NS, (knots - zero) / NS, values))

    @cached_property
    def regular_seconds(self) -> Floats:
        """Seconds (n,) up to the end of each step that were spent in runs of at least `RUN` steps whose periods hardly
        differ: nearly all of them for a device in the hand of a pedestrian, hardly any in a vehicle or on a foot."""
        period = np.diff(self.end_ns) / NS
        usual = period <= LONGEST_PERIOD_S
        alike = np.abs(np.diff(np.log(period))) < np.log(1.0 + RATIO)
        joined = np.concatenate([[False], usual[1:] & usual[:-1] & alike])
        found, before, count, length = [0.0], 0.0, 0, 0.0  # earlier runs; steps and seconds of the present one
        for seconds, goes_on in zip(period.tolist(), joined.tolist(), strict=False):
            if not goes_on:
                before += length if count >= RUN else 0.0
                count, length = 1, 0.0
            count, length = count + 1, length + seconds
            found.append(before + (length if count >= RUN else 0.0))
        return np.array(found[: len(self)])


def find_steps(imu: Imu) -> Steps:
    """The steps of a recording."""
    force = _swinging(imu)
    end = _rises(force)
    begin = np.maximum(np.concatenate([[0], end[:-1]]), end - round(LONGEST_S * RATE_HZ))
    swing = np.array([np.ptp(force[i : j + 1]) for i, j in zip(begin, end, strict=True)])
    step = swing >= LEAST_SWING
    stamps = imu.t_ns[0] + ns_from_seconds(np.arange(len(force)) / RATE_HZ)
    return Steps(stamps[begin[step]], stamps[end[step]], swing[step])


def _swinging(imu: Imu) -> Floats:
    """|specific force| (n,) m/s^2 at `RATE_HZ` from the first sample on: low-passed, less its mean so far."""
    from scipy.signal import firwin

    seconds = (imu.t_ns - imu.t_ns[0]) / NS
    grid = np.arange(0.0, seconds[-1], 1.0 / RATE_HZ)
    size = np.interp(grid, seconds, np.linalg.norm(imu.accel, axis=1))
    half, span = round(HALF_S * RATE_HZ), round(MEAN_S * RATE_HZ)
    taps = firwin(2 * half + 1, CUTOFF_HZ, fs=RATE_HZ)
    smooth = np.convolve(np.pad(size, half, mode="edge"), taps, mode="valid")
    total = np.cumsum(np.concatenate([np.zeros(1), np.full(span, STANDARD_GRAVITY), smooth]))
    return np.asarray(smooth - (total[span:-1] - total[: -span - 1]) / span)


def _rises(force: Floats) -> Indices:
    """Samples where the force rises above `RISE`, each after a fall below -`RISE` and at least `SHORTEST_S` after the
    one before."""
    found: list[int] = []
    low = False
    for k, value in enumerate(force.tolist()):
        if value < -RISE:
            low = True
        elif value > RISE and low:
            low = False
            if not found or k - found[-1] >= SHORTEST_S * RATE_HZ:
                found.append(k)
    return np.array(found, dtype=np.intp)
