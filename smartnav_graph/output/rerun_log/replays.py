"""A replay: causal path, current window, effort of each update, change of earlier states.

The latency of updates differs from run to run. It is in a second recording with the same identity, which the viewer
joins to the first: two runs of the same session then have equal recordings.
"""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.output.rerun_log.spatial import SpatialLog

# Updates, and points of each window, that are drawn at most.
MOST_WINDOWS, MOST_POINTS = 2000, 60


def log_causal(scene: SpatialLog, causal: Solution, updates: Updates | None) -> None:
    """The causal path, its latest point, and the window of each update."""
    scene.path("causal", causal.nav_t_body, colours.CAUSAL, 1.2)
    good = np.isfinite(causal.nav_t_body).all(axis=1)
    at = scene.local(causal.nav_t_body[good])
    scene.recorder.rows("/world/causal/now", causal.t_ns[good], rr.Points3D.columns(positions=at))
    style = rr.Points3D.from_fields(colors=colours.CAUSAL, radii=rr.Radius.ui_points(7.0))
    scene.recorder.style("/world/causal/now", style)
    scene.ellipsoids(
        "causal/covariance", causal.t_ns, causal.nav_t_body, causal.covariance[:, POS, POS], colours.CAUSAL
    )
    if updates is not None:
        _log_windows(scene, updates)


def _log_windows(scene: SpatialLog, updates: Updates) -> None:
    """The keyframes that each update can change, after the update."""
    count = len(updates.t_ns)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_WINDOWS)).astype(int))
    at = scene.local(updates.past)
    strips = [at[_some(updates.edge[k], updates.edge[k + 1])] for k in chosen]
    scene.recorder.rows("/world/causal/window", updates.t_ns[chosen], rr.LineStrips3D.columns(strips=strips))
    style = rr.LineStrips3D.from_fields(colors=colours.WINDOW, radii=rr.Radius.ui_points(3.0))
    scene.recorder.style("/world/causal/window", style)


def _some(start: int, end: int) -> NDArray[np.intp]:
    """Rows from start to end, the last one kept, at most MOST_POINTS."""
    return np.unique(np.linspace(start, end - 1, min(end - start, MOST_POINTS)).astype(np.intp))


def log_updates(recorder: Recorder, updates: Updates) -> None:
    """Effort, rejections and change of earlier states of each update."""
    t = updates.t_ns
    effort = np.stack([updates.solved, updates.relinearised], axis=1).astype(np.float64)
    recorder.rows("/update/effort", t, rr.Scalars.columns(scalars=effort))
    names = ["states solved for", "states relinearised"]
    recorder.style("/update/effort", rr.SeriesLines(colors=[colours.AXES[2], colours.CAUSAL], names=names))
    some = updates.doubted > 0
    recorder.rows("/update/rejected", t[some], rr.Scalars.columns(scalars=updates.doubted[some].astype(np.float64)))
    style = rr.SeriesPoints(
        colors=colours.REJECTED, names="rejected or downweighted rows", markers="cross", marker_sizes=3.0
    )
    recorder.style("/update/rejected", style)
    recorder.rows("/update/change", t, rr.Scalars.columns(scalars=updates.corrected))
    recorder.style("/update/change", rr.SeriesLines(colors=colours.WINDOW, names="change of earlier states"))


def log_latency(recorder: Recorder, updates: Updates) -> None:
    """Wall time of each update, ms: /update/latency."""
    recorder.rows("/update/latency", updates.t_ns, rr.Scalars.columns(scalars=updates.latency_ms))
    recorder.style("/update/latency", rr.SeriesLines(colors=colours.AXES[1], names="latency ms"))
