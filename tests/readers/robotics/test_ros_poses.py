"""Trajectories in bags, as `evaluate` takes them."""

from __future__ import annotations

import numpy as np
import pytest
from bags import KINDS, T0, Bag

from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.reference import load_reference

STEPS = np.arange(5)
HALF = np.sqrt(0.5)  # a quarter turn about z


def pose(bag: Bag, k: int):
    point = bag.type("geometry_msgs/msg/Point")(x=float(k), y=2.0 * k, z=0.5)
    turn = bag.type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=HALF, w=HALF)
    return bag.type("geometry_msgs/msg/Pose")(position=point, orientation=turn)


def with_poses(kind: str) -> Bag:
    bag = Bag(kind)
    for k in STEPS.tolist():
        bag.add("/pose", "geometry_msgs/msg/PoseStamped", T0 + k * 10**8, "map", pose=pose(bag, k))
    return bag


def check(found, rows=STEPS):
    np.testing.assert_array_equal(found.t_ns, T0 + rows * 10**8)
    np.testing.assert_allclose(found.enu, np.column_stack([rows, 2.0 * rows, np.full(len(rows), 0.5)]))
    np.testing.assert_allclose(found.quat, np.tile([HALF, 0, 0, HALF], (len(rows), 1)))


@pytest.mark.parametrize("kind", KINDS)
def test_poses_of_a_bag(kind, tmp_path):
    check(load_reference(with_poses(kind).write(tmp_path)))


def test_odometry_transforms_and_the_last_path(tmp_path):
    bag = Bag("mcap")
    for k in STEPS.tolist():
        t_ns, here = T0 + k * 10**8, pose(bag, k)
        twist = bag.type("geometry_msgs/msg/TwistWithCovariance")(
            twist=bag.type("geometry_msgs/msg/Twist")(linear=bag.xyz((0, 0, 0)), angular=bag.xyz((0, 0, 0))),
            covariance=np.zeros(36),
        )
        known = bag.type("geometry_msgs/msg/PoseWithCovariance")(pose=here, covariance=np.zeros(36))
        bag.add("/odom", "nav_msgs/msg/Odometry", t_ns, child_frame_id="base", pose=known, twist=twist)
        there = bag.type("geometry_msgs/msg/Transform")(translation=bag.xyz((k, 2 * k, 0.5)), rotation=here.orientation)
        bag.add("/vicon", "geometry_msgs/msg/TransformStamped", t_ns, child_frame_id="base", transform=there)
        stamped = [
            bag.type("geometry_msgs/msg/PoseStamped")(header=bag.header(T0 + i * 10**8, "map"), pose=pose(bag, i))
            for i in range(k + 1)
        ]
        bag.add("/path", "nav_msgs/msg/Path", t_ns, poses=stamped)
    path = bag.write(tmp_path)
    for topic in ("/odom", "/vicon", "/path"):
        check(load_reference(f"{path}#{topic}"))
    with pytest.raises(SessionError, match=r"topics with poses: /odom .*expected one of them; choose one"):
        load_reference(path)


def test_a_bag_without_poses_is_refused(tmp_path):
    bag = Bag("mcap")
    for k in range(3):
        bag.imu(T0 + k * 10**7)
    with pytest.raises(SessionError, match="topics with poses: none"):
        load_reference(bag.write(tmp_path))
