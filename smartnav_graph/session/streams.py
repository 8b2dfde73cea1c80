"""The streams of a session: one dataclass per kind of sensor, one field of `Streams` each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, get_args, get_type_hints

import numpy as np

from smartnav_graph.core.arrays import Floats, Texts, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import name_inside
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.stream import ENU, Label, Located, Positioned, Stream, axes, quantity

LONGEST_GAP_NS = 30 * 86400 * NS  # within one recording


@dataclass(frozen=True, kw_only=True)
class Imu(Stream):
    """Angular rate `gyro` (n, 3) rad/s and specific force `accel` (n, 3) m/s^2 in body axes."""

    NAME: ClassVar[str] = "imu"
    LABEL: ClassVar[Label] = Label("IMU", colour=(235, 80, 80))

    gyro: Floats = axes("gyro_{}_rad_s", limit=1e5)
    accel: Floats = axes("accel_{}_m_s2", limit=1e6)

    def _check_rows(self) -> None:
        super()._check_rows()
        step = np.diff(self.t_ns)
        if len(step) and int(step.max()) > LONGEST_GAP_NS:
            row = int(step.argmax()) + 1
            found = f"t_ns jumps by {step[row - 1] / NS / 86400:.1f} days at row {row}"
            remedy = "cut the recording there, or correct the stamps or their unit"
            raise self._error(found, f"gaps of at most {LONGEST_GAP_NS / NS / 86400:g} days", remedy, row)


@dataclass(frozen=True, kw_only=True)
class GnssFix(Positioned):
    """Position fixes with 1-sigma (n, 3) m; optional velocity (n, 3) m/s in nav axes."""

    NAME: ClassVar[str] = "gnss"
    LABEL: ClassVar[Label] = Label("GNSS", colour=(80, 200, 120))

    velocity: Floats | None = quantity("ve_m_s", "vn_m_s", "vu_m_s", optional=True, nan=True, limit=1e5)
    sigma_velocity: Floats | None = quantity("sigma_ve_m_s", "sigma_vn_m_s", "sigma_vu_m_s", optional=True, nan=True)
    fix_type: Times | None = quantity("fix_type", optional=True, kind="int")


@dataclass(frozen=True, kw_only=True)
class ControlPoint(Positioned):
    """Surveyed points at which the sensor head was placed."""

    NAME: ClassVar[str] = "control"
    LABEL: ClassVar[Label] = Label("Control points", colour=(255, 130, 200))

    point_id: Texts = quantity("point_id", kind="text")
    sensor: Texts | None = quantity("sensor", optional=True, kind="text")


@dataclass(frozen=True, kw_only=True)
class PoseFix(Positioned):
    """Position or pose fixes from elsewhere (image recognition, total station); `quat` (n, 4) w x y z of nav_R_body."""

    NAME: ClassVar[str] = "pose_fixes"
    LABEL: ClassVar[Label] = Label("Pose fixes", colour=(60, 210, 210))
    UNIQUE_TIMES: ClassVar[bool] = False

    quat: Floats | None = quantity("qw", "qx", "qy", "qz", optional=True, nan=True)
    sigma_rot: Floats | None = axes("sigma_{}_rad", "enu", optional=True, nan=True)
    source: Texts | None = quantity("source", optional=True, kind="text")


@dataclass(frozen=True, kw_only=True)
class Ranges(Located):
    """Distances `range_m` (n,) m to anchors (UWB, WiFi round-trip time, acoustic), with sigma (n,) m. The place of a
    row is that of its anchor."""

    NAME: ClassVar[str] = "ranges"
    LABEL: ClassVar[Label] = Label("Ranges", colour=(150, 220, 90))
    UNIQUE_TIMES: ClassVar[bool] = False

    anchor_id: Texts = quantity("anchor_id", kind="text")
    range_m: Floats = quantity("range_m")
    sigma: Floats | None = quantity("sigma_m", optional=True, nan=True)

    def _check_rows(self) -> None:
        super()._check_rows()
        below = np.flatnonzero(self.range_m < 0)
        if len(below):
            row = int(below[0])
            found = f"range_m is {self.range_m[row]} at row {row} ({len(below)} such rows in all)"
            raise SessionError(self.NAME, found, ">= 0 m", "leave the row out", row=row, stream=self.NAME)

    def sigmas(self, default: float) -> Floats:
        """Sigma (n,) m of each row, `default` where it has none."""
        known = np.full(len(self), np.nan) if self.sigma is None else self.sigma
        return np.where(np.isfinite(known), known, default)


@dataclass(frozen=True, kw_only=True)
class StaticPeriod(Stream):
    """Listed standstills: from t_ns to t_end_ns, residual speed sigma m/s."""

    NAME: ClassVar[str] = "static"
    LABEL: ClassVar[Label] = Label("Standstills")
    AIDING: ClassVar[bool] = True

    t_end_ns: Times = quantity("t_end_ns", kind="int")
    sigma_v: Floats | None = quantity("sigma_v_m_s", optional=True)
    source: Texts | None = quantity("source", optional=True, kind="text")

    def _check_rows(self) -> None:
        super()._check_rows()
        length = self.t_end_ns.astype(np.float64) - self.t_ns
        bad = np.flatnonzero(~((length >= 0) & (length <= LONGEST_GAP_NS)))
        if len(bad):
            row = int(bad[0])
            found = f"t_end_ns lies {length[row] / NS:.6g} s after t_ns at row {row} ({len(bad)} such rows in all)"
            rule = f"0 to {LONGEST_GAP_NS / NS / 86400:g} days"
            raise self._error(found, rule, "correct the stamps or their unit, or leave the row out", row)


@dataclass(frozen=True, kw_only=True)
class Magnetometer(Stream):
    """Magnetic flux density (n, 3) uT, body axes."""

    NAME: ClassVar[str] = "magnetometer"
    LABEL: ClassVar[Label] = Label("Magnetometer")
    AIDING: ClassVar[bool] = True

    field_ut: Floats = axes("mag_{}_ut")


@dataclass(frozen=True, kw_only=True)
class Barometer(Stream):
    """Air pressure (n,) hPa."""

    NAME: ClassVar[str] = "barometer"
    LABEL: ClassVar[Label] = Label("Barometer")
    AIDING: ClassVar[bool] = True

    pressure_hpa: Floats = quantity("pressure_hpa", limit=1e7)


@dataclass(frozen=True, kw_only=True)
class Temperature(Stream):
    """Sensor temperature (n,) deg C."""

    NAME: ClassVar[str] = "temperature"
    LABEL: ClassVar[Label] = Label("Temperature")

    temperature_c: Floats = quantity("temperature_c", limit=1e4)


@dataclass(frozen=True, kw_only=True)
class Velocity(Stream):
    """Velocity (n, 3) m/s in body axes."""

    NAME: ClassVar[str] = "velocity"
    LABEL: ClassVar[Label] = Label("Velocity")
    AIDING: ClassVar[bool] = True

    velocity: Floats = axes("v_{}_m_s", limit=1e5)
    sigma: Floats | None = axes("sigma_v{}_m_s", optional=True)


@dataclass(frozen=True, kw_only=True)
class WheelSpeed(Stream):
    """Wheel speed (n,) m/s along the vehicle's forward axis."""

    NAME: ClassVar[str] = "wheel"
    LABEL: ClassVar[Label] = Label("Wheel speed")
    AIDING: ClassVar[bool] = True

    speed: Floats = quantity("speed_m_s", limit=1e5)
    sigma: Floats | None = quantity("sigma_m_s", optional=True)


