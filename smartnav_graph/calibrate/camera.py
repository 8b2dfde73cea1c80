"""Camera calibration from pictures of a board: which pictures are used, and what is reported.

Pictures come from files, folders or the images of sessions. One is left out, with the reason, where it cannot be read,
does not show the board, or shows it as the one before it did; a view where its residuals exceed those of the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.calibrate.board import Board, find_corners, size_shown, squares_differ
from smartnav_graph.calibrate.camera_charts import camera_charts
from smartnav_graph.calibrate.circles import without_eccentricity
from smartnav_graph.calibrate.interior import LEAST_VIEWS, WHERE, BoardView, CameraFit, calibrate_camera, check_count
from smartnav_graph.calibrate.projection import projection_sigma
from smartnav_graph.calibrate.result import CalibrationResult
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError, ConfigError
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.vision.images import BROKEN, Gray, decoded, pictures

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".pgm")
NOT_FOUND, ALIKE = "board not found", "like the one before it"
LEAST_MOVE = 0.01  # median displacement of the corners between views over the width of the picture
MOST_NAMES = 8  # listed
LOOKED_AT = 5  # pictures in which the size of the board is looked for
CELLS = (8, 6)  # of the picture, in which corners are counted
UNCERTAIN_PX = 2.0  # sigma of a projection, px, from which the report warns


# What pictures of a board determine of a camera.
INTERIOR = ("width", "height", "fx", "fy", "cx", "cy", "model", "distortion")


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Camera from pictures of a flat board: 15 to 30 of them, the board tilted by 20 to 45 deg to all sides, at all
    places of the picture, near enough to fill half of it. Focus and zoom must be those of the recordings."""

    board: str = ""
    """chessboard:9x6:0.025 (inner corners, side of a square in m), circles:4x11:0.02 (asymmetric, distance of rows) or
    charuco:8x6:0.03:0.021:4x4_250 (squares, sides of square and marker, dictionary)."""
    model: Literal["brown", "rational", "fisheye"] = "brown"
    """Distortion: Brown-Conrady k1 k2 p1 p2 k3, rational with k4 k5 k6 more, or fisheye k1 k2 k3 k4."""
    camera: str = "cam0"
    """Name of the camera, as images of sessions carry it."""
    corner_window: int = 0
    """Half side in px of the window in which a corner is refined; 0 for a third of the distance of corners."""
    keep_views: bool = False
    """Keep views whose residuals exceed those of the others."""


@dataclass(frozen=True)
class Found:
    """Views of the board in pictures of one size, what was left out and why, and warnings."""

    views: tuple[BoardView, ...]
    size: tuple[int, int]
    left_out: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]


def fit(sources: Sequence[Path], options: CameraOptions) -> CalibrationResult:
    """Calibrate a camera.

    Raises
    ------
    CalibrationError
        No pictures, no board in them, sizes that differ, or views that do not determine the camera.
    """
    if not options.board:
        expected = "what the pictures show, as chessboard:9x6:0.025"
        raise ConfigError("--board", "is missing", expected, "see smartnav calibrate camera --help")
    board = Board.parse(options.board)
    found = find_views(picture_files(sources, options.camera), board, options.corner_window)
    fitted = calibrate_camera(found.views, found.size, options.model, keep=options.keep_views)
    if board.kind == "circles":
        views = without_eccentricity(fitted, found.views, board)
        fitted = calibrate_camera(views, found.size, options.model, keep=options.keep_views)
    return _result(fitted, found, options)


