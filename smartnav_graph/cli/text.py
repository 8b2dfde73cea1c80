"""Text output of the commands."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

from smartnav_graph.core.text import inert
from smartnav_graph.output.summary_json import (
    Summary,
    imu_gaps,
    numbers_of,
    other_warnings,
    table_of,
    text_of,
    verdict_lines,
)

if TYPE_CHECKING:
    from smartnav_graph.session.session import Session

STYLES = {
    "contradictory:": "bold red",
    "doubtful:": "yellow",
    "error:": "bold red",
    "warning:": "yellow",
    "missing:": "cyan",
}


def print_findings(text: str) -> None:
    """Lines on stdout; on a terminal wrapped at words and coloured by severity, in a pipe each in one piece."""
    console = Console(highlight=False)
    console.soft_wrap = not console.is_terminal
    for line in inert(text).splitlines():
        console.print(Text(line, style=STYLES.get(line.split(" ", 1)[0], "")))


def session_text(session: Session) -> str:
    """Device, streams and repairs."""
    streams = ", ".join(f"{name} {len(stream)}" for name, stream in session.streams().items())
    device = session.device
    lines = [
        f"device: {device.name}, forward {device.forward}, up {device.up}, vehicle {device.vehicle}",
        f"rows: {streams or 'none'}",
    ]
    for name, counts in session.dropped.items():
        lines += [f"repaired: {name}: {count} {reason}" for reason, count in counts.items()]
    return inert("\n".join(lines))


def run_text(summary: Summary, out: Path) -> str:
    """The result of a run in a few lines."""
    timings, chi2 = numbers_of(summary, "timings_s"), numbers_of(summary, "chi2_per_dof")
    lines = [
        *verdict_lines(summary),
        f"{summary['mode']}: {summary['duration_s']:.1f} s, path {summary['path_m']:.1f} m, "
        f"{summary['keyframes']} keyframes, in {timings['total']:.1f} s",
        f"start: {text_of(table_of(summary, 'initialisation'), 'sentence')}",
        f"chi2 per degree of freedom: {', '.join(f'{name} {value:.2f}' for name, value in chi2.items())}",
        "horizontal sigma: median {median:.3f} m, 95 % {p95:.3f} m, largest {max:.3f} m".format_map(
            numbers_of(summary, "position_sigma_m")
        ),
    ]
    update = numbers_of(summary, "update_ms")
    if update:
        lines.append("update: median {median:.1f} ms, 99 % {p99:.1f} ms, largest {max:.1f} ms".format_map(update))
    gaps = imu_gaps(summary)
    if gaps:
        lines.append(f"IMU data gaps: {len(gaps)}, {sum(gap.length_s for gap in gaps):.2f} s in all")
    lines += [f"rejected: {name} {count:.0f}" for name, count in numbers_of(summary, "rejected").items() if count]
    lines += withheld_lines(summary)
    lines += [f"warning: {text}" for text in other_warnings(summary)]
    return "\n".join([*lines, f"run: {out} (report.html, run.rrd, trajectory.csv, summary.json)"])


def withheld_lines(summary: Summary) -> list[str]:
    """One line for each sensor with withheld measurements."""
    withheld = table_of(summary, "withheld")
    scores = {name: numbers_of(withheld, name) for name in withheld}
    return [
        f"withheld {name}: {w['count']:.0f} rows, horizontal RMS {w['rms_horizontal_m']:.3f} m, "
        f"3-D RMS {w['rms_3d_m']:.3f} m, largest {w['max_m']:.3f} m"
        for name, w in scores.items()
    ]


def statistics_line(name: str, unit: str, values: Mapping[str, float | None] | None) -> str:
    """RMS, mean and percentiles of an error."""
    if values is None:
        return f"{name:<12}unknown"
    figures = " ".join(f"{key} {value:.3f}" for key, value in values.items() if value is not None)
    return f"{name:<12}{figures} {unit}"
