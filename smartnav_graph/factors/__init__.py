"""Factors: one file a kind, with its options (`Config`), its model and its builder.

A new factor adds a file here and a row in `FACTORS`; the options of a run, the report and the recording are made from
it. A new sensor also adds a stream to `session.streams`.

A default sigma has one home: noise of a device or of what carries it in `session.calibration.model` (calibration.toml),
sigma of a model assumption or of a prior in the module of its factor, in its `Config` where a user may set it.
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
        Label("Initial state", assumes="prior on the initial state", colour=(150, 150, 150)),
        config=prior.PriorConfig,
        section="prior",
        parts={"rest": Label("Standstill at the start", assumes="zero velocity at the start")},
    ),
    "imu": Factor(
        STREAMS["imu"].LABEL,
        imu.build,
        imu.ImuConfig,
        "imu",
        "imu",
        {
            "imu_bias": Label("IMU bias random walk", assumes="biases change slowly", colour=(200, 110, 70)),
            "imu_gap_error": Label("Gap error model", assumes="error of the motion inside IMU data gaps"),
        },
    ),
    "gnss": Factor(
        STREAMS["gnss"].LABEL,
        gnss.build,
        gnss.GnssConfig,
        "gnss",
        "gnss",
        {
            "gnss_correlated_error": Label(
                "Correlated GNSS error (Gauss-Markov)", assumes="successive fixes have correlated errors"
            )
        },
    ),
    "control": Factor(STREAMS["control"].LABEL, control.build, control.ControlConfig, "control", "control"),
    "pose_fixes": Factor(
        STREAMS["pose_fixes"].LABEL, pose_fix.build, pose_fix.PoseFixConfig, "pose_fixes", "pose_fixes"
    ),
    "pose_attitude": Factor(
        Label("Attitude of pose fixes"),
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
            "static_turn": Label("Zero angular rate updates (ZARU)", assumes="zero angular rate while at rest"),
            "static_level": Label("Flat floor", assumes="the floor is flat"),
        },
    ),
    "gnss_velocity": Factor(
        Label("GNSS velocity"),
        velocity.build_gnss,
        velocity.VelocityConfig,
        "velocity",
        "gnss",
    ),
    "velocity": Factor(STREAMS["velocity"].LABEL, velocity.build, velocity.VelocityConfig, "velocity", "velocity"),
    "vehicle": Factor(
        Label("Vehicle constraint", assumes="wheels move neither sideways nor off the road"),
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
        Label("Gravity", assumes="the mean specific force is vertical"),
        gravity.build,
        gravity.GravityConfig,
        "gravity",
        parts={"pace": Label("Walking pace", assumes="a pedestrian moves slowly")},
    ),
    "barometer": Factor(
        STREAMS["barometer"].LABEL,
        barometer.build,
        barometer.BarometerConfig,
        "barometer",
        "barometer",
        {"barometer_bias": Label("Barometer bias random walk", assumes="the pressure offset changes slowly")},
    ),
    "steps": Factor(
        Label("Steps", assumes="length and direction of a pedestrian's steps"),
        pedestrian.build,
        pedestrian.StepConfig,
        "steps",
    ),
    "image_pairs": Factor(
        Label("Image pairs", colour=(225, 180, 20)),
        coplanarity.build,
        coplanarity.CoplanarityConfig,
        "image_pairs",
        "matches",
    ),
    "smart": Factor(
        Label("Tracked points in space"),
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
    text = name.replace("_", " ")
    return _LABELS.get(name, Label(text[:1].upper() + text[1:]))


def title_of(name: str) -> str:
    """Title of a stream, a factor or a part of one."""
    return label_of(name).title


def builder_of(sensor: str) -> str:
    """The builder of a factor, from the sensor of its id: ``imu_bias`` comes from ``imu``."""
    return _PARTS.get(sensor, sensor)


def make_builders(context: FactorContext) -> list[Builder]:
    """The builders of everything that a session has, in the order of `FACTORS`."""
    makers = (factor.build for factor in FACTORS.values() if factor.build is not None)
    return [builder for build in makers if (builder := build(context)) is not None]
