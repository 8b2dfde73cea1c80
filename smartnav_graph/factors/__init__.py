"""Factors: one file = Config + model + builder. A new factor adds a file here and a row in BUILDERS."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from smartnav_graph.factors import (
    barometer,
    control,
    coplanarity,
    gnss,
    gravity,
    imu,
    magnetometer,
    pedestrian,
    pose_fix,
    smart,
    standstill,
    vehicle,
    velocity,
    wheel,
)
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.graph.update import Builder

# The inertial builder comes first: it predicts the state that the others refer to.
BUILDERS: Mapping[str, Callable[[FactorContext], Builder | None]] = {
    "imu": imu.build,
    "gnss": gnss.build,
    "control": control.build,
    "pose_fixes": pose_fix.build,
    "pose_attitude": pose_fix.build_attitude,
    "static": standstill.build,
    "gnss_velocity": velocity.build_gnss,
    "velocity": velocity.build,
    "vehicle": vehicle.build,
    "wheel": wheel.build,
    "magnetometer": magnetometer.build,
    "gravity": gravity.build,
    "barometer": barometer.build,
    "steps": pedestrian.build,
    "coplanarity": coplanarity.build,
    "smart": smart.build,
}

# Sensors of factors that do not begin with the name of their builder.
_OF_OTHERS = {"rest": "prior", "pace": "gravity"}


def builder_of(sensor: str) -> str:
    """The builder of a factor, from the sensor of its id: ``imu_bias`` comes from ``imu``."""
    return sensor if sensor in BUILDERS else _OF_OTHERS.get(sensor, sensor.split("_")[0])
