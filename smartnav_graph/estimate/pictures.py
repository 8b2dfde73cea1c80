"""Steps of the preparation for images: pictures are matched, image pairs made, the camera compared with the gyroscope.

Pictures of a session that has neither matches nor tracks are matched when it is smoothed. Frequent ones are tracked
(KLT): their points hardly move from one to the next. Of others features are matched (ORB), as these are found again
after a turn.
"""

from __future__ import annotations

import numpy as np

from smartnav_graph.core.errors import SmartnavError
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.notes import Notes
from smartnav_graph.factors.camera import UNKNOWN_CAMERA, readout_s
from smartnav_graph.factors.context import camera_name
from smartnav_graph.factors.coplanarity import pairs_of
from smartnav_graph.graph.pass_state import INITIALISATION_S
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Images
from smartnav_graph.vision.front_end import KLT, FrontEndConfig, run_front_end
from smartnav_graph.vision.gyro_comparison import compare_with_gyro, contradictions
from smartnav_graph.vision.match_store import stored_report

# Pictures a second from which on they are tracked.
TRACKED_HZ = 8.0


def match_pictures(session: Session, notes: Notes) -> Session:
    """Matches or tracks of the pictures inside the span, where there are none; what cannot be used is counted."""
    images, options = session.images, notes.config
    wanted = (options.image_pairs.enabled or options.smart.enabled) and notes.uses("images")
    if images is None or not images.file.astype(bool).any() or not wanted:
        return session
    if session.matches is not None or session.tracks is not None:
        notes.pictures = None if session.path is None else stored_report(session.path)
    elif session.pictures is None:
        notes.warnings.append("images: pictures are inside a log, and not used; run `smartnav import` first")
    else:
        own = images.camera.astype(str) == camera_name(session, notes.calibration)
        own &= (images.t_ns >= notes.span[0]) & (images.t_ns <= notes.span[1])
        images = images.take(own)
        try:
            found = run_front_end(session.replace(images=images), policy(images), progress=notes.progress)
        except SmartnavError as error:
            notes.warnings.append(f"images: not used: {error}")
            return session
        notes.pictures = found.report
        session = session.replace(matches=found.matches, tracks=found.tracks)
    for reason, count in ({} if notes.pictures is None else notes.pictures.skipped).items():
        notes.drop(reason, {"images": count})
    return session


def policy(images: Images) -> FrontEndConfig:
    """What pictures of one camera are matched by, from their rate."""
    rate_hz = NS / float(np.median(np.diff(images.t_ns))) if len(images) > 1 else 0.0
    return FrontEndConfig(KLT) if rate_hz >= TRACKED_HZ else FrontEndConfig()


def pair_images(session: Session, notes: Notes) -> Session:
    """Image pairs, where images are used."""
    notes.pairs = pairs_of(session, notes.config.image_pairs, smart=notes.config.smart.enabled)
    return session


def compare_camera(session: Session, notes: Notes) -> Session:
    """The camera beside the gyroscope. In a replay by what is known at first."""
    if notes.pairs is None:
        return session
    pairs, name = notes.pairs, camera_name(session, notes.calibration)
    camera = notes.calibration.cameras.get(name, UNKNOWN_CAMERA)
    if notes.causal:
        pairs = pairs.until(notes.span[0] + round(INITIALISATION_S * NS))
    rows_s = readout_s(session, name, notes.calibration.cameras.get(name)) * notes.config.image_pairs.row_time
    notes.camera_turns = compare_with_gyro(pairs, session.require_imu(), camera, session.mount(name), 0.5 * rows_s)
    for finding in contradictions(notes.camera_turns, camera):
        notes.findings, notes.warnings = [*notes.findings, finding], [*notes.warnings, str(finding)]
    return session
