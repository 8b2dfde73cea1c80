"""Two solutions of one session as one recording: both paths, and their differences over time.

Entities: /world/first, /world/second (path, now), /world/difference (from the first to the second, magnified), /world/
largest; /difference/<quantity>, second minus first, with the larger sigma of the two as band; /sigma/<run>; /log with
the largest differences; /report.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.encodings import AbsoluteTimeRange

from smartnav_graph.core.files import replacing
from smartnav_graph.evaluation.compare import MEASURES, Comparison
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, VEL, Solution
from smartnav_graph.output.rerun_log import blueprint, colours, signals
from smartnav_graph.output.rerun_log.recorder import Recorder, RecordingClock, fingerprint, recording_file
from smartnav_graph.output.rerun_log.spatial import Extent, extent_around, finite_rows, nice, thinned

FIRST, SECOND = colours.ESTIMATE, [255, 160, 60]
DIFFERENCE = [150, 150, 150]
MOST_LINES = 2000
# Number of largest differences that are marked, and the least share of the run between two of them.
MARKED, MARKED_APART = 5, 0.04
# Epochs on each side of the largest difference that are selected on the time line.
AROUND = 5
# Length of the largest difference as drawn, as a share of the scene.
DRAWN = 0.05
DEG = float(np.degrees(1.0))
# Plots: entity, name, components of the difference, factor to the unit, unit, names of the lines.
ENU, XYZ = ("east", "north", "up"), ("x", "y", "z")
PLOTS = (
    ("/difference/position", "Position, second minus first, m", POS, 1.0, "m", ENU),
    ("/difference/heading", "Heading, second minus first, °", slice(2, 3), DEG, "°", ("anticlockwise",)),
    ("/difference/velocity", "Velocity, second minus first, m/s", VEL, 1.0, "m/s", ENU),
    ("/difference/accel_bias", "Accelerometer bias, second minus first, m/s²", ACCEL_BIAS, 1.0, "m/s²", XYZ),
    ("/difference/gyro_bias", "Gyroscope bias, second minus first, °/s", GYRO_BIAS, DEG, "°/s", XYZ),
)


def write_comparison(
    path: str | Path,
    first: Solution,
    second: Solution,
    comparison: Comparison,
    *,
    names: tuple[str, str] = ("first", "second"),
    clock_epoch: str = "unknown",
    report_markdown: str | None = None,
    force: bool = True,
) -> None:
    """Write an .rrd file for the Rerun viewer of this version (rerun-sdk 0.41) or the next.

    Parameters
    ----------
    path : the file; replaced only when the new one is complete
    first, second : the solutions that `comparison` compares
    names : of the two runs, as shown
    clock_epoch : of the session's stamps
    report_markdown : the table of the differences

    Raises
    ------
    SessionError
        The file exists and `force` is not given, or cannot be written.
    """
    identity = fingerprint(first, second, names, report_markdown)
    with replacing(path, force=force) as new, recording_file(new, identity) as stream:
        recorder = Recorder(stream, RecordingClock(first.t0_ns, clock_epoch))
        recorder.name(f"{names[0]} | {names[1]}", identity)
        extent = extent_around(finite_rows(np.concatenate([first.nav_t_body, second.nav_t_body])))
        factor = _log_scene(recorder, first, second, comparison, extent)
        _log_plots(recorder, comparison, names)
        _log_largest(recorder, comparison, extent)
        if report_markdown is not None:
            recorder.static("/report", rr.TextDocument(report_markdown, media_type=rr.MediaType.MARKDOWN))
        stream.send_blueprint(_blueprint(recorder, comparison, names, extent, factor))


def _log_scene(recorder: Recorder, first: Solution, second: Solution, comparison: Comparison, extent: Extent) -> float:
    """Both paths, their positions at the chosen time, and the differences; returns the magnification of these."""
    recorder.style("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    for name, solution, colour, width in (("first", first, FIRST, 2.2), ("second", second, SECOND, 1.2)):
        points = solution.nav_t_body - extent.shift
        strip = rr.LineStrips3D([thinned(points)], colors=colour, radii=rr.Radius.ui_points(width))
        recorder.static(f"/world/{name}/path", strip)
        recorder.rows(f"/world/{name}/now", solution.t_ns, rr.Points3D.columns(positions=points))
        style = rr.Points3D.from_fields(colors=colour, radii=rr.Radius.ui_points(6.0))
        recorder.style(f"/world/{name}/now", style)
    largest = float(comparison.magnitude(MEASURES[0]).max())
    factor = nice(DRAWN * extent.size / largest) if largest > 0.0 else 1.0
    some = np.unique(np.linspace(0, len(comparison) - 1, min(len(comparison), MOST_LINES)).astype(int))
    start = comparison.position[some] - extent.shift
    ends = start + factor * comparison.difference[some][:, POS]
    lines = [*np.stack([start, ends], axis=1).astype(np.float32), ends.astype(np.float32)]
    recorder.static(
        "/world/difference", rr.LineStrips3D(lines, colors=[*DIFFERENCE, 160], radii=rr.Radius.ui_points(0.7))
    )
    return factor


def _log_plots(recorder: Recorder, comparison: Comparison, names: tuple[str, str]) -> None:
    """Differences with their bands, sigmas of both runs."""
    sigma = np.maximum(comparison.sigma_first, comparison.sigma_second)
    for path, _, part, factor, unit, lines in PLOTS:
        values, band = factor * comparison.difference[:, part], factor * sigma[:, part]
        signals.log_bands(recorder, path, comparison.t_ns, values, band, list(lines), unit)
    for run, name, colour, values in (
        ("first", names[0], FIRST, comparison.sigma_first),
        ("second", names[1], SECOND, comparison.sigma_second),
    ):
        horizontal = np.hypot(*values[:, 3:5].T)[:, None]
        recorder.rows(f"/sigma/{run}", comparison.t_ns, rr.Scalars.columns(scalars=horizontal))
        recorder.style(f"/sigma/{run}", rr.SeriesLines(colors=colour, names=name, widths=1.5))


def _log_largest(recorder: Recorder, comparison: Comparison, extent: Extent) -> None:
    """The largest differences: marks in the scene, and lines of the log."""
    span = float(comparison.seconds[-1] - comparison.seconds[0])
    rows = comparison.largest(MARKED, max(MARKED_APART * span, 1e-9))
    metres, turns = comparison.magnitude(MEASURES[0])[rows], comparison.magnitude(MEASURES[4])[rows]
    seconds = comparison.seconds[rows]
    labels = [f"{m:.3g} m at {t:.1f} s" for m, t in zip(metres, seconds, strict=True)]
    points = (comparison.position[rows] - extent.shift).astype(np.float32)
    marks = rr.Points3D(
        points, colors=colours.REJECTED, radii=rr.Radius.ui_points(4.0), labels=labels, show_labels=True
    )
    recorder.static("/world/largest", marks)
    lines = [
        (comparison.t_ns[row], f"{i + 1}. at {t:.2f} s: {m:.3f} m, heading {d:.3f} deg")
        for i, (row, t, m, d) in enumerate(zip(rows, seconds, metres, turns, strict=True))
    ]
    lines.sort(key=lambda line: line[0])
    recorder.rows(
        "/log", [t for t, _ in lines], rr.TextLog.columns(text=[text for _, text in lines], level=["INFO"] * len(lines))
    )


def _blueprint(
    recorder: Recorder, comparison: Comparison, names: tuple[str, str], extent: Extent, factor: float
) -> rrb.Blueprint:
    """The paths and the largest differences on the left, differences over time on the right."""
    title = f"{names[0]} blue, {names[1]} orange, grey: their difference ×{factor:g}"
    scene = blueprint.world_view(title, extent, np.array([0.2, 0.35, -0.9]), [0.0, 0.0, 1.0])
    log = rrb.TextLogView(name="Largest differences: click a time", origin="/log", columns=blueprint.log_columns())
    table = [rrb.TextDocumentView(name="Figures", origin="/report")] if recorder.has("/report") else []
    plots = [rrb.Tabs(*blueprint.banded(recorder, name, path), active_tab=0) for path, name, *_ in PLOTS]
    sigmas = blueprint.series_view("Horizontal position σ m", ["/sigma/**"])
    at = int(comparison.magnitude(MEASURES[0]).argmax())
    around = comparison.t_ns[[max(at - AROUND, 0), min(at + AROUND, len(comparison) - 1)]] - comparison.t0_ns
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, rrb.Horizontal(log, *table, column_shares=[2, 3][: 1 + len(table)]), row_shares=[3, 2]),
            rrb.Vertical(*plots[:3], rrb.Tabs(sigmas, *plots[3:], active_tab=0)),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(
            timeline="elapsed",
            state="collapsed",
            play_state="paused",
            time_selection=AbsoluteTimeRange(*around.tolist()),
        ),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )
