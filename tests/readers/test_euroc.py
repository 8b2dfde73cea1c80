"""EuRoC, from the gtsam wheel and as a folder: golden rows, axes, extrinsics."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph import readers
from smartnav_graph.core.errors import CalibrationError, SessionError
from smartnav_graph.core.frames import axis_vector
from smartnav_graph.readers.source import example_file
from smartnav_graph.session.folder import load, save

T_BS = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0.0, 0.0, 1.0, 0.1,
         -1.0, 0.0, 0.0, 0.2,
         0.0, -1.0, 0.0, 0.3,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
"""
IDENTITY = "T_BS:\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"


@pytest.fixture(scope="module")
def session():
    return readers.read("gtsam-euroc")


def test_counts(session):
    counts = {name: len(stream) for name, stream in session.streams().items()}
    assert counts == {"imu": 6001, "images": 601, "tracks": 13316}
    assert len(np.unique(session.tracks.track_id)) == 307
    assert session.images.image_id.tolist() == list(range(601))
    assert set(session.images.camera) == {"cam0"} and set(session.images.file) == {""}
    assert (session.clock_epoch, session.gravity, session.origin) == ("unix", 9.81, None)


def test_golden_rows(session):
    assert session.imu.t_ns[[0, 1, -1]].tolist() == [1403715273262143100, 1403715273267143000, 1403715303262143100]
    assert session.imu.gyro[0].tolist() == [-0.0020943951023931952, 0.017453292519943295, 0.07749261878854824]
    assert session.imu.accel[0].tolist() == [9.0874956666666655, 0.13075533333333333, -3.6938381666666662]
    assert session.imu.accel[-1].tolist() == [10.435910041666666, 0.31871612500000002, -3.0237170833333331]
    first, last = session.tracks.take(slice(0, 1)), session.tracks.take(slice(-1, None))
    assert (first.t_ns[0], first.image_id[0], first.track_id[0]) == (1403715273262143100, 0, 1)
    assert (last.t_ns[0], last.image_id[0], last.track_id[0]) == (1403715303262143100, 600, 307)
    assert first.xy_n.tolist() == [[0.24214458769801039, 0.29022359629266958]]
    assert last.xy_n.tolist() == [[-0.68772252433436076, 0.61528034522205666]]


def test_every_frame_is_stamped_on_an_imu_sample(session):
    assert np.isin(session.images.t_ns, session.imu.t_ns).all()
    assert np.abs(np.diff(session.images.t_ns) - 50_000_000).max() < 500  # 20 Hz; ns, at 17 digits of a Unix time


def test_up_is_the_axis_that_feels_gravity_and_forward_the_one_the_camera_looks_along(session):
    up = axis_vector(session.device.up)
    rest = session.imu.accel[:200].mean(axis=0)  # the first second stands still
    assert rest @ up > 0.9 * 9.7
    body_R_cam = np.array(session.mount("cam0").body_R)
    assert body_R_cam[:, 2] @ axis_vector(session.device.forward) > 0.999  # optical axis
    assert body_R_cam[:, 1] @ up < -0.999  # image rows run downwards


def test_extrinsics_are_those_of_the_set(session, dataset):
    folder = readers.read(dataset("euroc_v101"))
    wheel, original = session.mount("cam0"), folder.mount("cam0")
    np.testing.assert_allclose(wheel.body_t, original.body_t, atol=1e-12)
    np.testing.assert_allclose(wheel.body_R, original.body_R, atol=1e-9)


def test_imu_equals_the_original_recording(session, dataset):
    original = readers.read(dataset("euroc_v101")).imu
    assert len(original) == 29120
    np.testing.assert_array_equal(session.imu.gyro, original.gyro[:6001])
    np.testing.assert_array_equal(session.imu.accel, original.accel[:6001])
    assert np.abs(session.imu.t_ns - original.t_ns[:6001]).max() < 256  # ns: 17 digits of a Unix time


def test_gyro_turns_the_way_the_tracks_do(session):
    """Between frames 0.1 s apart, the mean rotation of bearing vectors follows the integrated gyro."""
    body_R_cam = np.array(session.mount("cam0").body_R)
    predicted, seen = [], []
    for frame in range(300, 590, 10):  # in flight
        a, b = (session.tracks.take(session.tracks.image_id == i) for i in (frame, frame + 2))
        _, ia, ib = np.intersect1d(a.track_id, b.track_id, return_indices=True)
        rows = (session.imu.t_ns >= a.t_ns[0]) & (session.imu.t_ns < b.t_ns[0])
        turned = Rotation.from_rotvec(session.imu.gyro[rows].mean(axis=0) * (b.t_ns[0] - a.t_ns[0]) / 1e9)
        rays = [np.c_[xy, np.ones(len(xy))] for xy in (a.xy_n[ia], b.xy_n[ib])]
        moved = rays[0] @ body_R_cam.T @ turned.as_matrix() @ body_R_cam  # R^T on columns
        predicted.append(np.median(moved[:, :2] / moved[:, 2:] - rays[0][:, :2], axis=0))
        seen.append(np.median(rays[1][:, :2] - rays[0][:, :2], axis=0))
    assert np.corrcoef(np.ravel(predicted), np.ravel(seen))[0, 1] > 0.9


