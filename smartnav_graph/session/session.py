"""A recorded session: device + streams + reference. The folder on disk and this object are the same thing."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w
from numpy.typing import NDArray

from smartnav_graph.core import frames
from smartnav_graph.core.errors import CalibrationError, SessionError
from smartnav_graph.core.files import read_toml, replacing
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.progress import Progress, silent, watched
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.session import repair
from smartnav_graph.session.calibration import model as calibration_model
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.streams import (
    ABSOLUTE,
    STREAMS,
    Barometer,
    ControlPoint,
    GnssFix,
    Images,
    Imu,
    Magnetometer,
    Matches,
    PoseFix,
    Positioned,
    Reference,
    StaticPeriod,
    Stream,
    Temperature,
    Tracks,
    Velocity,
    WheelSpeed,
)

SCHEMA = 1
PICTURES = "images"  # the folder of the pictures in that of the session
GPS_EPOCH_S = 315_964_800
EPOCHS = ("unix", "gps", "boot", "unknown")
VEHICLES = ("none", "car", "trolley", "foot")


@dataclass(frozen=True)
class Device:
    """Which body axis points forward and up, and what carries the device."""

    name: str = "unknown"
    forward: str = "+y"
    up: str = "+z"
    vehicle: str = "none"

    def __post_init__(self) -> None:
        frames.body_R_vehicle(self.forward, self.up)
        if self.vehicle not in VEHICLES:
            raise SessionError("session.toml [device]", f"vehicle = {self.vehicle!r}", f"one of {', '.join(VEHICLES)}")


@dataclass(frozen=True)
class Mount:
    """Where a sensor sits: `body_t` (3,) m its origin in body axes, `body_R` (3, 3) its axes; `frame` a free mark.

    For position sensors ``frame = "msl"`` says that heights count from mean sea level.
    """

    body_t: tuple[float, float, float] = (0.0, 0.0, 0.0)
    body_R: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    frame: str = ""


@dataclass(frozen=True, kw_only=True)
class Session:
    """Everything recorded, on one clock.

    Streams are optional; `origin` may be absent (metric local positions only). `gravity_m_s2` overrides normal
    gravity. `repairs` names the repairs applied when the session is loaded; `dropped` counts what they touched.
    `pictures` is the folder that the files of the images count from; saving copies those that are there.
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

    imu: Imu | None = None
    gnss: GnssFix | None = None
    control: ControlPoint | None = None
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

    def __post_init__(self) -> None:
        if self.clock_epoch not in EPOCHS:
            raise SessionError("session.toml [clock]", f"epoch = {self.clock_epoch!r}", f"one of {', '.join(EPOCHS)}")
        for name, stream in self.streams().items():
            if self.origin is None and isinstance(stream, Positioned) and stream.lla is not None:
                raise SessionError(
                    name,
                    "lat_deg, lon_deg, height_m in a session without origin",
                    "[origin] in session.toml, or local e_m, n_m, u_m",
                    "give lat_deg, lon_deg and height_m of the origin",
                    stream=name,
                )

    def streams(self) -> dict[str, Stream]:
        """The streams that are there, by name."""
        there = ((name, getattr(self, name)) for name in STREAMS)
        return {name: stream for name, stream in there if stream is not None}

    def absolute(self) -> dict[str, Positioned]:
        """The streams that tell a position by themselves, by name."""
        return {name: stream for name in ABSOLUTE if (stream := getattr(self, name)) is not None}

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
            raise SessionError(self.path or "session", rows, "at least two rows", "import imu.parquet", stream="imu")
        return self.imu

    @property
    def t0_ns(self) -> int:
        """Time zero of all seconds: the first inertial sample, else the first sample of any stream."""
        if self.imu is not None and len(self.imu):
            return int(self.imu.t_ns[0])
        starts = [int(stream.t_ns[0]) for stream in self.streams().values() if len(stream)]
        return min(starts, default=0)

    def seconds(self, t_ns: Any) -> NDArray[np.float64]:
        """Seconds since `t0_ns`."""
        return seconds_since(t_ns, self.t0_ns)

    @cached_property
    def frame(self) -> LocalFrame | None:
        """The local frame, where an origin is known."""
        return None if self.origin is None else LocalFrame(self.origin)

    def nav_position(self, stream: Positioned) -> NDArray[np.float64]:
        """Positions (n, 3) of a stream in nav metres."""
        if stream.enu is not None:
            return stream.enu
        assert self.frame is not None and stream.lla is not None  # checked when the session was built
        return self.frame.nav_from_lla(stream.lla)

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
        """Decimal year of time zero; 2025 where the clock tells no date."""
        unix_s = self.t0_ns / NS + (GPS_EPOCH_S if self.clock_epoch == "gps" else 0.0)
        return 1970.0 + unix_s / (365.2425 * 86400.0) if self.clock_epoch in ("unix", "gps") else 2025.0

    @cached_property
    def magnetic_field_ut(self) -> NDArray[np.float64] | None:
        """The Earth's field (3,) uT, ENU, at the origin; None without one."""
        return None if self.origin is None else frames.magnetic_field_ut(self.origin, self.year)

    @property
    def declination_deg(self) -> float:
        """Magnetic declination at the origin, deg; zero without one."""
        if self.magnetic_field_ut is None:
            return 0.0
        return float(np.degrees(np.arctan2(*self.magnetic_field_ut[:2])))

    def mount(self, sensor: str) -> Mount:
        """Where `sensor` sits; at the body origin when the session does not say."""
        return self.sensors.get(sensor, Mount())

    def lever_arms(self, stream: Positioned) -> NDArray[np.float64]:
        """Lever arm (n, 3) m in body axes of every row: of the sensor that a surveyed point names, else of the stream.

        Raises
        ------
        SessionError
            A row names a sensor of which the session does not know where it sits.
        """
        named = getattr(stream, "sensor", None)
        names = np.full(len(stream), stream.NAME, dtype=object) if named is None else named
        for row, name in enumerate(names):
            if named is not None and name and name not in self.sensors:
                raise SessionError(
                    stream.NAME,
                    f"row {row} was taken with {name!r}, which session.toml does not place",
                    f"[sensors.{name}] with body_t",
                    "add it, or leave the cell empty for the sensor head itself",
                    row=row,
                    stream=stream.NAME,
                )
        arms = [self.mount(name or stream.NAME).body_t for name in names]
        return np.array(arms, dtype=np.float64).reshape(-1, 3)