def picture_files(sources: Sequence[Path], camera: str) -> list[tuple[str, Path]]:
    """Name and path of every picture."""
    found: list[tuple[str, Path]] = []
    for source in sources:
        here = sorted(p for p in source.iterdir() if p.suffix.lower() in SUFFIXES) if source.is_dir() else []
        if source.is_file() and source.suffix.lower() in SUFFIXES:
            found.append((source.name, source))
        elif here and not (source / "session.toml").exists():
            found += [(path.name, path) for path in here]
        else:
            from smartnav_graph import readers

            seen = pictures(readers.load(source))
            mine = [picture for picture in seen if picture.camera == camera]
            if not mine:
                cameras = ", ".join(sorted({picture.camera for picture in seen}))
                raise CalibrationError(source, f"no pictures of {camera}", f"one of {cameras}", "give --camera")
            found += [(picture.file, picture.path) for picture in mine]
    if not found:
        raise CalibrationError(
            WHERE, "no pictures", f"files as {', '.join(SUFFIXES)}", "give files, folders or sessions"
        )
    return found


def find_views(files: Sequence[tuple[str, Path]], board: Board, window_px: int = 0) -> Found:
    """Look for the board in pictures.

    Raises
    ------
    CalibrationError
        Pictures of several sizes; the board in none or in too few of them.
    """
    views: list[BoardView] = []
    left_out: list[tuple[str, str]] = []
    sizes: Counter[tuple[int, int]] = Counter()
    for name, path in files:
        gray = _read(path)
        if gray is None:
            left_out.append((name, BROKEN))
            continue
        sizes[gray.shape[1], gray.shape[0]] += 1
        corners = find_corners(gray, board, window_px)
        if corners is None:
            left_out.append((name, NOT_FOUND))
            continue
        view = BoardView(name, board.points[corners.number], corners.xy)
        if views and _alike(views[-1], view, gray.shape[1]):
            left_out.append((name, ALIKE))
        else:
            views.append(view)
    if len(sizes) > 1:
        counted = ", ".join(f"{count} of {w} x {h} px" for (w, h), count in sizes.most_common())
        remedy = "calibrate each size for itself; one resolution at a time"
        raise CalibrationError(WHERE, f"pictures of several sizes: {counted}", "one size", remedy)
    if not sizes:
        raise CalibrationError(WHERE, f"none of {len(files)} pictures can be read", "pictures", "see the files")
    shown = None
    if board.kind == "chessboard" or len(views) < LEAST_VIEWS:  # part of a larger chessboard is found, too
        shown = size_shown((g for _, p in _some(files) if (g := _read(p)) is not None), board)
    if not views or (len(views) < LEAST_VIEWS and squares_differ(board, shown)):
        raise _no_board(len(views), len(files), board, shown)
    check_count(views)
    warnings = [_other_size(board, shown)] if shown is not None and squares_differ(board, shown) else []
    return Found(tuple(views), next(iter(sizes)), tuple(left_out), tuple(warnings))


def _some(files: Sequence[tuple[str, Path]]) -> Sequence[tuple[str, Path]]:
    return [files[i] for i in np.unique(np.linspace(0, len(files) - 1, LOOKED_AT).astype(int))]


def _read(path: Path) -> Gray | None:
    try:
        return decoded(path.read_bytes())
    except OSError:
        return None


def _alike(before: BoardView, now: BoardView, width: int) -> bool:
    if before.points.shape != now.points.shape or not np.array_equal(before.points, now.points):
        return False
    return float(np.median(np.linalg.norm(now.xy - before.xy, axis=1))) < LEAST_MOVE * width


def _no_board(found: int, count: int, board: Board, shown: tuple[int, int] | None) -> CalibrationError:
    remedy = "check kind and counts (inner corners, not squares), light, and that the whole board is in the picture"
    if shown is not None:
        remedy = f"the pictures show {shown[0]} x {shown[1]}: give --board {_with_size(board, shown)}"
    what = f"board {board} in {found or 'none'} of {count} pictures"
    return CalibrationError(WHERE, what, "pictures of the board", remedy)


def _with_size(board: Board, shown: tuple[int, int]) -> Board:
    return replace(board, columns=shown[0], rows=shown[1])


def _other_size(board: Board, shown: tuple[int, int]) -> str:
    return (
        f"The pictures show a board of {shown[0]} x {shown[1]}, of which {board.columns} x {board.rows} were used: "
        f"give --board {_with_size(board, shown)} for all of it."
    )


