"""Commands about recorded sessions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smartnav_graph.cli.options import Command, Repairs, SourceName, Switch, Text, Writing, repairs
from smartnav_graph.cli.progress import progress
from smartnav_graph.cli.text import print_findings, session_text
from smartnav_graph.core.files import refuse_existing, refuse_foreign
from smartnav_graph.session import folder as session_folder

HEADER = "session.toml"


@dataclass(frozen=True, kw_only=True)
class Formats(Command):
    """The readers, one line each, and how a file is recognised.

    Example: smartnav formats
    """

    def run(self) -> None:
        from smartnav_graph.readers import READERS

        for reader in READERS.values():
            print(f"{reader.name:<18}{reader.summary}\n{'':<18}recognised by {reader.recognised_by}")


@dataclass(frozen=True, kw_only=True)
class Import(Writing):
    """A foreign log -> a session folder: units and signs are changed, axes and the clock are kept.

    Example: smartnav import gtsam-kitti --out kitti
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """A file, folder or archive, or gtsam-kitti, gtsam-euroc."""
    format: Annotated[Text, tyro.conf.arg(metavar="NAME")] = None
    """The format, where the content does not tell (see `smartnav formats`)."""
    repair: Repairs = None
    """Repairs of faulty rows: nan, order, stamps."""

    def run(self) -> None:
        from smartnav_graph import readers

        check_session_out(self.out, self.force)
        with progress(self.quiet) as show:
            show(f"reading {self.source}", 0, 0)
            session = readers.read(self.source, self.format, repairs(self.repair))
            session_folder.save(session, self.out, force=self.force, progress=show)
        print(session_text(session))
        print(f"session: {self.out}")


@dataclass(frozen=True, kw_only=True)
class Info(Command):
    """What a session holds: streams, rates, gaps, clock, gravity check, what is missing, what looks wrong.

    Example: smartnav info kitti
    """

    session: SourceName
    """Session folder, or a log of a known format."""
    repair: Repairs = None
    """Repairs of faulty rows: nan, order, stamps."""

    def run(self) -> None:
        from smartnav_graph import readers
        from smartnav_graph.session import health

        with progress(self.quiet) as show:
            show(f"reading {self.session}", 0, 0)
            session = readers.load(self.session, repairs=repairs(self.repair))
        print_findings(session_text(session) + "\n" + health.inspect(session).to_text())


@dataclass(frozen=True, kw_only=True)
class Simulate(Writing):
    """A named simulated session; its truth stands in reference.parquet. Its constants are printed.

    Example: smartnav simulate walk-60s --seed 1 --out walk

    room-30s has tracks, trolley-20min matches of images that were never taken, rendered-room-10s pictures. They start
    at rest in the origin, facing north, which is what a start without fixes takes for granted.
    """

    scenario: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")]
    """For example walk-60s, car-10min, trolley-20min; a wrong name lists them all."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of every random draw."""

    def run(self) -> None:
        from smartnav_graph.simulation import recording, scenarios

        check_session_out(self.out, self.force)
        scenario = scenarios.find_scenario(self.scenario)
        with progress(self.quiet) as show:
            session = recording.simulate_to_folder(scenario, self.seed, self.out, force=self.force, progress=show)
        for name, value in recording.scenario_constants(scenario).items():
            print(f"{name} = {value}")
        print(session_text(session))
        print(f"session: {self.out}")


@dataclass(frozen=True, kw_only=True)
class DegradeSession(Writing):
    """A session -> a noisier, faulty one: worse fixes, outliers, missing, jittered, repeated, swapped, broken rows.

    Example: smartnav degrade kitti --gnss-white 3 --gnss-gm 4,60 --seed 0 --out kitti-phone
    """

    session: SourceName
    """Session folder, or a log of a known format."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")]
    """Of every random draw."""
    gnss_white: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """White noise of the fixes, metres a horizontal axis; 1.5 times as much in height."""
    gnss_gm: Annotated[Text, tyro.conf.arg(metavar="M,S")] = None
    """Gauss-Markov error of the fixes: sigma in metres, correlation time in seconds."""
    outliers: Annotated[Text, tyro.conf.arg(metavar="KIND:SHARE:LOW-HIGH")] = None
    """Outliers of the fixes, such as isolated:0.05:50-200 or burst:0.05:50-200 (metres)."""
    drop_imu: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="T,S")] = ()
    """Leave out S seconds of inertial rows from T on; repeatable."""
    jitter_ms: Annotated[float, tyro.conf.arg(metavar="MS")] = 0.0
    """Jitter of the inertial stamps, one sigma."""
    duplicates: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.0
    """Share of inertial rows repeated."""
    swaps: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.0
    """Share of inertial rows swapped with the next."""
    nan_rows: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.0
    """Share of inertial rows with a value that is not a number."""

    def run(self) -> None:
        from smartnav_graph import readers
        from smartnav_graph.simulation import degrade as rules

        check_session_out(self.out, self.force)
        options = rules.Degrade(
            gnss_white=self.gnss_white,
            gnss_gm=None if self.gnss_gm is None else rules.parse_pair(self.gnss_gm, "--gnss-gm"),
            outliers=None if self.outliers is None else rules.parse_outliers(self.outliers),
            drop_imu=tuple(rules.parse_pair(text, "--drop-imu") for text in self.drop_imu),
            jitter_ms=self.jitter_ms,
            duplicates=self.duplicates,
            swaps=self.swaps,
            nan_rows=self.nan_rows,
        )
        with progress(self.quiet) as show:
            show(f"reading {self.session}", 0, 0)
            session = readers.load(self.session)
            told = rules.write_degraded(session, options, self.seed, self.out, force=self.force, progress=show)
        print(session_text(told))
        print(f"session: {self.out}")


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Sessions and runs in the Rerun viewer, beside each other; returns when it is closed.

    Example: smartnav view kitti-run --web
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SESSION|RUN")]
    """Session folders, run folders, .rrd files."""
    web: Switch = False
    """In a browser instead of a window."""

    def run(self) -> None:
        from smartnav_graph.output.rerun_log import view

        view(self.paths, self.web)


def check_session_out(path: Path, force: bool) -> None:
    """Raise unless a session may be written to `path`: a free place, or with `force` an older session."""
    refuse_existing(path, force)
    refuse_foreign(path, HEADER)
