"""Folders of the SmartNav logger of 2012 (Android): text files, one for each sensor, and numbered pictures.

=============  ==============================================================================================
IMU            timestamp of the sensors, gyro x y z rad/s, accel x y z m/s^2
Compass        timestamp of the sensors, flux density x y z uT
Sync           time of the processor, timestamp of the sensors: pairs that tie the two clocks
GPS            time of the processor, UTC, latitude and longitude deg, altitude m, accuracy m
Camera         number of the picture, time of the processor; pictures are Image_N_T.jpg or ImageUndistorted_N_T.jpg
Matches        see `match_file`
ControlPoints  a list of points with start and end, see `positions.listed`
=============  ==============================================================================================

A name may go on after these words; columns are separated by commas, semicolons, tabs or blanks; lines that begin with #
and a first line with names are no rows. The processor counts milliseconds since 1970, the sensors nanoseconds, by their
values. The session has the clock of the processor: the sensors' is carried to it by a straight line through the pairs
(their rate differs by some ppm), fixes by the median of processor time minus UTC, which leaves the delay of the
receiver. smartnav.toml and calibration.toml (keys of session.toml) are read where they are there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers import match_file
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.positions.listed import read_points
from smartnav_graph.readers.samples import in_time_order
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.text import TextTable, first_lines, read_text
from smartnav_graph.session.folder import read_header
from smartnav_graph.session.session import Session

HEADER = "smartnav.toml"
COLUMNS = {
    "imu": ("timestamp", "gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"),
    "compass": ("timestamp", "mag_x", "mag_y", "mag_z"),
    "sync": ("processor", "timestamp"),
    "gps": ("processor", "utc", "latitude", "longitude", "altitude", "accuracy"),
    "camera": ("number", "processor"),
}
_WORDS = (*COLUMNS, "matches", "controlpoints")
_FILE = re.compile(rf"({'|'.join(_WORDS)})[\w .-]*\.(?:txt|csv|log)", re.IGNORECASE)
_PICTURE = re.compile(r"Image(Undistorted)?_(\d+)_(\d+)\.jpe?g", re.IGNORECASE)
_UNITS = (1, 1000, 10**6, NS)
_SENSOR_STEP_S = (1e-3, 0.2)  # between inertial samples: the unit of the stamps that gives such steps
_CLOCKS = ((1e17, 1), (1e14, 1000), (1e11, 10**6), (1e8, NS))  # least number since 1970 -> its unit
_OUTLIERS, _LEAST_NS = 4.0, 2_000_000  # of pairs from the line: robust sigmas, and at least
_LONG_NS = 60 * NS  # pairs over less than that do not show a rate
_SAME_NS = 5_000_000_000


@dataclass(frozen=True)
class SensorClock:
    """Processor time = sensor time + offset + rate * (sensor time - zero), ns.

    left_out : pairs far off the line; sigma_ns : scatter of the others
    """

    zero_ns: int = 0
    offset_ns: int = 0
    rate: float = 0.0
    left_out: int = 0
    sigma_ns: float = 0.0

    def to_processor(self, t_ns: Times) -> Times:
        """Stamps (n,) of the processor at stamps of the sensors."""
        drift = np.rint(self.rate * (t_ns - self.zero_ns)).astype(np.int64)
        return np.asarray(t_ns + self.offset_ns + drift)


def fit_sensor_clock(processor_ns: Times, sensor_ns: Times) -> SensorClock:
    """The line through pairs (n,) of stamps, by least squares without those far off: a pair that was written late.

    Raises
    ------
    SessionError
        No pairs.
    """
    if not len(processor_ns):
        raise SessionError("Sync", "has no pairs of stamps", "at least one")
    zero, first = int(sensor_ns[0]), int(processor_ns[0] - sensor_ns[0])
    since, apart = (sensor_ns - zero).astype(np.float64), (processor_ns - sensor_ns - first).astype(np.float64)
    long = len(since) > 2 and np.ptp(since) > _LONG_NS
    used = np.ones(len(since), dtype=bool)
    rate, level, scatter = 0.0, float(np.median(apart)), 0.0
    for _ in range(5):
        if long and used.sum() > 2:
            rate, level = map(float, np.polyfit(since[used], apart[used], 1))
        else:
            level = float(np.median(apart[used]))
        off = np.abs(apart - level - rate * since)
        scatter = 1.4826 * float(np.median(off[used]))
        used = off <= max(_OUTLIERS * scatter, _LEAST_NS)
    return SensorClock(zero, first + round(level), rate, int((~used).sum()), scatter)


def logger_files(folder: Path) -> dict[str, Path]:
    """The text files of a folder by the word that their names begin with."""
    found: dict[str, Path] = {}
    for file in sorted(folder.iterdir()) if folder.is_dir() else []:
        match = _FILE.fullmatch(file.name)
        if match is not None and match[1].lower() not in found:
            found[match[1].lower()] = file
    return found


def _matches(source: str) -> bool:
    if "\0" in source:
        return False
    files = logger_files(Path(source))
    ours = (Path(source) / "session.toml").is_file() or (Path(source) / "imu.csv").is_file()  # columns of a session
    return "imu" in files and bool({"sync", "gps"} & files.keys()) and not ours


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    folder = Path(source)
    files = logger_files(folder)
    if "imu" not in files:
        raise SessionError(folder, "holds no IMU file", "IMU.txt, Sync.txt, GPS.txt ...", "give the logger's folder")
    tables = {word: _table(files[word], word) for word in COLUMNS if word in files}
    unit = _sensor_unit(tables["imu"])
    clock, is_unix = _clock(tables, unit)
    parts = LogParts()
    imu = tables["imu"]
    t_ns = clock.to_processor(imu.times("timestamp", unit))
    gyro, accel = (imu.floats(*(f"{name}_{axis}" for axis in "xyz")) for name in ("gyro", "accel"))
    parts.add_imu(in_time_order(imu.path, t_ns, gyro, repairs), in_time_order(imu.path, t_ns, accel, repairs))
    if "compass" in tables:
        compass = tables["compass"]
        at = clock.to_processor(compass.times("timestamp", unit))
        parts.add_magnetometer(in_time_order(compass.path, at, compass.floats("mag_x", "mag_y", "mag_z"), repairs))
    if "gps" in tables:
        parts.add_fixes(tables["gps"].path, _fixes(tables["gps"]))
    images, left_out = _images(folder, tables.get("camera"))
    if len(images["t_ns"]):
        parts.add("images", tables["camera"].path if "camera" in tables else folder, images, left_out)
    parts.count("imu", {"pairs of Sync far from the line left out": clock.left_out})
    session = log_session(parts, repairs, name="SmartNav logger", epoch="unix" if is_unix else "unknown")
    return _completed(session.replace(pictures=folder), folder, files, repairs)


def _table(file: Path, word: str) -> TextTable:
    """The columns of a file, with or without a line of names."""
    first = next((line for line in first_lines(file, 50) if line and not line.startswith("#")), "")
    named = re.match(r"[-+.\d]", first) is None
    table = read_text(file) if named else read_text(file, names=COLUMNS[word])
    headings = list(table.cells)
    if len(headings) < len(COLUMNS[word]):
        found = f"has {len(headings)} columns"
        raise SessionError(file, found, f"{len(COLUMNS[word])}: {', '.join(COLUMNS[word])}", "complete the rows")
    cells = {name: table.cells[heading] for name, heading in zip(COLUMNS[word], headings, strict=False)}
    return TextTable(file, cells, table.skipped)


def _sensor_unit(imu: TextTable) -> int:
    """Nanoseconds in one unit of the sensors' stamps, by the step between samples."""
    stamps = imu.floats("timestamp")
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    for unit in _UNITS:
        if _SENSOR_STEP_S[0] <= step * unit / NS <= _SENSOR_STEP_S[1]:
            return unit
    found = f"timestamp grows by {step:g} from row to row"
    raise SessionError(imu.path, found, "ns, us, ms or s of samples at 5 to 1000 Hz", "check the columns")


