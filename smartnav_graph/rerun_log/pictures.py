"""Images as they were recorded, and feature tracks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.rerun_log import colours
from smartnav_graph.rerun_log.events import stops
from smartnav_graph.rerun_log.recorder import Recorder
from smartnav_graph.session import Session

MEDIA_TYPES = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}
IMAGE_BYTES = 300_000_000


def log_images(recorder: Recorder, session: Session, end_ns: int) -> list[str]:
    """The files' contents at /camera/<name>/image; sentences on what was left out.

    Of more than IMAGE_BYTES every k-th image is taken, so that a recording stays openable.
    """
    if session.images is None or session.path is None:
        return []
    told: list[str] = []
    for camera in sorted({str(name) for name in session.images.camera}):
        mine = np.flatnonzero((session.images.camera == camera) & (session.images.file != ""))
        found = [(int(i), session.path / "images" / str(session.images.file[i])) for i in mine]
        there = [(i, file) for i, file in found if file.suffix.lower() in MEDIA_TYPES and file.is_file()]
        step = max(1, -(-sum(file.stat().st_size for _, file in there) // IMAGE_BYTES))
        shown = there[::step]
        _send_images(recorder, session, f"/camera/{camera}/image", shown, end_ns)
        if len(there) < len(found):
            told.append(f"images: {len(found) - len(there)} files of {camera} not shown (no such JPEG or PNG)")
        if step > 1:
            told.append(f"images: every {step}th of {len(there)} of {camera} shown, to limit the recording's size")
    return told


def _send_images(recorder: Recorder, session: Session, path: str, shown: list[tuple[int, Path]], end_ns: int) -> None:
    import rerun as rr

    assert session.images is not None
    for i, file in shown:
        columns = rr.EncodedImage.columns(blob=[file.read_bytes()], media_type=[MEDIA_TYPES[file.suffix.lower()]])
        recorder.rows(path, session.images.t_ns[i : i + 1], columns)
    recorder.clear(path, stops(session.images.t_ns[[i for i, _ in shown]], end_ns))


def log_tracks(recorder: Recorder, session: Session, end_ns: int) -> None:
    """Points of each image: in pixels over the image where both are known, else normalised coordinates at /tracks."""
    import rerun as rr

    tracks = session.tracks
    if tracks is None or not len(tracks):
        return
    path, xy = "/tracks", tracks.xy_n
    cameras = sorted({str(name) for name in session.images.camera}) if session.images is not None else []
    if tracks.xy_px is not None and len(cameras) == 1 and recorder.has(f"/camera/{cameras[0]}/image"):
        path, xy = f"/camera/{cameras[0]}/image/tracks", tracks.xy_px
    order = np.lexsort((tracks.track_id, tracks.image_id, tracks.t_ns))
    starts = _group_starts(tracks.t_ns[order], tracks.image_id[order])
    lengths = np.diff([*starts, len(order)])
    palette = np.array(colours.TRACKS, dtype=np.uint8)[tracks.track_id[order] % len(colours.TRACKS)]
    columns = rr.Points2D.columns(positions=xy[order].astype(np.float32), colors=palette).partition(lengths)
    times = tracks.t_ns[order][starts]
    recorder.rows(path, times, columns)
    recorder.style(path, rr.Points2D.from_fields(radii=rr.Radius.ui_points(3.0)))
    recorder.clear(path, stops(times, end_ns))


def _group_starts(t_ns: NDArray[np.int64], image: NDArray[np.int64]) -> NDArray[np.intp]:
    return np.flatnonzero(np.concatenate([[True], (np.diff(t_ns) != 0) | (np.diff(image) != 0)]))
