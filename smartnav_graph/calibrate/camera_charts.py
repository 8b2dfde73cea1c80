"""Figures of a camera calibration: corners over the picture, residuals, uncertainty of projections, distortion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from smartnav_graph.calibrate.interior import CameraFit
from smartnav_graph.calibrate.projection import ImageMap, distortion
from smartnav_graph.calibrate.result import Chart, Series
from smartnav_graph.session.calibration.camera import Camera

X, Y = "Column [px]", "Row, up from the first [px]"
LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # px, of contours
MOST_LEVELS = 5
LONGEST = 0.05  # drawn length of the longest arrow over the width of the picture
FINE = 8  # times finer grid of contours


def camera_charts(found: CameraFit, sigma: ImageMap) -> tuple[Chart, ...]:
    """All figures."""
    return (
        _coverage(found),
        _residuals(found),
        _of_views(found),
        uncertainty_chart(found, sigma),
        *distortion_charts(found.camera),
    )


def _frame(width: int, height: int) -> Series:
    x, y = np.array([0, 1, 1, 0, 0]) * (width - 1.0), np.array([0, 0, 1, 1, 0]) * (height - 1.0)
    return Series("", x, -y, colour=4)


def _coverage(found: CameraFit) -> Chart:
    xy = np.concatenate([view.xy for view in found.views])
    dots = Series(f"{len(xy)} corners of {len(found.views)} views", xy[:, 0], -xy[:, 1], "dots")
    frame = _frame(found.width, found.height)
    return Chart("Coverage of the picture", X, Y, (frame, dots), aspect=found.width / found.height)


def _residuals(found: CameraFit) -> Chart:
    r = np.concatenate(found.residuals)
    dots = Series("corners", r[:, 0], -r[:, 1], "dots")
    note = f"Root mean square {found.rms_px:.3f} px; noise of a coordinate {found.noise_px:.3f} px."
    return Chart("Residuals of corners", "Across [px]", "Up [px]", (dots,), aspect=1.6, note=note)


def _of_views(found: CameraFit) -> Chart:
    number = np.arange(1.0, len(found.views) + 1)
    dots = Series("root mean square", number, found.view_rms_px, "dots")
    return Chart("Residuals of views", "BoardView", "Residual [px]", (dots, Series("", number, 0 * number, colour=4)))


def uncertainty_chart(found: CameraFit, sigma: ImageMap) -> Chart:
    """Contours of the sigma of a projection."""
    lines = [_frame(found.width, found.height), *_contours(sigma)]
    least, most = np.nanmin(sigma.values), np.nanmax(sigma.values)
    note = f"From {least:.3f} to {most:.2f} px; a rotation of the camera is taken out."
    title = "Sigma of a projection, far points"
    return Chart(title, X, Y, lines, aspect=found.width / found.height, note=note)


def _contours(of: ImageMap) -> Iterator[Series]:
    """Lines of equal value, each level one series."""
    import cv2

    least, most = float(np.nanmin(of.values)), float(np.nanmax(of.values))
    levels = [level for level in LEVELS if least < level < most]
    levels = levels[:: -(-len(levels) // MOST_LEVELS)] if levels else []
    full = np.where(np.isfinite(of.values), of.values, most)
    fine = cv2.resize(full, None, fx=FINE, fy=FINE, interpolation=cv2.INTER_LINEAR)
    span = of.x[-1] - of.x[0], of.y[-1] - of.y[0]
    for colour, level in enumerate(levels):
        found, _ = cv2.findContours((fine > level).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        parts = []
        for line in found:
            at = line.reshape(-1, 2) / (np.array(fine.shape[::-1]) - 1.0)
            edge = (at <= 0.0).any(axis=1) | (at >= 1.0).any(axis=1)
            at[edge] = np.nan  # along the edge of the picture there is no contour
            parts += [at * span, np.full((1, 2), np.nan)]
        xy = np.concatenate(parts) if parts else np.zeros((0, 2))
        yield Series(f"{level:g} px", xy[:, 0], -xy[:, 1], colour=colour)


def distortion_charts(camera: Camera) -> tuple[Chart, ...]:
    """Radial and tangential distortion as displacements, enlarged or reduced to a common length."""
    xy, radial, tangential = distortion(camera, (15, 11))
    aspect = camera.width / camera.height
    out = []
    for title, moved in (("Radial distortion", radial), ("Tangential distortion", tangential)):
        longest = float(np.nanmax(np.linalg.norm(moved, axis=1)))
        if longest == 0.0:
            continue
        scale = LONGEST * camera.width / longest
        lines = np.stack([xy, xy + scale * moved, np.full_like(xy, np.nan)], axis=1).reshape(-1, 2)
        arrows = Series("displacement", lines[:, 0], -lines[:, 1])
        start = Series("without distortion", xy[:, 0], -xy[:, 1], "dots")
        note = f"Largest displacement {longest:.2f} px, drawn {scale:.3g} times its size."
        frame = _frame(camera.width, camera.height)
        out.append(Chart(title, X, Y, (frame, arrows, start), aspect=aspect, note=note))
    return tuple(out)