def _processor_times(table: TextTable, name: str = "processor") -> tuple[Times, bool]:
    """Stamps (n,) ns of the processor, milliseconds unless their size shows another unit; whether since 1970."""
    size = abs(float(table.floats(name)[0]))
    unit = next((unit for least, unit in _CLOCKS if size >= least), 10**6)
    return table.times(name, unit), size >= _CLOCKS[-1][0]


def _clock(tables: dict[str, TextTable], unit: int) -> tuple[SensorClock, bool]:
    """The sensors' clock against the processor's, and whether that counts since 1970."""
    imu = tables["imu"].times("timestamp", unit)
    if "sync" in tables:
        processor, is_unix = _processor_times(tables["sync"])
        return fit_sensor_clock(processor, tables["sync"].times("timestamp", unit)), is_unix
    processor, is_unix = _processor_times(tables["gps"])
    if processor[-1] < imu[0] - _SAME_NS or processor[0] > imu[-1] + _SAME_NS:
        found = "GPS and IMU have no time in common, and there is no Sync file"
        raise SessionError(tables["imu"].path, found, "pairs of both clocks", "add Sync.txt: processor time, timestamp")
    return SensorClock(), is_unix


def _fixes(gps: TextTable) -> LoggedFixes:
    """Fixes at the times of the receiver, carried to the processor's clock where they have one."""
    processor, _ = _processor_times(gps)
    t_ns = processor
    if not gps.is_empty("utc") and (gps.floats("utc") > 0).all():
        utc, _ = _processor_times(gps, "utc")
        t_ns = utc + round(float(np.median(processor - utc)))
    lat, lon, altitude, accuracy = (gps.floats(name) for name in COLUMNS["gps"][2:])
    return LoggedFixes(t_ns, lat, lon, altitude, horizontal=accuracy)