def test_the_csv_itself_is_recognised_and_a_session_round_trips(session, tmp_path):
    assert readers.find(example_file("eqvio_processed_30s.csv")).name == "gtsam-euroc"
    save(session, tmp_path / "s")
    again = load(tmp_path / "s")
    np.testing.assert_array_equal(again.tracks.xy_n, session.tracks.xy_n)
    assert again.sensors == session.sensors and again.images.file[0] == ""


def test_missing_extrinsics_are_reported(tmp_path):
    path = tmp_path / "eqvio.csv"
    lines = example_file("eqvio_processed_30s.csv").read_text().splitlines()[:200]
    path.write_text("\n".join(line for line in lines if "T_ci_qw" not in line))
    with pytest.raises(SessionError, match="camera: 'T_ci_qw'; expected meta rows T_ci_tx"):
        readers.read(path)


@pytest.fixture
def asl(tmp_path):
    """An ASL folder of two cameras, whose IMU is turned a quarter to the left of the rig's base."""
    mav0 = tmp_path / "V1" / "mav0"
    for name in ("imu0", "cam0", "cam1", "state_groundtruth_estimate0"):
        (mav0 / name).mkdir(parents=True)
    (mav0 / "imu0" / "data.csv").write_text(
        "#timestamp [ns],wx,wy,wz,ax,ay,az\n100,1,2,3,4,5,6\r\n200,7,8,9,10,11,12\n"
    )
    turned = IDENTITY.replace("[1, 0, 0, 0, 0, 1, 0, 0,", "[0, -1, 0, 0, 1, 0, 0, 0,")
    (mav0 / "imu0" / "sensor.yaml").write_text(turned)
    for name in ("cam0", "cam1"):
        (mav0 / name / "data.csv").write_text("#timestamp [ns],filename\n100,100.png\n200,200.png\n")
        (mav0 / name / "sensor.yaml").write_text(T_BS)
    heading = "#timestamp, px, py, pz, qw, qx, qy, qz, vx, vy, vz, bwx, bwy, bwz, bax, bay, baz\n"
    truth = heading + "100, 1,2,3, 1,0,0,0, 4,5,6, 7,8,9, 10,11,12\n"
    (mav0 / "state_groundtruth_estimate0" / "data.csv").write_text(truth)
    return tmp_path / "V1"


def test_asl_folder(asl):
    session = readers.read(asl)
    assert readers.find(asl).name == readers.find(asl / "mav0").name == "euroc"
    assert session.imu.gyro.tolist() == [[1, 2, 3], [7, 8, 9]] and session.imu.accel.tolist() == [
        [4, 5, 6],
        [10, 11, 12],
    ]
    assert session.images.t_ns.tolist() == [100, 100, 200, 200]
    assert session.images.file.tolist()[:3] == ["cam0/data/100.png", "cam1/data/100.png", "cam0/data/200.png"]
    assert session.images.image_id.tolist() == [0, 1, 2, 3]
    reference = session.reference
    assert reference.enu.tolist() == [[1, 2, 3]] and reference.velocity.tolist() == [[4, 5, 6]]
    assert reference.gyro_bias.tolist() == [[7, 8, 9]] and reference.accel_bias.tolist() == [[10, 11, 12]]


def test_asl_extrinsics_are_relative_to_the_imu(asl):
    mount = readers.read(asl).mount("cam0")
    # base_t_cam = (.1, .2, .3), and the IMU's x axis is the base's y axis
    np.testing.assert_allclose(mount.body_t, [0.2, -0.1, 0.3], atol=1e-15)
    np.testing.assert_allclose(np.array(mount.body_R)[:, 2], [0, -1, 0], atol=1e-15)  # looks along the base's x


INTRINSICS = """resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.76e-05]
"""


