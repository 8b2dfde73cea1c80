"""Trajectories in ROS bags: Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped, or the last Path."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Table
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.robotics.ros_bag import opened, suffix_of
from smartnav_graph.readers.robotics.sensor_choice import split_source
from smartnav_graph.readers.source import vector_columns

Getter = Callable[[object], tuple[float, ...]]


def _getter(place: str, position: str = "position", orientation: str = "orientation") -> Getter:
    """Position, and quaternion w first, of the pose at `place` in a message."""
    return attrgetter(*(f"{place}{position}.{a}" for a in "xyz"), *(f"{place}{orientation}.{a}" for a in "wxyz"))


POSES: dict[str, Getter] = {
    "nav_msgs/msg/Odometry": _getter("pose.pose."),
    "geometry_msgs/msg/PoseStamped": _getter("pose."),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _getter("pose.pose."),
    "geometry_msgs/msg/TransformStamped": _getter("transform.", "translation", "rotation"),
}
STAMP = attrgetter("header.stamp.sec", "header.stamp.nanosec")
PATH = "nav_msgs/msg/Path"


def is_bag(source: str | Path) -> bool:
    """Whether ``BAG`` or ``BAG#/topic`` is a bag. Never raises."""
    return bool(suffix_of(split_source(str(source))[0]))


def pose_columns_of_bag(source: str | Path) -> Table:
    """File columns of `Reference`: the poses of the only such topic, or of that in ``BAG#/topic``.

    Raises
    ------
    SessionError
        The bag cannot be read, has no poses, or has several topics of them and none is chosen.
    """
    path, names = split_source(str(source))
    with opened(path) as reader:
        found = [one for one in reader.connections if one.msgtype in (*POSES, PATH)]
        chosen = [one for one in found if not names or one.topic in names]
        topics = sorted({one.topic for one in chosen})
        if len(topics) != 1:
            listed = ", ".join(sorted({f"{one.topic} ({one.msgtype})" for one in found})) or "none"
            remedy = f"choose one, such as {path}#{topics[0]}" if topics else "record Odometry or PoseStamped"
            raise SessionError(path, f"topics with poses: {listed}", "one of them", remedy)
        rows, stamps = list[tuple[float, ...]](), list[int]()
        for connection, log_ns, data in reader.messages(connections=chosen):
            message = reader.deserialize(data, connection.msgtype)
            is_path = connection.msgtype == PATH
            if is_path:  # each repeats the ones before it
                rows, stamps = [], []
            for one in attrgetter("poses")(message) if is_path else [message]:
                seconds, nanoseconds = STAMP(one)
                stamps.append(seconds * NS + nanoseconds or log_ns)
                rows.append(POSES["geometry_msgs/msg/PoseStamped" if is_path else connection.msgtype](one))
    order = np.argsort(stamps, kind="stable")
    values = np.array(rows, dtype=np.float64).reshape(-1, 7)[order]
    position = vector_columns("{}_m", values[:, :3], "enu")
    return {"t_ns": np.array(stamps, dtype=np.int64)[order]} | position | vector_columns("q{}", values[:, 3:], "wxyz")
