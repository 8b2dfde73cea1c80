"""Surveyed points under the sensor head: position factors with the point's own sigma and lever arm."""

from __future__ import annotations

from dataclasses import dataclass

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.gnss import GnssConfig, PositionBuilder
from smartnav_graph.session.calibration.model import GnssNoise


@dataclass(frozen=True)
class ControlConfig:
    """lever_arm_sigma : prior of the lever arm as a state, m (zero: taken as known)."""

    lever_arm_sigma: float = 0.0

    def __post_init__(self) -> None:
        if self.lever_arm_sigma < 0:
            raise ConfigError("config [control]", f"lever_arm_sigma = {self.lever_arm_sigma}", ">= 0 m")


def build(context: FactorContext) -> PositionBuilder | None:
    """The builder of a session's surveyed points. Points are stamped by the clock of the device itself."""
    stream, options = context.session.control, context.options(ControlConfig)
    if stream is None:
        return None
    gnss = context.options(GnssConfig)
    config = GnssConfig(
        loss=gnss.loss,
        gate_probability=gnss.gate_probability,
        estimate_sigma=False,
        correlated=False,
        time_offset_sigma=0.0,
        lever_arm_sigma=options.lever_arm_sigma,
    )
    sigma = context.calibration.control_noise.position_sigma
    noise = GnssNoise(sigma, sigma)
    return PositionBuilder.of(context, "control", stream, noise, config)
