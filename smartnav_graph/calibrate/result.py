"""What a calibration returns: values, residuals, refusals, what changes in calibration.toml, and charts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from smartnav_graph.core.arrays import Floats
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Piece, Residual, Value


@dataclass(frozen=True)
class Series:
    """A line, dots, or a band from `y` to `upper`, over `x`: arrays (n,); `colour` is 0 to 4."""

    name: str
    x: Floats
    y: Floats
    mark: Literal["line", "dots", "band"] = "line"
    colour: int = 0
    upper: Floats | None = None


@dataclass(frozen=True)
class Chart:
    """A figure of the report, drawn by `output.report.calibration`; `aspect` (width / height) for equal scales."""

    title: str
    x_title: str
    y_title: str
    series: Sequence[Series]
    log: bool = False
    aspect: float | None = None
    note: str = ""


def unchanged(calibration: Calibration) -> Calibration:
    """What a calibration changes that has nothing for the estimation."""
    return calibration


@dataclass(frozen=True)
class CalibrationResult:
    """What one calibration found.

    values, residuals : by name, e.g. ``gyro_bias_x``
    refused : name of a term -> why the data do not support it, and what to record instead
    warnings : what may be wrong with the recording, each with its remedy
    change : a calibration -> the same with the keys that the estimation uses, as found
    order, covariance : names and row-major covariance of correlated values
    """

    values: Mapping[str, Value]
    residuals: Mapping[str, Residual] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    change: Callable[[Calibration], Calibration] = unchanged
    charts: tuple[Chart, ...] = ()
    order: tuple[str, ...] = ()
    covariance: tuple[float, ...] = ()

    def piece(self, date: str, sources: Sequence[str]) -> Piece:
        """The record for calibration.toml."""
        return Piece(
            *(date, tuple(sources), self.values, self.residuals, self.refused, self.warnings),
            *(self.order, self.covariance),
        )

    def merged(self, into: Calibration, kind: str, date: str, sources: Sequence[str]) -> Calibration:
        """The calibration `into` with what was found; other pieces stay as they are."""
        pieces = {**into.pieces, kind: self.piece(date, sources)}
        return replace(self.change(into), pieces=pieces)