def test_intrinsics_go_into_the_calibration(asl):
    assert readers.read(asl).calibration is None
    (asl / "mav0" / "cam1" / "sensor.yaml").write_text(T_BS + INTRINSICS)
    session = readers.read(asl)
    (name,) = session.calibration.cameras
    camera = session.calibration.cameras[name]
    assert (name, camera.width, camera.height, camera.model) == ("cam1", 752, 480, "brown")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (458.654, 457.296, 367.215, 248.375)
    assert camera.distortion == (-0.28, 0.07, 0.0002, 1.76e-05)
    assert session.pictures == asl / "mav0"


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("radial-tangential", "spherical", "describes no camera (distortion_model is spherical)"),
        ("458.654, ", "", "describes no camera (not enough values"),
        ("-0.28", "x", "distortion_coefficients is no list of numbers"),
        ("458.654", "-458.654", "expected 0 to 100000 px"),
    ],
)
def test_broken_intrinsics_are_reported(asl, old, new, part):
    (asl / "mav0" / "cam0" / "sensor.yaml").write_text(T_BS + INTRINSICS.replace(old, new))
    with pytest.raises((SessionError, CalibrationError), match=r"cam0/sensor\.yaml") as caught:
        readers.read(asl)
    assert part in str(caught.value)


@pytest.mark.parametrize(
    ("file", "text", "parts"),
    [
        ("imu0/data.csv", "#t\n1,2,3\n", ("imu0/data.csv", "no table of 7 columns", "got 3")),
        ("imu0/data.csv", "#t,wx,wy,wz,ax,ay,az\n1.5,2,3,4,5,6,7\n", ("t is '1.5' at row 0", "a whole number")),
        (
            "imu0/data.csv",
            "#t,..\n2,2,3,4,5,6,7\n1,2,3,4,5,6,7\n",
            ("not strictly increasing at row 1", "--repair order"),
        ),
        ("cam1/sensor.yaml", "rate_hz: 20\n", ("cam1/sensor.yaml: T_BS is missing or no matrix",)),
        ("cam1/sensor.yaml", "T_BS:\n  data: [1, 2]\n", ("T_BS is missing or no matrix", "16 numbers")),
        ("state_groundtruth_estimate0/data.csv", "#timestamp\n1,x,0\n", ("state_groundtruth_estimate0",)),
    ],
)
def test_asl_faults(asl, file, text, parts):
    (asl / "mav0" / file).write_text(text)
    with pytest.raises(SessionError) as caught:
        readers.read(asl)
    for part in parts:
        assert part in str(caught.value)


CHAIN = """cam0:
  T_cam_imu:
  - [-1.0, 0.0, 0.0, 0.1]
  - [0.0, 0.0, -1.0, -0.05]
  - [0.0, -1.0, 0.0, 0.02]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.0021, 0.0002]
  distortion_model: equidistant
  intrinsics: [190.9, 190.9, 254.9, 256.9]
  resolution: [512, 512]
  timeshift_cam_imu: -0.0005
"""


def tum_vi(folder):
    """IMU, one camera and ground truth as TUM-VI has them: no sensor.yaml, mocap0, the camera chain under dso."""
    t0 = 1520530308199447626
    for part in ("mav0/imu0", "mav0/cam0/data", "mav0/mocap0", "dso"):
        (folder / part).mkdir(parents=True)
    heading = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z,a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z"
    rows = "\n".join(f"{t0 + i * 5_000_000},0.01,0.02,0.03,0.1,0.2,9.8" for i in range(20))
    (folder / "mav0/imu0/data.csv").write_text(f"{heading}\n{rows}\n")
    (folder / "mav0/cam0/data.csv").write_text(f"#timestamp [ns],filename\n{t0},{t0}.png\n")
    truth = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    (folder / "mav0/mocap0/data.csv").write_text(f"{truth}\n{t0},1,2,3,1,0,0,0\n{t0 + 8_000_000},1,2,3,1,0,0,0\n")
    (folder / "dso/camchain.yaml").write_text(CHAIN)
    return folder


def test_tum_vi_folder(tmp_path):
    session = readers.read(tum_vi(tmp_path))
    assert (len(session.imu), len(session.images), len(session.reference)) == (20, 1, 2)
    assert (session.device.up, session.device.forward) == ("+z", "-y")  # gravity; the camera looks along -y
    camera = session.calibration.cameras["cam0"]
    assert (camera.model, camera.width, camera.fx, camera.time_offset_s) == ("fisheye", 512, 190.9, -0.0005)
    cam_T_imu = np.array([[-1.0, 0, 0, 0.1], [0, 0, -1, -0.05], [0, -1, 0, 0.02], [0, 0, 0, 1]])
    np.testing.assert_allclose(np.linalg.inv(cam_T_imu)[:3, 3], session.mount("cam0").body_t, atol=1e-12)


def test_without_a_camera_chain_pictures_have_no_calibration(tmp_path):
    folder = tum_vi(tmp_path)
    (folder / "dso/camchain.yaml").write_text("cam0: {T_cam_imu: [1, 2]}")
    with pytest.raises(SessionError, match=r"camchain.yaml: cam0 is no camera"):
        readers.read(folder)
    (folder / "dso/camchain.yaml").unlink()
    session = readers.read(folder)
    assert session.calibration is None and len(session.images) == 1
