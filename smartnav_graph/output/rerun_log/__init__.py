"""A session, its solution and its evaluation as one Rerun recording with its window layout inside.

Only this package imports rerun. Entities: /world (local ENU: est with its cameras, causal, gnss, reference, control),
/geo (map), /imu and other signals, /motion, /bias, /sigma, /error, /residuals, /clock, /pairs, /update, /graph,
/status, /log, /report, /states; /camera and /tracks where no path or no calibration is known. Every row has the time
lines `elapsed` (since the session's time zero), `utc` (clock is a date) or `device` (raw reading), and, where there is
a solution, `keyframe`. Nothing in the file depends on when or how fast it was made; the latency of updates, which does,
is a second recording that the viewer joins to the first (`write_latency`). Signals of more than `signals.MOST_ROWS`
rows are thinned: every row is in the Parquet files of the session, as used in imu.parquet of the run.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from smartnav_graph.core.files import replacing
from smartnav_graph.estimate.result.diagnostics import Diagnostics, Updates
from smartnav_graph.evaluation import Evaluation
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
from smartnav_graph.output.rerun_log.recorder import Recorder, RecordingClock, fingerprint, recording_file
from smartnav_graph.output.rerun_log.viewer import view
from smartnav_graph.output.summary_json import Summary, table_of
from smartnav_graph.session.session import Session

__all__ = ["view", "write_latency", "write_recording"]

# Parts of a summary that a recording shows; timings and memory differ from run to run.
_SHOWN = ("verdict", "gaps", "initialisation", "warnings", "standstills", "states")
# Wall times of updates differ from run to run, too.
_STEADY = [name for name in Updates.__dataclass_fields__ if name != "latency_ms"]


@dataclass(frozen=True)
class _Shown:
    """The content of a recording; see `write_recording`."""

    session: Session
    solution: Solution | None
    causal: Solution | None
    evaluation: Evaluation | None
    diagnostics: Diagnostics | None
    summary: Summary
    report_markdown: str | None

    @property
    def identity(self) -> str:
        """Digest of the content."""
        session = self.session
        states = [self.solution, self.causal, self.summary]
        content: list[object] = [session.streams(), session.origin, session.dropped, *states]
        if self.evaluation is not None:
            content += [getattr(self.evaluation, name) for name in signals.EVALUATION_FIELDS]
        if self.diagnostics is not None:
            content += [self.diagnostics.keyframe_ns, self.diagnostics.layout, self.diagnostics.pairs]
            content += [getattr(self.updates, name, None) for name in _STEADY]
        return fingerprint(*content, self.report_markdown)

    @property
    def updates(self) -> Updates | None:
        return None if self.diagnostics is None else self.diagnostics.updates

    @property
    def clock(self) -> RecordingClock:
        none = np.zeros(0, dtype=np.int64)
        keyframes = none if self.solution is None else self.solution.t_ns
        keyframes = keyframes if self.diagnostics is None else self.diagnostics.keyframe_ns
        return RecordingClock(self.session.t0_ns, self.session.clock_epoch, keyframes)


def write_recording(
    path: str | Path,
    *,
    session: Session,
    solution: Solution | None,
    summary: Summary | None = None,
    evaluation: Evaluation | None = None,
    causal: Solution | None = None,
    diagnostics: Diagnostics | None = None,
    report_markdown: str | None = None,
    force: bool = True,
) -> str:
    """Write an .rrd file for the Rerun viewer of this version (rerun-sdk 0.41) or the next.

    Parameters
    ----------
    path : the file; replaced only when the new one is complete
    session : the recorded session; alone is enough
    solution : the smoothed solution, if there is one
    summary : as in summary.json; its `verdict`, `gaps`, `standstills`, `states`, `initialisation` and `warnings` are
    shown
    evaluation : comparison with a reference
    causal : the causal states of a replay
    diagnostics : factor graph, image pairs and updates of the run
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
    known = {key: value for key, value in (summary or {}).items() if key in _SHOWN}
    shown = _Shown(session, solution, causal, evaluation, diagnostics, known, report_markdown)
    identity = shown.identity
    with replacing(path, force=force) as new, recording_file(new, identity) as stream:
        recorder = Recorder(stream, shown.clock)
        recorder.name(session.device.name, identity)
        stream.send_blueprint(_log_all(recorder, shown))
    return identity


def write_latency(
    path: str | Path, *, session: Session, diagnostics: Diagnostics, identity: str, force: bool = True
) -> None:
    """Write the wall times of a replay's updates as an .rrd file that the viewer joins to the recording `identity`.

    Raises
    ------
    SessionError
        The file exists and `force` is not given, or cannot be written.
    """
    assert diagnostics.updates is not None
    clock = RecordingClock(session.t0_ns, session.clock_epoch, diagnostics.keyframe_ns)
    with replacing(path, force=force) as new, recording_file(new, identity) as stream:
        replays.log_latency(Recorder(stream, clock), diagnostics.updates)


def _log_all(recorder: Recorder, shown: _Shown) -> rrb.Blueprint:
    """Write every entity; returns the blueprint that shows them."""
    session, solution = shown.session, shown.solution
    found = events.find_events(session, solution, shown.summary)
    extent = spatial.extent_of(session, solution, shown.causal)
    notes: list[str] = []
    factor = 1.0
    if extent is not None:
        factor = _log_scene(recorder, shown, extent, found)
        if extent.shift.any():
            notes.append("positions are drawn minus {:.0f}, {:.0f}, {:.0f} m east, north, up".format(*extent.shift))
    notes += signals.log_sensors(recorder, session, found.end_ns)
    if solution is not None:
        signals.log_motion(recorder, solution)
        signals.log_biases(recorder, solution, shown.evaluation)
        signals.log_residuals(recorder, solution.residuals)
        states.log_states(recorder, table_of(shown.summary, "states"), shown.updates, found.start_ns, found.end_ns)
    views = cameras.views(session, solution is not None)
    notes += cameras.log_cameras(recorder, session, views, 1.0 if extent is None else extent.size, found.end_ns)
    matched = pairs.image_pairs(session, None if shown.diagnostics is None else shown.diagnostics.pairs)
    if matched is not None and views:
        pairs.log_pairs(recorder, views[0], matched, found.end_ns)
    if shown.diagnostics is not None:
        factor_graph.log_graph(recorder, shown.diagnostics)
    if shown.updates is not None:
        replays.log_updates(recorder, shown.updates)
    timeline.log_status(recorder, session, found)
    timeline.log_verdict(recorder, session, shown.summary, found)
    timeline.log_lines(recorder, session, found, shown.summary, notes)
    timeline.log_report(recorder, shown.report_markdown)
    return blueprint.build(recorder, session, solution, extent, factor, views)


def _log_scene(recorder: Recorder, shown: _Shown, extent: spatial.Extent, found: events.Events) -> float:
    """Positions and map; the magnification of the ellipsoids."""
    recorder.style("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    scene = spatial.SpatialLog(recorder, shown.session, extent)
    if shown.session.reference is not None:
        scene.path("reference", shown.session.reference.enu, colours.REFERENCE, 0.8)
    if shown.causal is not None:
        replays.log_causal(scene, shown.causal, shown.updates)
    spatial.log_fixes(scene, found)
    return 1.0 if shown.solution is None else spatial.log_solution(scene, shown.solution)
