"""Pictures without distortion: what a camera of the same matrix without distortion would have seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.calibrate.camera import SUFFIXES
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import replacing
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.vision.images import BROKEN, RESIZED, Gray

PREFIX = "ImageUndistorted_"


@dataclass(frozen=True)
class Undistorted:
    """Number of pictures written, and names of those left out, with the reason."""

    written: int
    left_out: Mapping[str, str]


def undistorted(picture: Gray, camera: Camera) -> Gray:
    """A picture (h, w[, 3]) without distortion."""
    import cv2

    distortion = np.array(camera.distortion or (0.0,) * 4)
    undistort = cv2.fisheye.undistortImage if camera.model == "fisheye" else cv2.undistort
    keep = {"Knew": camera.matrix} if camera.model == "fisheye" else {}
    return np.asarray(undistort(picture, camera.matrix, distortion, **keep), dtype=np.uint8)


def undistorted_name(name: str) -> str:
    """Image_N_T.jpg -> ImageUndistorted_N_T.jpg; the prefix before any other name."""
    return PREFIX + name.removeprefix("Image_")


def undistort_folder(folder: str | Path, camera: Camera, out: str | Path, *, force: bool = False) -> Undistorted:
    """Write the pictures of a folder without distortion, in colour, as they are stored (no EXIF orientation).

    Raises
    ------
    SessionError
        No pictures, or `out` exists: it is replaced with `force` only, and only where it holds such pictures.
    """
    import cv2

    source, target = Path(folder), Path(out)
    files = sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES) if source.is_dir() else []
    if not files:
        raise SessionError(source, "no pictures", f"files as {', '.join(SUFFIXES)}")
    others = [path.name for path in target.iterdir() if not path.name.startswith(PREFIX)] if target.is_dir() else []
    if others:
        found = f"holds {others[0]}, so it is not replaced"
        raise SessionError(target, found, f"a new name, or a folder of {PREFIX} pictures", "choose another --out")
    left_out, written = {}, 0
    with replacing(target, force=force) as new:
        new.mkdir()
        for path in files:
            picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            if picture is None or picture.shape[:2] != (camera.height, camera.width):
                left_out[path.name] = BROKEN if picture is None else RESIZED
                continue
            shown = undistorted(np.asarray(picture, dtype=np.uint8), camera)
            if not cv2.imwrite(str(new / undistorted_name(path.name)), shown):
                raise SessionError(target, f"{undistorted_name(path.name)} cannot be written", "a writable place")
            written += 1
    return Undistorted(written, left_out)