def save(session: Session, path: str | Path, *, force: bool = False, progress: Progress = silent) -> None:
    """Write a session folder: session.toml and one Parquet file a stream. Replaces nothing without `force`."""
    with replacing(path, force=force) as folder:
        folder.mkdir()
        for name, stream in watched("writing streams", list(session.streams().items()), progress):
            write_table(stream.columns(), folder / f"{name}.parquet")
        if session.calibration is not None:
            (folder / "calibration.toml").write_text(calibration_model.dumps(session.calibration), encoding="utf-8")
        _copy_pictures(session, folder / PICTURES, progress)
        (folder / "session.toml").write_text(tomli_w.dumps(_header(session)), encoding="utf-8")


def _copy_pictures(session: Session, folder: Path, progress: Progress) -> None:
    if session.images is None or session.pictures is None:
        return
    for file in watched("copying pictures", list(map(str, session.images.file)), progress):
        source = session.pictures / file
        if file and not Path(file).is_absolute() and source.is_file():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, folder / file)


def _header(session: Session) -> dict[str, Any]:
    header: dict[str, Any] = {"schema": SCHEMA}
    if session.gravity_m_s2 is not None:
        header["gravity_m_s2"] = session.gravity_m_s2
    if session.repairs:
        header["repair"] = list(session.repairs)
    header["device"] = dataclasses.asdict(session.device)
    header["clock"] = {"epoch": session.clock_epoch}
    if session.origin is not None:
        header["origin"] = dataclasses.asdict(session.origin)
    if session.sensors:
        header["sensors"] = {name: dataclasses.asdict(mount) for name, mount in session.sensors.items()}
    if session.calibration is not None:
        header["calibration"] = "calibration.toml"
    return header


