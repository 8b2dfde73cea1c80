"""Commands that inspect runs: compare a run with a reference, explain a state, compare two runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from smartnav_graph.cli.options import Reporting, RunPath, Switch
from smartnav_graph.cli.text import statistics_line
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.files import refuse_existing
from smartnav_graph.output.progress import progress

if TYPE_CHECKING:
    from smartnav_graph.evaluation import Evaluation


@dataclass(frozen=True, kw_only=True)
class Evaluate(Reporting):
    """Compare a run with a reference trajectory: absolute and relative errors, percentiles, consistency (NEES).

    Example: smartnav evaluate walk-run --reference walk --align yaw --json
    """

    run_path: RunPath
    """Run folder, or a trajectory of another program as for --reference."""
    reference: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """TUM, EuRoC ground truth, KITTI poses, CSV with t, x, y, z named, a session, a EuRoC or KITTI folder, a ROS bag
    (BAG#/topic)."""
    report_path: Annotated[Path | None, tyro.conf.arg(name="report", metavar="FILE")] = None
    """Also write the figures and plots as a page (.html)."""
    force: Switch = False
    """Replace the page."""
    times: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Times of KITTI poses."""
    body_T_ref: Annotated[Path | None, tyro.conf.arg(name="body-T-ref", metavar="FILE")] = None
    """TOML with the pose of the reference's frame in the body, a 4x4 matrix body_T_<name>."""
    align: Literal["none", "yaw", "se3", "sim3"] = "none"
    """Transformation to estimate before comparing."""
    solution: Literal["smoothed", "causal"] = "smoothed"
    """Solution of a replay."""
    time_offset: Annotated[str, tyro.conf.arg(metavar="S|auto")] = "0"
    """Added to the time stamps of the reference; auto estimates it."""

    def run(self) -> None:
        from smartnav_graph.evaluation import evaluate
        from smartnav_graph.evaluation.trajectories import as_solution
        from smartnav_graph.output.report.comparison import write_comparison_report
        from smartnav_graph.output.run_folder import SUMMARY, read_run
        from smartnav_graph.readers.reference import load_reference, load_trajectory

        offset = _offset(self.time_offset)
        if self.report_path is not None:
            refuse_existing(self.report_path, self.force)
        with progress(self.quiet) as show:
            show(f"reading {self.reference}", 0, 0)
            reference = load_reference(self.reference, times=self.times, body_T_ref=self.body_T_ref)
            run = None if self._is_trajectory(SUMMARY) else read_run(self.run_path)
            if run is None:
                track = load_trajectory(self.run_path, times=self.times, body_T_ref=self.body_T_ref)
                solution, reference = as_solution(track, reference, str(self.run_path))
            else:
                solution = run.named(self.solution)
            show("comparing", 0, 0)
            found = evaluate(
                solution,
                reference,
                align=self.align,
                time_offset_s=offset,
                solution_name=self.solution if run is not None else str(self.run_path),
                reference_name=str(self.reference),
            )
            if self.report_path is not None:
                summary = {} if run is None else run.summary
                write_comparison_report(self.report_path, self.run_path.name, solution, reference, found, summary)
        page = "" if self.report_path is None else f"\nreport: {self.report_path}"
        self.report(found.to_dict(), evaluation_text(found) + page)

    def _is_trajectory(self, summary: str) -> bool:
        """Whether the estimate is of another program."""
        from smartnav_graph.readers.robotics.ros_poses import is_bag

        return not (self.run_path / summary).is_file() and (self.run_path.is_file() or is_bag(self.run_path))


def _offset(text: str) -> float | Literal["auto"]:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError as error:
        raise ConfigError("--time-offset", repr(text), "seconds, or auto") from error


def evaluation_text(found: Evaluation) -> str:
    """The figures of an evaluation as text."""
    rotation = None if found.rotation_deg is None else asdict(found.rotation_deg)
    lines = [
        f"{found.solution} against {found.reference}: {found.matched} epochs matched, {found.unmatched} outside; "
        f"alignment {found.align}, time offset {found.time_offset_s:.4f} s",
        statistics_line("position", "m", asdict(found.ape_m)),
        statistics_line("rotation", "deg", rotation),
    ]
    for row in found.rpe:
        if row.translation_m is not None:
            turn = "" if row.rotation_deg is None else f", {row.rotation_deg:.3f} deg"
            lines.append(f"over {row.delta_s:g} s{'':<4}{row.translation_m:.3f} m{turn} ({row.pairs} pairs)")
    nees = ", ".join(f"{k} {v:.2f} ({found.nees_verdict[k]})" for k, v in found.nees.items() if v is not None)
    lines += [f"NEES        {nees}; expected 3, yaw 1"] if nees else []
    return "\n".join([*lines, *found.notes])


@dataclass(frozen=True, kw_only=True)
class Explain(Reporting):
    """Explain which measurements determine the state at one epoch: variance by source, what is not observable without
    a source, shift of the estimate by source, and the nearest data gap, rejection and standstill.

    Example: smartnav explain kitti-run --at 306
    """

    run_path: RunPath
    """Run folder."""
    at: Annotated[float | None, tyro.conf.arg(metavar="T")] = None
    """Time in seconds from the session's start; by default that of the largest position uncertainty."""

    def run(self) -> None:
        from smartnav_graph.output.explain import explain
        from smartnav_graph.output.run_folder import read_run

        with progress(self.quiet) as show:
            show(f"reading {self.run_path}", 0, 0)
            found = explain(read_run(self.run_path), self.at)
        self.report(found.to_dict(), found.to_text())


@dataclass(frozen=True, kw_only=True)
class Compare(Reporting):
    """Compare a run with another run: differences of states and sigmas, options, rejected measurements and summary
    figures; as a table, and with --out as one recording for the Rerun viewer.

    Example: smartnav compare kitti-run kitti-replay --out both.rrd
    """

    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN1")]
    """Run folder."""
    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN2")]
    """Run folder."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write one recording (.rrd): both paths, and their differences over time."""
    force: Switch = False
    """Replace the file."""

    def run(self) -> None:
        from smartnav_graph.output.run_comparison import compare_runs
        from smartnav_graph.output.run_folder import read_run

        if self.out is not None:
            refuse_existing(self.out, self.force)
        with progress(self.quiet) as show:
            show("comparing", 0, 0)
            found = compare_runs(read_run(self.first), read_run(self.second))
            if self.out is not None:
                show("writing the recording", 0, 0)
                found.write_recording(self.out, force=self.force)
        recording = "" if self.out is None else f"\nrecording: {self.out}"
        self.report(found.to_dict(), found.to_text() + recording)
