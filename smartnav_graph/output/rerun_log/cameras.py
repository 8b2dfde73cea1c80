"""Cameras: their frustum on the moving body, images as they were recorded, feature tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors.context import camera_name
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.events import stops
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Session
from smartnav_graph.vision.images import Picture, pictures

MEDIA_TYPES = {".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".png": "image/png"}
IMAGE_BYTES = 300_000_000
BODY = "/world/est/body"
# The viewer counts pixels from the corner of the first pixel, a calibration from its centre.
HALF_PIXEL = 0.5
# Distance of the image from the camera, as a share of the scene.
FRUSTUM = 0.08


@dataclass(frozen=True)
class CameraView:
    """Where one camera is drawn: on the body where there is a path, else alone.

    camera : its calibration, where there is one: points are then drawn in pixels, else in normalised coordinates
    """

    name: str
    root: str
    camera: Camera | None

    @property
    def image(self) -> str:
        """Entity of the image."""
        return f"{self.root}/image"

    @property
    def origin(self) -> str:
        """Origin of a view of its points; without a calibration they are not drawn in the image."""
        return self.root if self.camera is not None else f"/tracks/{self.name}"

    @property
    def points(self) -> str:
        """Parent of everything measured in the image."""
        return self.image if self.camera is not None else self.origin

    def drawn(self, xy_n: Floats) -> NDArray[np.float32]:
        """Undistorted normalised coordinates (n, 2) as drawn."""
        if self.camera is None:
            return xy_n.astype(np.float32)
        return (self.camera.pixels(xy_n) + HALF_PIXEL).astype(np.float32)


def views(session: Session, on_body: bool) -> list[CameraView]:
    """The cameras of a session that have data, that of its tracks and matches first."""
    main = camera_name(session, session.calibration)
    names = [main] if session.tracks is not None or session.matches is not None else []
    if session.images is not None:
        names += sorted(set(session.images.camera.astype(str)))
    known = session.calibration.cameras if session.calibration is not None else {}
    root = BODY if on_body else "/camera"
    return [CameraView(name, f"{root}/{name}", known.get(name)) for name in dict.fromkeys(names)]


def log_cameras(recorder: Recorder, session: Session, found: list[CameraView], size: float, end_ns: int) -> list[str]:
    """Frusta, images and tracks; returns notes on what was left out. `size` of the scene, m."""
    for view in found:
        _log_frustum(recorder, session, view, size)
    notes = _log_images(recorder, session, found, end_ns)
    if found and session.tracks is not None and len(session.tracks):
        _log_tracks(recorder, session, found[0], end_ns)
    return notes


def _log_frustum(recorder: Recorder, session: Session, view: CameraView, size: float) -> None:
    """The camera's mount on the body, and its pinhole model without distortion."""
    mount, camera = session.mount(view.name), view.camera
    there: list[rr.AsComponents] = []
    if view.root.startswith(BODY):
        there.append(rr.Transform3D(translation=mount.body_t, mat3x3=mount.body_R))
    if camera is not None:
        pinhole = rr.Pinhole(
            image_from_camera=camera.matrix + np.array([[0, 0, HALF_PIXEL], [0, 0, HALF_PIXEL], [0, 0, 0]]),
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=FRUSTUM * size,
            color=colours.CAMERA,
        )
        there.append(pinhole)
    if there:
        recorder.style(view.root, *there)


def _log_images(recorder: Recorder, session: Session, found: list[CameraView], end_ns: int) -> list[str]:
    """The files' contents. Above IMAGE_BYTES only every k-th image is taken, to limit the size of the recording."""
    if session.images is None or session.pictures is None or not any(session.images.file):
        return []
    files, notes = pictures(session), list[str]()
    for view in found:
        mine = [picture for picture in files if picture.camera == view.name and picture.file]
        there = [p for p in mine if p.path.suffix.lower() in MEDIA_TYPES and p.path.is_file()]
        step = max(1, -(-sum(p.path.stat().st_size for p in there) // IMAGE_BYTES))
        _send_images(recorder, view.image, there[::step], end_ns)
        if len(there) < len(mine):
            notes.append(f"images: {len(mine) - len(there)} files of {view.name} not shown (no such JPEG or PNG)")
        if step > 1:
            notes.append(f"images: every {step}th of {len(there)} of {view.name} shown, to limit the recording's size")
    return notes


def _send_images(recorder: Recorder, path: str, shown: list[Picture], end_ns: int) -> None:
    for picture in shown:
        media = MEDIA_TYPES[picture.path.suffix.lower()]
        columns = rr.EncodedImage.columns(blob=[picture.path.read_bytes()], media_type=[media])
        recorder.rows(path, [picture.t_ns], columns)
    recorder.clear(path, stops(np.array([picture.t_ns for picture in shown], dtype=np.int64), end_ns))


def _log_tracks(recorder: Recorder, session: Session, view: CameraView, end_ns: int) -> None:
    """Points of each image, coloured by track."""
    tracks = session.tracks
    assert tracks is not None
    xy, path = view.drawn(tracks.xy_n), f"{view.points}/tracks"
    if tracks.xy_px is not None and recorder.has(view.image):
        xy, path = (tracks.xy_px + HALF_PIXEL).astype(np.float32), f"{view.image}/tracks"
    order = np.lexsort((tracks.track_id, tracks.image_id, tracks.t_ns))
    starts = _group_starts(tracks.t_ns[order], tracks.image_id[order])
    lengths = np.diff([*starts, len(order)])
    palette = np.array(colours.TRACKS, dtype=np.uint8)[tracks.track_id[order] % len(colours.TRACKS)]
    columns = rr.Points2D.columns(positions=xy[order], colors=palette).partition(lengths)
    times = tracks.t_ns[order][starts]
    recorder.rows(path, times, columns)
    recorder.style(path, rr.Points2D.from_fields(radii=rr.Radius.ui_points(3.0)))
    recorder.clear(path, stops(times, end_ns))


def _group_starts(t_ns: NDArray[np.int64], image: NDArray[np.int64]) -> NDArray[np.intp]:
    return np.flatnonzero(np.concatenate([[True], (np.diff(t_ns) != 0) | (np.diff(image) != 0)]))
