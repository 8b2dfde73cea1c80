"""Pictures of a session: opened and checked.

A picture is left out, with the reason, when its file is missing or broken, its camera is not calibrated or calibrated
at another size, when it is dark, blurred beyond the rest of the recording, or the same as the one before it.
"""

from __future__ import annotations

import hashlib
import io
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import file_inside
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Session
from smartnav_graph.vision.pairs import rows_at_rate

Gray = NDArray[np.uint8]

MISSING = "missing file"
BROKEN = "broken file"
UNCALIBRATED = "camera without calibration"
RESIZED = "other size than calibrated"
DARK = "dark or without contrast"
BLURRED = "blurred"
REPEATED = "repeated"
REASONS = (MISSING, BROKEN, UNCALIBRATED, RESIZED, DARK, BLURRED, REPEATED)

# Least difference of grey levels between the 1st and the 99th percentile: less is noise, a covered lens or night.
LEAST_CONTRAST = 16.0
# Least sharpness over the usual one: motion blur of about a thirtieth of the width.
LEAST_SHARPNESS = 0.5
USUAL_OF, USUAL_FROM = 200, 5  # pictures
_SMALL_PX = 400


@dataclass(frozen=True)
class Picture:
    """One row of the images, with the path of its file; ``Path()`` where there is none."""

    image_id: int
    t_ns: int
    camera: str
    file: str
    path: Path

    def fingerprint(self) -> bytes:
        """Hash of the file's bytes; empty if there is no file."""
        try:
            return hashlib.blake2b(self.path.read_bytes(), digest_size=16).digest()
        except OSError:
            return b""


@dataclass(frozen=True)
class OpenedPicture:
    """Grey levels `gray` (h, w) of a picture, None with a `fault`; sharpness and fingerprint for later checks."""

    gray: Gray | None = None
    fault: str = ""
    sharpness: float = 0.0
    fingerprint: bytes = b""


def pictures(session: Session) -> list[Picture]:
    """The pictures of a session, by time.

    Raises
    ------
    SessionError
        There are none: no images, or only rows without a file.
    """
    images, folder = session.images, session.pictures
    where = session.path or "session"
    if images is None:
        raise SessionError(where, "has no images", "images.parquet with pictures", "import a log with a camera")
    if folder is None or not any(images.file):
        found = "lists images, but no files of them"
        raise SessionError(where, found, "files in images/", "its tracks or matches can be used as they are")
    rows = zip(images.image_id, images.t_ns, images.camera, map(str, images.file), strict=True)
    none = Path()  # no file: where there is none inside the folder
    return [Picture(int(i), int(t), str(c), file, file_inside(folder, file) or none) for i, t, c, file in rows]


def limit_rate(found: list[Picture], rate_hz: float) -> list[Picture]:
    """At most `rate_hz` pictures a second of each camera; all where the rate is 0."""
    if rate_hz <= 0:
        return found
    by_camera: dict[str, list[int]] = {}
    for row, picture in enumerate(found):
        by_camera.setdefault(picture.camera, []).append(row)
    stamps = np.array([picture.t_ns for picture in found], dtype=np.int64)
    rows = sorted(rows[i] for rows in by_camera.values() for i in rows_at_rate(stamps[rows], rate_hz))
    return [found[row] for row in rows]


def open_picture(picture: Picture, camera: Camera | None) -> OpenedPicture:
    """Open a picture and check it without regard to others."""
    if camera is None:
        return OpenedPicture(fault=UNCALIBRATED)
    try:
        data = picture.path.read_bytes()
    except OSError:
        return OpenedPicture(fault=MISSING)
    if _claimed_size(data) not in (None, (camera.width, camera.height)):  # before it is decoded: it may be huge
        return OpenedPicture(fault=RESIZED)
    gray = decoded(data)
    if gray is None:
        return OpenedPicture(fault=BROKEN)
    if gray.shape != (camera.height, camera.width):
        return OpenedPicture(fault=RESIZED)
    low, high = np.percentile(gray[::4, ::4], [1.0, 99.0])
    if high - low < LEAST_CONTRAST:
        return OpenedPicture(fault=DARK)
    return OpenedPicture(gray, "", sharpness(gray), hashlib.blake2b(gray.tobytes(), digest_size=16).digest())


def _claimed_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that the heading of a picture gives; None where it is of a kind that Pillow does not know."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as picture:
            return picture.size
    except Image.DecompressionBombError:
        return (0, 0)
    except (OSError, ValueError, SyntaxError, MemoryError):
        return None


def decoded(data: bytes) -> Gray | None:
    """Grey levels (h, w) of the bytes of a picture, in the axes of the sensor; None if truncated or not a picture.

    OpenCV refuses truncated data; from a file it would fill the lost part with grey. The orientation for viewers (EXIF)
    is ignored: cameras are calibrated and mounted by their sensor's axes.
    """
    if not data:
        return None
    import cv2

    try:
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        return None
    return None if found is None else np.asarray(found, dtype=np.uint8)


def sharpness(gray: Gray) -> float:
    """Gradient in the direction of the strongest blur over the contrast, at a common width.

    The root of the smaller eigenvalue of the mean structure tensor over the standard deviation; 0.12 to 0.18 for sharp
    pictures of indoor and road scenes, with any noise. Source: Bigün, Granlund (1987), Optimal orientation
    detection of linear symmetry, ICCV.
    """
    import cv2

    scale = min(_SMALL_PX / max(gray.shape), 1.0)
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.0)
    x, y = (cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=3) / 8.0 for axes in ((1, 0), (0, 1)))
    a, b, c = (x * x).mean(), (x * y).mean(), (y * y).mean()
    least = max((a + c) / 2.0 - np.hypot((a - c) / 2.0, b), 0.0)
    return float(np.sqrt(least / max(smooth.var(), 1.0)))


@dataclass
class PictureChecker:
    """Compares each picture with those of the same camera before it; one for all cameras, pictures in order."""

    _sharpness: dict[str, deque[float]] = field(default_factory=dict)
    _last: dict[str, bytes] = field(default_factory=dict)

    def fault(self, picture: Picture, seen: OpenedPicture) -> str:
        """Reason to skip the picture; empty for a usable one."""
        if seen.fault:
            return seen.fault
        usual = self._sharpness.setdefault(picture.camera, deque(maxlen=USUAL_OF))
        blurred = len(usual) >= USUAL_FROM and seen.sharpness < LEAST_SHARPNESS * float(np.median(usual))
        usual.append(seen.sharpness)
        repeated = self._last.get(picture.camera) == seen.fingerprint
        self._last[picture.camera] = seen.fingerprint
        return REPEATED if repeated else BLURRED if blurred else ""


def longest_break_s(found: Sequence[Picture], used: Iterable[Picture]) -> float:
    """Longest time, s, between used pictures of one camera, the recording's ends included."""
    usable = {(picture.camera, picture.t_ns) for picture in used}
    longest = 0
    for camera in {picture.camera for picture in found}:
        stamps = [picture.t_ns for picture in found if picture.camera == camera]
        kept = [t_ns for t_ns in stamps if (camera, t_ns) in usable]
        longest = max(longest, int(np.diff([stamps[0], *kept, stamps[-1]]).max()))
    return longest / NS