@dataclass(frozen=True, kw_only=True)
class Images(Stream):
    """One row per image; files lie in the session's images/ folder."""

    NAME: ClassVar[str] = "images"
    LABEL: ClassVar[Label] = Label("Images")
    UNIQUE_TIMES: ClassVar[bool] = False

    image_id: Times = quantity("image_id", kind="int")
    file: Texts = quantity("file", kind="text")
    camera: Texts = quantity("camera", kind="text")
    exposure_ns: Times | None = quantity("exposure_ns", optional=True, kind="int")
    readout_ns: Times | None = quantity("readout_ns", optional=True, kind="int")

    def _check_rows(self) -> None:
        super()._check_rows()
        for row, file in enumerate(map(str, self.file)):
            if file and not name_inside(file):
                rule = "a name inside the folder of the pictures: no .., no absolute path, at most 255 bytes a part"
                raise self._error(f"file is {file[:300]!r} at row {row}", rule, "copy the pictures into it", row)


@dataclass(frozen=True, kw_only=True)
class Tracks(Stream):
    """Feature observations; `xy_n` (n, 2) undistorted normalised image coordinates."""

    NAME: ClassVar[str] = "tracks"
    LABEL: ClassVar[Label] = Label("Tracked points")
    UNIQUE_TIMES: ClassVar[bool] = False

    image_id: Times = quantity("image_id", kind="int")
    track_id: Times = quantity("track_id", kind="int")
    xy_n: Floats = quantity("x_n", "y_n")
    xy_px: Floats | None = quantity("x_px", "y_px", optional=True)


