"""Boards: their descriptions, their pictures, their print."""

import numpy as np
import pytest
from boards import PHONE, poses, render, theta_of

from smartnav_graph.calibrate.board import Board, find_corners, size_shown, squares_differ
from smartnav_graph.calibrate.board_pdf import black_parts, write_board
from smartnav_graph.calibrate.interior import project_board
from smartnav_graph.core.errors import ConfigError, SessionError

BOARDS = ["chessboard:9x6:0.03", "circles:4x11:0.02", "charuco:8x6:0.03:0.021"]


@pytest.mark.parametrize("text", BOARDS)
def test_points_are_found_where_they_are(text):
    """By their numbers, within 0.15 px, twice what rendering and noise give; circles within their eccentricity."""
    board = Board.parse(text)
    rng = np.random.default_rng(1)
    for pose in poses(2, rng, board=board, tilt=25.0):
        found = find_corners(render(pose, board=board, rng=rng), board)
        assert found is not None
        exact, _, _ = project_board("brown", theta_of(PHONE), pose, board.points[found.number])
        apart = np.linalg.norm(found.xy - exact, axis=1)
        if board.kind == "chessboard" and apart.mean() > 10:  # either end may be the first
            apart = np.linalg.norm(found.xy[::-1] - exact, axis=1)
        assert len(found.number) >= 0.8 * len(board.points)
        assert np.sqrt((apart**2).mean()) < (0.3 if board.kind == "circles" else 0.15)  # px


def test_an_empty_picture_shows_no_board():
    grey = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    assert all(find_corners(grey, Board.parse(text)) is None for text in BOARDS)


@pytest.mark.parametrize("text", BOARDS[:2])
def test_the_size_of_a_board_is_seen(text):
    board = Board.parse(text)
    rng = np.random.default_rng(2)
    pictures = [
        render(pose, board=board) for pose in poses(5 if text.startswith("chess") else 2, rng, board=board, tilt=15.0)
    ]
    shown = size_shown(pictures, board)
    assert shown == (board.columns, board.rows)
    assert not squares_differ(board, shown) and not squares_differ(board, None)
    assert squares_differ(Board(board.kind, 5, 4, 0.03), shown)


@pytest.mark.parametrize(
    "text",
    [
        "chessboard",
        "chessboard:9",
        "checker:9x6:0.03",
        "chessboard:9x6:0",
        "chessboard:2x6:0.03",
        "charuco:8x6:0.03:0.04",
    ],
)
def test_descriptions_that_are_none(text):
    with pytest.raises(ConfigError, match="chessboard:9x6:0"):
        Board.parse(text)


def test_too_few_markers_are_named():
    with pytest.raises(ConfigError, match="larger dictionary"):
        Board.parse("charuco:14x12:0.03:0.02:4x4_50").charuco()


def test_descriptions_are_read_back():
    for text in (*BOARDS, "charuco:8x6:0.03:0.021:5x5_100"):
        assert Board.parse(str(Board.parse(text))) == Board.parse(text)


@pytest.mark.parametrize("text", BOARDS)
def test_print_is_of_true_size(text, tmp_path):
    """The page is the board and its margins; the cross-reference table points at the objects."""
    board = Board.parse(text)
    width, height = write_board(board, tmp_path / "board.pdf")
    data = (tmp_path / "board.pdf").read_bytes()
    box = f"/MediaBox [0 0 {width / 25.4 * 72:.3f} {height / 25.4 * 72:.3f}]"
    assert data.startswith(b"%PDF-1.4") and box.encode() in data
    start = int(data.split(b"startxref\n")[1].split()[0])
    offsets = [int(line[:10]) for line in data[start:].splitlines()[3:8]]
    assert [data[o : o + 7] for o in offsets] == [b"%d 0 obj" % n for n in range(1, 6)]
    rectangles, circles = black_parts(board)
    assert data.count(b" re\n") == len(rectangles) and data.count(b" c\n") == len(circles)
    with pytest.raises(SessionError, match="exists"):
        write_board(board, tmp_path / "board.pdf")


def test_charuco_print_is_the_board_of_opencv():
    """Every bit of the markers is where OpenCV draws it."""
    board = Board.parse("charuco:5x4:0.04:0.03")
    image = board.charuco().generateImage((500, 400))  # 100 px a square
    rectangles, _ = black_parts(board)
    y, x = (np.mgrid[:400, :500] + 0.5) / 2500 - 0.04
    drawn = np.zeros((400, 500), bool)
    for a, b, w, h in rectangles:
        drawn |= (x >= a) & (x < a + w) & (y >= b) & (y < b + h)
    assert (drawn == (image < 128)).mean() > 0.97  # edges of bits are rounded to pixels
