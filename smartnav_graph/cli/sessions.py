"""Commands about recorded sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smartnav_graph.cli.options import Command, Repairs, Reporting, SourceName, Switch, Text, Writing, repairs
from smartnav_graph.cli.text import print_findings, session_text
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.files import refuse_existing, refuse_foreign
from smartnav_graph.output.progress import progress

HEADER = "session.toml"


@dataclass(frozen=True, kw_only=True)
class Formats(Command):
    """List the formats that can be imported, and how they are recognised.

    Example: smartnav formats
    """

    columns: Switch = False
    """Print the page about the session folder instead: streams, columns, units, keys of session.toml."""

    def run(self) -> None:
        from smartnav_graph.readers import known_readers
        from smartnav_graph.session.format_page import format_page

        if self.columns:
            print(format_page(), end="")
            return

        for reader in known_readers().values():
            print(f"{reader.name:<18}{reader.summary}\n{'':<18}recognised by {reader.recognised_by}")


@dataclass(frozen=True, kw_only=True)
class Import(Writing):
    """Import logs of other programs into a session folder: units and signs are converted, axes and clock are kept.

    Several files become one session: the inertial log, and positions, control points, images that belong to it.

    Example: smartnav import log.zip track.gpx points.csv --out walk
    """

    source: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Files, folders or archives, or gtsam-kitti, gtsam-euroc."""
    format: Annotated[Text, tyro.conf.arg(metavar="NAME")] = None
    """The format, if it is not recognised (see `smartnav formats`)."""
    repair: Repairs = None
    """Repairs of faulty rows: nan, order, stamps; units converts readings in another unit."""
    shift: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="FILE=S")] = ()
    """Seconds to add to the stamps of a file whose clock cannot be tied to that of the inertial log; repeatable."""

    denoise: Annotated[Text, tyro.conf.arg(metavar="WAVELET:LEVEL")] = None
    """Keep only the slow part of the inertial data, as db4:7 (Daubechies 4, level 7) of the 2016 study, which makes
    positions worse. Needs PyWavelets."""
    columns: Annotated[Text, tyro.conf.arg(metavar="NAME|DESCRIPTION")] = None
    """Columns of a text file of no known format, such as "time=t_ms:ms, ax=accel_x:g, gx=gyro_x:deg/s ...", or the name
    of a description that was kept."""
    save_columns: Annotated[Text, tyro.conf.arg(metavar="NAME")] = None
    """Keep the description of the columns under a name."""

    def run(self) -> None:
        from smartnav_graph.readers.columns import parse_columns, save_profile
        from smartnav_graph.readers.join import join
        from smartnav_graph.session.denoise import Denoising, denoised
        from smartnav_graph.session.folder import save

        check_session_out(self.out, self.force)
        how = None if self.denoise is None else Denoising.parse(self.denoise)
        with progress(self.quiet) as show:
            show(f"reading {', '.join(self.source)}", 0, 0)
            columns = None if self.columns is None else parse_columns(self.columns)
            found = join(self.source, self.format, repairs(self.repair), assigned_seconds(self.shift), columns)
            session, ties = found.session if how is None else denoised(found.session, how), found.ties
            save(session, self.out, force=self.force, progress=show)
        print("\n".join([session_text(session), *(f"clock: {tie}" for tie in ties)]))
        if self.columns is not None and self.save_columns is not None:
            print(f"columns: {save_profile(self.save_columns, self.columns)}")
        print(f"session: {self.out}")


