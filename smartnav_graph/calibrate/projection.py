"""How well a calibration projects, over the image; what two calibrations differ by, in pixels.

A small error of theta that acts like a rotation of the camera does no harm: it is absorbed by the attitude of the
camera, in a calibration by the poses of the board. It is taken out by the rotation w that fits best over the image:

    dq = P dtheta + R w,   w = -(sum c R' R)^-1 sum c R' P dtheta,   dq = G dtheta,   cov(q) = G cov(theta) G'

P, R : derivatives of the pixel of a fixed direction by theta and by a rotation of the camera; c : weight of a pixel,
the inverse of the variance that results, so that corners which no board reached do not determine the rotation. For
points at a finite distance a shift along the optical axis is taken out too, which acts like a change of the focal
length.

Source: Kogan, mrcal (2021-), the uncertainty of a projection; Hartley, Zisserman (2004), section 5.2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.calibrate.interior import CameraFit, project_board
from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.so3 import exp
from smartnav_graph.session.calibration.camera import Camera

GRID = (20, 15)  # pixels at which a map over the image is made: across, down
_RETURN_PX = 0.01
_ROUNDS = 6  # of weights of the rotation that is taken out


@dataclass(frozen=True)
class ImageMap:
    """Values (h, w) at pixels x (w,), y (h,)."""

    x: Floats
    y: Floats
    values: Floats


def pixel_grid(width: int, height: int, count: tuple[int, int] = GRID) -> tuple[Floats, Floats, Floats]:
    """x (w,), y (h,) px from the first to the last pixel, and all of them (h w, 2)."""
    x, y = np.linspace(0.0, width - 1.0, count[0]), np.linspace(0.0, height - 1.0, count[1])
    return x, y, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def projection_covariance(fit: CameraFit, xy: Floats, distance_m: float = np.inf) -> Floats:
    """Covariance (n, 2, 2) px^2 of the projection at pixels (n, 2), over which the best rotation is taken out."""
    xy_n = fit.camera.normalised(xy)
    points = np.column_stack([xy_n, np.ones(len(xy_n))])
    _, P, B = project_board(fit.model, fit.theta, np.zeros(6), points)
    absorbed = B[:, :3] if np.isinf(distance_m) else B[:, [0, 1, 2, 5]]
    weight, covariance = np.ones(len(xy)), np.zeros((len(xy), 2, 2))
    for _ in range(_ROUNDS):
        root = np.repeat(np.sqrt(weight), 2)[:, None]
        G = P - absorbed @ np.linalg.lstsq(root * absorbed, root * P, rcond=None)[0]
        G = G.reshape(-1, 2, len(fit.theta))
        covariance = np.asarray(G @ fit.covariance @ np.swapaxes(G, 1, 2))
        weight = 1.0 / np.trace(covariance, axis1=1, axis2=2)
    return covariance


def projection_sigma(fit: CameraFit, distance_m: float = np.inf, count: tuple[int, int] = GRID) -> ImageMap:
    """Sigma px of one coordinate of a projected point, the mean of both axes, over the image; NaN where the
    model has no direction for a pixel."""
    x, y, xy = pixel_grid(fit.width, fit.height, count)
    sigma, there = np.full(len(xy), np.nan), invertible(fit.camera, xy)
    sigma[there] = np.sqrt(np.trace(projection_covariance(fit, xy[there], distance_m), axis1=1, axis2=2) / 2)
    return ImageMap(x, y, sigma.reshape(count[::-1]))


def invertible(camera: Camera, xy: Floats) -> Mask:
    """Which pixels (n, 2) the model has a direction for; elsewhere its distortion folds the image."""
    again = camera.pixels(camera.normalised(xy))
    return np.asarray(np.abs(again - xy).max(axis=1) < _RETURN_PX)


def projection_difference(
    one: Camera,
    other: Camera,
    distance_m: float = np.inf,
    count: tuple[int, int] = GRID,
    sigma: Floats | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Displacement (h w, 2) px of what pixels (h w, 2) of `one` see in `other`, less the rotation (3,) rad of the
    camera (and the shift along its axis, m) that fits best; NaN where a pixel has no direction.

    sigma : (h w,), of the displacements; the weights of the rotation are 1 / sigma^2, equal by default

    Raises
    ------
    CalibrationError
        The images have other sizes.
    """
    from scipy.optimize import least_squares

    if (one.width, one.height) != (other.width, other.height):
        found = f"{one.width} x {one.height} and {other.width} x {other.height} px"
        raise CalibrationError("calibrate compare", found, "one size of image", "scale or crop one of them before")
    _, _, xy = pixel_grid(one.width, one.height, count)
    there = invertible(one, xy) & (True if sigma is None else np.isfinite(sigma))
    xy_n = one.normalised(xy[there])
    rays = np.column_stack([xy_n, np.ones(len(xy_n))])
    finite = np.isfinite(distance_m)
    weight = np.ones((len(xy_n), 1)) if sigma is None else 1.0 / sigma[there, None]

    def displaced(move: Floats) -> Floats:
        seen = rays @ exp(move[:3]).T
        if finite:
            seen[:, 2] += move[3]
        return np.asarray(other.pixels(seen[:, :2] / seen[:, 2:]) - xy[there])

    found = least_squares(lambda move: (weight * displaced(move)).ravel(), np.zeros(4 if finite else 3), method="lm")
    move = np.asarray(found.x)
    apart = np.full_like(xy, np.nan)
    apart[there] = displaced(move)
    if finite:
        move[3] *= distance_m
    return xy, apart, move


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    """The same camera with images cut to `width` x `height` px from (left, top) on.

    Raises
    ------
    CalibrationError
        The part is not inside the image.
    """
    if not (0 <= left < left + width <= camera.width and 0 <= top < top + height <= camera.height):
        found = f"{width} x {height} px from ({left}, {top})"
        raise CalibrationError(
            "calibrate camera", found, f"a part of {camera.width} x {camera.height} px", "see --crop"
        )
    return replace(camera, width=width, height=height, cx=camera.cx - left, cy=camera.cy - top)


def distortion(camera: Camera, count: tuple[int, int] = GRID) -> tuple[Floats, Floats, Floats]:
    """Pixels (n, 2) without distortion on a grid over the image, and where they are displaced to by the radial terms
    and by the tangential terms, (n, 2) px each."""
    _, _, xy = pixel_grid(camera.width, camera.height, count)
    flat = (xy - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    total = camera.pixels(flat) - xy
    if camera.model == "fisheye" or len(camera.distortion) < 4:
        return xy, total, np.zeros_like(total)
    k = list(camera.distortion)
    k[2] = k[3] = 0.0
    radial = replace(camera, distortion=tuple(k)).pixels(flat) - xy
    return xy, radial, total - radial
