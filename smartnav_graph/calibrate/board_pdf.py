"""A board as a PDF of one page, in true size, with a line of 100 mm to check the print.

Lengths of the page are points of 1/72 inch. Source: ISO 32000-1 (2008), PDF 1.7, sections 7.5 and 8.5.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.calibrate.board import CIRCLE, Board
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.files import replacing

MM = 72.0 / 25.4  # points
MARGIN_MM, FOOT_MM = 12.0, 14.0
ROUND = 0.5522847498  # control points of a quarter of a circle, over its radius


def black_parts(board: Board) -> tuple[Floats, Floats]:
    """What is black: rectangles (n, 4) x, y, width, height, and circles (m, 3) x, y, radius; m, from the first point
    of the board."""
    a, none = board.size_m, np.zeros((0, 3))
    if board.kind == "circles":
        radius = np.full((board.columns * board.rows, 1), CIRCLE * a / 2)
        return np.zeros((0, 4)), np.hstack([board.points[:, :2], radius])
    columns, rows = (board.columns, board.rows) if board.kind == "charuco" else (board.columns + 1, board.rows + 1)
    y, x = np.mgrid[:rows, :columns].reshape(2, -1)
    black = (x + y) % 2 == 0
    squares = np.column_stack([x[black] - 1, y[black] - 1, np.ones((black.sum(), 2))]) * a
    if board.kind == "chessboard":
        return squares, none
    return np.concatenate([squares, *_markers(board, x[~black], y[~black])]), none


def _markers(board: Board, x: Floats, y: Floats) -> list[Floats]:
    """Black bits of the markers on the white squares (n,), row by row."""
    import cv2

    charuco = board.charuco()
    dictionary = charuco.getDictionary()
    bits = dictionary.markerSize + 2
    cell, inset, parts = board.marker_m / bits, (board.size_m - board.marker_m) / 2, []
    for number, column, row in zip(np.asarray(charuco.getIds()).ravel(), x, y, strict=True):
        image = cv2.aruco.generateImageMarker(dictionary, int(number), bits)
        down, along = np.nonzero(image == 0)
        corner = (np.array([column, row]) - 1) * board.size_m + inset
        parts.append(np.column_stack([corner + cell * np.column_stack([along, down]), np.full((len(down), 2), cell)]))
    return parts


def write_board(board: Board, path: str | Path, *, force: bool = False) -> tuple[float, float]:
    """Write the page; its width and height, mm.

    Raises
    ------
    SessionError
        The file exists, and `force` is not given.
    """
    rectangles, circles = (1000.0 * part for part in black_parts(board))
    low = np.concatenate([rectangles[:, :2], circles[:, :2] - circles[:, 2:]]).min(axis=0)
    high = np.concatenate([rectangles[:, :2] + rectangles[:, 2:], circles[:, :2] + circles[:, 2:]]).max(axis=0)
    width, height = high - low + 2 * MARGIN_MM
    height += FOOT_MM
    width = max(width, 100.0 + 2 * MARGIN_MM)
    left, top = MARGIN_MM - low[0], height - MARGIN_MM + low[1]  # of the first point; y of a page is up
    lines = [f"{MM:.6f} 0 0 {MM:.6f} 0 0 cm 0 g"]
    lines += [f"{left + x:.4f} {top - y - h:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in rectangles]
    lines += [_circle(left + x, top - y, r) for x, y, r in circles]
    lines += ["f", "0.2 w", f"{MARGIN_MM} 10 m {MARGIN_MM + 100} 10 l S"]
    lines += [f"{x} 8.5 m {x} 11.5 l S" for x in (MARGIN_MM, MARGIN_MM + 100)]
    lines += [
        f"BT /F1 3 Tf {MARGIN_MM} 4.5 Td ({board}   print at 100 %: the line is 100 mm; glue on a flat plate) Tj ET"
    ]
    with replacing(path, force=force) as new:
        new.write_bytes(_document("\n".join(lines).encode("latin-1"), width * MM, height * MM))
    return float(width), float(height)


def _circle(x: float, y: float, r: float) -> str:
    k, quarters = ROUND * r, []
    for a, b, c, d in ((1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0)):
        points = (a * r + c * k, b * r + d * k, c * r + a * k, d * r + b * k, c * r, d * r)
        quarters.append(" ".join(f"{p + (x, y)[i % 2]:.4f}" for i, p in enumerate(points)) + " c")
    return f"{x + r:.4f} {y:.4f} m " + " ".join(quarters)


def _document(content: bytes, width: float, height: float) -> bytes:
    page = (
        f"/Parent 2 0 R /MediaBox [0 0 {width:.3f} {height:.3f}] /Contents 4 0 R /Resources << /Font << /F1 5 0 R >> >>"
    )
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page {page} >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, starts = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        starts.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % start for start in starts)
    size = len(objects) + 1
    return out + b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (
        *(size, table),
        *(size, len(out)),
    )
