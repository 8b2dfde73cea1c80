"""Boards seen by a simulated camera: exact corners, and rendered pictures."""

from functools import cache

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from smartnav_graph.calibrate.board import Board
from smartnav_graph.calibrate.board_pdf import black_parts
from smartnav_graph.calibrate.interior import BoardView, project_board
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.simulation.cameras import PHONE_CAMERA

BOARD = Board.parse("chessboard:9x6:0.03")
PHONE = PHONE_CAMERA  # the thesis' camera at 640 x 480


def theta_of(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def poses(count, rng, camera=PHONE, board=BOARD, model="brown", tilt=40.0):
    """Rotation vectors and positions (n, 6) of the board, all of it in the picture."""
    found = []
    centre = board.points.mean(axis=0)
    while len(found) < count:
        turn = Rotation.from_euler("xyz", rng.uniform([-tilt, -tilt, -30], [tilt, tilt, 30]), degrees=True)
        at = rng.uniform(0.2, 0.8, 2) * [camera.width, camera.height]
        place = np.append(camera.normalised(at[None])[0], 1.0) * rng.uniform(0.25, 0.6) - turn.apply(centre)
        pose = np.concatenate([turn.as_rotvec(), place])
        xy, _, _ = project_board(model, theta_of(camera), pose, board.points)
        if ((xy > 3) & (xy < [camera.width - 4, camera.height - 4])).all():
            found.append(pose)
    return np.array(found)


def exact_views(found, camera=PHONE, board=BOARD, model="brown"):
    theta = theta_of(camera)
    return [
        BoardView(f"{i}", board.points, project_board(model, theta, pose, board.points)[0])
        for i, pose in enumerate(found)
    ]


def noisy(views, sigma, rng, smooth=0.0):
    """Corners with white noise, and errors that are alike over a third of the board."""
    points = views[0].points
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    size = np.sort(apart[0])[1]
    root = np.linalg.cholesky(np.exp(-((apart / (4 * size)) ** 2) / 2) + 1e-9 * np.eye(len(points)))
    shape = (len(points), 2)
    return [
        BoardView(
            v.name, v.points, v.xy + sigma * rng.standard_normal(shape) + smooth * root @ rng.standard_normal(shape)
        )
        for v in views
    ]


@cache
def _texture(board, texels_per_m):
    """Grey levels of a board on a table, and the place of its first texel."""
    rectangles, circles = black_parts(board)
    border = 1.5 * board.size_m
    low = np.concatenate([rectangles[:, :2], circles[:, :2] - circles[:, 2:]]).min(axis=0) - border
    high = np.concatenate([rectangles[:, :2] + rectangles[:, 2:], circles[:, :2] + circles[:, 2:]]).max(axis=0) + border
    columns, rows = np.ceil((high - low) * texels_per_m).astype(int)
    texture = np.full((rows, columns), 0.9)
    for a, b, w, h in np.rint((rectangles - [*low, 0, 0]) * texels_per_m).astype(int):
        texture[b : b + h, a : a + w] = 0.1
    y, x = np.mgrid[:rows, :columns] + 0.5
    for a, b, r in (circles - [*low, 0]) * texels_per_m:
        texture[(x - a) ** 2 + (y - b) ** 2 < r**2] = 0.1
    return texture, low


@cache
def _rays(camera, samples):
    """Rays (s, h w, 3) through `samples` x `samples` points of each pixel."""
    at = (np.arange(samples) + 0.5) / samples - 0.5
    v, u = np.mgrid[: camera.height, : camera.width]
    grids = [np.stack([u + dx, v + dy], axis=-1).reshape(-1, 2) for dx in at for dy in at]
    flat = [camera.normalised(grid) for grid in grids]
    return [np.column_stack([xy, np.ones(len(xy))]) for xy in flat]


def render(pose, camera=PHONE, board=BOARD, rng=None, texels_per_m=4000, samples=2):
    """Picture (h, w) of the board on a grey table, the mean of `samples` x `samples` rays a pixel."""
    texture, low = _texture(board, texels_per_m)
    R, t = Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]
    total = np.zeros((camera.height, camera.width))
    for ray in _rays(camera, samples):
        at = (ray * ((R[:, 2] @ t) / (ray @ R[:, 2]))[:, None] - t) @ R
        where = (at[:, 1::-1] - low[::-1]) * texels_per_m - 0.5
        total += map_coordinates(texture, where.T, order=1, cval=0.5).reshape(total.shape)
    grey = 255 * total / samples**2
    if rng is not None:
        grey += 2.0 * rng.standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)
