"""Calibration boards: their points, and where a picture shows them.

    chessboard:COLUMNSxROWS:SIZE            inner corners, side of a square in m
    circles:COLUMNSxROWS:SIZE               asymmetric circles: in a row, rows; SIZE: distance of the rows, m, half of
                                            that of circles in a row; diameters are `CIRCLE` of it
    charuco:COLUMNSxROWS:SIZE[:MARKER[:DICTIONARY]]     squares, sides of a square and of a marker in m

Corners are found on a picture of at most `SEARCH_PX` and refined at full size, in a window of a third of the least
distance between corners: a wider one takes in the next corner and moves the found one by pixels. On a ChArUco board it
ends where the markers begin.

Source: Förstner, Gülch (1987), corners as least-squares intersections of edges (as OpenCV's cornerSubPix);
Garrido-Jurado et al. (2014), Automatic generation and detection of highly reliable fiducial markers under occlusion.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.vision.images import Gray

if TYPE_CHECKING:
    import cv2

KINDS = ("chessboard", "circles", "charuco")
# Diameter of a circle over the distance of rows, as in OpenCV's pattern.
CIRCLE = 0.8
SEARCH_PX = 1000
WINDOW = 1 / 3  # half side of the window of a corner, over the least distance of corners
LEAST_WINDOW_PX = 2
LEAST_CORNERS = 8  # of a view of a ChArUco board
MARKER = 0.7  # side of a marker over that of its square
DICTIONARY = "4x4_250"
MOST_SIZE = 14  # columns and rows that are tried when no board is found
_BLOB_SHARES = (2e-5, 0.02)  # area of a circle over that of the picture


@dataclass(frozen=True)
class Board:
    """A flat board.

    kind : one of `KINDS`; columns, rows : inner corners, circles, or squares of a ChArUco board
    size_m : side of a square, or distance of the rows of circles; marker_m, dictionary : of a ChArUco board
    """

    kind: str
    columns: int
    rows: int
    size_m: float
    marker_m: float = 0.0
    dictionary: str = DICTIONARY

    def __post_init__(self) -> None:
        least = 3 if self.kind != "circles" else 2
        sound = self.kind in KINDS and min(self.columns, self.rows) >= least and 0 < self.size_m < 10
        if not (sound and 0 <= self.marker_m < self.size_m):
            expected = "chessboard:9x6:0.025, circles:4x11:0.02 or charuco:8x6:0.03:0.021 (counts, sides in m)"
            raise ConfigError("--board", str(self), expected)

    @classmethod
    def parse(cls, text: str) -> Board:
        """Of a description as above.

        Raises
        ------
        ConfigError
            The description is not one, or has impossible numbers.
        """
        kind, *rest = text.split(":")
        try:
            columns, rows = map(int, rest[0].lower().split("x"))
            size = float(rest[1]) if len(rest) > 1 else 1.0
            marker = float(rest[2]) if len(rest) > 2 else MARKER * size if kind == "charuco" else 0.0
        except (ValueError, IndexError):
            columns, rows, size, marker = 0, 0, 0.0, 0.0
        found = rest[3] if len(rest) > 3 else DICTIONARY
        if columns == 0 or len(rest) > 4:
            expected = "chessboard:9x6:0.025, circles:4x11:0.02 or charuco:8x6:0.03:0.021:4x4_250"
            raise ConfigError("--board", repr(text), expected, "give kind, columns x rows and the size in m")
        return cls(kind, columns, rows, size, marker, found)

    def __str__(self) -> str:
        marker = f":{self.marker_m:g}:{self.dictionary}" if self.kind == "charuco" else ""
        return f"{self.kind}:{self.columns}x{self.rows}:{self.size_m:g}{marker}"

    @property
    def points(self) -> Floats:
        """Points (n, 3) of the board, m, z = 0; by their number."""
        if self.kind == "circles":
            row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
            flat = np.stack([2 * column + row % 2, row], axis=1)
        else:
            columns, rows = self._inner
            flat = np.stack(np.divmod(np.arange(columns * rows), columns)[::-1], axis=1)
        return np.column_stack([self.size_m * flat, np.zeros(len(flat))])

    @property
    def _inner(self) -> tuple[int, int]:
        less = 1 if self.kind == "charuco" else 0
        return self.columns - less, self.rows - less

    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's board.

        Raises
        ------
        ConfigError
            No such dictionary, or it has too few markers.
        """
        import cv2

        number = getattr(cv2.aruco, f"DICT_{self.dictionary.upper()}", None)
        if number is None:
            raise ConfigError("--board", f"dictionary {self.dictionary!r}", "a name as 4x4_250, 5x5_100, 6x6_250")
        markers = cv2.aruco.getPredefinedDictionary(number)
        if len(markers.bytesList) < self.columns * self.rows // 2:
            found = f"{self.columns} x {self.rows} squares for {len(markers.bytesList)} markers of {self.dictionary}"
            raise ConfigError("--board", found, "a marker for every second square", "take a larger dictionary")
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.size_m, self.marker_m, markers)