def write_table(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Columns -> Parquet."""
    pq.write_table(pa.table({name: pa.array(column) for name, column in columns.items()}), path)


def read_table(path: Path) -> dict[str, NDArray[Any]]:
    """Parquet -> columns; empty cells of number columns become NaN.

    Raises
    ------
    SessionError
        Missing, unreadable or empty file.
    """
    try:
        table = pq.read_table(path)
    except FileNotFoundError as error:
        raise SessionError(path, "is missing", "a Parquet file", "check the path") from error
    except (OSError, pa.ArrowException) as error:
        raise SessionError(path, f"cannot be read ({error})", "a Parquet file", "import the log again") from error
    if table.num_rows == 0:
        raise SessionError(path, "has no rows", "at least one row", "delete the file if there was no such sensor")
    return {name: table.column(name).to_numpy() for name in table.column_names}


def build_stream(
    kind: type[Stream], table: Mapping[str, NDArray[Any]], where: Path | str, repairs: Iterable[str] = ()
) -> tuple[Stream, dict[str, int]]:
    """A checked stream of file columns, after the repairs asked for, with their counts; errors name the file."""
    try:
        rows, counts = repair.repair(kind, table, repairs)
        return kind.from_columns(rows), counts
    except SessionError as error:
        raise error.located(where) from error
    except (ValueError, TypeError) as error:
        raise SessionError(where, f"a column holds no numbers ({error})", "numbers", stream=kind.NAME) from error


def read_header(folder: Path) -> dict[str, Any]:
    """session.toml as keyword arguments of Session (without streams)."""
    path = folder / "session.toml"
    if not path.exists():
        raise SessionError(folder, "holds no session.toml", "a session folder", "make one with `smartnav import`")
    raw = read_toml(path, SessionError, "a session.toml")
    known = {"schema", "device", "clock", "origin", "gravity_m_s2", "sensors", "calibration", "repair"}
    unknown = sorted(set(raw) - known)
    if unknown:
        raise SessionError(path, f"unknown key {', '.join(unknown)}", f"some of {', '.join(sorted(known))}")
    if raw.get("schema", SCHEMA) != SCHEMA:
        raise SessionError(path, f"schema = {raw['schema']}", f"{SCHEMA}", "import the log again with this version")
    gravity = raw.get("gravity_m_s2")
    if gravity is not None and not 9.0 < gravity < 10.5:
        raise SessionError(path, f"gravity_m_s2 = {gravity}", "9.0 to 10.5 m/s^2", "give SI units")
    try:
        return {
            "device": Device(**raw.get("device", {})),
            "clock_epoch": raw.get("clock", {}).get("epoch", "unknown"),
            "origin": Origin(**raw["origin"]) if raw.get("origin") else None,
            "gravity_m_s2": gravity,
            "sensors": {name: Mount(**_tuples(mount)) for name, mount in raw.get("sensors", {}).items()},
            "calibration": calibration_model.load(folder / raw["calibration"]) if "calibration" in raw else None,
            "repairs": repair.check_names(raw.get("repair", ())),
        }
    except TypeError as error:
        raise SessionError(path, str(error), "the keys of the session format") from error
    except (SessionError, CalibrationError) as error:
        raise error.located(path) if isinstance(error, SessionError) else error from error


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def load(path: str | Path, *, repairs: Iterable[str] = ()) -> Session:
    """Read a session folder.

    Parameters
    ----------
    path : the folder
    repairs : names of `smartnav_graph.session.repair` to apply beside those that session.toml asks for

    Raises
    ------
    SessionError
        Folder or file missing, unreadable or empty; wrong column; non-finite value; stamps not increasing.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise SessionError(folder, "is no folder", "a session folder", "make one with `smartnav import`")
    header = read_header(folder)
    wanted = repair.check_names({*header["repairs"], *repairs})
    streams: dict[str, Stream] = {}
    dropped: dict[str, dict[str, int]] = {}
    for name, kind in STREAMS.items():
        file = folder / f"{name}.parquet"
        if file.exists():
            streams[name], counts = build_stream(kind, read_table(file), file, wanted)
            dropped |= {name: counts} if counts else {}
    header["repairs"] = wanted
    try:
        return Session(path=folder, pictures=folder / PICTURES, dropped=dropped, **header, **streams)  # type: ignore[arg-type]
    except SessionError as error:
        raise error.located(folder / f"{error.stream}.parquet" if error.stream else folder) from error