def _images(folder: Path, camera: TextTable | None) -> tuple[Table, dict[str, int]]:
    """Images of the camera file, else of the names of the pictures; undistorted ones only where there are no others."""
    named = [(match, file.name) for file in sorted(folder.iterdir()) if (match := _PICTURE.fullmatch(file.name))]
    plain = {int(match[2]): (int(match[3]), name) for match, name in named if match[1] is None}
    undistorted = {int(match[2]): (int(match[3]), name) for match, name in named if match[1] is not None}
    pictures = plain or undistorted
    if camera is not None:
        numbers, (t_ns, _) = camera.ints("number"), _processor_times(camera)
    else:
        numbers = np.array(sorted(pictures), dtype=np.int64)
        t_ns = np.array([pictures[number][0] for number in numbers.tolist()], dtype=np.int64) * 10**6
    files = [""] * len(numbers)
    if pictures:  # else they were left elsewhere
        expected = [f"Image_{n}_{t // 10**6}.jpg" for n, t in zip(numbers.tolist(), t_ns.tolist(), strict=True)]
        files = [pictures.get(n, (0, name))[1] for n, name in zip(numbers.tolist(), expected, strict=True)]
    order = np.argsort(t_ns, kind="stable")
    name = "back" if plain or not undistorted else "undistorted"
    table: Table = {
        "t_ns": t_ns[order],
        "image_id": numbers[order],
        "file": np.array(files, dtype=object)[order],
        "camera": np.full(len(numbers), name, dtype=object),
    }
    both = len(plain.keys() & undistorted.keys())
    return table, {"undistorted copies of pictures left out": both} if both else {}


def _completed(session: Session, folder: Path, files: dict[str, Path], repairs: tuple[str, ...]) -> Session:
    """With what smartnav.toml says, control points, and matches where the camera is calibrated."""
    if (folder / HEADER).is_file():
        header = read_header(folder, HEADER)
        kept = {name: header[name] for name in ("device", "gravity_m_s2", "sensors", "calibration")}
        session = session.replace(**kept, origin=header["origin"] or session.origin)
    if "controlpoints" in files:
        points = read_points(files["controlpoints"]).session(repairs)
        session = session.replace(control=points.control, static=points.static, origin=session.origin or points.origin)
    cameras = session.calibration.cameras if session.calibration is not None else {}
    if session.images is not None and len(cameras) == 1:
        camera = next(iter(cameras))
        names = np.full(len(session.images), camera, dtype=object)
        session = session.replace(images=replace(session.images, camera=names))
    if "matches" in files and session.images is not None:
        rows = match_file.read_match_file(files["matches"])
        if len(cameras) != 1:
            reason = "matches left out (give calibration.toml, or `smartnav match --from`)"
            return session.replace(dropped={**session.dropped, "matches": {reason: len(rows.t0_ns)}})
        name, found = next(iter(cameras.items()))
        matches, lost = match_file.to_matches(rows, session.images, name, found)
        counts = {"matches": {"of no two images left out": lost}} if lost else {}
        session = session.replace(matches=matches, dropped={**session.dropped, **counts})
    return session


READER = Reader(
    name="smartnav",
    summary="folder of the SmartNav logger of 2012: IMU, Sync, GPS, Compass, Camera, pictures",
    recognised_by="a folder with IMU*.txt and Sync*.txt or GPS*.txt",
    matches=_matches,
    read_source=_read,
)
