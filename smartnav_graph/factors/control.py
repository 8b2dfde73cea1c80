"""Surveyed points the sensor head stood on: position factors with the point's own sigma and lever arm."""

from __future__ import annotations

from dataclasses import dataclass

from smartnav_graph.errors import ConfigError


@dataclass(frozen=True)
class ControlConfig:
    """default_sigma : m, of points that carry none."""

    default_sigma: float = 0.05

    def __post_init__(self) -> None:
        if not self.default_sigma > 0:
            raise ConfigError("config [control]", f"default_sigma = {self.default_sigma}", "> 0 m")
