"""What commands say."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smartnav_graph.session.session import Session

STYLES = {"error:": "bold red", "warning:": "yellow", "missing:": "cyan"}


def print_findings(text: str) -> None:
    """Lines on stdout, coloured by how bad they are where the terminal can."""
    from rich.console import Console
    from rich.text import Text

    console = Console(soft_wrap=True, highlight=False)
    for line in text.splitlines():
        console.print(Text(line, style=STYLES.get(line.split(" ", 1)[0], "")))


def session_text(session: Session) -> str:
    """Device and streams, and what was repaired."""
    streams = ", ".join(f"{name} {len(stream)}" for name, stream in session.streams().items())
    device = session.device
    lines = [
        f"device: {device.name}, forward {device.forward}, up {device.up}, vehicle {device.vehicle}",
        f"rows: {streams or 'none'}",
    ]
    for name, counts in session.dropped.items():
        lines += [f"repaired: {name}: {count} {reason}" for reason, count in counts.items()]
    return "\n".join(lines)


def run_text(summary: Mapping[str, Any], out: Path) -> str:
    """What a run found, in a few lines."""
    timings, chi2 = summary["timings_s"], summary["chi2_per_dof"]
    lines = [
        f"{summary['mode']}: {summary['duration_s']:.1f} s, path {summary['path_m']:.1f} m, "
        f"{summary['keyframes']} keyframes, in {timings['total']:.1f} s",
        f"start: {summary['initialisation']['sentence']}",
        f"chi2 per degree of freedom: {', '.join(f'{name} {value:.2f}' for name, value in chi2.items())}",
        "horizontal sigma: median {median:.3f} m, 95 % {p95:.3f} m, largest {max:.3f} m".format_map(
            summary["position_sigma_m"]
        ),
    ]
    if summary.get("update_ms"):
        lines.append(
            "update: median {median:.1f} ms, 99 % {p99:.1f} ms, largest {max:.1f} ms".format_map(summary["update_ms"])
        )
    if summary["gaps"]:
        missing = sum(gap["length_s"] for gap in summary["gaps"])
        lines.append(f"inertial gaps: {len(summary['gaps'])}, {missing:.2f} s in all")
    lines += [f"rejected: {name} {count}" for name, count in summary["rejected"].items() if count]
    lines += withheld_lines(summary)
    lines += [f"warning: {text}" for text in summary["warnings"]]
    return "\n".join([*lines, f"run: {out} (report.html, run.rrd, trajectory.csv, summary.json)"])


def withheld_lines(summary: Mapping[str, Any]) -> list[str]:
    """One line a sensor whose rows were kept back."""
    return [
        f"withheld {name}: {w['count']} rows, horizontal RMS {w['rms_horizontal_m']:.3f} m, "
        f"3-D RMS {w['rms_3d_m']:.3f} m, largest {w['max_m']:.3f} m"
        for name, w in summary["withheld"].items()
    ]


def statistics_line(name: str, unit: str, values: Mapping[str, float] | None) -> str:
    """RMS, mean and percentiles of an error."""
    if values is None:
        return f"{name:<12}unknown"
    told = " ".join(f"{key} {values[key]:.3f}" for key in ("rmse", "mean", "p50", "p67", "p95", "max"))
    return f"{name:<12}{told} {unit}"
