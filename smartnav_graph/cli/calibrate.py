"""`smartnav calibrate KIND`: calibration from recordings, and what was found before."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from smartnav_graph.calibrate import KINDS, calibrate_into
from smartnav_graph.cli.calibrate_camera import PrintBoard, Undistort, camera_differences
from smartnav_graph.cli.options import Command, Reporting, SourceName, Switch, Writing, with_options
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.files import refuse_existing
from smartnav_graph.output.progress import progress
from smartnav_graph.session.calibration.model import load_calibration
from smartnav_graph.session.calibration.pieces import Piece


@dataclass(frozen=True, kw_only=True)
class Calibrate(Command):
    """Calibrate sensors, camera or clocks from recordings; every value has its sigma, and what the data do not support
    is refused by name.

    Example: smartnav calibrate camera pictures --out calibration.toml --report report.html
    """

    PLACE: ClassVar[str] = "KIND ..."

    @classmethod
    def kinds(cls) -> dict[str, str]:
        """The kinds and the other sub-commands, with a line about each."""
        others = {
            "apply": "correct the inertial data of a session by a calibration, or keep the calibration with it",
            "show": "show a calibration.toml",
            "compare": "differences of two calibrations, over their sigmas, of cameras also in pixels",
            "board": "write a calibration board as a PDF",
            "undistort": "write the pictures of a folder without distortion",
        }
        return {name: kind.summary for name, kind in KINDS.items()} | others

    @classmethod
    def narrowed(cls, name: str, arguments: list[str]) -> tuple[type[Command], str, list[str]]:
        """The command of a kind, or `show`, `compare`, `apply`."""
        word = arguments[0] if arguments else "--help"
        if word in ("-h", "--help"):
            return cls, name, ["--help"]
        commands = {"apply": Apply, "show": Show, "compare": CompareCalibrations}
        commands |= {"board": PrintBoard, "undistort": Undistort}
        if word in commands:
            return commands[word], f"{name} {word}", arguments[1:]
        if word not in KINDS:
            raise ConfigError(f"calibrate {word}", "is no kind of calibration", f"one of {', '.join(cls.kinds())}")
        row = KINDS[word]
        options = row.options_class()
        about = f"{(options.__doc__ or row.summary).strip()}\n\nExample: {row.example}"
        return with_options(Calibrating, options, about, KIND=word), f"{name} {word}", arguments[1:]


_LISTED = "\n\n".join(f"{name:<16}{summary}" for name, summary in Calibrate.kinds().items())
_HEADING = "\n\nKinds (`smartnav calibrate KIND --help` has the options of one):\n\n"
Calibrate.__doc__ = (Calibrate.__doc__ or "") + _HEADING + _LISTED


@dataclass(frozen=True, kw_only=True)
class Calibrating(Command):
    """Common options of the kinds."""

    KIND: ClassVar[str]

    sources: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SESSION")]
    """Session folders, or logs of a known format; images or a folder of them for a camera."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("calibration.toml")
    """The calibration.toml; what is found is added to an existing file."""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write an HTML report with plots."""
    force: Switch = False
    """Replace an older result of the same kind in the file, and an older report."""
    options: object = None

    def run(self) -> None:
        from smartnav_graph.output.report.calibration import write_calibration_report

        if self.report is not None:
            refuse_existing(self.report, self.force)
        with progress(self.quiet) as show:
            show(f"reading {', '.join(self.sources)}", 0, 0)
            result, piece = calibrate_into(self.out, self.KIND, self.sources, self.options, force=self.force)
        if self.report is not None:
            write_calibration_report(self.report, self.KIND, piece, result.charts)
        print("\n".join(piece_lines(self.KIND, piece)))
        print(f"calibration: {self.out}" + (f", report: {self.report}" if self.report else ""))


@dataclass(frozen=True, kw_only=True)
class Show(Reporting):
    """Show a calibration.toml: every value with its sigma, date and recording; what was refused, and why.

    Example: smartnav calibrate show calibration.toml
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A calibration.toml."""

    def run(self) -> None:
        known = load_calibration(self.file)
        lines = [line for kind, piece in known.pieces.items() for line in piece_lines(kind, piece)]
        self.report(dataclasses.asdict(known), "\n".join(lines) or f"{self.file}: no pieces; noise and errors as typed")


@dataclass(frozen=True, kw_only=True)
class CompareCalibrations(Reporting):
    """Compare two calibrations value by value: difference, and difference over its sigma.

    Example: smartnav calibrate compare may.toml october.toml
    """

    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE1")]
    """A calibration.toml."""
    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE2")]
    """Another calibration.toml."""

    def run(self) -> None:
        one, two = load_calibration(self.first), load_calibration(self.second)
        both = [kind for kind in one.pieces if kind in two.pieces]
        if not both:
            have = [", ".join(pieces) or "none" for pieces in (one.pieces, two.pieces)]
            raise ConfigError(self.second, f"pieces {have[1]}", f"a piece that {self.first} has, too ({have[0]})")
        found = {kind: one.pieces[kind].difference(two.pieces[kind]) for kind in both}
        lines = []
        for kind, values in found.items():
            lines.append(f"{kind}: {one.pieces[kind].date} -> {two.pieces[kind].date}")
            for name, (change, sigmas) in values.items():
                beside = "" if math.isnan(sigmas) else f"  ({sigmas:+.1f} sigma)"
                lines.append(f"  {name:<34}{change:+.6g} {one.pieces[kind].values[name].unit}{beside}")
        lines += camera_differences(one, two)
        self.report(found, "\n".join(lines))


@dataclass(frozen=True, kw_only=True)
class Apply(Writing):
    """Keep a calibration with a session, so that match, smooth and replay use it; or correct its inertial data at once.

    Example: smartnav calibrate apply calibration.toml walk --out walk-calibrated
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """A calibration.toml."""
    session: SourceName
    """Session folder, or a log of a known format."""
    correct: Switch = False
    """Correct the inertial data and the magnetometer now, and drop these errors from the calibration."""

    def run(self) -> None:
        from smartnav_graph import readers
        from smartnav_graph.calibrate.apply import applied
        from smartnav_graph.cli.sessions import check_session_out
        from smartnav_graph.session import folder

        check_session_out(self.out, self.force)
        calibration = load_calibration(self.file)
        with progress(self.quiet) as show:
            show(f"reading {self.session}", 0, 0)
            session = applied(calibration, readers.load(self.session), correct=self.correct)
            folder.save(session, self.out, force=self.force, progress=show)
        print(f"session: {self.out}")


def piece_lines(kind: str, piece: Piece) -> list[str]:
    """A piece as text."""
    lines = [f"{kind}: {piece.date}, {', '.join(piece.sources)}"]
    for name, v in piece.values.items():
        sigma = "" if math.isnan(v.sigma) else f" +- {v.sigma:.2g}"
        lines.append(f"  {name:<34}{v.value:.6g}{sigma} {v.unit}")
    lines += [f"  residual {name}: {r.rms:.4g} {r.unit} RMS of {r.count}" for name, r in piece.residuals.items()]
    lines += [f"  refused: {name}: {why}" for name, why in piece.refused.items()]
    return lines + [f"  warning: {text}" for text in piece.warnings]
