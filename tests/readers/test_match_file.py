"""Match files of 2012: golden rows, the sensor's axes, the round trip, and broken files."""

import numpy as np
import pytest

from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers import match_file
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.streams import Images

# the camera of 2012: Brown's distortion with five coefficients
CAMERA = Camera(3264, 2448, 2935.64, 2944.08, 1619, 1234, distortion=(0.228, -0.973, -2.32e-4, -1.29e-3, 0.951))
FLAT = Camera(3264, 2448, 2935.64, 2944.08, 1619, 1234)
IMAGES = Images(
    t_ns=np.array([10, 11, 11, 12]) * 1_000_000_000,
    image_id=[3, 4, 5, 6],
    file=np.array(["a", "b", "c", "d"], dtype=object),
    camera=np.array(["back", "back", "front", "back"], dtype=object),
)
TEXT = """# time0 time1 x0 y0 x1 y1
10.000000000 11.000000000 0.000 0.000 1000.000 -500.000
11.000000000 12.000000000 -2269.500 1709.250 -2000.125 1500.001
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "m.txt").write_text(TEXT)
    return tmp_path / "m.txt"


def test_the_centre_of_the_picture_is_the_origin_and_y_points_down(file):
    matches, lost = match_file.to_matches(match_file.read_match_file(file), IMAGES, "back", FLAT)
    assert lost == 0
    assert matches.image_id_0.tolist() == [3, 4] and matches.image_id_1.tolist() == [4, 6]
    assert matches.t_1_ns.tolist() == [11_000_000_000, 12_000_000_000]
    # centre pixel (1631.5, 1223.5); 1000 um are 718.94 px to the right, -500 um are 357.89 px up
    np.testing.assert_allclose(matches.xy0_n[0], [(1631.5 - 1619) / 2935.64, (1223.5 - 1234) / 2944.08], atol=1e-12)
    up = [(1631.5 + 1000 * 3264 / 4540 - 1619) / 2935.64, (1223.5 - 500 * 2448 / 3420 - 1234) / 2944.08]
    np.testing.assert_allclose(matches.xy1_n[0], up, atol=1e-12)


def test_the_lens_is_undone(file):
    bent, flat = (match_file.to_matches(match_file.read_match_file(file), IMAGES, "back", c)[0] for c in (CAMERA, FLAT))
    shift = np.linalg.norm(bent.xy0_n[1] - flat.xy0_n[1]) * CAMERA.focal
    assert 10 < shift < 200  # px in the corner
    np.testing.assert_allclose(CAMERA.pixels(bent.xy0_n), FLAT.pixels(flat.xy0_n), atol=1e-6)


def test_reading_and_writing_again_gives_the_same_text(file, tmp_path):
    matches, _ = match_file.to_matches(match_file.read_match_file(file), IMAGES, "back", CAMERA)
    match_file.write_match_file(matches, tmp_path / "again.txt", CAMERA)
    assert (tmp_path / "again.txt").read_text().splitlines()[1:] == TEXT.splitlines()[1:]
    with pytest.raises(SessionError, match="exists already"):
        match_file.write_match_file(matches, tmp_path / "again.txt", CAMERA)


def test_many_random_matches_come_back_to_a_nanometre(tmp_path):
    rng = np.random.default_rng(0)
    um = rng.uniform([-2270, -1710], [2270, 1710], (2, 400, 2)).round(3)
    rows = match_file.Rows(np.full(400, 10_000_000_000), np.full(400, 12_000_000_000), *um)
    matches, _ = match_file.to_matches(rows, IMAGES, "back", CAMERA)
    match_file.write_match_file(matches, tmp_path / "m.txt", CAMERA)
    again = match_file.read_match_file(tmp_path / "m.txt")
    np.testing.assert_array_equal(again.xy0_um, um[0])
    np.testing.assert_array_equal(again.xy1_um, um[1])


def test_separators_and_a_heading(tmp_path, file):
    expected = match_file.read_match_file(file)
    for text in (TEXT.replace("# ", "").replace(" ", ","), TEXT.replace(" ", "\t"), TEXT.split("\n", 1)[1]):
        (tmp_path / "other.txt").write_text(text)
        for one, other in zip(match_file.read_match_file(tmp_path / "other.txt"), expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_rows_without_images_are_counted(file):
    rows = match_file.read_match_file(file)
    late = rows._replace(t1_ns=rows.t1_ns + np.array([0, 30_000_000]))
    matches, lost = match_file.to_matches(late, IMAGES, "back", CAMERA)
    assert (len(matches), lost) == (1, 1)
    with pytest.raises(SessionError) as caught:
        match_file.to_matches(rows._replace(t0_ns=rows.t0_ns + 10**12), IMAGES, "back", CAMERA)
    assert "no row belongs to two images; times from 1010.000 to 1011.000 s" in str(caught.value)
    assert "those are from 10.000 to 12.000 s" in str(caught.value)


@pytest.mark.parametrize(
    ("row", "parts"),
    [
        ("10 11 1 2 3", ("m.txt: is no table of 6 columns", "Expected 6 columns, got 5")),
        ("10 11 1 2 3 x", ("m.txt: y1 is 'x' at row 2", "a number")),
        ("10 soon 1 2 3 4", ("m.txt: time1 is 'soon' at row 2", "a decimal number")),
        ("10 11 1 2 3 nan", ("m.txt: y1 is nan at row 2", "-1710 to 1710 um")),
        ("10 11 2271 2 3 4", ("m.txt: x0 is 2271 at row 2", "-2270 to 2270 um", "x right, y down")),
    ],
)
def test_broken_rows_name_file_and_row(file, row, parts):
    file.write_text(TEXT + row + "\n")
    with pytest.raises(SessionError) as caught:
        match_file.read_match_file(file)
    for part in parts:
        assert part in str(caught.value)


def test_a_missing_file_is_reported(tmp_path):
    with pytest.raises(SessionError, match="is missing"):
        match_file.read_match_file(tmp_path / "none.txt")
