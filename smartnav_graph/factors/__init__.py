"""Factors: one file a kind, with its options (`Config`), its model and its builder.

A new factor adds a file here and a row in `FACTORS`; the options of a run, the report and the recording are made from
it. A new sensor also adds a stream to `session.streams`. Other packages add factors by entry points of the group
``smartnav_graph.builders``; see docs/how-to/own-factor.md.

A default sigma has one home: noise of a device or of what carries it in `session.calibration.model` (calibration.toml),
sigma of a model assumption or of a prior in the module of its factor, in its `Config` where a user may set it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass

from smartnav_graph.core.errors import InputTypeError, warn
from smartnav_graph.core.plugins import installed_parts
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
from smartnav_graph.graph.update import Builder
from smartnav_graph.session.detect.standstills import StandstillConfig
from smartnav_graph.session.stream import Label
from smartnav_graph.session.streams import STREAMS

Build = Callable[[FactorContext], Builder | None]


@dataclass(frozen=True)
class Factor:
    """One row of `FACTORS`.

    build : makes the builder, None where a session has no use for it; the prior has none, the initialisation makes it
    config, section : class of its options and name of their section in config.toml; a section may serve several factors
    stream : the stream that it reads, if any
    label : title and colour
    parts : labels of its factors that carry a name of their own, such as the bias random walk of the inertial data
    """

    build: Build | None
    config: type[object]
    section: str
    label: Label
    stream: str | None = None
    parts: Mapping[str, Label] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (isinstance(self.config, type) and is_dataclass(self.config)):
            raise InputTypeError("Factor.config", f"is {self.config!r}", "a dataclass", "decorate it with @dataclass")
        if not isinstance(self.label, Label):
            raise InputTypeError("Factor.label", f"is {self.label!r}", "a Label", "give Label('Title of the factor')")


def _of(stream: str, build: Build, config: type[object], section: str = "", **parts: Label) -> Factor:
    """The factor that goes by the name of its stream, as its section does where none is given."""
    return Factor(build, config, section or stream, STREAMS[stream].LABEL, stream, parts)


# The inertial builder comes first: it predicts the state that the others refer to.
FACTORS: dict[str, Factor] = {
    "prior": Factor(
        *(None, prior.PriorConfig, "prior"),
        Label("Initial state", assumes="prior on the initial state", colour=(150, 150, 150)),
        parts={"rest": Label("Standstill at the start", assumes="zero velocity at the start")},
    ),
    "imu": _of(
        *("imu", imu.build, imu.ImuConfig),
        imu_bias=Label("IMU bias random walk", assumes="biases change slowly", colour=(200, 110, 70)),
        imu_gap_error=Label("Gap error model", assumes="error of the motion inside IMU data gaps"),
    ),
    "gnss": _of(
        *("gnss", gnss.build, gnss.GnssConfig),
        gnss_correlated_error=Label(
            "Correlated GNSS error (Gauss-Markov)", assumes="successive fixes have correlated errors"
        ),
    ),
    "control": _of("control", control.build, control.ControlConfig),
    "pose_fixes": _of("pose_fixes", pose_fix.build, pose_fix.PoseFixConfig),
    "pose_attitude": Factor(
        *(pose_fix.build_attitude, pose_fix.PoseFixConfig, "pose_fixes"), Label("Attitude of pose fixes"), "pose_fixes"
    ),
    "ranges": _of("ranges", ranging.build, ranging.RangeConfig),
    "static": _of(
        *("static", standstill.build, StandstillConfig, "standstill"),
        static_turn=Label("Zero angular rate updates (ZARU)", assumes="zero angular rate while at rest"),
        static_level=Label("Flat floor", assumes="the floor is flat"),
    ),
    "gnss_velocity": Factor(
        velocity.build_gnss, velocity.VelocityConfig, "velocity", Label("GNSS velocity"), stream="gnss"
    ),
    "velocity": _of("velocity", velocity.build, velocity.VelocityConfig),
    "vehicle": Factor(
        *(vehicle.build, vehicle.VehicleConfig, "vehicle"),
        Label("Vehicle constraint", assumes="wheels move neither sideways nor off the road"),
    ),
    "wheel": _of("wheel", wheel.build, wheel.WheelConfig),
    "magnetometer": _of("magnetometer", magnetometer.build, magnetometer.MagnetometerConfig),
    "gravity": Factor(
        *(gravity.build, gravity.GravityConfig, "gravity"),
        Label("Gravity", assumes="the mean specific force is vertical"),
        parts={"pace": Label("Walking pace", assumes="a pedestrian moves slowly")},
    ),
    "barometer": _of(
        *("barometer", barometer.build, barometer.BarometerConfig),
        barometer_bias=Label("Barometer bias random walk", assumes="the pressure offset changes slowly"),
    ),
    "steps": Factor(
        *(pedestrian.build, pedestrian.StepConfig, "steps"),
        Label("Steps", assumes="length and direction of a pedestrian's steps"),
    ),
    "image_pairs": Factor(
        *(coplanarity.build, coplanarity.CoplanarityConfig, "image_pairs"),
        *(Label("Image pairs", colour=(225, 180, 20)), "matches"),
    ),
    "smart": Factor(smart.build, smart.SmartConfig, "smart", Label("Tracked points in space"), "tracks"),
}
_PARTS = {part: name for name, factor in FACTORS.items() for part in factor.parts}
_LABELS = {
    **{name: kind.LABEL for name, kind in STREAMS.items()},
    **{name: factor.label for name, factor in FACTORS.items()},
    **{name: label for factor in FACTORS.values() for name, label in factor.parts.items()},
}


def add_installed_factors() -> None:
    """Add the factors of other installed packages to `FACTORS`: once, before the configuration is made of them."""
    for name, factor in installed_parts("smartnav_graph.builders", Factor, {*FACTORS, *_LABELS}).items():
        same = [one.config for one in FACTORS.values() if one.section == factor.section]
        if same and factor.config not in same:
            warn(f"factor {name}: section {factor.section!r} has other options; left out; choose another section")
            continue
        FACTORS[name] = factor
        _PARTS.update(dict.fromkeys(factor.parts, name))
        _LABELS.update({name: factor.label, **factor.parts})


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
