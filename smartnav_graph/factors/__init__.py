"""Factors: one file = Config + model + builder. A new factor adds a file here and a row in BUILDERS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from smartnav_graph.calibration.model import Calibration, GnssNoise
from smartnav_graph.factors.control import ControlConfig
from smartnav_graph.factors.gnss import GnssConfig, PositionBuilder
from smartnav_graph.factors.imu import ImuBuilder, ImuConfig, bridge_noise
from smartnav_graph.graph import Builder
from smartnav_graph.session import Session
from smartnav_graph.timebase import Gap


@dataclass(frozen=True)
class FactorContext:
    """What a builder may be made of."""

    session: Session
    calibration: Calibration
    gaps: Sequence[Gap]
    imu: ImuConfig
    gnss: GnssConfig
    control: ControlConfig


def _imu(context: FactorContext) -> Builder | None:
    imu, noise = context.session.require_imu(), context.calibration.imu_noise
    bridges = {gap.start_ns: bridge_noise(imu, context.gaps, gap.length_s, noise) for gap in context.gaps}
    return ImuBuilder(noise, context.session.gravity, context.gaps, bridges, context.imu)


def _gnss(context: FactorContext) -> Builder | None:
    stream = context.session.gnss
    if stream is None:
        return None
    return PositionBuilder.of(context.session, "gnss", stream, context.calibration.gnss_noise, context.gnss)


def _control(context: FactorContext) -> Builder | None:
    stream = context.session.control
    if stream is None:
        return None
    sigma = context.control.default_sigma
    config = replace(context.gnss, estimate_sigma=False, correlated=False)
    return PositionBuilder.of(context.session, "control", stream, GnssNoise(sigma, sigma), config)


# The inertial builder comes first: it predicts the state that the others refer to.
BUILDERS: Mapping[str, Callable[[FactorContext], Builder | None]] = {
    "imu": _imu,
    "gnss": _gnss,
    "control": _control,
}
ABSOLUTE = ("gnss", "control")
