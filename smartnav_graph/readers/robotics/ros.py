"""ROS 1 and ROS 2 bags, MCAP: Imu, NavSatFix, MagneticField, FluidPressure, Temperature, TwistStamped, images.

Of several topics of one type the fastest is read, and of those equally fast the first; ``BAG#/topic,/topic`` chooses
others. Specific force is +g on the axis that points up (REP 145); up and forward are found in the data. A covariance
is variances: position_covariance of the axes east, north, up. A topic whose stamps are on another clock than those of
the IMU is carried over by the stamps of the recorder.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask, Table, Times
from smartnav_graph.core.errors import SessionError, warn
from smartnav_graph.core.frames import LocalFrame
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.readers.axes import BodyAxes
from smartnav_graph.readers.fixes import LoggedFixes, first_fix
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.robotics.device_axes import device_axes
from smartnav_graph.readers.robotics.ros_bag import IMAGES, Topic, read_topics, suffix_of
from smartnav_graph.readers.robotics.ros_images import image_table, write_bag_pictures
from smartnav_graph.readers.robotics.sensor_choice import check_sensor_names, select_sensor, split_source
from smartnav_graph.readers.samples import Samples, carried, clock_offset, in_time_order
from smartnav_graph.readers.source import Reader, vector_columns
from smartnav_graph.session.session import Session

OTHER_CLOCK_S = 1.0  # a topic delivered so much later than the IMU, or before it was measured, is on another clock
UNIX_SINCE_NS = int(np.datetime64("2000-01-01", "ns").astype(np.int64))  # a simulated clock begins at zero
_WITHOUT_GRAVITY = 4.0  # m/s^2, of the median specific force
_SAME_VELOCITY = 0.3  # misfit of a velocity and the differences of the fixes, over their size
_SINGLE = {  # type -> stream, column, factor to its unit
    "sensor_msgs/msg/FluidPressure": ("barometer", "pressure_hpa", 0.01),
    "sensor_msgs/msg/Temperature": ("temperature", "temperature_c", 1.0),
}


def _matches(source: str) -> bool:
    try:
        return bool(suffix_of(split_source(source)[0]))
    except (OSError, ValueError):
        return False


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path, names = split_source(source)
    topics = read_topics(path)
    check_sensor_names(path, names, [topic.name for topic in topics])
    parts = LogParts()
    imus = _of(topics, "sensor_msgs/msg/Imu")
    clock = _Clock(path, repairs, imus[0] if imus else topics[0])
    if imus:
        parts.add_imu(*_inertial(clock, imus, names))
    if found := _of(topics, "sensor_msgs/msg/NavSatFix"):
        parts.add_fixes(path, _fixes(clock, select_sensor(path, "fixes", found, names)), may_repeat=True)
    if found := _of(topics, "sensor_msgs/msg/MagneticField"):
        parts.add_magnetometer(clock.samples(select_sensor(path, "magnetometer", found, names), slice(0, 3), 1e6))
    for kind, (stream, column, factor) in _SINGLE.items():
        if found := _of(topics, kind):
            parts.add_single(
                stream, column, clock.samples(select_sensor(path, stream, found, names), slice(0, 1), factor)
            )
    axes = device_axes(path, parts)
    for topic in topics:
        if "Twist" in topic.kind:
            _add_velocity(clock, parts, topic, imus[0].frame if imus else "", axes)
    cameras = [topic for topic in topics if topic.kind in IMAGES]
    if cameras:
        parts.add("images", path, image_table([(topic, clock.t_ns(topic)) for topic in cameras]))
    epoch = "unix" if clock.t_ns(clock.first)[0] > UNIX_SINCE_NS else "unknown"
    session = log_session(parts, repairs, name="ROS bag", epoch=epoch, forward=axes.forward, up=axes.up)
    return session.replace(write_pictures=partial(write_bag_pictures, path)) if cameras else session


def _of(topics: list[Topic], kind: str) -> list[Topic]:
    return [topic for topic in topics if topic.kind == kind]


class _Clock:
    """Stamps of all topics on the clock of the first: by the recorder's where a topic is on another clock."""

    def __init__(self, path: Path, repairs: tuple[str, ...], first: Topic) -> None:
        self.path, self.repairs, self.first = path, repairs, first
        self._delay_ns = self._delay(first)

    @staticmethod
    def _delay(topic: Topic) -> int:
        return clock_offset(topic.t_ns, topic.log_ns)

    def t_ns(self, topic: Topic) -> Times:
        """Stamps (n,) of a topic."""
        shift = self._delay(topic) - self._delay_ns
        if abs(shift) < OTHER_CLOCK_S * NS:
            return topic.t_ns
        off = f"stamps of {topic.name} are {-shift / NS:.3f} s off those of {self.first.name}"
        warn(f"{self.path}: {off} by the stamps of the recorder; {shift / NS:.3f} s are added")
        return topic.t_ns + shift

    def samples(self, topic: Topic, columns: slice, factor: float = 1.0) -> Samples:
        """Readings of a topic, in order of time."""
        try:
            return in_time_order(self.path, self.t_ns(topic), topic.values[:, columns] * factor, self.repairs)
        except SessionError as error:
            raise error.located(f"{self.path}#{topic.name}") from error


