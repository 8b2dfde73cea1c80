"""A session, its solution and its evaluation as one Rerun recording with its window layout inside.

The only importer of rerun. Entities: /world (local ENU: est with its cameras, causal, gnss, reference, control), /geo
(map), /imu and other signals, /motion, /bias, /sigma, /error, /residuals, /clock, /pairs, /update, /graph, /status,
/log, /report, /states; /camera and /tracks where no path or no calibration is known. Every row stands on the time lines
`elapsed` (since the session's time zero), `utc` (clock is a date) or `device` (raw reading), and, where there is a
solution, `keyframe`. Nothing in the file depends on when or how fast it was made; what does, the latency of updates, is
a recording beside it that the viewer joins to it (`write_latency`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from smartnav_graph.core.files import replacing
from smartnav_graph.estimate.result.diagnostics import Diagnostics, Updates
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.rerun_log import (
    blueprint,
    cameras,
    colours,
    events,
    factor_graph,
    pairs,
    replays,
    signals,
    spatial,
    states,
    timeline,
)
from smartnav_graph.output.rerun_log.recorder import Clock, Recorder, fingerprint, recording_file
from smartnav_graph.output.rerun_log.viewer import view
from smartnav_graph.session.session import Session

__all__ = ["view", "write_latency", "write_recording"]

# What of a summary the recording tells; its timings and memory differ from run to run and stay out.
_TOLD = ("gaps", "initialisation", "warnings", "standstills", "states")
# Nor do the wall times of updates.
_STEADY = [name for name in Updates.__dataclass_fields__ if name != "latency_ms"]


@dataclass(frozen=True)
class _Shown:
    """What a recording is made of; see `write_recording`."""

    session: Session
    solution: Solution | None
    causal: Solution | None
    evaluation: Any | None
    trace: Diagnostics | None
    told: Mapping[str, Any]
    report_markdown: str | None

    @property
    def identity(self) -> str:
        """Digest of the content."""
        session = self.session
        content: list[Any] = [session.streams(), session.origin, session.dropped, self.solution, self.causal, self.told]
        if self.evaluation is not None:
            content += [getattr(self.evaluation, name, None) for name in signals.EVALUATION_FIELDS]
        if self.trace is not None:
            content += [self.trace.keyframe_ns, self.trace.layout, self.trace.pairs]
            content += [getattr(self.updates, name, None) for name in _STEADY]
        return fingerprint(*content, self.report_markdown)

    @property
    def updates(self) -> Updates | None:
        return None if self.trace is None else self.trace.updates

    @property
    def clock(self) -> Clock:
        none = np.zeros(0, dtype=np.int64)
        keyframes = none if self.solution is None else self.solution.t_ns
        keyframes = keyframes if self.trace is None else self.trace.keyframe_ns
        return Clock(self.session.t0_ns, self.session.clock_epoch, keyframes)


def write_recording(
    path: str | Path,
    *,
    session: Session,
    solution: Solution | None,
    summary: Mapping[str, Any] | None = None,
    evaluation: Any | None = None,
    causal: Solution | None = None,
    trace: Diagnostics | None = None,
    report_markdown: str | None = None,
    force: bool = True,
) -> str:
    """Write an .rrd file for the Rerun viewer of this version (rerun-sdk 0.41) or the next.

    Parameters
    ----------
    path : the file; replaced only when the new one is complete
    session : what was recorded; enough on its own
    solution : the smoothed solution, if there is one
    summary : as in summary.json; its `gaps`, `standstills`, `states`, `initialisation` and `warnings` are shown
    evaluation : anything with `t_ns` (n,), `error_enu_m` (n, 3) and, where known, `sigma_enu` (n, 3) m and
        `rotation_error_deg` (n,)
    causal : the estimate when each keyframe became known (replay)
    trace : how the run came about: its graph, image pairs and updates
    report_markdown : shown beside the path
    force : replace an existing file

    Returns
    -------
    The recording's identity, a digest of its content.

    Raises
    ------
    SessionError
        The file exists and `force` is not given, or cannot be written.
    """
    told = {key: value for key, value in (summary or {}).items() if key in _TOLD}
    shown = _Shown(session, solution, causal, evaluation, trace, told, report_markdown)
    identity = shown.identity
    with replacing(path, force=force) as new, recording_file(new, identity) as stream:
        recorder = Recorder(stream, shown.clock)
        recorder.name(session.device.name, identity)
        stream.send_blueprint(_log_all(recorder, shown))
    return identity


def write_latency(path: str | Path, *, session: Session, trace: Diagnostics, identity: str, force: bool = True) -> None:
    """Write the wall times of a replay's updates as an .rrd file that the viewer joins to the recording `identity`.

    Raises
    ------
    SessionError
        The file exists and `force` is not given, or cannot be written.
    """
    assert trace.updates is not None
    clock = Clock(session.t0_ns, session.clock_epoch, trace.keyframe_ns)
    with replacing(path, force=force) as new, recording_file(new, identity) as stream:
        replays.log_latency(Recorder(stream, clock), trace.updates)


def _log_all(recorder: Recorder, shown: _Shown) -> Any:
    """Every entity; returns the blueprint of what there is."""
    session, solution = shown.session, shown.solution
    found = events.find(session, solution, shown.told)
    extent = spatial.extent_of(session, solution, shown.causal)
    told: list[str] = []
    factor = 1.0
    if extent is not None:
        factor = _log_scene(recorder, shown, extent, found)
        if extent.shift.any():
            told.append("positions are drawn with east, north, up less {:.0f}, {:.0f}, {:.0f} m".format(*extent.shift))
    signals.log_sensors(recorder, session, found.end_ns)
    if solution is not None:
        signals.log_motion(recorder, solution)
        signals.log_states(recorder, solution, shown.evaluation)
        signals.log_residuals(recorder, solution.residuals)
        states.log_states(recorder, shown.told.get("states", {}), shown.updates, found.start_ns, found.end_ns)
    seen = cameras.views(session, solution is not None)
    told += cameras.log_cameras(recorder, session, seen, 1.0 if extent is None else extent.size, found.end_ns)
    matched = pairs.image_pairs(session, None if shown.trace is None else shown.trace.pairs)
    if matched is not None and seen:
        pairs.log_pairs(recorder, seen[0], matched, found.end_ns)
    if shown.trace is not None:
        factor_graph.log_graph(recorder, shown.trace)
    if shown.updates is not None:
        replays.log_updates(recorder, shown.updates)
    timeline.log_status(recorder, session, found)
    timeline.log_lines(recorder, session, found, shown.told, told)
    timeline.log_report(recorder, shown.report_markdown)
    return blueprint.build(recorder, session, solution, extent, factor, seen)


def _log_scene(recorder: Recorder, shown: _Shown, extent: spatial.Extent, found: events.Events) -> float:
    """Positions and map; the magnification of the ellipsoids."""
    import rerun as rr

    recorder.style("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    scene = spatial.Scene(recorder, shown.session, extent)
    if shown.session.reference is not None:
        scene.path("reference", shown.session.reference.enu, colours.REFERENCE, 0.8)
    if shown.causal is not None:
        replays.log_causal(scene, shown.causal, shown.updates)
    spatial.log_fixes(scene, found)
    return 1.0 if shown.solution is None else spatial.log_solution(scene, shown.solution)
