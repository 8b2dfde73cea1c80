"""Commands that compute a run, and that export it."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from smartnav_graph.cli.options import Estimating, RunPath, Writing, given, repairs
from smartnav_graph.cli.text import print_findings, run_text
from smartnav_graph.core.errors import SessionError, SmartnavError
from smartnav_graph.output.progress import progress

if TYPE_CHECKING:
    from smartnav_graph.core.progress import Progress
    from smartnav_graph.estimate.both_ways import BothWays
    from smartnav_graph.estimate.config import Config
    from smartnav_graph.estimate.run import Run
    from smartnav_graph.evaluation import Evaluation
    from smartnav_graph.output.run_folder import StoredRun
    from smartnav_graph.session.session import Session

# Exit code of a run that is finished and written, and whose measurements exclude each other.
CONTRADICTORY = 3


@dataclass(frozen=True, kw_only=True)
class Smooth(Estimating):
    """Compute the trajectory of a session: smoothed states with covariance, residuals, report and recording.

    Example: smartnav smooth kitti --out kitti-run --withhold gnss:every=10
    """

    def run(self) -> int:
        return estimate_to_folder(self, self.resolved(), causal=False)


@dataclass(frozen=True, kw_only=True)
class Replay(Estimating):
    """Compute the causal trajectory of a session, one window at a time; both the final smoothed and the causal solution
    are written.

    Ctrl-C ends the replay and writes the part that is done.

    Example: smartnav replay kitti --out kitti-replay --smoother fixed-lag --lag 10
    """

    OWN_OPTIONS: ClassVar[Mapping[str, tuple[str, ...]]] = {
        **Estimating.OWN_OPTIONS,
        "replay": ("smoother", "lag_s"),
    }

    smoother: Literal["fixed-lag", "isam2"] | None = None
    """The smoother."""
    lag: Annotated[float | None, tyro.conf.arg(metavar="S")] = None
    """Lag of the fixed-lag smoother, seconds."""

    def resolved(self) -> Config:
        """With the smoother and its lag."""
        config = super().resolved()
        return replace(config, replay=replace(config.replay, **given(smoother=self.smoother, lag_s=self.lag)))

    def run(self) -> int:
        return estimate_to_folder(self, self.resolved(), causal=True)


def estimate_to_folder(command: Estimating, config: Config, *, causal: bool) -> int:
    """Load, estimate, write, print; the exit code."""
    from smartnav_graph import readers
    from smartnav_graph.estimate.replay import replay
    from smartnav_graph.estimate.run import smooth
    from smartnav_graph.output.report.about import check_shown
    from smartnav_graph.output.run_folder import check_out, write_run
    from smartnav_graph.output.summary_json import table_of, text_of

    check_out(command.out, command.force)
    check_shown(config.report)
    with progress(command.quiet) as show:
        show(f"reading {command.session}", 0, 0)
        begin = time.perf_counter()
        session = readers.load(command.session, repairs=repairs(command.repair))
        load_s = time.perf_counter() - begin
        check_shown(config.report, session)
        run = (replay if causal else smooth)(session, config, progress=show)
        evaluation = against_own_reference(run)
        ways = forward_and_backward(session, config, show) if config.report.forward_backward else None
        summary = write_run(
            *(run, command.out), force=command.force, evaluation=evaluation, ways=ways, load_s=load_s, progress=show
        )
    if "interrupted" in text_of(summary, "mode") and not command.quiet:
        print("smartnav: interrupted; the part that was done is written", file=sys.stderr)
    print_findings(run_text(summary, command.out))
    return CONTRADICTORY if text_of(table_of(summary, "verdict"), "level") == "contradictory" else 0


def forward_and_backward(session: Session, config: Config, show: Progress) -> BothWays | None:
    """The filter in both directions; None, and a line that says why, where one of them cannot be computed."""
    from smartnav_graph.estimate.both_ways import both_ways

    try:
        ways = both_ways(session, config, show)
    except SmartnavError as error:
        print(f"smartnav: forward and backward are not compared: {error}", file=sys.stderr)
        return None
    if not len(ways.t_ns):
        print("smartnav: forward and backward are not compared: they have no time in common", file=sys.stderr)
        return None
    return ways


def against_own_reference(run: Run) -> Evaluation | None:
    """The comparison with the session's own reference, if it has one."""
    from smartnav_graph.evaluation import evaluate

    if run.session.reference is None:
        return None
    try:
        # without an absolute position the start cannot agree in position and heading
        relative = any(mode in run.summary["mode"] for mode in ("dead-reckoning", "visual-inertial"))
        align = "yaw" if relative else "none"
        return evaluate(run.solution, run.session.reference, align=align, reference_name="reference.parquet")
    except SmartnavError as error:
        print(f"smartnav: not compared with the session's reference: {error}", file=sys.stderr)
        return None


