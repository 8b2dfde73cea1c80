"""What a builder may be made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from smartnav_graph.calibration.model import Calibration
from smartnav_graph.factors import bridging
from smartnav_graph.factors.bridging import Bridge
from smartnav_graph.session import Session
from smartnav_graph.standstill import Standstills
from smartnav_graph.timebase import Gap


@dataclass(frozen=True)
class FactorContext:
    """The session without its withheld rows, the device's calibration, holes of the inertial data, what carries the
    device (none, car, trolley, foot), the options of all rooms (`config.Config`, which stands below this room), the
    standstills of the recording, and whether nothing may be learnt from what comes later (replay)."""

    session: Session
    calibration: Calibration
    gaps: Sequence[Gap]
    vehicle: str
    config: Any
    rests: Standstills | None = None
    causal: bool = False

    @cached_property
    def bridges(self) -> Mapping[int, Bridge]:
        """The bridge of every gap, by its start stamp."""
        noise = self.calibration.imu_noise
        return bridging.bridges(self.session.require_imu(), self.gaps, noise, causal=self.causal)

    @property
    def on_foot(self) -> bool:
        """Whether the device is mounted on a walking foot: its stances hold speed and tilt."""
        return self.rests is not None and self.rests.on_foot
