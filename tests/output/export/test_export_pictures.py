"""Copies of pictures with their place: read back by other programs' readers, originals and pixels untouched."""

from __future__ import annotations

import csv
import hashlib
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pyproj
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.export import export_pictures
from smartnav_graph.output.export.exif import with_exif
from smartnav_graph.output.export.pictures import TABLE
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.session.streams import Images

ORIGIN = Origin(-33.5, -70.25, 520.0)  # south and west: signs show
T0 = 1_748_772_000_123_456_789  # 2025-06-01T10:00:00.123456789Z
SECOND = 1_000_000_000
# A phone that stands upright: body x to the right, y up, z backwards; its camera looks along -z.
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
CAMERA = Mount(body_t=(0.0, 0.0, -0.5), body_R=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)))


def heading(deg: float) -> np.ndarray:
    """nav_R_body of the upright phone whose camera looks `deg` clockwise from north."""
    return Rotation.from_euler("z", -deg, degrees=True).as_matrix() @ UPRIGHT


def make_solution(turns_deg=(0.0, 90.0, 180.0), speed: float = 2.0, tilt: np.ndarray | None = None) -> Solution:
    """One row a second, eastwards from the origin at a steady speed."""
    n = len(turns_deg)
    R = np.stack([heading(deg) for deg in turns_deg])
    variance = np.r_[np.full(3, 1e-4), 0.09, 0.16, 4.0, np.ones(9)]
    return Solution(
        t_ns=T0 + np.arange(n) * SECOND,
        nav_R_body=R if tilt is None else tilt @ R,
        nav_t_body=np.arange(n)[:, None] * [speed, 0.0, 0.0],
        nav_v_body=np.tile([speed, 0.0, 0.0], (n, 1)),
        accel_bias=np.zeros((n, 3)),
        gyro_bias=np.zeros((n, 3)),
        covariance=np.broadcast_to(np.diag(variance), (n, 15, 15)),
        t0_ns=T0,
        origin=ORIGIN,
        up="+y",
        forward="-z",
    )


def picture(kind: str, made_by: str = "") -> bytes:
    rng = np.random.default_rng(5)
    image = Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8))
    exif = image.getexif()
    if made_by:
        exif[271] = made_by  # Make
        exif.get_ifd(0x8769)[33434] = 0.01  # ExposureTime
        exif.get_ifd(0x8825).update({1: "N", 2: (1.0, 2.0, 3.0), 29: "1999:01:01"})
    buffer = io.BytesIO()
    image.save(buffer, kind, exif=exif)
    return buffer.getvalue()


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """Pictures at the three rows of the solution, and one a minute later."""
    folder = tmp_path / "images"
    (folder / "left").mkdir(parents=True)
    files = ["left/a.jpg", "left/b.png", "left/c.jpg", "left/late.jpg"]
    for file, made_by in zip(files, ("", "", "ACME", ""), strict=True):
        (folder / file).write_bytes(picture("png" if file.endswith("png") else "jpeg", made_by))
    return Session(
        clock_epoch="unix",
        origin=ORIGIN,
        sensors={"left": CAMERA},
        pictures=folder,
        images=Images(
            t_ns=T0 + np.array([0, 1, 2, 60]) * SECOND,
            image_id=np.arange(4),
            file=np.array(files, dtype=object),
            camera=np.array(["left"] * 4, dtype=object),
        ),
    )


def gps(path: Path) -> dict:
    with Image.open(path) as image:
        return image.getexif().get_ifd(0x8825)


def lla_of_camera(enu) -> np.ndarray:
    return LocalFrame(ORIGIN).lla_from_nav(np.array([enu]))[0]


def test_position_and_direction_are_those_of_the_camera(session, tmp_path):
    done = export_pictures(make_solution(), session, tmp_path / "out")
    assert (done.written, dict(done.left_out)) == (3, {"outside the run": 1})
    # the camera sits half a metre ahead of the body: north, east and south of it
    for file, enu, azimuth in zip("abc", ([0, 0.5, 0], [2.5, 0, 0], [4, -0.5, 0]), (0.0, 90.0, 180.0), strict=True):
        path = tmp_path / "out" / "left" / f"{file}.{'png' if file == 'b' else 'jpg'}"
        lat, lon, height = lla_of_camera(enu)
        seen = pycolmap.Bitmap.read(str(path), True)  # a photogrammetry program's own reader of EXIF
        assert seen.exif_latitude() == pytest.approx(lat, abs=5e-9)  # deg, 0.5 mm
        assert seen.exif_longitude() == pytest.approx(lon, abs=5e-9)
        assert seen.exif_altitude() == pytest.approx(height, abs=1e-3)  # m
        tags = gps(path)
        assert tags[16] == "T" and (float(tags[17]) - azimuth + 180) % 360 - 180 == pytest.approx(0, abs=0.01)  # deg
        assert (tags[1], tags[3], tags[5], tags[18]) == ("S", "W", b"\x00", "WGS-84")
        assert float(tags[31]) == pytest.approx(0.5, abs=1e-3)  # m, of 0.3 east and 0.4 north


