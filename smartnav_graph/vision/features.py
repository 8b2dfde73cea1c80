"""Points of interest with descriptors: detectors and descriptors of OpenCV by name.

The names with a plus (detector + descriptor) need the contrib modules of OpenCV. Every detector returns more points
than needed; the best of them that cover the picture are used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.vision.images import Gray

if TYPE_CHECKING:
    import cv2

# Points that a detector returns over those needed.
SURPLUS = 2
# Cells along the longer side of the picture, among which the points are distributed.
CELLS = 16


@dataclass(frozen=True)
class Kind:
    """How to create a detector (of the cv2 module and the number of points) and a descriptor; None: the same object.

    at_once : detector and descriptor share a pyramid, and the detector keeps to the number of points
    """

    detector: Callable[[ModuleType, int], cv2.Feature2D]
    descriptor: Callable[[ModuleType], cv2.Feature2D] | None = None
    at_once: bool = False


def _freak(opencv: ModuleType) -> cv2.Feature2D:
    descriptor: cv2.Feature2D = opencv.xfeatures2d.FREAK_create()
    return descriptor


# Thresholds are low: the strongest points are taken even with weak texture. ORB locates points at whole pixels of each
# level of its pyramid: beyond a scale of two (five levels) they are too coarse for relative geometry. The Harris score
# grows with the fourth power of contrast and would cluster the points; the FAST score does not.
KINDS: dict[str, Kind] = {
    "orb": Kind(lambda cv2, n: cv2.ORB_create(2 * n, fastThreshold=10, nlevels=5, scoreType=cv2.ORB_FAST_SCORE)),
    "sift": Kind(lambda cv2, n: cv2.SIFT_create(nfeatures=n, contrastThreshold=0.02), at_once=True),
    "akaze": Kind(lambda cv2, n: cv2.AKAZE_create(threshold=5e-4)),
    "brisk": Kind(lambda cv2, n: cv2.BRISK_create(thresh=20)),
    "fast+freak": Kind(lambda cv2, n: cv2.FastFeatureDetector_create(15), _freak),
    "star+brief": Kind(
        lambda cv2, n: cv2.xfeatures2d.StarDetector_create(responseThreshold=10),
        lambda cv2: cv2.xfeatures2d.BriefDescriptorExtractor_create(),
    ),
    "gftt+freak": Kind(lambda cv2, n: cv2.GFTTDetector_create(maxCorners=n, qualityLevel=1e-3, minDistance=3), _freak),
    "mser+freak": Kind(lambda cv2, n: cv2.MSER_create(), _freak),
}


@dataclass(frozen=True)
class Features:
    """Points of one picture: `xy_px`, `xy_n` (n, 2) pixels and undistorted normalised, `descriptors` (n, k)."""

    xy_px: Floats
    xy_n: Floats
    descriptors: NDArray[np.generic]

    def __len__(self) -> int:
        return len(self.xy_px)


def require(name: str) -> Kind:
    """The kind of this name, checked against the installed OpenCV.

    Raises
    ------
    ConfigError
        Unknown name, or the installed OpenCV is built without it.
    """
    if name not in KINDS:
        raise ConfigError("--features", f"unknown features {name!r}", f"klt or one of {', '.join(KINDS)}")
    try:
        make(name, 1)
    except AttributeError as error:
        import cv2

        raise ConfigError(
            "--features",
            f"{name} is not in the installed build of OpenCV ({cv2.__version__}, {error})",
            f"one of {', '.join(available())}, or a build with the contrib modules (opencv-contrib-python-headless)",
            "it cannot share an environment with opencv-python-headless: scripts/reproduce_features makes one",
        ) from error
    return KINDS[name]


def available() -> list[str]:
    """Names that the installed OpenCV supports."""
    found = []
    for name in KINDS:
        try:
            make(name, 1)
        except AttributeError:
            continue
        found.append(name)
    return found


def make(name: str, count: int) -> tuple[cv2.Feature2D, cv2.Feature2D]:
    """Detector and descriptor of OpenCV; AttributeError if its build has no such one."""
    import cv2

    kind = KINDS[name]
    detector = kind.detector(cv2, SURPLUS * count)
    return detector, detector if kind.descriptor is None else kind.descriptor(cv2)


def extract(gray: Gray, camera: Camera, name: str, count: int) -> Features:
    """At most `count` points that cover a picture, with their descriptors.

    Parameters
    ----------
    gray : (h, w) grey levels
    camera : undistorts the points
    name : of `KINDS`, checked by `require`
    """
    points, descriptors = _described(gray, name, count)
    if not points:
        return Features(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 1), dtype=np.uint8))
    xy_px = _places(points)[0]
    xy_n = camera.normalised(xy_px)
    good = np.isfinite(xy_n).all(axis=1)
    return Features(xy_px[good], xy_n[good], descriptors[good])


def _described(gray: Gray, name: str, count: int) -> tuple[Sequence[cv2.KeyPoint], NDArray[np.generic]]:
    """Points of OpenCV with their descriptors."""
    detector, descriptor = make(name, count)
    described: NDArray[np.generic] = np.zeros((0, 1), dtype=np.uint8)
    if KINDS[name].at_once:
        points, described = detector.detectAndCompute(gray, None)
    else:
        points = detector.detect(gray)
    if not points:
        return [], described
    best = spread(*_places(points), gray.shape, count)
    strongest = [points[i] for i in best]
    if KINDS[name].at_once:
        return strongest, described[best]
    points, described = descriptor.compute(gray, strongest)
    return points, np.asarray(described)


def _places(points: Sequence[cv2.KeyPoint]) -> tuple[Floats, Floats]:
    """Pixels (n, 2) and strengths (n,); detectors without a response are ranked by size."""
    xy = np.array([point.pt for point in points], dtype=np.float64)
    strength = np.array([point.response for point in points], dtype=np.float64)
    return xy, strength if strength.any() else np.array([point.size for point in points], dtype=np.float64)


def spread(xy: Floats, strength: Floats, shape: tuple[int, ...], count: int) -> NDArray[np.intp]:
    """Rows of at most `count` points: the strongest of every cell first, then every cell's second, and so on."""
    side = max(shape) / CELLS
    cell = (xy // side) @ np.array([1.0, CELLS + 1.0])
    order = np.lexsort((-strength, cell))
    first = np.concatenate([[True], np.diff(cell[order]) != 0])
    start = np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    rank = np.arange(len(order)) - start
    return np.asarray(order[np.lexsort((-strength[order], rank))][:count])
