"""PX4 logs (.ulg): inertial samples, fixes, magnetometer, pressure, temperature, on the clock since boot.

PX4 user guide, ULog file format; fields as in the uORB messages of PX4 1.8 to 1.16. Body axes are forward, right, down.
`eph`, `epv` and `s_variance_m_s` are standard deviations: the estimator of PX4 takes them so. Of several inertial
sensors the fastest is read, and of those equally fast the first of sensor_combined, vehicle_imu, sensor_gyro with
sensor_accel; ``LOG.ulg#vehicle_imu.1`` chooses another.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast

import numpy as np

from smartnav_graph.core.arrays import Column, Floats, Times
from smartnav_graph.core.errors import SessionError, warn
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.robotics.sensor_choice import check_sensor_names, select_sensor, split_source
from smartnav_graph.readers.samples import Samples, in_time_order
from smartnav_graph.readers.source import Reader, first_bytes
from smartnav_graph.session.session import Session

MAGIC = b"ULog\x01\x12\x35"
MESSAGES = (
    *("sensor_combined", "vehicle_imu", "sensor_gyro", "sensor_accel", "vehicle_gps_position", "sensor_gps"),
    *("vehicle_magnetometer", "sensor_mag", "vehicle_air_data", "sensor_baro"),
)
_US = NS // 10**6
_LARGE_FIELD = re.compile(rb"\w\[\d{5,}\] \w+;")  # no message of PX4 has arrays of 10 000 and more
_NO_STAMP = 2**31 - 1  # us: the accelerometer has no stamp of its own
_HIGHEST_HPA = 2000.0  # a reading above it is in pascals
_LOWEST_FIX = 2  # fix_type of a position in two dimensions


class _Dataset(Protocol):
    name: str
    multi_id: int
    data: Mapping[str, Column]


class _Log(Protocol):
    data_list: Sequence[_Dataset]
    msg_info_dict: Mapping[str, object]
    dropouts: Sequence[object]
    file_corruption: bool


@dataclass(frozen=True)
class _Imu:
    """One inertial sensor of a log: its name, and readings of its gyro and accelerometer."""

    name: str
    gyro: Samples
    accel: Samples

    @property
    def rate_hz(self) -> float:
        return self.gyro.rate_hz


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path, names = split_source(source)
    log = _opened(path)
    try:
        parts = _streams(path, log, names, repairs)
    except KeyError as error:  # a field that every version of PX4 has
        raise SessionError(path, f"a message has no field {error}", "a log of PX4", "copy it again") from error
    if not parts.tables:
        seen = ", ".join(sorted({found.name for found in log.data_list})) or "no message"
        raise SessionError(path, f"holds {seen} of what is read", f"some of {', '.join(MESSAGES)}", "log them")
    name = " ".join(str(log.msg_info_dict[key]) for key in ("sys_name", "ver_hw") if key in log.msg_info_dict)
    return log_session(parts, repairs, name=name or "PX4", epoch="boot", forward="+x", up="-z")


def _streams(path: Path, log: _Log, names: tuple[str, ...], repairs: tuple[str, ...]) -> LogParts:
    """What is read of a log, one stream after the other."""
    sets = {(found.name, found.multi_id): found.data for found in log.data_list if len(found.data["timestamp"])}
    imus = [imu for name in MESSAGES[:3] for imu in _inertial(path, sets, name, repairs)]
    parts = LogParts()
    if imus:
        check_sensor_names(path, names, [imu.name for imu in imus])
        imu = select_sensor(path, "imu", imus, names)
        parts.add_imu(imu.gyro, imu.accel)
        _report_dropouts(path, log)
    for name in ("vehicle_gps_position", "sensor_gps"):
        if (name, 0) in sets and "gnss" not in parts.tables:
            parts.add_fixes(path, _fixes(sets[name, 0]), may_repeat=True)
    for name, field in (("vehicle_magnetometer", "magnetometer_ga[{}]"), ("sensor_mag", "{}")):
        if (name, 0) in sets and "magnetometer" not in parts.tables:
            field_ut = 100.0 * _vector(sets[name, 0], field)  # gauss -> uT
            parts.add_magnetometer(in_time_order(path, _times(sets[name, 0]), field_ut, repairs))
    for name, field in (("vehicle_air_data", "baro_pressure_pa"), ("sensor_baro", "pressure")):
        if (name, 0) in sets and "barometer" not in parts.tables:
            pressure = _column(sets[name, 0], field)
            pressure = np.where(pressure > _HIGHEST_HPA, pressure / 100.0, pressure)
            parts.add_single("barometer", "pressure_hpa", in_time_order(path, _times(sets[name, 0]), pressure, repairs))
    if ("sensor_gyro", 0) in sets and np.isfinite(warmth := _column(sets["sensor_gyro", 0], "temperature")).any():
        samples = in_time_order(path, _times(sets["sensor_gyro", 0]), warmth, repairs)
        parts.add_single("temperature", "temperature_c", samples)
    return parts


def _opened(path: Path) -> _Log:
    """The log; whatever pyulog raises on a damaged one is a SessionError, what it prints is left out."""
    from pyulog import ULog

    try:
        with path.open("rb") as file:
            if _LARGE_FIELD.search(file.read(1 << 20)):
                raise SessionError(path, "defines a message of an impossible size", "a log of PX4", "copy it again")
        with contextlib.redirect_stdout(io.StringIO()):
            log = cast(_Log, ULog(str(path), list(MESSAGES)))
    except SessionError:
        raise
    except Exception as error:  # pyulog indexes and unpacks what a damaged log does not hold
        reason = str(error) or type(error).__name__
        raise SessionError(path, f"cannot be read ({reason})", "a whole log of PX4", "copy it again") from error
    if log.file_corruption:
        warn(f"{path}: parts of the log are damaged and left out")
    return log


def _report_dropouts(path: Path, log: _Log) -> None:
    if log.dropouts:
        lost = sum(int(getattr(dropout, "duration", 0)) for dropout in log.dropouts)
        warn(f"{path}: {len(log.dropouts)} dropouts of the logger, {lost} ms in all")


def _times(data: Mapping[str, Column]) -> Times:
    """Stamps (n,) ns: of the sample where there is one, else of the message."""
    stamps = data.get("timestamp_sample", data["timestamp"])
    chosen = stamps if np.asarray(stamps).any() else data["timestamp"]
    return np.asarray(np.minimum(chosen, np.uint64(2**62 // _US)), dtype=np.int64) * _US


def _column(data: Mapping[str, Column], name: str) -> Floats:
    """A field (n,) as numbers; NaN where the message has no such field."""
    return np.asarray(data.get(name, np.full(len(data["timestamp"]), np.nan)), dtype=np.float64)


def _vector(data: Mapping[str, Column], template: str) -> Floats:
    """The three fields (n, 3) of a vector: ``name[{}]`` counts them, ``{}`` names them."""
    axes = "012" if "[" in template else "xyz"
    return np.stack([_column(data, template.format(axis)) for axis in axes], axis=-1)


def _inertial(
    path: Path, sets: Mapping[tuple[str, int], Mapping[str, Column]], name: str, repairs: tuple[str, ...]
) -> list[_Imu]:
    """The inertial sensors that one message describes."""
    found = []
    for instance in sorted(number for message, number in sets if message == name):
        data = sets[name, instance]
        gyro_ns = accel_ns = _times(data)
        if name == "sensor_combined":
            relative = np.asarray(data["accelerometer_timestamp_relative"], dtype=np.int64)
            accel_ns = gyro_ns + np.where(np.abs(relative) < _NO_STAMP, relative, 0) * _US
            rate, force = _vector(data, "gyro_rad[{}]"), _vector(data, "accelerometer_m_s2[{}]")
        elif name == "vehicle_imu":  # increments over an integration time in us
            rate = _vector(data, "delta_angle[{}]") / _per_second(data, "delta_angle_dt")
            force = _vector(data, "delta_velocity[{}]") / _per_second(data, "delta_velocity_dt")
        elif ("sensor_accel", instance) in sets:
            accel = sets["sensor_accel", instance]
            accel_ns, rate, force = _times(accel), _vector(data, "{}"), _vector(accel, "{}")
        else:
            continue
        if np.isfinite(rate).all(axis=1).any() and np.isfinite(force).all(axis=1).any():
            samples = (in_time_order(path, *rows, repairs) for rows in ((gyro_ns, rate), (accel_ns, force)))
            found.append(_Imu(name if name == "sensor_combined" else f"{name}.{instance}", *samples))
    return found


def _per_second(data: Mapping[str, Column], name: str) -> Floats:
    """Integration times (n, 1) s; NaN where there was none."""
    seconds = _column(data, name)[:, None] / 1e6
    return np.where(seconds > 0.0, seconds, np.nan)


def _fixes(data: Mapping[str, Column]) -> LoggedFixes:
    """Fixes of the receiver; heights above the ellipsoid."""
    if "latitude_deg" in data:  # since PX4 1.15
        lat, lon = _column(data, "latitude_deg"), _column(data, "longitude_deg")
        height = _column(data, "altitude_ellipsoid_m")
    else:
        lat, lon = _column(data, "lat") * 1e-7, _column(data, "lon") * 1e-7
        height = _column(data, "alt_ellipsoid") * 1e-3
    kind = np.asarray(data["fix_type"], dtype=np.int64)
    north, east, down = (_column(data, f"vel_{axis}_m_s") for axis in "ned")
    velocity = np.stack([east, north, -down], axis=-1)
    velocity[_column(data, "vel_ned_valid") == 0.0] = np.nan
    horizontal, vertical = _column(data, "eph"), _column(data, "epv")
    return LoggedFixes(
        _times(data),
        np.where(kind >= _LOWEST_FIX, lat, np.nan),
        lon,
        np.where(kind > _LOWEST_FIX, height, np.nan),
        velocity=velocity,
        velocity_sigma=_column(data, "s_variance_m_s"),
        sigma=np.stack([horizontal, horizontal, vertical], axis=-1),
        fix_type=kind,
    )


READER = Reader(
    name="px4-ulog",
    summary="PX4 log (.ulg): IMU, fixes with velocity, magnetometer, pressure; LOG.ulg#vehicle_imu.1",
    recognised_by="the first bytes of the file, ULog",
    matches=lambda source: first_bytes(str(split_source(source)[0]), 7) == MAGIC if "\0" not in source else False,
    read_source=_read,
)
