"""What is seen of a picture before it is used: broken files, darkness, blur, repetition."""

import cv2
import numpy as np
import pytest
from scenes2d import CAMERA, centred, jpeg, png, seen, session_of, texture

from smartnav_graph.core.errors import SessionError
from smartnav_graph.session.session import Session
from smartnav_graph.vision import images
from smartnav_graph.vision.images import OpenedPicture, Picture, PictureChecker

PLANE = texture()
PICTURE = seen(PLANE, centred(PLANE))


def smeared(picture: np.ndarray, length: int, degrees: float) -> np.ndarray:
    kernel = np.zeros((length, length), np.float32)
    middle, arm = length // 2, (length // 2) * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    ends = [tuple(int(v) for v in np.rint(middle + sign * arm)) for sign in (-1, 1)]
    cv2.line(kernel, *ends, 1)
    return cv2.filter2D(picture, -1, kernel / kernel.sum())


@pytest.mark.parametrize("encode", [png, jpeg])
def test_a_file_cut_short_is_broken_wherever_it_is_cut(encode):
    data = encode(PICTURE)
    assert images.decoded(data).shape == PICTURE.shape
    for share in (0.0, 0.01, 0.3, 0.9, 0.999):
        assert images.decoded(data[: int(share * len(data))]) is None


def test_what_a_camera_appends_to_a_jpeg_does_no_harm():
    data = jpeg(PICTURE)
    np.testing.assert_array_equal(images.decoded(data + b"\xff\xda\xff\x11 appended \xff\xd8"), images.decoded(data))


def test_the_way_a_phone_was_held_does_not_turn_the_picture():
    data = jpeg(PICTURE)
    tag = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"  # orientation 6: to be shown turned by 90 degrees
    exif = b"Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01" + tag + b"\x00\x00\x00\x00"
    held = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    turned = cv2.imdecode(np.frombuffer(held, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert turned.shape == PICTURE.shape[::-1]  # so it is an orientation that OpenCV knows
    np.testing.assert_array_equal(images.decoded(held), images.decoded(data))


def test_no_picture_at_all():
    assert images.decoded(b"") is None
    assert images.decoded(b"\x89PNG nothing of the kind IEND") is None
    assert images.decoded(b"text") is None


def picture(tmp_path, content, camera="cam0", number=0) -> Picture:
    path = tmp_path / f"{number}.png"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else png(content))
    return Picture(number, number * 10**9, camera, path.name, path)


@pytest.mark.parametrize(
    ("content", "camera", "fault"),
    [
        (PICTURE, CAMERA, ""),
        (PICTURE, None, images.UNCALIBRATED),
        (None, CAMERA, images.MISSING),
        (png(PICTURE)[:-30], CAMERA, images.BROKEN),
        (PICTURE[:200], CAMERA, images.RESIZED),
        (PICTURE // 30, CAMERA, images.DARK),
        (np.full_like(PICTURE, 200), CAMERA, images.DARK),
    ],
)
def test_faults_of_one_picture(tmp_path, content, camera, fault):
    found = images.open_picture(picture(tmp_path, content), camera)
    assert found.fault == fault
    assert (found.gray is None) == bool(fault)


@pytest.mark.parametrize("degrees", [0, 45, 90, 135])
def test_a_smear_of_a_tenth_of_the_width_is_blur_in_every_direction(degrees):
    rng = np.random.default_rng(1)
    noisy = np.clip(smeared(PICTURE, 31, degrees) + rng.normal(0, 4, PICTURE.shape), 0, 255).astype(np.uint8)
    share = images.sharpness(noisy) / images.sharpness(PICTURE)
    assert share < images.LEAST_SHARPNESS
    assert images.sharpness(smeared(PICTURE, 3, degrees)) > 0.7 * images.sharpness(PICTURE)


def test_sharpness_does_not_depend_on_exposure_or_noise():
    rng = np.random.default_rng(2)
    dim = (PICTURE * 0.3 + 10).astype(np.uint8)
    noisy = np.clip(PICTURE + rng.normal(0, 8, PICTURE.shape), 0, 255).astype(np.uint8)
    for other in (dim, noisy):
        assert images.sharpness(other) == pytest.approx(images.sharpness(PICTURE), rel=0.1)


def test_blur_is_relative_to_the_rest_and_a_picture_twice_is_one_too_many(tmp_path):
    checker = PictureChecker()
    where = picture(tmp_path, None)

    def faults(*values: float, mark: str = "") -> list[str]:
        return [
            checker.fault(where, OpenedPicture(PICTURE, "", value, f"{mark}{i}".encode()))
            for i, value in enumerate(values)
        ]

    assert faults(0.05, 0.15, 0.14, 0.15, 0.15, 0.16) == [""] * 6  # nothing to compare the first with
    assert faults(*[0.05] * 4, mark="b") == [images.BLURRED] * 4
    assert faults(0.15, mark="c") == [""]
    assert checker.fault(where, OpenedPicture(PICTURE, "", 0.15, b"c0")) == images.REPEATED
    assert checker.fault(where, OpenedPicture(fault=images.DARK)) == images.DARK
    elsewhere = Picture(9, 0, "cam1", "", tmp_path)
    assert checker.fault(elsewhere, OpenedPicture(PICTURE, "", 0.02, b"c0")) == ""  # another camera


def test_thinning_keeps_the_rate_of_each_camera(tmp_path):
    stamps = np.arange(0, 2_000_000_000, 50_000_000) + np.random.default_rng(0).integers(0, 4_000_000, 40)
    rows = [Picture(i, int(t), name, "", tmp_path) for i, t in enumerate(stamps) for name in ("a", "b")]
    kept = images.limit_rate(rows, 4.0)
    for name in "ab":
        mine = [row.t_ns for row in kept if row.camera == name]
        assert len(mine) == 8 and min(np.diff(mine)) > 0.23e9
    assert images.limit_rate(rows, 0.0) == rows


def test_the_longest_break_counts_the_ends(tmp_path):
    rows = [Picture(i, i * 10**9, "a", "", tmp_path) for i in range(10)]
    assert images.longest_break_s(rows, rows) == 1.0
    assert images.longest_break_s(rows, rows[:3]) == 7.0
    assert images.longest_break_s(rows, []) == 9.0


def test_a_session_without_pictures_is_reported(tmp_path):
    with pytest.raises(SessionError, match="has no images"):
        images.pictures(Session())
    session = session_of([PICTURE], tmp_path / "s")
    nameless = session.images.take(slice(None))
    object.__setattr__(nameless, "file", np.array([""], dtype=object))
    for other in (session.replace(images=nameless), session.replace(pictures=None)):
        with pytest.raises(SessionError, match="lists images, but no files of them"):
            images.pictures(other)


def test_a_picture_that_claims_to_be_huge_is_not_decoded(tmp_path, monkeypatch):
    import zlib

    from smartnav_graph.session.calibration.camera import Camera

    heading = b"IHDR" + (30_000).to_bytes(4, "big") * 2 + bytes([8, 0, 0, 0, 0])
    chunk = (13).to_bytes(4, "big") + heading + zlib.crc32(heading).to_bytes(4, "big")
    rows = (4).to_bytes(4, "big") + b"IDAT" + bytes(8)
    (tmp_path / "huge.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + rows)
    monkeypatch.setattr(images, "decoded", lambda data: pytest.fail("decoded"))
    picture = Picture(0, 0, "cam0", "huge.png", tmp_path / "huge.png")
    assert images.open_picture(picture, Camera(640, 480, 500.0, 500.0, 320.0, 240.0)).fault == images.RESIZED
