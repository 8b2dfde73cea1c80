"""A camera: from pixels to undistorted normalised image coordinates and back.

    x_n = X / Z, y_n = Y / Z of a point (X, Y, Z) in optical axes (x right, y down, z forward)
    pixel = K distorted(x_n, y_n),  K = [fx 0 cx; 0 fy cy; 0 0 1],  the centre of the first pixel is (0, 0)

Source: Brown (1971), Close-range camera calibration (radial and decentring terms, as in OpenCV); Kannala, Brandt
(2006), A generic camera model and calibration method for conventional, wide-angle, and fish-eye lenses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.so3 import is_rotation

LARGEST_PX = 100_000
# Numbers of distortion coefficients a model may have.
MODELS = {"brown": (0, 4, 5, 8), "fisheye": (4,)}


@dataclass(frozen=True)
class Camera:
    """Interior orientation of one camera.

    model : ``brown`` (k1, k2, p1, p2[, k3[, k4, k5, k6]]) or ``fisheye`` (k1 .. k4)
    width, height : px, of the images; fx, fy, cx, cy : px
    noise_px : sigma of an inlier match, px per axis; time_offset_s : a frame stamped t shows IMU time t + offset;
    readout_s : from the first row to the last, 0 for a global shutter
    boresight_sigma_deg, time_offset_sigma_s : sigmas of its attitude in the body and of its clock
    focal_sigma : of its focal length, relative
    body_R : row-major (3, 3), its axes, body_t : (3,) m, its place in the body where they were calibrated; else the
    session's mount has them
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "brown"
    distortion: tuple[float, ...] = ()
    noise_px: float = 0.7
    time_offset_s: float = 0.0
    readout_s: float = 0.0
    boresight_sigma_deg: float = 0.5
    time_offset_sigma_s: float = 0.02
    focal_sigma: float = 0.02
    body_R: tuple[float, ...] = ()
    body_t: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion, self.time_offset_s, self.readout_s)
        if self.model not in MODELS:
            raise self._error(f"model = {self.model!r}", f"one of {', '.join(MODELS)}")
        if len(self.distortion) not in MODELS[self.model]:
            raise self._error(
                f"{len(self.distortion)} distortion coefficients for model {self.model!r}",
                " or ".join(map(str, MODELS[self.model])),
            )
        if not all(map(math.isfinite, numbers)):
            raise self._error(f"fx, fy, cx, cy, distortion, time_offset_s, readout_s = {numbers}", "finite numbers")
        for name in ("width", "height", "fx", "fy", "noise_px"):
            if not 0 < getattr(self, name) <= LARGEST_PX:
                raise self._error(f"{name} = {getattr(self, name)}", f"0 to {LARGEST_PX} px", "give pixels")
        for name in ("cx", "cy"):
            if not abs(getattr(self, name)) <= LARGEST_PX:
                raise self._error(f"{name} = {getattr(self, name)}", f"-{LARGEST_PX} to {LARGEST_PX} px", "give pixels")
        for name in ("readout_s", "boresight_sigma_deg", "time_offset_sigma_s", "focal_sigma"):
            if not 0 <= getattr(self, name) < math.inf:
                raise self._error(f"{name} = {getattr(self, name)}", "a finite number >= 0")
        if self.body_R and not (len(self.body_R) == 9 and is_rotation(np.reshape(self.body_R, (3, 3)))):
            raise self._error(f"body_R = {list(self.body_R)}", "nine numbers of a rotation matrix, row by row")

        if self.body_t and not (len(self.body_t) == 3 and all(map(math.isfinite, self.body_t))):
            raise self._error(f"body_t = {list(self.body_t)}", "three finite numbers", "give m")

    def _error(self, found: str, expected: str, remedy: str = "see calibration/camera.py") -> CalibrationError:
        return CalibrationError("calibration.toml [cameras]", found, expected, remedy)

    @property
    def matrix(self) -> Floats:
        """K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def focal(self) -> float:
        """Mean focal length, px: pixels a unit of normalised coordinates."""
        return math.sqrt(self.fx * self.fy)

    @property
    def noise(self) -> float:
        """Sigma of an inlier match in normalised coordinates."""
        return self.noise_px / self.focal

    def normalised(self, xy_px: Floats) -> Floats:
        """Undistorted normalised coordinates (n, 2) of pixels (n, 2)."""
        points = np.ascontiguousarray(xy_px, dtype=np.float64).reshape(-1, 1, 2)
        if not len(points):
            return np.zeros((0, 2))
        import cv2

        if self.model == "fisheye":
            flat = cv2.fisheye.undistortPoints(points, self.matrix, np.array(self.distortion))
        else:
            steps = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-10)
            flat = cv2.undistortPointsIter(points, self.matrix, self._brown(), np.eye(3), np.eye(3), steps)
        return np.asarray(flat, dtype=np.float64).reshape(-1, 2)

    def pixels(self, xy_n: Floats) -> Floats:
        """Pixels (n, 2) of undistorted normalised coordinates (n, 2); the inverse of `normalised`."""
        points = np.ascontiguousarray(xy_n, dtype=np.float64).reshape(-1, 2)
        if not len(points):
            return np.zeros((0, 2))
        import cv2

        if self.model == "fisheye":
            found = cv2.fisheye.distortPoints(points[:, None], self.matrix, np.array(self.distortion))
        else:
            ahead = np.column_stack([points, np.ones(len(points))])
            found, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), self.matrix, self._brown())
        return np.asarray(found, dtype=np.float64).reshape(-1, 2)

    def _brown(self) -> Floats:
        return np.array(self.distortion) if self.distortion else np.zeros(5)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera read out at another resolution of the same field of view.

        Raises
        ------
        CalibrationError
            The aspect differs by more than a pixel: the field of view is not the same.
        """
        a, b = width / self.width, height / self.height
        if abs(a * self.height - height) > 1.0:
            raise self._error(
                f"images of {width} x {height} px for a camera of {self.width} x {self.height}",
                "the same field of view",
                "calibrate at the resolution of the recording",
            )
        cx, cy = (self.cx + 0.5) * a - 0.5, (self.cy + 0.5) * b - 0.5
        return replace(self, width=width, height=height, fx=self.fx * a, fy=self.fy * b, cx=cx, cy=cy)