@dataclass(frozen=True, kw_only=True)
class Matches(Stream):
    """Matched points of two images; normalised coordinates (n, 2) each."""

    NAME: ClassVar[str] = "matches"
    LABEL: ClassVar[Label] = Label("Matched points")
    UNIQUE_TIMES: ClassVar[bool] = False

    image_id_0: Times = quantity("image_id_0", kind="int")
    image_id_1: Times = quantity("image_id_1", kind="int")
    t_1_ns: Times = quantity("t_ns_1", kind="int")
    xy0_n: Floats = quantity("x0_n", "y0_n")
    xy1_n: Floats = quantity("x1_n", "y1_n")
    score: Floats | None = quantity("score", optional=True)


@dataclass(frozen=True, kw_only=True)
class Reference(Stream):
    """A reference trajectory in nav: position m, and where known attitude, velocity, biases and sigmas."""

    NAME: ClassVar[str] = "reference"
    LABEL: ClassVar[Label] = Label("Reference")

    enu: Floats = quantity(*ENU)
    quat: Floats | None = quantity("qw", "qx", "qy", "qz", optional=True)
    velocity: Floats | None = quantity("ve_m_s", "vn_m_s", "vu_m_s", optional=True)
    accel_bias: Floats | None = axes("accel_bias_{}_m_s2", optional=True)
    gyro_bias: Floats | None = axes("gyro_bias_{}_rad_s", optional=True)
    sigma: Floats | None = axes("sigma_{}_m", "enu", optional=True, nan=True)


@dataclass(frozen=True, kw_only=True)
class Streams:
    """The streams that a session may hold, each optional. A new kind of stream adds its field here."""

    imu: Imu | None = None
    gnss: GnssFix | None = None
    control: ControlPoint | None = None
    ranges: Ranges | None = None
    static: StaticPeriod | None = None
    pose_fixes: PoseFix | None = None
    magnetometer: Magnetometer | None = None
    barometer: Barometer | None = None
    temperature: Temperature | None = None
    velocity: Velocity | None = None
    wheel: WheelSpeed | None = None
    images: Images | None = None
    tracks: Tracks | None = None
    matches: Matches | None = None
    reference: Reference | None = None

    def streams(self) -> dict[str, Stream]:
        """The streams that exist, by name."""
        return {name: stream for name in STREAMS if (stream := getattr(self, name)) is not None}

    def absolute(self) -> dict[str, Stream]:
        """The streams that tie the trajectory to places, by name."""
        return {name: stream for name, stream in self.streams().items() if stream.ABSOLUTE}

    def positions(self) -> dict[str, Positioned]:
        """The streams of positions, by name."""
        return {name: stream for name, stream in self.streams().items() if isinstance(stream, Positioned)}


# Every kind of stream, by name.
STREAMS: dict[str, type[Stream]] = {name: get_args(kind)[0] for name, kind in get_type_hints(Streams).items()}
ABSOLUTE = tuple(name for name, kind in STREAMS.items() if kind.ABSOLUTE)
POSITIONS = tuple(name for name, kind in STREAMS.items() if issubclass(kind, Positioned))
