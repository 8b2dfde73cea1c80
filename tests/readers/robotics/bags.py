"""Writes small ROS bags: the messages of a device on a drive, in any of the formats."""

from __future__ import annotations

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

T0 = 1_700_000_000_123_456_789  # ns
SPEED = 5.0  # m/s
ORIGIN = (48.0, 9.0, 300.0)
KINDS = ("ros1", "mcap", "sqlite")
FIELD = (1e-5, -4e-5, 2e-5)  # T


def course(t):
    """Angle from east to the left, rad, at t s of a winding road."""
    return 0.4 / 0.3 * np.sin(0.3 * t)


def motion(t):
    """Angular rate and specific force at t s: up is +y, forward +z, left +x."""
    turn = 0.4 * np.cos(0.3 * t)
    return (0.001, turn, -0.002), (SPEED * turn, 9.81, 0.25)


class Bag:
    """Collects messages (topic, type, log time ns, message) and writes them."""

    def __init__(self, kind):
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        self.rows = []

    def type(self, name):
        return self.store.types[name]

    def header(self, t_ns, frame):
        stamp = self.type("builtin_interfaces/msg/Time")(sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        fields = {"seq": 0} if self.kind == "ros1" else {}
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **fields)

    def add(self, topic, name, t_ns, frame="", log_ns=None, **fields):
        message = self.type(name)(header=self.header(t_ns, frame), **fields)
        self.rows.append((topic, name, t_ns + 2_000_000 if log_ns is None else log_ns, message))

    def xyz(self, values):
        return self.type("geometry_msgs/msg/Vector3")(**dict(zip("xyz", map(float, values), strict=True)))

    def imu(self, t_ns, rate=(0.001, 0.0, 0.0), force=(0.0, 9.81, 0.0), topic="/imu/data", unknown=(0.0, 0.0), **where):
        covariance = [np.diag([first or 4e-4, 4e-4, 4e-4]).ravel() for first in (*unknown, 0.0)]
        self.add(
            *(topic, "sensor_msgs/msg/Imu", t_ns, "imu_link"),
            orientation=self.type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=covariance[2],
            angular_velocity=self.xyz(rate),
            angular_velocity_covariance=covariance[0],
            linear_acceleration=self.xyz(force),
            linear_acceleration_covariance=covariance[1],
            **where,
        )

    def fix(self, t_ns, lat, lon, height, variances=(0.04, 0.09, 1.44), status=0, known=2, **where):
        flags = self.type("sensor_msgs/msg/NavSatStatus")(status=status, service=1)
        self.add(
            *("/fix", "sensor_msgs/msg/NavSatFix", t_ns, "gps"),
            status=flags,
            latitude=lat,
            longitude=lon,
            altitude=height,
            position_covariance=np.diag(variances).ravel(),
            position_covariance_type=known,
            **where,
        )

    def twist(self, t_ns, velocity, frame="gps", topic="/vel"):
        twist = self.type("geometry_msgs/msg/Twist")(linear=self.xyz(velocity), angular=self.xyz((0, 0, 0)))
        self.add(topic, "geometry_msgs/msg/TwistStamped", t_ns, frame, twist=twist)

    def write(self, folder):
        """The path of the bag."""
        suffix = {"ros1": "log.bag", "mcap": "log", "sqlite": "log"}[self.kind]
        path, known = folder / suffix, {}
        if self.kind == "ros1":
            writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
        with writer:
            for topic, name, log_ns, message in sorted(self.rows, key=lambda row: row[2]):
                if topic not in known:
                    known[topic] = writer.add_connection(topic, name, typestore=self.store)
                serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
                writer.write(known[topic], log_ns, serialize(message, name))
        return path


def drive(kind, seconds=60):
    """A winding road: IMU 50 Hz (another of 10 Hz), fixes and their velocity 5 Hz, field and pressure 10 Hz."""
    bag = Bag(kind)
    for i in range(seconds * 50):
        t_ns = T0 + i * 20_000_000
        bag.imu(t_ns, *motion(i * 0.02))
        if i % 5 == 0:
            bag.imu(t_ns + 1000, force=(0.0, 0.0, 9.7), topic="/slow/imu")
            bag.add("/mag", "sensor_msgs/msg/MagneticField", t_ns, "imu_link", magnetic_field=bag.xyz(FIELD),
                    magnetic_field_covariance=np.zeros(9))  # fmt: skip
            bag.add("/air", "sensor_msgs/msg/FluidPressure", t_ns, "", fluid_pressure=97_812.5, variance=4.0)
        if i % 10 == 0:
            t = np.arange(0.0, i * 0.02 + 0.005, 0.01)
            east, north = (SPEED * 0.01 * np.sum(f(course(t[:-1]))) for f in (np.cos, np.sin))
            bag.fix(t_ns + 5_000_000, ORIGIN[0] + north / 111_200.0, ORIGIN[1] + east / 73_172.0, ORIGIN[2])
            bag.twist(t_ns + 5_000_000, (SPEED * np.cos(course(t[-1])), SPEED * np.sin(course(t[-1])), 0.125))
    return bag
