"""The centre of a circle's image is not the image of its centre.

A circle of radius r at a distance d is seen as an ellipse whose centre is off by about f (r / d)^2 sin(tilt), some
hundredths to tenths of a pixel, always to the side of the nearer half of the board: it does not average out. It is
computed at the first calibration as the centroid of the projected outline, and taken from the pixels.

Source: Heikkilä (2000), Geometric camera calibration using circular control points, section 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smartnav_graph.calibrate.board import CIRCLE, Board
from smartnav_graph.calibrate.interior import BoardView, CameraFit, pose_of, project_board
from smartnav_graph.core.arrays import Floats

_OUTLINE = 24  # points of a circle


def without_eccentricity(found: CameraFit, views: Sequence[BoardView], board: Board) -> tuple[BoardView, ...]:
    """The views with the images of the centres for the centres of the images."""
    return tuple(replace(view, xy=view.xy - eccentricity(found, view, board)) for view in views)


def eccentricity(found: CameraFit, view: BoardView, board: Board) -> Floats:
    """Centre of the image less image of the centre (n, 2) px of the circles of a view."""
    radius, pose = CIRCLE * board.size_m / 2, pose_of(found, view)
    angle = 2 * np.pi * np.arange(_OUTLINE) / _OUTLINE
    ring = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_OUTLINE)])
    outline = (view.points[:, None] + ring).reshape(-1, 3)
    x, y = np.moveaxis(project_board(found.model, found.theta, pose, outline)[0].reshape(-1, _OUTLINE, 2), -1, 0)
    next_x, next_y = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * next_y - next_x * y
    area = 3.0 * cross.sum(axis=1)
    centre = np.stack([((x + next_x) * cross).sum(axis=1) / area, ((y + next_y) * cross).sum(axis=1) / area], axis=1)
    return np.asarray(centre - project_board(found.model, found.theta, pose, view.points)[0])
