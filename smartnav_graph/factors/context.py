"""What a builder may be made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import NS, Gap
from smartnav_graph.factors import gap_model
from smartnav_graph.factors.gap_model import Bridge
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.detect.heights import HeightLevels
from smartnav_graph.session.detect.standstills import Standstills
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.gyro_comparison import LINEAR_S, GyroComparison
from smartnav_graph.vision.pairs import Pairs

Section = TypeVar("Section")


@dataclass(frozen=True)
class FactorContext:
    """What the builders of one problem are made of.

    session : without its withheld rows; gaps : of the inertial data; vehicle : none, car, trolley or foot
    config : a dataclass whose fields are the sections of the configuration; see `options`
    rests : standstills of the recording; causal : replay, where nothing may be learned from later data
    pairs : image pairs of the session
    session_states_fixed : the smoother of a replay keeps session states at their initial values
    heights : levels of the heights of streams that have another datum, or more than one
    polished : a batch solution follows the replay
    camera_turns : the camera compared with the gyroscope, where it was
    """

    session: Session
    calibration: Calibration
    gaps: Sequence[Gap]
    vehicle: str
    config: object
    rests: Standstills | None = None
    causal: bool = False
    pairs: Pairs | None = None
    session_states_fixed: bool = False
    polished: bool = True
    heights: Mapping[str, HeightLevels] = field(default_factory=dict)
    camera_turns: GyroComparison | None = None

    def height_offsets(self, name: str, t_ns: Times) -> Floats:
        """What was taken (n,) m from the heights of a stream's rows."""
        found = self.heights.get(name)
        return np.zeros(len(t_ns)) if found is None else found.offset[found.of(t_ns)]

    def options(self, kind: type[Section]) -> Section:
        """The section of the configuration that is a `kind`, such as `GnssConfig`."""
        return next(section for section in vars(self.config).values() if isinstance(section, kind))

    @cached_property
    def bridges(self) -> Mapping[int, Bridge]:
        """The bridge of every gap, by its start stamp."""
        noise = self.calibration.imu_noise
        return gap_model.bridges(self.session.require_imu(), self.gaps, noise, causal=self.causal)

    @cached_property
    def bridged_imu(self) -> Imu:
        """The inertial data with a curve across every gap."""
        return gap_model.bridged(self.session.require_imu(), self.gaps, self.bridges)

    @cached_property
    def camera_name(self) -> str:
        """See `camera_name`."""
        return camera_name(self.session, self.calibration)

    @property
    def camera(self) -> Camera | None:
        """The calibration of that camera, where there is one."""
        return self.calibration.cameras.get(self.camera_name)

    @property
    def image_ns(self) -> Times:
        """Stamps of the keyframes at the images of the pairs, by the clock offset that is known."""
        if self.pairs is None:
            return np.zeros(0, dtype=np.int64)
        offset = 0.0 if self.camera is None else self.camera.time_offset_s
        return np.asarray(self.pairs.t_ns + round((offset + self.camera_offset_s) * NS))

    @property
    def camera_offset_s(self) -> float:
        """Offset (s) of the camera's clock beside the calibrated one, as the gyroscope shows it; zero where it is too
        small to matter, or not known."""
        found = self.camera_turns
        return found.offset_s if found is not None and found.known and abs(found.offset_s) > LINEAR_S else 0.0

    @property
    def on_foot(self) -> bool:
        """Whether the device is mounted on a walking foot: its stances hold speed and tilt."""
        return self.rests is not None and self.rests.on_foot


def camera_name(session: Session, calibration: Calibration | None) -> str:
    """The camera whose matches or tracks there are: that of the images, else the only one that is calibrated."""
    images, known = session.images, {} if calibration is None else calibration.cameras
    if images is not None and len(images):
        names, count = np.unique(images.camera.astype(str), return_counts=True)
        return str(names[np.argmax(count)])
    return next(iter(known), "camera")