@dataclass(frozen=True, kw_only=True)
class Export(Writing):
    """Export a run: one file, or the images of the session with their position.

    --format images copies the images of the session into a folder, with position, direction, time and one sigma in
    their EXIF and in geotags.csv; the originals stay unchanged.

    Example: smartnav export kitti-run --format tum --out kitti.tum
    """

    run_path: RunPath
    """Run folder; for smartnav a session."""
    format: Annotated[
        Literal["tum", "kml", "geojson", "gpx", "csv", "sbet", "nmea", "gpkg", "images", "smartnav"],
        tyro.conf.arg(metavar="FORMAT"),
    ]
    """One of tum, kml, geojson, gpx, csv, sbet, nmea, gpkg, images, smartnav (files of the logger of 2012). All but
    tum, csv and smartnav need an origin, sbet and nmea a clock with dates."""
    crs: Annotated[str | None, tyro.conf.arg(metavar="EPSG:CODE")] = None
    """For csv and gpkg: coordinates in this system, too, such as EPSG:25832."""
    solution: Literal["smoothed", "causal"] = "smoothed"
    """Solution of a replay."""
    session: Annotated[Path | None, tyro.conf.arg(metavar="SESSION")] = None
    """For images: the session, if it was moved."""

    def run(self) -> None:
        from smartnav_graph import readers
        from smartnav_graph.output.export import export
        from smartnav_graph.output.export.smartnav_logger import write_smartnav
        from smartnav_graph.output.run_folder import read_run

        if self.format == "smartnav":
            unwritten = write_smartnav(readers.load(self.run_path), self.out, force=self.force)
            left_out = ", ".join(f"{name} {rows}" for name, rows in unwritten.items())
            print(f"smartnav: {self.out}" + (f"; without {left_out}" if left_out else ""))
            return
        run = read_run(self.run_path)
        if self.format == "images":
            self._pictures(run)
            return
        if self.out.is_dir():  # --force replaces an older export, not a folder
            raise SessionError(self.out, "is a folder", "the name of a file", "choose another --out")
        solution, epoch = run.named(self.solution), run.clock_epoch
        export(solution, self.format, self.out, force=self.force, clock_epoch=epoch, crs=self.crs)
        print(f"{self.format}: {self.out}")

    def _pictures(self, run: StoredRun) -> None:
        from smartnav_graph import readers
        from smartnav_graph.output.export import export_pictures
        from smartnav_graph.output.summary_json import table_of, text_of
        from smartnav_graph.session.calibration.model import load_calibration

        source = self.session or text_of(table_of(run.summary, "session"), "source")
        if not source or not Path(source).exists():
            found = f"was computed from {source}, which does not exist" if source else "does not name its session"
            raise SessionError(self.run_path, found, "a session with images", "give --session")
        with progress(self.quiet) as show:
            show(f"reading {source}", 0, 0)
            done = export_pictures(
                run.named(self.solution),
                readers.load(source),
                self.out,
                calibration=load_calibration(self.run_path / "calibration.toml"),
                states=table_of(run.summary, "states"),
                force=self.force,
                progress=show,
            )
        print(f"images: {done.written} in {self.out}, with geotags.csv")
        for reason, n in done.left_out.items():
            print(f"left out: {n} ({reason})", file=sys.stderr)
