"""What builders that look through a camera share: where it sits, when it looks, and how the body moves meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.so3 import exp, rotate
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.coplanar_rows import Rig
from smartnav_graph.factors.gnss import clock_state
from smartnav_graph.graph.states import SessionState
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Imu

# States of the camera belong to this stream; the name of its correction in the body.
STREAM = "images"
BORESIGHT = "camera_boresight_rad"
FOCAL = "camera_focal_length_correction"
# A camera's clock offset (s) is looked up in the rates over at least so long; replay looks ahead by that.
AROUND_S = 0.005
# Least sigma (s) of a clock that the gyroscope shows.
LEAST_CLOCK_SIGMA_S = 0.002
# Used where no camera is calibrated: a phone's at 640 x 480.
UNKNOWN_CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


class BodyRates:
    """Turn of the body by the gyroscope as it was read, its bias included."""

    def __init__(self, imu: Imu) -> None:
        self._imu = imu

    def mean(self, t_ns: Times, offset_s: float) -> Floats:
        """Mean rates (m, 3) rad/s from stamps (m,) to an offset; around them where that is next to nothing."""
        start, end = (0.0, offset_s) if abs(offset_s) > AROUND_S else (-AROUND_S, AROUND_S)
        t = self._since(t_ns)
        return np.asarray((self._turned_by(t + end) - self._turned_by(t + start)) / (end - start))

    def turn(self, t_ns: Times, length_s: Floats) -> Floats:
        """Integral (m, 3) rad of the rate over `length_s` (m,) s from stamps (m,) on."""
        t = self._since(t_ns)
        return self._turned_by(t + length_s) - self._turned_by(t)

    def _since(self, t_ns: Times) -> Floats:
        return seconds_since(t_ns, int(self._imu.t_ns[0]))

    def _turned_by(self, t: Floats) -> Floats:
        """Integral (m, 3) of the rate up to times (m,) s since the first sample."""
        return np.stack([np.interp(t, self._seconds, column) for column in self._integral.T], axis=1)

    @cached_property
    def _seconds(self) -> Floats:
        return seconds_since(self._imu.t_ns, int(self._imu.t_ns[0]))

    @cached_property
    def _integral(self) -> Floats:
        steps = 0.5 * (self._imu.gyro[1:] + self._imu.gyro[:-1]) * np.diff(self._seconds)[:, None]
        return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


@dataclass(frozen=True)
class Motion:
    """Of the body at k images: nav_R_body (k, 3, 3), nav_v_body (k, 3) m/s, gyro_bias (k, 3) rad/s."""

    nav_R_body: Floats
    nav_v_body: Floats
    gyro_bias: Floats

    @classmethod
    def unknown(cls, count: int) -> Motion:
        """At rest, until it is found."""
        return cls(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.zeros((count, 3)))


@dataclass(frozen=True)
class CameraModel:
    """The camera of a session as its factors take it.

    camera : its calibration, or a substitute; readout_s : from its first row to its last, zero where rows
    are taken as seen at once; boresight_sigma rad, clock_sigma s, focal_sigma (relative) : priors of its states, zero
    for none
    expected_boresight (3,) rad : the boresight that is expected
    """

    camera: Camera
    rig: Rig
    readout_s: float
    boresight_sigma: float
    clock_sigma: float
    focal_sigma: float = 0.0
    expected_boresight: Floats = field(default_factory=lambda: np.zeros(3))

    def states(self) -> Mapping[str, SessionState]:
        """Session states of the camera, by letter."""
        found = {}
        if self.rig.timed:
            found["T"] = clock_state(STREAM, self.clock_sigma, self.rig.known_s)
        if self.rig.boresight:
            found["A"] = SessionState("A", STREAM, BORESIGHT, self.expected_boresight, np.full(3, self.boresight_sigma))
        if self.rig.focal:
            found["I"] = SessionState("I", STREAM, FOCAL, np.zeros(1), np.array([self.focal_sigma]))
        return found

    @property
    def body_R_cam(self) -> Floats:
        """Axes of the camera (3, 3) as they are expected."""
        return np.asarray(self.rig.body_R_cam @ exp(self.expected_boresight))

    def delay(self, xy_n: Floats) -> Floats:
        """When points (m, 2) were seen, s (m,) after the first row of their image."""
        if self.readout_s == 0:
            return np.zeros(len(xy_n))
        rows = self.camera.pixels(xy_n)[:, 1]
        return np.asarray(self.readout_s * np.clip(rows / (self.camera.height - 1), 0.0, 1.0))

    def turns(self, rates: BodyRates, t_ns: Times, delay: Floats, bias: Floats) -> Floats:
        """Rotation vectors (m, 3), camera axes, of the camera from stamps (m,) to `delay` (m,) s later; `bias` (m, 3)
        of the gyroscope."""
        turn = rates.turn(t_ns, delay) - bias * delay[:, None]
        return np.asarray(turn @ self.body_R_cam)

    def velocity(self, motion: Motion, rate: Floats) -> Floats:
        """Of the camera (k, 3) m/s in nav axes, from that of the body and its rate (k, 3) rad/s."""
        around = np.cross(rate, self.rig.body_t_cam)
        return motion.nav_v_body + rotate(motion.nav_R_body, around)


def seen_from(xy_n: Floats, turn: Floats) -> Floats:
    """Points (m, 2) that a camera saw after it had turned by rotation vectors (m, 3), as it would have seen them
    before, had it only turned."""
    ray = rotate(exp(turn), np.column_stack([xy_n, np.ones(len(xy_n))]))
    return np.asarray(ray[:, :2] / ray[:, 2:])


def make_camera_model(
    context: FactorContext,
    boresight_sigma_deg: float | None,
    time_offset_sigma: float | None,
    focal_sigma: float | None,
    row_time: bool,
) -> CameraModel:
    """The camera of a session; prior sigmas deg, s and relative (None: as calibrated), whether rows have their own
    time."""
    camera = context.camera or UNKNOWN_CAMERA
    mount = context.session.mount(context.camera_name)
    degrees = camera.boresight_sigma_deg if boresight_sigma_deg is None else boresight_sigma_deg
    seconds = camera.time_offset_sigma_s if time_offset_sigma is None else time_offset_sigma
    focal = camera.focal_sigma if focal_sigma is None else focal_sigma
    if context.causal:  # before scale and heading are known it would take their errors
        focal = 0.0
    body_R, body_t = np.array(mount.body_R, dtype=np.float64), np.array(mount.body_t, dtype=np.float64)
    expected_boresight, seen = np.zeros(3), context.camera_turns
    if seen is not None and context.camera_offset_s and seconds > 0:
        seconds = max(seen.sigma_s, LEAST_CLOCK_SIGMA_S)
    if seen is not None and degrees > 0 and seen.turned_by > np.radians(degrees):
        expected_boresight = seen.certain_boresight
    rig = Rig(
        body_R, body_t, boresight=degrees > 0, timed=seconds > 0, known_s=context.camera_offset_s, focal=focal > 0
    )
    readout = readout_s(context.session, context.camera_name, context.camera) if row_time else 0.0
    return CameraModel(camera, rig, readout, float(np.radians(degrees)), seconds, focal, expected_boresight)


def readout_s(session: Session, name: str, camera: Camera | None) -> float:
    """Of a camera's images as recorded, their median, else as calibrated; unknown without a calibration, which says
    what row a point was in."""
    if camera is None:
        return 0.0
    images = session.images
    if images is not None and images.readout_ns is not None:
        own = images.readout_ns[images.camera.astype(str) == name]
        if len(own):
            return float(np.median(own)) / NS
    return camera.readout_s
