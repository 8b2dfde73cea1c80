"""All options in one frozen tree, <-> TOML. Noise of a device is not here but in calibration.toml."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict
from zoneinfo import ZoneInfo

import tomli_w

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.files import read_toml
from smartnav_graph.core.tables import structured
from smartnav_graph.estimate.alignment.initial_state import InitialiseConfig
from smartnav_graph.factors import FACTORS, add_installed_factors
from smartnav_graph.graph.keyframes import KeyframeConfig
from smartnav_graph.session.session import VEHICLES
from smartnav_graph.smoothers.batch import BatchConfig
from smartnav_graph.smoothers.incremental import ReplayConfig
from smartnav_graph.smoothers.minimise import SolveConfig

LOGOS = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".svg": "image/svg+xml",
    ".webp": "image/webp",
}


@dataclass(frozen=True)
class GapConfig:
    """What counts as a gap in the inertial data; see `timebase.find_gaps`.

    missing_s : shortest time without samples, s; bridged_rows : least samples that lie on a straight line
    """

    missing_s: float = 0.05
    bridged_rows: int = 5


@dataclass(frozen=True)
class RunConfig:
    """What one run is asked to do.

    vehicle : none, car, trolley or foot; empty takes the session's own
    sensors : names to use, or names with a leading minus to leave out; empty uses all
    withhold : specifications of rows withheld and scored; start_s, end_s : from and to, seconds since time zero
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
    passes: int = 14

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


class RunOptions(TypedDict, total=False):
    """The fields of `RunConfig` as keyword arguments."""

    vehicle: str
    sensors: tuple[str, ...]
    withhold: tuple[str, ...]
    start_s: float | None
    end_s: float | None
    initial: str
    rate: str
    passes: int


def given_options(options: RunOptions) -> RunOptions:
    """Options as `RunConfig` has them: a rate may be a number, and what is withheld a single text."""
    found = options.copy()
    rate: object = options.get("rate")
    withhold: object = options.get("withhold")
    if isinstance(rate, int | float) and not isinstance(rate, bool):
        found["rate"] = str(rate)
    if isinstance(withhold, str):
        found["withhold"] = (withhold,)
    return found


@dataclass(frozen=True)
class ReportConfig:
    """What the report shows beside the run.

    company : name above the title; logo : PNG, JPEG, SVG or WebP file beside it; time_zone : of local times, such as
    Europe/Berlin, never guessed; crs : system of the coordinates of control points, such as EPSG:25832;
    forward_backward : compare the filter forward and backward in time, which takes two replays
    """

    company: str = ""
    logo: str = ""
    time_zone: str = ""
    crs: str = ""
    forward_backward: bool = False

    def __post_init__(self) -> None:
        if self.logo and Path(self.logo).suffix.lower() not in LOGOS:
            raise ConfigError("config [report]", f"logo = {self.logo!r}", f"a file of {', '.join(LOGOS)}")
        if self.time_zone:
            try:
                ZoneInfo(self.time_zone)
            except (LookupError, OSError, ValueError) as error:
                found, rule = f"time_zone = {self.time_zone!r}", "a name of the time zone database"
                raise ConfigError("config [report]", found, rule, "for example Europe/Berlin or UTC") from error


@dataclass(frozen=True)
class GeneralConfig:
    """The sections that belong to no factor."""

    run: RunConfig = field(default_factory=RunConfig)
    gaps: GapConfig = field(default_factory=GapConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    initialise: InitialiseConfig = field(default_factory=InitialiseConfig)
    batch: BatchConfig = field(default_factory=BatchConfig)
    solver: SolveConfig = field(default_factory=SolveConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    report: ReportConfig = field(default_factory=ReportConfig)


add_installed_factors()
_OF_FACTORS = {factor.section: factor.config for factor in FACTORS.values()}
FactorConfigs: Any = dataclasses.make_dataclass(
    "FactorConfigs",
    [(section, kind, field(default_factory=kind)) for section, kind in _OF_FACTORS.items()],
    frozen=True,
)


@dataclass(frozen=True)
class Config(FactorConfigs, GeneralConfig):  # type: ignore[misc]
    """All options: the sections of `GeneralConfig`, and one section for each of the factors (`FACTORS`)."""


def from_dict(data: dict[str, Any], where: str | Path = "config.toml") -> Config:
    """Config of a parsed TOML table.

    Raises
    ------
    ConfigError
        Unknown section or key (named with its path), wrong type or value.
    """
    return structured(Config, data, ConfigError, where)


def load(path: str | Path) -> Config:
    """Read config.toml.

    Raises
    ------
    ConfigError
        Missing or unreadable file, or what `from_dict` finds.
    """
    return from_dict(read_toml(Path(path), ConfigError, "a config.toml"), path)


def dumps(config: Config, *, beside: Config | None = None) -> str:
    """The text of config.toml; options that are not set are left out, and those equal to the ones of `beside`."""
    others = {} if beside is None else dataclasses.asdict(beside)
    tables = {}
    for section, options in dataclasses.asdict(config).items():
        known = others.get(section, {})
        kept = {k: v for k, v in options.items() if v is not None and (k not in known or known[k] != v)}
        if kept:
            tables[section] = {k: list(v) if isinstance(v, tuple) else v for k, v in kept.items()}
    return tomli_w.dumps(tables)