def test_direction_counts_from_true_north_far_from_the_origin(session, tmp_path):
    """A hundred kilometres east, the tangent plane's north is off by the convergence, dlon sin(lat)."""
    far = make_solution((0.0, 0.0, 0.0))
    far = replace(far, nav_t_body=far.nav_t_body + np.array([100_000.0, 0.0, 0.0]))
    export_pictures(far, session, tmp_path / "out")
    lat, lon, _ = lla_of_camera([100_000.0, 0.5, 0.0])
    convergence = (lon - ORIGIN.lon_deg) * np.sin(np.radians(lat))
    assert abs(convergence) > 0.5
    off = (float(gps(tmp_path / "out" / "left" / "a.jpg")[17]) + 180) % 360 - 180
    assert off == pytest.approx(convergence, abs=0.02)  # deg


def test_between_rows_the_path_bends_as_the_velocities_say(session, tmp_path):
    """Free fall: halfway between two rows a straight line would be off by g t^2 / 8."""
    solution = make_solution((0.0, 0.0, 0.0), 0.0)
    t = solution.seconds
    falling = replace(
        solution,
        nav_t_body=np.column_stack([0 * t, 0 * t, -4.9 * t**2]),
        nav_v_body=np.column_stack([0 * t, 0 * t, -9.8 * t]),
    )
    late = session.replace(images=replace(session.images, t_ns=session.images.t_ns + SECOND // 2))
    export_pictures(falling, late, tmp_path / "out")
    height = float(gps(tmp_path / "out" / "left" / "b.png")[6])
    assert height == pytest.approx(520.0 - 4.9 * 1.5**2, abs=2e-3)  # m


def test_clock_offset_of_calibration_and_run_counts(session, tmp_path):
    camera = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5, time_offset_s=0.25)
    states = {"images_time_offset_s": {"value": 0.15}, "camera_boresight_rad": {"value": [0.0, np.radians(3.0), 0.0]}}
    export_pictures(
        make_solution((0.0, 0.0, 0.0)),
        session,
        tmp_path / "out",
        calibration=Calibration(cameras={"left": camera}),
        states=states,
    )
    tags = gps(tmp_path / "out" / "left" / "a.jpg")
    assert [float(x) for x in tags[7]] == pytest.approx([10.0, 0.0, 0.523457], abs=1e-6)  # 0.4 s after its stamp
    lat, lon, _ = lla_of_camera([0.8, 0.5, 0.0])
    seen = pycolmap.Bitmap.read(str(tmp_path / "out" / "left" / "a.jpg"), True)
    assert (seen.exif_latitude(), seen.exif_longitude()) == pytest.approx((lat, lon), abs=5e-9)
    # turned about the camera's own axis y, which points down: to the right
    assert float(tags[17]) == pytest.approx(3.0, abs=0.01)


def test_steep_pictures_have_no_direction(session, tmp_path):
    down = Rotation.from_euler("x", -87.0, degrees=True).as_matrix()
    export_pictures(make_solution((0.0, 0.0, 0.0), tilt=down), session, tmp_path / "out")
    tags = gps(tmp_path / "out" / "left" / "a.jpg")
    assert 17 not in tags and 16 not in tags and 2 in tags
    with open(tmp_path / "out" / TABLE, newline="") as file:
        assert {row["direction_deg"] for row in csv.DictReader(file)} == {""}


@pytest.mark.parametrize("epoch", ["unix", "gps", "boot"])
def test_time_only_where_the_clock_tells_it(session, epoch, tmp_path):
    export_pictures(make_solution(), session.replace(clock_epoch=epoch), tmp_path / "out")
    tags = gps(tmp_path / "out" / "left" / "c.jpg")
    if epoch == "unix":
        assert tags[29] == "2025:06:01"
        assert [float(x) for x in tags[7]] == pytest.approx([10.0, 0.0, 2.123457], abs=1e-6)
    else:
        assert 7 not in tags and 29 not in tags


def test_originals_pixels_and_other_tags_stay(session, tmp_path):
    def digests() -> dict[str, str]:
        files = sorted(session.pictures.rglob("*.*"))
        return {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}

    before = digests()
    export_pictures(make_solution(), session, tmp_path / "out")
    assert digests() == before
    for file in ("a.jpg", "b.png", "c.jpg"):
        old, new = session.pictures / "left" / file, tmp_path / "out" / "left" / file
        with Image.open(old) as one, Image.open(new) as other:
            assert np.array_equal(np.asarray(one), np.asarray(other))
    scans = [(root / "left/c.jpg").read_bytes() for root in (session.pictures, tmp_path / "out")]
    assert scans[0][scans[0].index(b"\xff\xda") :] == scans[1][scans[1].index(b"\xff\xda") :]  # not coded anew
    with Image.open(tmp_path / "out/left/c.jpg") as image:
        exif = image.getexif()
        assert exif[271] == "ACME"
        assert float(exif.get_ifd(0x8769)[33434]) == 0.01
        assert float(exif.get_ifd(0x8825)[2][0]) == 33.0  # the old place is gone


def test_table_agrees_with_the_tags(session, tmp_path):
    export_pictures(make_solution(), session, tmp_path / "out")
    with open(tmp_path / "out" / TABLE, newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == ["left/a.jpg", "left/b.png", "left/c.jpg"]
    assert [int(row["t_ns"]) for row in rows] == session.images.t_ns[:3].tolist()
    forth, _, length = pyproj.Geod(ellps="WGS84").inv(
        *(float(rows[i][k]) for i in (0, 2) for k in ("lon_deg", "lat_deg"))
    )
    assert length == pytest.approx(np.hypot(4.0, 1.0), abs=2e-3)  # m, from (0, 0.5) to (4, -0.5)
    assert forth == pytest.approx(np.degrees(np.arctan2(4.0, -1.0)), abs=0.02)  # deg
    assert {row["sigma_horizontal_m"] for row in rows} == {"0.5000"}


def test_missing_and_broken_files_are_counted(session, tmp_path):
    (session.pictures / "left/a.jpg").unlink()
    (session.pictures / "left/b.png").write_bytes(b"GIF89a")
    done = export_pictures(make_solution(), session, tmp_path / "out")
    assert done.written == 1
    assert dict(done.left_out) == {"outside the run": 1, "missing file": 1, "damaged JPEG or PNG": 1}


def test_refusals(session, tmp_path):
    with pytest.raises(SessionError, match=r"--format images: .*no origin.*add lat_deg, lon_deg, height_m"):
        export_pictures(replace(make_solution(), origin=None), session, tmp_path / "out")
    with pytest.raises(SessionError, match="has no images"):
        export_pictures(make_solution(), session.replace(images=None), tmp_path / "out")
    early = replace(make_solution(), t_ns=make_solution().t_ns - 3600 * SECOND, t0_ns=T0 - 3600 * SECOND)
    with pytest.raises(SessionError, match="none of 4 pictures lies inside the run"):
        export_pictures(early, session, tmp_path / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "precious.txt").write_text("mine")
    with pytest.raises(SessionError, match="exists already"):
        export_pictures(make_solution(), session, tmp_path / "out")
    with pytest.raises(SessionError, match=r"holds no geotags\.csv, so it is not replaced"):
        export_pictures(make_solution(), session, tmp_path / "out", force=True)
    with pytest.raises(SessionError, match="not replaced"):  # --out on the originals
        export_pictures(make_solution(), session, session.pictures, force=True)


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_a_picture_cut_short_is_no_picture(kind):
    whole = picture(kind)
    with_exif(whole, b"MM\0*")
    with pytest.raises(ValueError, match=r"truncated|damaged"):
        with_exif(whole[:17], b"MM\0*")
    with pytest.raises(ValueError, match="neither JPEG nor PNG"):
        with_exif(b"GIF89a", b"")
    if kind == "jpeg":
        with pytest.raises(ValueError, match="more than a JPEG holds"):
            with_exif(whole, bytes(70_000))
