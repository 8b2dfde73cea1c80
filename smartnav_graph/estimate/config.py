"""The rooms' options in one frozen tree, <-> TOML. Noise of a device does not live here but in calibration.toml."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cattrs
import tomli_w

from smartnav_graph.core.errors import ConfigError, SmartnavError
from smartnav_graph.core.files import read_toml
from smartnav_graph.estimate.alignment.initial_state import InitialiseConfig
from smartnav_graph.factors.barometer import BarometerConfig
from smartnav_graph.factors.control import ControlConfig
from smartnav_graph.factors.coplanarity import CoplanarityConfig
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.factors.gravity import GravityConfig
from smartnav_graph.factors.imu import ImuConfig
from smartnav_graph.factors.magnetometer import MagnetometerConfig
from smartnav_graph.factors.pedestrian import StepConfig
from smartnav_graph.factors.pose_fix import PoseFixConfig
from smartnav_graph.factors.prior import PriorConfig
from smartnav_graph.factors.smart import SmartConfig
from smartnav_graph.factors.vehicle import VehicleConfig
from smartnav_graph.factors.velocity import VelocityConfig
from smartnav_graph.factors.wheel import WheelConfig
from smartnav_graph.graph.keyframes import KeyframeConfig
from smartnav_graph.session.detect.standstills import StandstillConfig
from smartnav_graph.session.session import VEHICLES
from smartnav_graph.smoothers.batch import BatchConfig
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.minimise import SolveConfig


@dataclass(frozen=True)
class GapConfig:
    """What counts as a hole in the inertial data; see `timebase.find_gaps`."""

    missing_s: float = 0.05
    bridged_rows: int = 5


@dataclass(frozen=True)
class RunConfig:
    """What one run is asked to do.

    vehicle : none, car, trolley or foot; empty takes the session's own
    sensors : names to use, or names with a leading minus to leave out; empty uses all
    withhold : specifications of rows kept back and scored; start_s, end_s : stretch, seconds since time zero
    initial : "e,n,u,heading_deg[,sigma_m,sigma_deg]"; rate : ``keyframes`` (and images), ``imu`` or a frequency in Hz
    passes : most solves of a batch run
    """

    vehicle: str = ""
    sensors: tuple[str, ...] = ()
    withhold: tuple[str, ...] = ()
    start_s: float | None = None
    end_s: float | None = None
    initial: str = ""
    rate: str = "keyframes"
    passes: int = 8

    def __post_init__(self) -> None:
        if self.vehicle and self.vehicle not in VEHICLES:
            raise ConfigError("--vehicle", f"{self.vehicle!r}", f"one of {', '.join(VEHICLES)}")
        if self.start_s is not None and self.end_s is not None and self.start_s >= self.end_s:
            raise ConfigError("--from, --to", f"{self.start_s} s to {self.end_s} s", "--from before --to")
        if self.rate not in ("keyframes", "imu"):
            try:
                valid = 0.0 < float(self.rate) <= 1000.0
            except ValueError:
                valid = False
            if not valid:
                raise ConfigError("--rate", f"{self.rate!r}", "keyframes, imu or a frequency in (0, 1000] Hz")
        if self.passes < 1:
            raise ConfigError("config [run]", f"passes = {self.passes}", ">= 1")


@dataclass(frozen=True)
class Config:
    """All options. Sections are the rooms, fields their options."""

    run: RunConfig = field(default_factory=RunConfig)
    gaps: GapConfig = field(default_factory=GapConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    initialise: InitialiseConfig = field(default_factory=InitialiseConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    imu: ImuConfig = field(default_factory=ImuConfig)
    gnss: GnssConfig = field(default_factory=GnssConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    pose_fixes: PoseFixConfig = field(default_factory=PoseFixConfig)
    standstill: StandstillConfig = field(default_factory=StandstillConfig)
    magnetometer: MagnetometerConfig = field(default_factory=MagnetometerConfig)
    gravity: GravityConfig = field(default_factory=GravityConfig)
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    velocity: VelocityConfig = field(default_factory=VelocityConfig)
    wheel: WheelConfig = field(default_factory=WheelConfig)
    barometer: BarometerConfig = field(default_factory=BarometerConfig)
    steps: StepConfig = field(default_factory=StepConfig)
    coplanarity: CoplanarityConfig = field(default_factory=CoplanarityConfig)
    smart: SmartConfig = field(default_factory=SmartConfig)
    batch: BatchConfig = field(default_factory=BatchConfig)
    solve: SolveConfig = field(default_factory=SolveConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)


_converter = cattrs.Converter(forbid_extra_keys=True)


def from_dict(data: dict[str, Any], where: str | Path = "config.toml") -> Config:
    """Config of a parsed TOML table.

    Raises
    ------
    ConfigError
        Unknown section or key (named with its path), wrong type or value.
    """
    try:
        return _converter.structure(data, Config)
    except cattrs.BaseValidationError as error:
        named = _named_cause(error)
        if named is not None:
            raise named from error
        text = "; ".join(cattrs.transform_error(error)).replace("$.", "").replace("@ $", "at the top level")
        raise ConfigError(where, text, "the sections and keys of the configuration") from error


def _named_cause(error: BaseException) -> SmartnavError | None:
    for inner in getattr(error, "exceptions", ()):
        found = inner if isinstance(inner, SmartnavError) else _named_cause(inner)
        if found is not None:
            return found
    return None


def load(path: str | Path) -> Config:
    """Read config.toml.

    Raises
    ------
    ConfigError
        Missing or unreadable file, or what `from_dict` finds.
    """
    return from_dict(read_toml(Path(path), ConfigError, "a config.toml"), path)


def dumps(config: Config) -> str:
    """The text of config.toml; options that are not set are left out."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items() if v is not None}
        return list(value) if isinstance(value, tuple) else value

    return tomli_w.dumps(plain(dataclasses.asdict(config)))