def _result(found: CameraFit, seen: Found, options: CameraOptions) -> CalibrationResult:
    sigma = projection_sigma(found)
    prefix = options.camera
    order = tuple(f"{prefix}_{name}" for name in found.names)
    units = ["px"] * 4 + ["1"] * (len(order) - 4)
    rows = zip(order, found.theta, found.sigmas, units, strict=True)
    values = {name: Value(float(value), float(s), unit) for name, value, s, unit in rows}
    summary = {
        "corner_noise": found.noise_px,
        "rms": found.rms_px,
        "projection_sigma_median": float(np.nanmedian(sigma.values)),
        "projection_sigma_largest": float(np.nanmax(sigma.values)),
    }
    values |= {f"{prefix}_{name}": Value(value, np.nan, "px") for name, value in summary.items()}
    values[f"{prefix}_variance_inflation"] = Value(found.inflation, np.nan, "1")
    rms = zip(found.views, found.view_rms_px, strict=True)
    residuals = {view.name: Residual(float(r), len(view.xy), "px") for view, r in rms}
    left_out = (*seen.left_out, *found.left_out)
    return CalibrationResult(
        values,
        residuals,
        warnings=(*seen.warnings, *left_out_lines(left_out), *_warnings(found, sigma.values)),
        change=_change(found, options.camera),
        charts=camera_charts(found, sigma),
        order=order,
        covariance=tuple(found.covariance.ravel().tolist()),
    )


def left_out_lines(pictures: Sequence[tuple[str, str]]) -> list[str]:
    """One line for each reason."""
    by_reason: dict[str, list[str]] = {}
    for name, why in pictures:
        by_reason.setdefault(why, []).append(name)
    return [
        f"Left out, {why}: {', '.join(names[:MOST_NAMES])}"
        + (f" and {len(names) - MOST_NAMES} more." if len(names) > MOST_NAMES else ".")
        for why, names in by_reason.items()
    ]


def _change(found: CameraFit, name: str) -> Callable[[Calibration], Calibration]:
    """Puts the camera into a calibration; what is not its interior orientation stays as an earlier one has it."""

    def change(calibration: Calibration) -> Calibration:
        camera, before = found.camera, calibration.cameras.get(name)
        if before is not None:
            camera = replace(before, **{key: getattr(camera, key) for key in INTERIOR})
        return replace(calibration, cameras={**calibration.cameras, name: camera})

    return change


def coverage(found: CameraFit) -> NDArray[np.intp]:
    """Number of corners (rows, columns) in `CELLS` equal parts of the picture."""
    xy = np.concatenate([view.xy for view in found.views])
    edges = [np.linspace(-0.5, side - 0.5, n + 1) for side, n in zip((found.width, found.height), CELLS, strict=True)]
    return np.asarray(np.histogram2d(xy[:, 1], xy[:, 0], bins=edges[::-1])[0], dtype=np.intp)


def _warnings(found: CameraFit, sigma: Floats) -> list[str]:
    texts = []
    empty = float((coverage(found) == 0).mean())
    if empty > 0.25:
        texts.append(
            f"No corner in {empty:.0%} of the picture: projections there have sigmas of up to "
            f"{np.nanmax(sigma):.1f} px; add views with the board in its corners and at its edges."
        )
    elif np.nanmax(sigma) > UNCERTAIN_PX:
        texts.append(f"Sigma of a projection: up to {np.nanmax(sigma):.1f} px; add views with the board at the edges.")
    folded = float(np.isnan(sigma).mean())
    if folded > 0:
        texts.append(
            f"The distortion folds in {folded:.0%} of the picture, which the model has no direction for: add views "
            "there, or take a model with fewer terms."
        )
    if found.inflation > 2.0:
        texts.append(
            f"Errors of corners in one view are alike: variances are {found.inflation:.1f} times those of independent "
            "errors. Check that the board is flat, the pictures sharp, and the model fits; sigmas cover it."
        )
    return texts
