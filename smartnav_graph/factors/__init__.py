"""Factors: one file a kind, with its options (`Config`), its model and its builder.

A new factor adds a file here and a row in `FACTORS`; the options of a run, the report and the recording are made from
it. A new sensor also adds a stream to `session.streams`.

A default sigma has one home: noise of a device in `session.calibration.model`, sigma of a model assumption or prior in
the `Config` of its factor, which a user may set.
"""

from __future__ import annotations

from collections.abc import Mapping

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
    prior,
    ranging,
    smart,
    standstill,
    vehicle,
    velocity,
    wheel,
)
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.table import Factor
from smartnav_graph.graph.update import Builder
from smartnav_graph.session.detect.standstills import StandstillConfig
from smartnav_graph.session.stream import Label
from smartnav_graph.session.streams import STREAMS

# The inertial builder comes first: it predicts the state that the others refer to.
FACTORS: Mapping[str, Factor] = {
    "prior": Factor(
        Label(
            "Start",
            "prior",
            "priors",
            "the prior on the initial state",
            "the initial state, as found or given",
            (150, 150, 150),
        ),
        config=prior.PriorConfig,
        section="prior",
        parts={
            "rest": Label("Rest at the start", "zero velocity", "zero velocities", assumes="the device did not move")
        },
    ),
    "imu": Factor(
        STREAMS["imu"].LABEL,
        imu.build,
        imu.ImuConfig,
        "imu",
        "imu",
        {
            "imu_bias": Label(
                "IMU bias walk",
                "bias step",
                "bias steps",
                assumes="biases of the IMU change slowly",
                colour=(200, 110, 70),
            ),
            "imu_straying": Label(
                "Gap error model", "gap error", "gap errors", assumes="errors of motion interpolated in IMU data gaps"
            ),
        },
    ),
    "gnss": Factor(
        STREAMS["gnss"].LABEL,
        gnss.build,
        gnss.GnssConfig,
        "gnss",
        "gnss",
        {
            "gnss_wander": Label(
                "Correlated GNSS error",
                "correlated error",
                "correlated errors",
                assumes="errors of successive fixes are alike (Gauss-Markov)",
            )
        },
    ),
    "control": Factor(STREAMS["control"].LABEL, control.build, control.ControlConfig, "control", "control"),
    "pose_fixes": Factor(
        STREAMS["pose_fixes"].LABEL, pose_fix.build, pose_fix.PoseFixConfig, "pose_fixes", "pose_fixes"
    ),
    "pose_attitude": Factor(
        Label("Attitude of pose fixes", "attitude", "attitudes", "the attitude of the pose fixes"),
        pose_fix.build_attitude,
        pose_fix.PoseFixConfig,
        "pose_fixes",
        "pose_fixes",
    ),
    "ranges": Factor(STREAMS["ranges"].LABEL, ranging.build, ranging.RangeConfig, "ranges", "ranges"),
    "static": Factor(
        STREAMS["static"].LABEL,
        standstill.build,
        StandstillConfig,
        "standstill",
        "static",
        {
            "static_turn": Label(
                "Zero angular rate updates (ZARU)",
                "zero angular rate update",
                "zero angular rate updates",
                assumes="the device did not turn while at rest",
            ),
            "static_level": Label("Flat floor", "floor height", "floor heights", assumes="the floor is flat"),
        },
    ),
    "gnss_velocity": Factor(
        Label("GNSS velocity", "GNSS velocity", "GNSS velocities"),
        velocity.build_gnss,
        velocity.VelocityConfig,
        "velocity",
        "gnss",
    ),
    "velocity": Factor(STREAMS["velocity"].LABEL, velocity.build, velocity.VelocityConfig, "velocity", "velocity"),
    "vehicle": Factor(
        Label(
            "Vehicle",
            "vehicle row",
            "vehicle rows",
            "the vehicle constraint",
            assumes="wheels do not slide sideways or leave the road",
        ),
        vehicle.build,
        vehicle.VehicleConfig,
        "vehicle",
    ),
    "wheel": Factor(STREAMS["wheel"].LABEL, wheel.build, wheel.WheelConfig, "wheel", "wheel"),
    "magnetometer": Factor(
        STREAMS["magnetometer"].LABEL,
        magnetometer.build,
        magnetometer.MagnetometerConfig,
        "magnetometer",
        "magnetometer",
    ),
    "gravity": Factor(
        Label(
            "Gravity",
            "tilt from gravity",
            "tilts from gravity",
            "gravity as the level",
            assumes="the mean of the specific force points up",
        ),
        gravity.build,
        gravity.GravityConfig,
        "gravity",
        parts={"pace": Label("Walking pace", "pace", "paces", assumes="a person does not move fast")},
    ),
    "barometer": Factor(
        STREAMS["barometer"].LABEL,
        barometer.build,
        barometer.BarometerConfig,
        "barometer",
        "barometer",
        {"barometer_bias": Label("Pressure drift", "drift", "drifts", assumes="the weather changes slowly")},
    ),
    "steps": Factor(
        Label(
            "Steps",
            "stretch of steps",
            "stretches of steps",
            "the steps",
            assumes="how long a walker's steps are, and where they lead",
        ),
        pedestrian.build,
        pedestrian.StepConfig,
        "steps",
    ),
    "image_pairs": Factor(
        Label("Image pairs", "image pair", "image pairs", colour=(225, 180, 20)),
        coplanarity.build,
        coplanarity.CoplanarityConfig,
        "image_pairs",
        "matches",
    ),
    "smart": Factor(
        Label("Tracks in space", "track", "tracks", "the image tracks"),
        smart.build,
        smart.SmartConfig,
        "smart",
        "tracks",
    ),
}
_PARTS = {part: name for name, factor in FACTORS.items() for part in factor.parts}
_LABELS = {
    **{name: kind.LABEL for name, kind in STREAMS.items()},
    **{name: factor.label for name, factor in FACTORS.items()},
    **{name: label for factor in FACTORS.values() for name, label in factor.parts.items()},
}


def label_of(name: str) -> Label:
    """Label of a stream, a factor or a part of one, by its name; made of the name where it is unknown."""
    words = name.replace("_", " ")
    unknown = Label(words[:1].upper() + words[1:], f"{name} measurement", f"{name} measurements", name)
    return _LABELS.get(name, unknown)


def builder_of(sensor: str) -> str:
    """The builder of a factor, from the sensor of its id: ``imu_bias`` comes from ``imu``."""
    return _PARTS.get(sensor, sensor)


def make_builders(context: FactorContext) -> list[Builder]:
    """The builders of everything that a session has, in the order of `FACTORS`."""
    makers = (factor.build for factor in FACTORS.values() if factor.build is not None)
    return [builder for build in makers if (builder := build(context)) is not None]