def _inertial(clock: _Clock, imus: list[Topic], names: tuple[str, ...]) -> tuple[Samples, Samples]:
    """Angular rate and specific force: of one topic, else of one with the gyro and one with the accelerometer."""
    rates, forces, complete = [], [], []
    for topic in imus:
        values = topic.values
        has_rate = values[0, 6] != -1.0 and (len(imus) == 1 or bool(np.nan_to_num(values[:, :3]).any()))
        size = float(np.nanmedian(np.linalg.norm(values[:, 3:6], axis=1)))
        has_force = values[0, 7] != -1.0 and size > 0.0
        rates += [topic] if has_rate else []
        forces += [topic] if has_force else []
        complete += [topic] if has_rate and has_force and (size > _WITHOUT_GRAVITY or topic.name in names) else []
    rates, forces = (complete, complete) if complete else (rates, forces)
    if not rates or not forces:
        missing = "angular rate" if not rates else "acceleration"
        seen = ", ".join(topic.name for topic in imus)
        raise SessionError(clock.path, f"has no {missing} in {seen}", "sensor_msgs/Imu with both", "record the raw IMU")
    gyro = select_sensor(clock.path, "imu", rates, names)
    accel = gyro if gyro in forces else select_sensor(clock.path, "accelerometer", forces, names)
    return clock.samples(gyro, slice(0, 3)), clock.samples(accel, slice(3, 6))


def _fixes(clock: _Clock, topic: Topic) -> LoggedFixes:
    values = topic.values
    lat, lon, height = np.where(values[:, 6] < 0.0, np.nan, values[:, :3].T)  # status -1: no fix
    known = (values[:, 7:8] > 0.0) & (values[:, 3:6] > 0.0)
    sigma = np.sqrt(np.where(known, values[:, 3:6], np.nan))
    return LoggedFixes(clock.t_ns(topic), lat, lon, height, sigma=sigma)


def _add_velocity(clock: _Clock, parts: LogParts, topic: Topic, imu_frame: str, axes: BodyAxes) -> None:
    """The velocity of the receiver, where it is that of the fixes; else that of the body or of the wheels."""
    velocity = clock.samples(topic, slice(0, 3))
    fixes = parts.tables["gnss"][1] if "gnss" in parts.tables else None
    if fixes is not None and "ve_m_s" not in fixes and _is_of_fixes(velocity, fixes):
        rows, known = carried(np.asarray(fixes["t_ns"], dtype=np.int64), velocity)
        fixes |= vector_columns("v{}_m_s", np.where(known[:, None], rows, np.nan), "enu")
    elif topic.frame and topic.frame == imu_frame and "velocity" not in parts.tables:
        columns: Table = {"t_ns": velocity.t_ns} | vector_columns("v_{}_m_s", velocity.values)
        parts.add("velocity", velocity.file, columns, velocity.counts)
    elif axes.forward_found and "wheel" not in parts.tables:
        parts.add("wheel", velocity.file, {"t_ns": velocity.t_ns, "speed_m_s": velocity.values[:, 0]}, velocity.counts)
    else:
        axes_text = f"its axes (frame {topic.frame!r}) are neither those of the fixes nor those of the IMU"
        warn(f"{clock.path}: {topic.name} is not used: {axes_text}")


def _is_of_fixes(velocity: Samples, fixes: Table) -> bool:
    """Whether a velocity has the axes east, north: it is then what the differences of the fixes are."""
    at = np.asarray(fixes["t_ns"], dtype=np.int64)
    if len(at) < 3:
        return False
    position = np.column_stack([*(np.asarray(fixes[name]) for name in ("lat_deg", "lon_deg")), np.zeros(len(at))])
    enu: Floats = LocalFrame(first_fix(fixes)).nav_from_lla(position.astype(np.float64))
    chord = np.gradient(enu[:, :2], seconds_since(at, int(at[0])), axis=0)
    rows, known = carried(at, velocity)
    moving: Mask = known & (np.hypot(*chord.T) > 1.0)
    if moving.sum() < 10:
        return False
    misfit = np.median(np.linalg.norm(rows[moving, :2] - chord[moving], axis=1))
    return bool(misfit < _SAME_VELOCITY * np.median(np.linalg.norm(chord[moving], axis=1)))


READER = Reader(
    name="ros",
    summary="ROS 1 or ROS 2 bag, MCAP: IMU, fixes, magnetometer, pressure, velocity, images; BAG#/topic",
    recognised_by="the first bytes of a .bag, .mcap or .db3 file, or a folder with metadata.yaml of a bag",
    matches=_matches,
    read_source=_read,
)
