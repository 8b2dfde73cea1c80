"""A ROS 1 bag, a ROS 2 bag (folder, SQLite or MCAP) -> its topics as arrays.

Message definitions: sensor_msgs, geometry_msgs (docs.ros.org). A bag is foreign data: what rosbags raises on a damaged
one becomes a SessionError, and nothing in it says how much memory is taken: rows are kept as numbers only.
"""

from __future__ import annotations

import tempfile
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

MAGIC = {b"#ROSBAG V2.0\n": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
METADATA = "metadata.yaml"


class _Vector(Protocol):
    x: float
    y: float
    z: float


class _Stamp(Protocol):
    sec: int
    nanosec: int


class _Header(Protocol):
    stamp: _Stamp
    frame_id: str


class _Twist(Protocol):
    linear: _Vector
    twist: _Twist  # of TwistWithCovariance


class _Status(Protocol):
    status: int


class Message(Protocol):
    """The fields of the messages that are read, each of some types only."""

    header: _Header
    angular_velocity: _Vector
    linear_acceleration: _Vector
    angular_velocity_covariance: Floats
    linear_acceleration_covariance: Floats
    status: _Status
    latitude: float
    longitude: float
    altitude: float
    position_covariance: Floats
    position_covariance_type: int
    magnetic_field: _Vector
    fluid_pressure: float
    temperature: float
    twist: _Twist
    encoding: str
    format: str
    height: int
    width: int
    step: int
    is_bigendian: int
    data: Floats


def _xyz(vector: _Vector) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _imu(message: Message) -> tuple[float, ...]:
    rate, force = _xyz(message.angular_velocity), _xyz(message.linear_acceleration)
    unknown = (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0])
    return (*rate, *force, *(float(first) for first in unknown))


def _fix(message: Message) -> tuple[float, ...]:
    """Position, variances (east, north, up), whether there is a fix, and whether the variances are known."""
    variances = message.position_covariance
    known = message.position_covariance_type > 0
    position = (message.latitude, message.longitude, message.altitude)
    return (*position, *(float(variances[i]) for i in (0, 4, 8)), float(message.status.status), float(known))


# Values of a message of each type that is read, without those of images.
VALUES: dict[str, Callable[[Message], tuple[float, ...]]] = {
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/NavSatFix": _fix,
    "sensor_msgs/msg/MagneticField": lambda message: _xyz(message.magnetic_field),
    "sensor_msgs/msg/FluidPressure": lambda message: (message.fluid_pressure,),
    "sensor_msgs/msg/Temperature": lambda message: (message.temperature,),
    "geometry_msgs/msg/TwistStamped": lambda message: _xyz(message.twist.linear),
    "geometry_msgs/msg/TwistWithCovarianceStamped": lambda message: _xyz(message.twist.twist.linear),
}
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


@dataclass
class Topic:
    """Messages of one topic: `t_ns` of the sensor, `log_ns` of the recorder (n,), and `values` (n, k).

    texts : of images their encoding
    """

    name: str
    kind: str
    frame: str = ""
    _stamps: array[int] = field(default_factory=lambda: array("q"))
    _logged: array[int] = field(default_factory=lambda: array("q"))
    _values: array[float] = field(default_factory=lambda: array("d"))
    texts: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self._stamps)

    def append(self, message: Message, log_ns: int) -> None:
        """One more message; without a stamp of its own it has that of the recorder."""
        stamp = message.header.stamp.sec * NS + message.header.stamp.nanosec
        self._stamps.append(stamp if stamp > 0 else log_ns)
        self._logged.append(log_ns)
        self.frame = self.frame or message.header.frame_id
        if self.kind in VALUES:
            self._values.extend(VALUES[self.kind](message))
        else:
            self.texts.append(message.encoding if self.kind == IMAGES[0] else message.format)

    @property
    def t_ns(self) -> Times:
        """Stamps (n,) ns of the headers."""
        return np.frombuffer(self._stamps, dtype=np.int64)

    @property
    def log_ns(self) -> Times:
        """Times (n,) ns at which the messages were recorded."""
        return np.frombuffer(self._logged, dtype=np.int64)

    @property
    def values(self) -> Floats:
        """Values (n, columns) of the messages."""
        return np.frombuffer(self._values, dtype=np.float64).reshape(len(self), -1)

    @property
    def rate_hz(self) -> float:
        """Messages a second, by their stamps."""
        steps = np.diff(self.t_ns)
        steps = steps[steps > 0]
        return float(NS / np.median(steps)) if len(steps) else 0.0


def suffix_of(path: Path) -> str:
    """The suffix that a bag of this content has; empty for anything else. Never raises."""
    try:
        if path.is_dir():
            with (path / METADATA).open("rb") as file:
                return "folder" if b"rosbag2_bagfile_information" in file.read(4096) else ""
        with path.open("rb") as file:
            start = file.read(8192)
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return ""
    found = next((suffix for magic, suffix in MAGIC.items() if start.startswith(magic)), "")
    return found if found != ".db3" or b"CREATE TABLE topics" in start else ""


@contextmanager
def opened(path: Path) -> Iterator[AnyReader]:
    """The reader of a bag; whatever it raises on a damaged one is a SessionError.

    Raises
    ------
    SessionError
        The bag cannot be read.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    suffix = suffix_of(path)
    with tempfile.TemporaryDirectory() as scratch:
        named = path
        if suffix not in ("folder", path.suffix):  # rosbags goes by the suffix
            named = Path(scratch, f"bag{suffix}")
            named.symlink_to(path.resolve())
        try:
            with AnyReader([named], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
                yield reader
        except SessionError:
            raise
        except Exception as error:  # rosbags asserts and indexes what a damaged bag does not hold
            reason = str(error).replace(str(named), path.name) or type(error).__name__
            remedy = "copy it again; `rosbag reindex` (ROS 1) or `ros2 bag reindex` mends one that was not closed"
            raise SessionError(path, f"cannot be read ({reason})", "a whole ROS bag", remedy) from error


def read_topics(path: Path) -> list[Topic]:
    """The topics of the types that are read, in the order of the bag.

    Raises
    ------
    SessionError
        The bag cannot be read.
    """
    with opened(path) as reader:
        wanted = [found for found in reader.connections if found.msgtype in (*VALUES, *IMAGES)]
        topics = {(found.topic, found.msgtype): Topic(found.topic, found.msgtype) for found in wanted}
        for connection, log_ns, message in messages(reader, wanted):
            topics[connection.topic, connection.msgtype].append(message, log_ns)
        if not any(map(len, topics.values())):
            names = ", ".join(f"{found.topic} ({found.msgtype})" for found in reader.connections) or "no topic"
            found = f"holds no messages that can be used; it has {names}"[:500]
            raise SessionError(path, found, "sensor_msgs/Imu, NavSatFix, ...", "record these topics")
    return [topic for topic in topics.values() if len(topic)]


def messages(reader: AnyReader, wanted: list[Connection]) -> Iterator[tuple[Connection, int, Message]]:
    """The messages of some connections, in the order of the recorder."""
    if wanted:
        for connection, log_ns, data in reader.messages(wanted):
            yield connection, log_ns, cast(Message, reader.deserialize(data, connection.msgtype))
