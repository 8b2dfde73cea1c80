"""Steps of a walker from the specific force, and how far they carry up to any time.

The magnitude of the specific force, low-passed and freed of its mean, swings once a step. A step spans two upward
swings; its length in units of the step factor is Weinberg's (max - min)^(1/4). Everything known at t rests on data up
to t + `LOOKAHEAD_S`.

Source: Weinberg (2002), Using the ADXL202 in pedometer and personal navigation applications, AN-602.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import firwin

from smartnav_graph.frames import STANDARD_GRAVITY
from smartnav_graph.streams import Imu
from smartnav_graph.timebase import NS, Times, ns_from_seconds

Floats = NDArray[np.float64]

RATE_HZ = 50.0
CUTOFF_HZ = 3.0  # people make 1.4 to 2.5 steps a second
HALF_S = 0.2  # half length of the low-pass filter
MEAN_S = 2.0  # the mean of so many seconds before is taken off
SWING = 0.4  # m/s^2 above and below the mean that a step exceeds; a hand that stands trembles by less
SHORTEST_S, LONGEST_S = 0.25, 1.2
# A step is spread over at most so much of its end, so that it is known in time.
SPREAD_S = 0.75
LOOKAHEAD_S = HALF_S + 1.0 / RATE_HZ + SPREAD_S


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

    def travelled(self, t_ns: Times) -> Floats:
        """Length of all steps up to the stamps (m,), each growing evenly over the last `SPREAD_S` of its span."""
        begin = np.maximum(self.start_ns, self.end_ns - round(SPREAD_S * NS))
        total = np.cumsum(self.length)
        knots = np.stack([begin, self.end_ns], axis=1).ravel()
        values = np.stack([total - self.length, total], axis=1).ravel()
        if not len(knots):
            return np.zeros(len(t_ns))
        zero = int(knots[0])  # nanoseconds since 1970 would lose their last digits as floats
        return np.asarray(np.interp((t_ns - zero) / NS, (knots - zero) / NS, values))


def find_steps(imu: Imu) -> Steps:
    """The steps of a recording."""
    force = _swinging(imu)
    up = _upward(force)
    stamps = imu.t_ns[0] + ns_from_seconds(np.arange(len(force)) / RATE_HZ)
    begin, end = up[:-1], up[1:]
    whole = (end - begin) <= LONGEST_S * RATE_HZ
    begin, end = begin[whole], end[whole]
    swing = np.array([np.ptp(force[i : j + 1]) for i, j in zip(begin, end, strict=True)])
    return Steps(stamps[begin], stamps[end], swing)


def _swinging(imu: Imu) -> Floats:
    """|specific force| (n,) m/s^2 at `RATE_HZ` from the first sample on: low-passed, less its mean so far."""
    seconds = (imu.t_ns - imu.t_ns[0]) / NS
    grid = np.arange(0.0, seconds[-1], 1.0 / RATE_HZ)
    size = np.interp(grid, seconds, np.linalg.norm(imu.accel, axis=1))
    half, span = round(HALF_S * RATE_HZ), round(MEAN_S * RATE_HZ)
    taps = firwin(2 * half + 1, CUTOFF_HZ, fs=RATE_HZ)
    smooth = np.convolve(np.pad(size, half, mode="edge"), taps, mode="valid")
    total = np.cumsum(np.concatenate([np.zeros(1), np.full(span, STANDARD_GRAVITY), smooth]))
    return np.asarray(smooth - (total[span:-1] - total[: -span - 1]) / span)


def _upward(force: Floats) -> NDArray[np.intp]:
    """Samples where the force rises above `SWING`, each after a fall below -`SWING` and at least `SHORTEST_S` after the
    one before."""
    found: list[int] = []
    low = True
    for k, value in enumerate(force.tolist()):
        if value < -SWING:
            low = True
        elif value > SWING and low:
            low = False
            if not found or k - found[-1] >= SHORTEST_S * RATE_HZ:
                found.append(k)
    return np.array(found, dtype=np.intp)