@dataclass(frozen=True)
class Corners:
    """What a picture shows of a board: numbers of points (n,), and pixels (n, 2)."""

    number: NDArray[np.intp]
    xy: Floats


def find_corners(gray: Gray, board: Board, window_px: int = 0) -> Corners | None:
    """The points of a board in a picture (h, w); None where it is not found.

    window_px : half side of the window in which a corner is refined; 0 for a third of the least distance.
    """
    scale = min(SEARCH_PX / max(gray.shape), 1.0)
    small = gray if scale == 1.0 else _resized(gray, scale)
    found = _FINDERS[board.kind](small, board)
    if found is None:
        return None
    xy = (found.xy + 0.5) / scale - 0.5
    if board.kind == "circles":
        full = found if scale == 1.0 else _circles(gray, board)
        return Corners(found.number, xy) if full is None else full
    share = min(WINDOW, 0.5 * (1.0 - board.marker_m / board.size_m)) if board.kind == "charuco" else WINDOW
    return Corners(found.number, refined(gray, xy, window_px, share))


def _resized(gray: Gray, scale: float) -> Gray:
    import cv2

    return np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def refined(gray: Gray, xy: Floats, window_px: int = 0, share: float = WINDOW) -> Floats:
    """Corners (n, 2) px where the edges around them meet, in a window of `share` of their distance."""
    import cv2
    from scipy.spatial import cKDTree

    if window_px == 0:
        nearest = float(cKDTree(xy).query(xy, 2)[0][:, 1].min())
        window_px = max(LEAST_WINDOW_PX, math.floor(share * nearest))
    steps = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    start = xy.astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(gray, start, (window_px, window_px), (-1, -1), steps)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def _chessboard(gray: Gray, board: Board) -> Corners | None:
    import cv2

    size = (board.columns, board.rows)
    there, xy = cv2.findChessboardCorners(gray, size)
    if not there:
        there, xy = cv2.findChessboardCornersSB(gray, size)
    return Corners(np.arange(len(xy)), np.asarray(xy, dtype=np.float64).reshape(-1, 2)) if there else None


def _circles(gray: Gray, board: Board) -> Corners | None:
    import cv2

    how = cv2.SimpleBlobDetector.Params()
    how.minArea, how.maxArea = (max(25.0, share * gray.size) for share in _BLOB_SHARES)
    how.minDistBetweenBlobs = 4.0
    size, blobs = (board.columns, board.rows), cv2.SimpleBlobDetector.create(how)
    there, xy = cv2.findCirclesGrid(gray, size, flags=cv2.CALIB_CB_ASYMMETRIC_GRID, blobDetector=blobs)
    return Corners(np.arange(len(xy)), np.asarray(xy, dtype=np.float64).reshape(-1, 2)) if there else None


def _charuco(gray: Gray, board: Board) -> Corners | None:
    import cv2

    xy, number, _, _ = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(gray)
    if number is None or len(number) < LEAST_CORNERS:
        return None
    return Corners(np.asarray(number, dtype=np.intp).ravel(), np.asarray(xy, dtype=np.float64).reshape(-1, 2))


_FINDERS = {"chessboard": _chessboard, "circles": _circles, "charuco": _charuco}


def size_shown(pictures: Iterable[Gray], board: Board) -> tuple[int, int] | None:
    """Columns and rows that more than half of some pictures show, of the kind of `board`; None where none does."""
    if board.kind == "charuco":
        return None
    shown: Counter[tuple[int, int]] = Counter()
    count = 0
    for gray in pictures:
        count += 1
        small = _resized(gray, min(SEARCH_PX / max(gray.shape), 1.0))
        size = _largest_chessboard(small) if board.kind == "chessboard" else _some_circles(small)
        if size is not None:
            shown[size] += 1
    (best, votes), *_ = shown.most_common(1) or [((0, 0), 0)]
    return best if 2 * votes > count else None


def _largest_chessboard(gray: Gray) -> tuple[int, int] | None:
    import cv2

    there, _, squares = cv2.findChessboardCornersSBWithMeta(gray, (3, 3), cv2.CALIB_CB_LARGER)
    return (max(squares.shape), min(squares.shape)) if there else None


def _some_circles(gray: Gray) -> tuple[int, int] | None:
    sizes: Sequence[tuple[int, int]] = [(c, r) for c in range(7, 2, -1) for r in range(MOST_SIZE, 2, -1)]
    return next((s for s in sizes if _circles(gray, Board("circles", *s, 1.0)) is not None), None)


def squares_differ(board: Board, shown: tuple[int, int] | None) -> bool:
    """Whether the pictures show another number of columns and rows."""
    if shown is None:
        return False
    own = (board.columns, board.rows)
    return sorted(own) != sorted(shown) if board.kind == "chessboard" else own != shown
