"""A session, its solution and its evaluation as one Rerun recording with its window layout inside.

The only importer of rerun. Entities: /world (local ENU: est, causal, gnss, reference, control), /geo (map), /imu,
/bias, /sigma, /error, /residuals, /status, /log, /report, /camera, /tracks. Every row stands on the time lines
`elapsed` (since the session's time zero), `utc` (clock is a date) or `device` (raw reading), and, where rows are
keyframes, `keyframe`. Nothing in the file depends on when it was written.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from smartnav_graph.files import replacing
from smartnav_graph.rerun_log import blueprint, colours, events, pictures, signals, spatial, story
from smartnav_graph.rerun_log.recorder import Clock, Recorder, fingerprint, recording_file
from smartnav_graph.rerun_log.viewer import view
from smartnav_graph.session import Session
from smartnav_graph.solution import Solution

__all__ = ["view", "write_recording"]

# What of a summary the log tells; its timings and memory differ from run to run and stay out.
_TOLD = ("gaps", "initialisation", "warnings")


def write_recording(
    path: str | Path,
    *,
    session: Session,
    solution: Solution | None,
    summary: Mapping[str, Any] | None = None,
    evaluation: Any | None = None,
    causal: Solution | None = None,
    report_markdown: str | None = None,
    force: bool = True,
) -> None:
    """Write an .rrd file for the Rerun viewer of this version (rerun-sdk 0.41) or the next.

    Parameters
    ----------
    path : the file; replaced only when the new one is complete
    session : what was recorded; enough on its own
    solution : the smoothed solution, if there is one
    summary : as in summary.json; its `gaps`, `initialisation` and `warnings` are shown
    evaluation : anything with `t_ns` (n,), `error_enu_m` (n, 3) and, where known, `sigma_enu` (n, 3) m and
        `rotation_error_deg` (n,)
    causal : the estimate when each keyframe became known (replay)
    report_markdown : shown beside the path
    force : replace an existing file

    Raises
    ------
    SessionError
        The file exists and `force` is not given, or cannot be written.
    """
    told = {key: value for key, value in (summary or {}).items() if key in _TOLD}
    identity = fingerprint(session.streams(), session.origin, session.dropped, solution, causal, told, report_markdown)
    if evaluation is not None:
        identity = fingerprint(identity, *(getattr(evaluation, name, None) for name in signals.EVALUATION_FIELDS))
    with replacing(path, force=force) as new, recording_file(new, identity) as stream:
        recorder = Recorder(stream, Clock(session.t0_ns, session.clock_epoch))
        recorder.name(session.device.name, identity)
        stream.send_blueprint(_log_all(recorder, session, solution, causal, evaluation, told, report_markdown))


def _log_all(
    recorder: Recorder,
    session: Session,
    solution: Solution | None,
    causal: Solution | None,
    evaluation: Any | None,
    summary: Mapping[str, Any],
    report_markdown: str | None,
) -> Any:
    """Every entity; returns the blueprint of what there is."""
    found = events.find(session, solution, summary)
    extent = spatial.extent_of(session, solution, causal)
    told: list[str] = []
    factor = 1.0
    if extent is not None:
        factor = _log_scene(recorder, session, solution, causal, extent, found)
        if extent.shift.any():
            told.append("positions are drawn with east, north, up less {:.0f}, {:.0f}, {:.0f} m".format(*extent.shift))
    signals.log_sensors(recorder, session, found.end_ns)
    if solution is not None:
        signals.log_states(recorder, solution, evaluation)
        signals.log_residuals(recorder, solution.residuals)
    told += pictures.log_images(recorder, session, found.end_ns)
    pictures.log_tracks(recorder, session, found.end_ns)
    story.log_status(recorder, session, found)
    story.log_lines(recorder, session, found, summary, told)
    story.log_report(recorder, report_markdown)
    return blueprint.build(recorder, session, solution, extent, factor)


def _log_scene(
    recorder: Recorder,
    session: Session,
    solution: Solution | None,
    causal: Solution | None,
    extent: spatial.Extent,
    found: events.Events,
) -> float:
    """Positions and map; the magnification of the ellipsoids."""
    import rerun as rr

    recorder.style("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    scene = spatial.Scene(recorder, session, extent)
    if session.reference is not None:
        scene.path("reference", session.reference.enu, colours.REFERENCE, 0.8)
    if causal is not None:
        scene.path("causal", causal.nav_t_body, colours.CAUSAL, 1.2)
    spatial.log_fixes(scene, found)
    return 1.0 if solution is None else spatial.log_solution(scene, solution)