@dataclass(frozen=True, kw_only=True)
class Info(Reporting):
    """Check a session: when and where, streams, rates, data gaps, clock, gravity, what is missing, possible faults.

    Example: smartnav info kitti
    """

    session: SourceName
    """Session folder, or a log of a known format."""
    repair: Repairs = None
    """Repairs of faulty rows: nan, order, stamps; units converts readings in another unit."""

    def run(self) -> int | None:
        from smartnav_graph import readers
        from smartnav_graph.output.session_info import SessionInfo
        from smartnav_graph.session import health

        if readers.is_unknown(self.session):
            return self._describe()
        with progress(self.quiet) as show:
            show(f"reading {self.session}", 0, 0)
            session = readers.load(self.session, repairs=repairs(self.repair))
        found = SessionInfo(session, health.inspect(session))
        if self.json:
            self.report(found.to_dict(), "")
        else:
            print_findings(found.to_text())
        return None

    def _describe(self) -> int:
        """What a file of no known format looks like; exit code 1."""
        from smartnav_graph.readers.unknown import describe_unknown

        seen = describe_unknown(self.session)
        lines = [f"{self.session}: is of no known format", *(f"  {line}" for line in seen.seen)]
        if seen.columns:
            lines.append(f'import it with: smartnav import {self.session} --out S --columns "{seen.columns}"')
        lines.append("or write CSV with the columns of `smartnav formats --columns`")
        self.report({"format": None, "seen": seen.seen, "columns": seen.columns or None}, "\n".join(lines))
        return 1


@dataclass(frozen=True, kw_only=True)
class Simulate(Writing):
    """Simulate a session; the ground truth is written to reference.parquet. Its constants are printed.

    Example: smartnav simulate walk-60s --seed 1 --out walk

    room-30s has tracks, trolley-20min simulated matches, rendered-room-10s images. They start at rest at the origin,
    heading north, as an initialisation without fixes assumes.
    """

    scenario: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENARIO")]
    """For example walk-60s, car-10min, trolley-20min; an unknown name lists all."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Seed of the random numbers."""

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
    """Add noise and faults to a session: noisier fixes, outliers, missing, jittered, repeated, swapped, invalid rows.

    Example: smartnav degrade kitti --gnss-white 3 --gnss-gm 4,60 --seed 0 --out kitti-phone
    """

    session: SourceName
    """Session folder, or a log of a known format."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")]
    """Seed of the random numbers."""
    gnss_white: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """White noise of the fixes, metres on each horizontal axis; 1.5 times as much in height."""
    gnss_gm: Annotated[Text, tyro.conf.arg(metavar="M,S")] = None
    """Correlated error of the fixes (Gauss-Markov): sigma in metres, correlation time in seconds."""
    outliers: Annotated[Text, tyro.conf.arg(metavar="KIND:SHARE:LOW-HIGH")] = None
    """Outliers of the fixes, such as isolated:0.05:50-200 or burst:0.05:50-200 (metres)."""
    drop_imu: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="T,S")] = ()
    """Remove S seconds of IMU samples from T on; repeatable."""
    jitter_ms: Annotated[float, tyro.conf.arg(metavar="MS")] = 0.0
    """Jitter of the IMU time stamps, one sigma."""
    duplicates: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.0
    """Share of IMU samples repeated."""
    swaps: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.0
    """Share of IMU samples swapped with the next."""
    nan_rows: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.0
    """Share of IMU samples with an invalid value (NaN)."""

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
            degraded = rules.write_degraded(session, options, self.seed, self.out, force=self.force, progress=show)
        print(session_text(degraded))
        print(f"session: {self.out}")


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Show sessions and runs in the Rerun viewer, together; returns when it is closed.

    Example: smartnav view kitti-run --web
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SESSION|RUN")]
    """Session folders, run folders, .rrd files."""
    web: Switch = False
    """Serve to a browser of this machine, and print the link."""

    def run(self) -> None:
        from smartnav_graph.output.rerun_log import view

        view(self.paths, self.web, announce=lambda address: print(f"open in a browser: {address}", flush=True))


def assigned_seconds(texts: Sequence[str]) -> dict[str, float]:
    """The seconds of ``FILE=S``, by file.

    Raises
    ------
    ConfigError
        A text of another form.
    """
    found = {}
    for text in texts:
        name, _, seconds = text.rpartition("=")
        try:
            found[name] = float(seconds)
        except ValueError as error:
            raise ConfigError("--shift", f"{text!r}", "FILE=SECONDS", "for example --shift track.gpx=-3600") from error
    return found


def check_session_out(path: Path, force: bool) -> None:
    """Check that a session may be written to `path`: it does not exist, or `force` is given for an older session."""
    refuse_existing(path, force)
    refuse_foreign(path, HEADER)
