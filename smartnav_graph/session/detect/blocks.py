"""The inertial data in blocks of a tenth of a second: means, extremes and root mean squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Mask
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.session.streams import Imu

BLOCK_S = 0.1


@dataclass(frozen=True)
class Blocks:
    """Blocks of `BLOCK_S` seconds from the first inertial sample on; NaN where a block has no sample.

    accel, gyro (b, 3) means; norm, rate (b,) largest | |a| - g | and |w|; rms_norm, rms_rate (b,) their root mean
    squares; whole (b,) has samples and no gap; of (n,) block of each sample
    """

    accel: Floats
    gyro: Floats
    norm: Floats
    rate: Floats
    rms_norm: Floats
    rms_rate: Floats
    whole: Mask
    of: Indices

    @classmethod
    def of_samples(cls, imu: Imu, gaps: Sequence[Gap], gravity: float) -> Blocks:
        """The blocks of a recording; gravity in m/s^2."""
        of = (imu.t_ns - imu.t_ns[0]) // round(BLOCK_S * NS)
        used, starts, count = np.unique(of, return_index=True, return_counts=True)
        norm, rate = np.abs(np.linalg.norm(imu.accel, axis=1) - gravity), np.linalg.norm(imu.gyro, axis=1)
        size = int(used[-1]) + 1

        def spread(values: Floats) -> Floats:
            out = np.full((size, *values.shape[1:]), np.nan)
            out[used] = values
            return out

        def mean(rows: Floats) -> Floats:
            return np.asarray((np.add.reduceat(rows, starts).T / count).T)

        whole = np.zeros(size, dtype=bool)
        whole[used] = True
        for gap in gaps:
            first, last = (np.array([gap.start_ns, gap.end_ns]) - imu.t_ns[0]) // round(BLOCK_S * NS)
            whole[first : last + 1] = False
        return cls(
            accel=spread(mean(imu.accel)),
            gyro=spread(mean(imu.gyro)),
            norm=spread(np.maximum.reduceat(norm, starts)),
            rate=spread(np.maximum.reduceat(rate, starts)),
            rms_norm=spread(np.sqrt(mean(norm**2))),
            rms_rate=spread(np.sqrt(mean(rate**2))),
            whole=whole,
            of=of,
        )
