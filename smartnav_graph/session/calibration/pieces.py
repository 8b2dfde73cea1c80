"""The record of what a calibration found: values with sigma and unit, residuals, refused terms, date and sources.

calibration.toml has one table ``[pieces.KIND]`` for each kind of calibration that was done (schema 2)::

    [pieces.static]
    date = "2026-11-29"                 # of the recording where its clock is a date, else of the computation; UTC
    sources = ["static"]                # recordings
    [pieces.static.values.gyro_white_noise_x]
    value = 5.1e-05
    sigma = 2.0e-07                     # one standard deviation; nan where it is not known
    unit = "rad/s/sqrt(Hz)"
    [pieces.static.residuals.gyro_x]
    rms = 0.0005
    count = 216000
    unit = "rad/s"
    [pieces.static.refused]
    gyro_rate_ramp_x = "not significant: ..."

The keys that the estimation uses (``imu_errors``, ``imu_noise``, ``magnetometer_noise``, ``cameras``) are elsewhere in
the file, see `model`; the pieces say where they come from and how well they are known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Value:
    """A calibrated number with its standard deviation `sigma` (nan: not known) in `unit`."""

    value: float
    sigma: float = field(metadata={"nan": True})
    unit: str

    def interval(self, sigmas: float = 1.96) -> tuple[float, float]:
        """Limits of the interval of +- `sigmas` standard deviations, 95 % by default."""
        return self.value - sigmas * self.sigma, self.value + sigmas * self.sigma


@dataclass(frozen=True)
class Residual:
    """Root mean square `rms` in `unit` of `count` residuals."""

    rms: float
    count: int
    unit: str


@dataclass(frozen=True)
class Piece:
    """What one calibration found.

    values : by name; order : the names of `covariance`, row-major, where the values are correlated
    residuals : by name; refused : what the data do not support, with reason and remedy
    """

    date: str
    sources: tuple[str, ...]
    values: Mapping[str, Value] = field(default_factory=dict)
    residuals: Mapping[str, Residual] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    order: tuple[str, ...] = ()
    covariance: tuple[float, ...] = ()

    def difference(self, other: Piece) -> dict[str, tuple[float, float]]:
        """Of every value in both: other minus this one, and that over its sigma (nan where no sigma is known)."""
        found = {}
        for name, mine in self.values.items():
            theirs = other.values.get(name)
            if theirs is not None:
                change = theirs.value - mine.value
                sigma = math.hypot(mine.sigma, theirs.sigma)
                found[name] = (change, change / sigma if sigma > 0 else math.nan)
        return found
