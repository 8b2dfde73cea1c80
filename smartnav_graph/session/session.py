"""A recorded session: device, streams and reference; see `folder` for its files."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import InputTypeError, SessionError, warn
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.timebase import NS, seconds_since, span_text, unix_ns
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.from_arrays import build_streams, first_origin
from smartnav_graph.session.stream import Located, Positioned, Stream
from smartnav_graph.session.streams import Imu, Streams

if TYPE_CHECKING:
    import pandas as pd

EPOCHS = ("unix", "gps", "boot", "unknown")
VEHICLES = ("none", "car", "trolley", "foot")
MOUNTINGS = ("auto", "foot", "body")
# Mounts: largest lever arm; how far a matrix may be from a rotation; what is no more than rounding.
FARTHEST_M, ROTATION_ERROR, ROUNDING = 1000.0, 1e-3, 1e-6


@dataclass(frozen=True)
class Device:
    """Which body axis points forward and up, what carries the device, and whether it is mounted on a foot.

    mounting : ``foot``, ``body`` (anywhere else), or ``auto`` where the data have to show it
    """

    name: str = "unknown"
    forward: str = "+y"
    up: str = "+z"
    vehicle: str = "none"
    mounting: str = "auto"

    def __post_init__(self) -> None:
        frames.body_R_vehicle(self.forward, self.up)
        for name, value, known in (("vehicle", self.vehicle, VEHICLES), ("mounting", self.mounting, MOUNTINGS)):
            if value not in known:
                raise SessionError("session.toml [device]", f"{name} = {value!r}", f"one of {', '.join(known)}")


@dataclass(frozen=True)
class Mount:
    """Where a sensor is mounted: `body_t` (3,) m its origin in body axes, `body_R` (3, 3) its axes; `frame` a label.

    For position sensors ``frame = "msl"`` says that height_m is above mean sea level; `geoid_m` is then the height of
    the geoid above the ellipsoid there, m.
    """

    body_t: tuple[float, float, float] = (0.0, 0.0, 0.0)
    body_R: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    frame: str = ""
    geoid_m: float = float("nan")

    def __post_init__(self) -> None:
        R, t = np.array(self.body_R, dtype=np.float64), np.array(self.body_t, dtype=np.float64)
        if t.shape != (3,) or not (np.abs(t) <= FARTHEST_M).all():
            expected = f"three numbers of at most {FARTHEST_M:g} m"
            raise SessionError("session.toml [sensors]", f"body_t = {list(self.body_t)}", expected, "give metres")
        off = np.inf if R.shape != (3, 3) or np.linalg.det(R) < 0 else float(np.abs(R @ R.T - np.eye(3)).max())
        if not off <= ROTATION_ERROR:
            found, rule = f"body_R = {R.tolist()}", f"the rows of a rotation, to {ROTATION_ERROR:g}"
            raise SessionError("session.toml [sensors]", found, rule, "give the axes of the sensor in body axes")
        if off > ROUNDING:
            warn(f"session.toml [sensors]: body_R is a rotation to {off:.1e} only; the nearest rotation is used")
            u, _, vt = np.linalg.svd(R)
            object.__setattr__(self, "body_R", tuple(tuple(row) for row in (u @ vt).tolist()))

    @property
    def above_sea(self) -> bool:
        """Whether heights are above mean sea level."""
        return self.frame == "msl"


_AT_ORIGIN = Mount()


@dataclass(frozen=True, kw_only=True)
class Session(Summarised, Streams):
    """Everything recorded, on one clock: its streams and what is known of the device.

    `origin` may be absent (metric local positions only). `gravity_m_s2` overrides normal gravity. `repairs` names the
    repairs applied when the session is loaded; `dropped` counts what they touched. `pictures` is the folder that the
    files of the images count from; saving copies those that are there. Where pictures have to be decoded from a log,
    `write_pictures` writes them into a folder; only saving does so.
    """

    device: Device = Device()
    clock_epoch: str = "unknown"
    origin: Origin | None = None
    gravity_m_s2: float | None = None
    sensors: Mapping[str, Mount] = field(default_factory=dict)
    calibration: Calibration | None = None
    repairs: tuple[str, ...] = ()
    dropped: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    path: Path | None = None
    pictures: Path | None = None
    write_pictures: Callable[[Path], None] | None = None

    def __post_init__(self) -> None:
        if self.clock_epoch not in EPOCHS:
            raise SessionError("session.toml [clock]", f"epoch = {self.clock_epoch!r}", f"one of {', '.join(EPOCHS)}")
        for name, stream in self.streams().items():
            if self.origin is None and isinstance(stream, Located) and stream.lla is not None:
                raise SessionError(
                    name,
                    "lat_deg, lon_deg, height_m in a session without origin",
                    "[origin] in session.toml, or local e_m, n_m, u_m",
                    "give lat_deg, lon_deg and height_m of the origin",
                    stream=name,
                )

    @classmethod
    def from_arrays(
        cls,
        *,
        device: Device | None = None,
        clock_epoch: str | None = None,
        origin: Origin | None = None,
        gravity_m_s2: float | None = None,
        sensors: Mapping[str, Mount] | None = None,
        calibration: Calibration | None = None,
        repairs: Iterable[str] = (),
        **streams: Stream | Mapping[str, ArrayLike] | pd.DataFrame,
    ) -> Session:
        """A session of arrays: ``from_arrays(imu={"time": t, "gyro": gyro, "accel": accel}, gnss={...})``.

        Parameters
        ----------
        device : body axes that point forward and up, and what carries the device; by default as a phone lying flat
        clock_epoch : of whole nanoseconds: ``unix``, ``gps``, ``boot`` or ``unknown``; datetimes are ``unix``
        origin : of the local frame; by default the first latitude, longitude and height
        gravity_m_s2, sensors, calibration : as the fields of the class
        repairs : names of `smartnav_graph.session.repair`, such as ``order``, ``nan``, ``units``; what they touched is
            counted in `dropped`
        streams : by name (``imu``, ``gnss``, ``control`` ...), each a stream, or a mapping of its arrays by name of
            field (``gyro`` (n, 3) rad/s) or of column (``gyro_x_rad_s``), with its times (n,) as ``time``: datetime64
            of any unit (UTC where there is no time zone), timedelta64, or whole nanoseconds. Columns and units:
            docs/session-format.md

        Raises
        ------
        InputTypeError
            A stream or a time of another type; it is a TypeError, and says what to build.
        SessionError
            A column, row, time or unit that does not fit.
        """
        repairs = tuple(repairs)  # an iterator serves one stream only
        built, epoch, dropped = build_streams(streams, clock_epoch, repairs)
        located = [one for one in built.values() if isinstance(one, Located)]
        found = cls(
            device=device or Device(),
            clock_epoch=epoch,
            origin=origin or next((first for one in located if (first := first_origin(one)) is not None), None),
            gravity_m_s2=gravity_m_s2,
            sensors=sensors or {},
            calibration=calibration,
            dropped=dropped,
            **built,
        )
        return found._in_right_units(repairs)

    @classmethod
    def from_pandas(
        cls,
        *,
        device: Device | None = None,
        clock_epoch: str | None = None,
        origin: Origin | None = None,
        gravity_m_s2: float | None = None,
        sensors: Mapping[str, Mount] | None = None,
        calibration: Calibration | None = None,
        repairs: Iterable[str] = (),
        **streams: pd.DataFrame | Stream,
    ) -> Session:
        """A session of DataFrames with the columns of docs/session-format.md: ``from_pandas(imu=imu, gnss=fixes)``.

        The times of a DataFrame are its column ``time``, ``timestamp`` or ``t_ns``, or else its index. Other parameters
        and errors as `from_arrays`.
        """
        for name, frame in streams.items():
            if not isinstance(frame, Stream) and not hasattr(frame, "columns"):
                remedy = "arrays go to Session.from_arrays"
                raise InputTypeError(name, f"is {type(frame).__name__}", "a pandas DataFrame", remedy)
        return cls.from_arrays(
            device=device,
            clock_epoch=clock_epoch,
            origin=origin,
            gravity_m_s2=gravity_m_s2,
            sensors=sensors,
            calibration=calibration,
            repairs=repairs,
            **streams,
        )

    def _in_right_units(self, repairs: Iterable[str]) -> Session:
        """Checked for readings in another unit, or converted by the repair ``units``."""
        from smartnav_graph.session import health
        from smartnav_graph.session.health.units import in_right_units, without_wrong_units

        if self.imu is None or len(self.imu) < 2:
            return self
        if "units" in repairs:
            return in_right_units(self)
        for name in without_wrong_units(self, health.inspect(self).findings)[1]:
            warn(f"{name}: in another unit, and not used; convert it, or add repairs=('units',)")
        return self

    def facts(self) -> dict[str, str]:
        """Device, clock, origin, and rows of every stream."""
        shown = {"device": f"{self.device.name}, forward {self.device.forward}, up {self.device.up}"}
        unix = unix_ns(self.t0_ns, self.clock_epoch)
        shown["start"] = f"clock {self.clock_epoch}" if unix is None else f"{np.datetime64(int(unix), 'ns')} UTC"
        if self.origin is not None:
            shown["origin"] = f"{self.origin.lat_deg:.7f}, {self.origin.lon_deg:.7f}, {self.origin.height_m:.3f} m"
        for name, stream in self.streams().items():
            shown[name] = ", ".join(filter(None, [f"{len(stream)} rows", span_text(stream.t_ns)]))
        return shown

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def require_imu(self) -> Imu:
        """The inertial stream.

        Raises
        ------
        SessionError
            There is none, or it has fewer than two rows.
        """
        if self.imu is None or len(self.imu) < 2:
            rows = "no imu stream" if self.imu is None else f"imu has {len(self.imu)} rows"
            left_out = "; ".join(f"{count} rows {reason}" for reason, count in self.dropped.get("imu", {}).items())
            rows += f" ({left_out})" if left_out else ""
            raise SessionError(self.path or "session", rows, "at least two rows", "record the IMU too", stream="imu")
        return self.imu

    @property
    def t0_ns(self) -> int:
        """Time zero of all seconds: the first inertial sample, else the first sample of any stream."""
        if self.imu is not None and len(self.imu):
            return int(self.imu.t_ns[0])
        starts = [int(stream.t_ns[0]) for stream in self.streams().values() if len(stream)]
        return min(starts, default=0)

    def seconds(self, t_ns: ArrayLike) -> Floats:
        """Seconds since `t0_ns`."""
        return seconds_since(t_ns, self.t0_ns)

    @cached_property
    def frame(self) -> LocalFrame | None:
        """The local frame, where an origin is known."""
        return None if self.origin is None else LocalFrame(self.origin)

    def nav_position(self, stream: Located) -> Floats:
        """Positions (n, 3) of a stream in nav metres. Unknown heights are the median of the known ones, or that of the
        origin; see `Located.has_height`."""
        rows = stream.enu if stream.enu is not None else stream.lla
        assert rows is not None  # checked when the stream was built
        known = stream.has_height
        if not known.all():
            zero = 0.0 if stream.lla is None or self.origin is None else self.origin.height_m
            height = np.where(known, rows[:, 2], np.median(rows[known, 2]) if known.any() else zero)
            rows = np.column_stack([rows[:, :2], height])
        if stream.enu is not None:
            return rows
        assert self.frame is not None  # checked when the session was built
        mount = self.mount(stream.NAME)
        if mount.above_sea and np.isfinite(mount.geoid_m):
            rows = np.column_stack([rows[:, :2], rows[:, 2] + np.where(known, mount.geoid_m, 0.0)])
        return self.frame.nav_from_lla(rows)

    @property
    def heights(self) -> str:
        """What the heights of the positions, and so of a result, count from."""
        if self.origin is None:
            return frames.LOCAL_HEIGHTS
        known = [name for name, rows in self.positions().items() if rows.lla is not None and rows.has_height.any()]
        mounts = [self.mount(name) for name in known]
        above_sea = [mount.above_sea and not np.isfinite(mount.geoid_m) for mount in mounts]
        if not any(above_sea):
            return frames.ELLIPSOIDAL
        return frames.ABOVE_SEA if all(above_sea) else frames.PARTLY_ABOVE_SEA

    @property
    def gravity(self) -> float:
        """Magnitude of gravity m/s^2: the session's own, else normal gravity at the origin, else the standard value."""
        if self.gravity_m_s2 is not None:
            return self.gravity_m_s2
        if self.origin is not None:
            return frames.normal_gravity(self.origin.lat_deg, self.origin.height_m)
        return frames.STANDARD_GRAVITY

    @property
    def year(self) -> float:
        """Decimal year of time zero; 2025 where the clock is no date."""
        unix = unix_ns(self.t0_ns, self.clock_epoch)
        if unix is None:
            return 2025.0
        return 1970.0 + int(unix) / NS / (365.2425 * 86400.0)

    @cached_property
    def magnetic_field_ut(self) -> Floats | None:
        """The Earth's field (3,) uT, ENU, at the origin; None without one."""
        return None if self.origin is None else frames.magnetic_field_ut(self.origin, self.year)

    @property
    def declination_deg(self) -> float:
        """Magnetic declination at the origin, deg; zero without one."""
        if self.magnetic_field_ut is None:
            return 0.0
        return float(np.degrees(np.arctan2(*self.magnetic_field_ut[:2])))

    def mount(self, sensor: str) -> Mount:
        """Where `sensor` is mounted; the body origin where the session does not give it. What was calibrated of a
        camera takes precedence."""
        found = self.sensors.get(sensor, _AT_ORIGIN)
        camera = None if self.calibration is None else self.calibration.cameras.get(sensor)
        if camera is not None and camera.body_t:
            x, y, z = camera.body_t
            found = dataclasses.replace(found, body_t=(x, y, z))
        if camera is None or not camera.body_R:
            return found
        a, b, c, d, e, f, g, h, i = camera.body_R
        return dataclasses.replace(found, body_R=((a, b, c), (d, e, f), (g, h, i)))

    def lever_arms(self, stream: Positioned) -> Floats:
        """Lever arm (n, 3) m in body axes of every row: of the sensor that a surveyed point names, else of the stream.

        Raises
        ------
        SessionError
            A row names a sensor without mount in the session.
        """
        named = getattr(stream, "sensor", None)
        names = np.full(len(stream), stream.NAME, dtype=object) if named is None else named
        for row, name in enumerate(names):
            if named is not None and name and name not in self.sensors:
                raise SessionError(
                    stream.NAME,
                    f"row {row} was taken with {name!r}, which has no mount in session.toml",
                    f"[sensors.{name}] with body_t",
                    "add it, or leave the cell empty for the sensor head itself",
                    row=row,
                    stream=stream.NAME,
                )
        where = [name or stream.NAME for name in names]
        arms = {name: self.mount(name).body_t for name in set(where)}
        return np.array([arms[name] for name in where], dtype=np.float64).reshape(-1, 3)
