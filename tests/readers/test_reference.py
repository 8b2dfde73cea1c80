"""Reference trajectories: every format gives the same poses, in the frame the definitions ask for."""

import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph import readers
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import interpolate
from smartnav_graph.evaluation.align import fit_alignment
from smartnav_graph.readers.reference import load_reference, load_trajectory, load_transform
from smartnav_graph.session.folder import save
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Reference

# forward-left-up body; the camera looks ahead, 1.1 m in front of and 0.7 m above the IMU
BODY_T_CAM = np.array([[0.0, 0, 1, 1.1], [-1, 0, 0, -0.3], [0, -1, 0, 0.7], [0, 0, 0, 1]])


def write(tmp_path, text, name="reference.txt"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


def toml(tmp_path, matrix=BODY_T_CAM, key="body_T_cam"):
    return write(tmp_path, f"{key} = {np.asarray(matrix).tolist()}\n", "body_T_cam.toml")


def test_tum(tmp_path):
    path = write(
        tmp_path, "# timestamp tx ty tz qx qy qz qw\n1403715274.302140001 1 2 3 0 0 0.6 0.8\n1403715275 4 5 6 0 0 0 1\n"
    )
    reference = load_reference(path)
    assert reference.t_ns.tolist() == [1403715274302140001, 1403715275000000000]
    assert reference.enu.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert reference.quat[0].tolist() == [0.8, 0, 0, 0.6]  # w first
    assert reference.velocity is None


@pytest.mark.parametrize("width", [8, 11, 17])
def test_euroc(tmp_path, width):
    names = ["#timestamp", *"pppqqqqvvvgggaaa"][:width]
    cells = [
        "1403715273262142976",
        "1",
        "2",
        "3",
        "0.8",
        "0",
        "0",
        "0.6",
        "4",
        "5",
        "6",
        "7",
        "8",
        "9",
        "10",
        "11",
        "12",
    ]
    reference = load_reference(write(tmp_path, ",".join(names) + "\n" + ",".join(cells[:width]) + "\n"))
    assert reference.t_ns.tolist() == [1403715273262142976]
    assert reference.quat.tolist() == [[0.8, 0, 0, 0.6]]
    assert (reference.velocity is None) == (width < 11) and (reference.gyro_bias is None) == (width < 17)
    if width == 17:
        assert reference.velocity.tolist() == [[4, 5, 6]]
        assert reference.gyro_bias.tolist() == [[7, 8, 9]] and reference.accel_bias.tolist() == [[10, 11, 12]]


@pytest.mark.parametrize(
    ("heading", "row", "t_ns"),
    [
        ("t,x,y,z", "1.5,1,2,3", 1_500_000_000),
        ("Time;X;Y;Z", "1.5;1;2;3", 1_500_000_000),
        ("timestamp x y z", "1.5 1 2 3", 1_500_000_000),
        ("t_ns,e_m,n_m,u_m,heading_deg", "1500000001,1,2,3,90", 1_500_000_001),
        ("z,y,x,t_s", "3,2,1,1.5", 1_500_000_000),
    ],
)
def test_named_columns(tmp_path, heading, row, t_ns):
    reference = load_reference(write(tmp_path, f"{heading}\n{row}\n", "truth.csv"))
    assert reference.t_ns.tolist() == [t_ns] and reference.enu.tolist() == [[1, 2, 3]] and reference.quat is None


def test_named_columns_with_attitude_and_velocity(tmp_path):
    text = "t_ns,e_m,n_m,u_m,qw,qx,qy,qz,ve_m_s,vn_m_s,vu_m_s\n1,1,2,3,0.8,0,0,0.6,4,5,6\n"
    reference = load_reference(write(tmp_path, text))
    assert reference.quat.tolist() == [[0.8, 0, 0, 0.6]] and reference.velocity.tolist() == [[4, 5, 6]]


def test_session_folder_and_parquet(tmp_path):
    kept = Reference(t_ns=np.array([1, 2]), enu=np.array([[1.0, 2, 3], [4, 5, 6]]))
    save(Session(reference=kept), tmp_path / "s")
    for path in (tmp_path / "s", tmp_path / "s" / "reference.parquet"):
        np.testing.assert_array_equal(load_reference(path).enu, kept.enu)


def kitti_files(tmp_path, nav_T_body):
    """KITTI poses of a body trajectory: camera poses in the first camera's frame."""
    nav_T_cam = nav_T_body @ BODY_T_CAM
    poses = np.linalg.inv(nav_T_cam[0]) @ nav_T_cam
    lines = (" ".join(f"{value:.9e}" for value in pose[:3].ravel()) for pose in poses)
    times = "".join(f"{0.1 * i:e}\n" for i in range(len(poses)))
    return write(tmp_path, "\n".join(lines) + "\n", "00.txt"), write(tmp_path, times, "times.txt")


def test_kitti_poses_become_body_poses_in_the_first_body_frame(tmp_path):
    # a left turn while climbing; nav = first body frame
    yaw = np.linspace(0, 1.5, 20)
    nav_T_body = np.tile(np.eye(4), (20, 1, 1))
    nav_T_body[:, :3, :3] = Rotation.from_euler("ZYX", np.c_[yaw, -0.1 * yaw, 0.05 * yaw]).as_matrix()
    nav_T_body[:, :3, 3] = 10 * np.c_[np.sin(yaw), 1 - np.cos(yaw), 0.1 * yaw]
    path, times = kitti_files(tmp_path, nav_T_body)
    reference = load_reference(path, times=times, body_T_ref=toml(tmp_path))
    np.testing.assert_allclose(reference.enu, nav_T_body[:, :3, 3], atol=1e-7)  # m: nine digits of 10 m
    R = Rotation.from_quat(reference.quat[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(R, nav_T_body[:, :3, :3], atol=1e-8)
    assert reference.t_ns[:3].tolist() == [0, 100_000_000, 200_000_000]
    assert reference.enu[-1, 1] > 5 and reference.enu[-1, 2] > 1  # it did go left and up


def test_body_T_ref_moves_any_pose_to_the_body(tmp_path):
    nav_T_cam = np.eye(4)
    nav_T_cam[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix() @ BODY_T_CAM[:3, :3]
    nav_T_cam[:3, 3] = [0.3, 1.1, 0.7]  # the body is at the origin and heads along +y
    x, y, z, w = Rotation.from_matrix(nav_T_cam[:3, :3]).as_quat()
    path = write(tmp_path, f"1 0.3 1.1 0.7 {x} {y} {z} {w}\n")
    reference = load_reference(path, body_T_ref=toml(tmp_path))
    np.testing.assert_allclose(reference.enu, [[0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(reference.quat, [[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], atol=1e-12)


def test_kitti_drive_and_euroc_truth_as_recorded(dataset):
    folder = dataset("kitti00_reference")
    reference = load_reference(
        folder / "poses_00.txt", times=folder / "times.txt", body_T_ref=folder / "body_T_cam.toml"
    )
    assert len(reference) == 4541 and reference.t_ns[[0, 1, -1]].tolist() == [0, 103735900, 470581600000]
    np.testing.assert_allclose(reference.enu[0], 0, atol=1e-6)
    path = np.linalg.norm(np.diff(reference.enu, axis=0), axis=1).sum()
    assert path == pytest.approx(3724, abs=10)  # m, the published length of sequence 00
    forward = Rotation.from_quat(reference.quat[:, [1, 2, 3, 0]]).as_matrix()[:-1, :, 0]
    step = np.diff(reference.enu, axis=0)
    speed = np.linalg.norm(step, axis=1)
    along = (forward * step).sum(axis=1)[speed > 0.3] / speed[speed > 0.3]
    assert np.median(along) > 0.999  # the car drives along its own x axis

    truth = load_reference(dataset("euroc_v101") / "groundtruth_openvins" / "V1_01_easy.csv")
    assert len(truth) == 2895 and truth.t_ns[[0, -1]].tolist() == [1403715273262142976, 1403715417962142976]
    assert truth.enu[0].tolist() == [0.878895, 2.1834, 0.948427]
    assert truth.quat[0].tolist() == [0.069433, -0.824237, -0.106942, -0.551702]
    nav_R_body = Rotation.from_quat(truth.quat[0, [1, 2, 3, 0]]).as_matrix()
    accel = readers.read("gtsam-euroc").imu.accel[:200].mean(axis=0)  # at rest
    np.testing.assert_allclose(nav_R_body @ accel, [0, 0, 9.8], atol=0.15)  # m/s^2: specific force points up

    original = load_reference(dataset("euroc_v101") / "groundtruth_openvins" / "V1_01_easy_original_first9s.txt")
    assert original.t_ns[0] == 1403715274302140000 and original.quat[0, 0] == 0.060514


def test_kitti_body_positions_are_those_of_the_wheel(dataset):
    """Moved from the camera to the IMU, the poses fit the drive's positions to a centimetre; the camera's do not."""
    folder = dataset("kitti00_reference")
    options = {"times": folder / "times.txt", "body_T_ref": folder / "body_T_cam.toml"}
    reference = load_reference(folder / "poses_00.txt", **options)
    fixes = readers.read("gtsam-kitti").gnss
    t_ns = fixes.t_ns - 46534_940_000_000  # ns; where frame 0 lies on the drive's clock
    inside = (t_ns >= 0) & (t_ns <= reference.t_ns[-1])
    nav_R_body = Rotation.from_quat(reference.quat[:, [1, 2, 3, 0]]).as_matrix()
    camera = reference.enu + nav_R_body @ load_transform(folder / "body_T_cam.toml")[:3, 3]

    def misfit(positions):
        at = interpolate(t_ns[inside], reference.t_ns, positions)
        found = fit_alignment("sim3", at, fixes.enu[inside])
        assert found.scale == pytest.approx(0.998, abs=2e-3)
        residual = fixes.enu[inside] - found.position(at)
        return np.sqrt((residual**2).sum(axis=1).mean())

    assert misfit(reference.enu) < 0.05  # m: 10 Hz poses interpolated linearly at 8 m/s in bends
    assert misfit(camera) > 0.3  # m: the lever arm of 1.1 m is seen in every bend


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ("has no rows",)),
        ("a,b\n1,2\n", ("is no known reference format", "begins with 'a,b'", "TUM, EuRoC or KITTI")),
        ("t,x,y\n1,2,3\n", ("column z is missing",)),
        (
            "timestamp,x,y,z\n1403715273262142976,1,2,3\n",
            ("timestamp begins with 1403715273262142976", "seconds", "t_ns"),
        ),
        ("t,x,y,z\n1,2,3,four\n", ("z is 'four' at row 0",)),
        ("t,x,y,z\n1,2,3,\n", ("u_m is nan at row 0",)),
        ("t,x,y,z\n2,2,3,4\n1,2,3,4\n", ("t_ns not strictly increasing at row 1",)),
        ("1 1 2 3 0 0 0 1\n2 1 2 3 0 0 0 0\n", ("quaternion norm 0 at row 1 (1 such rows in all)", "column order")),
        ("1 1 2 3 0 0 0 1\n2 1 2 3 0 0 1 1\n", ("quaternion norm 1.41421 at row 1",)),
        ("1 1 2 3 0 0 0 1\n2 1 2 3 0 0 0 1\n3 1 2\n", ("no table of 8 columns",)),
        ("t,x,y,z,qw,qx\n1,2,3,4,1,0\n", ("column qy, qz is missing",)),
    ],
)
def test_faults(tmp_path, text, parts):
    path = write(tmp_path, text)
    with pytest.raises(SessionError) as caught:
        load_reference(path)
    for part in (str(path), *parts):
        assert part in str(caught.value)


def test_missing_reference(tmp_path):
    with pytest.raises(SessionError, match=r"no\.txt: is missing"):
        load_reference(tmp_path / "no.txt")
    with pytest.raises(SessionError, match=r"reference\.parquet: is missing"):
        load_reference(tmp_path)


def test_kitti_faults(tmp_path):
    path, times = kitti_files(tmp_path, np.tile(np.eye(4), (3, 1, 1)))
    mount = toml(tmp_path)
    with pytest.raises(ConfigError, match="give --times"):
        load_reference(path, body_T_ref=mount)
    with pytest.raises(ConfigError, match="give --body-T-ref"):
        load_reference(path, times=times)
    times.write_text("0\n1\n")
    with pytest.raises(SessionError, match=r"times.txt: has 2 rows; expected 3, as many as .*00.txt"):
        load_reference(path, times=times, body_T_ref=mount)
    times.write_text("0\n1\n2\n")
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2 + "2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SessionError, match=r"3x3 part of row 2 is no rotation \(R R\^T differs from 1 by 3\)"):
        load_reference(path, times=times, body_T_ref=mount)


def test_options_that_say_nothing_are_refused(tmp_path):
    path = write(tmp_path, "t,x,y,z\n1,2,3,4\n")
    with pytest.raises(ConfigError, match=r"--times: is given, but .* has times of its own"):
        load_reference(path, times=path)
    with pytest.raises(ConfigError, match=r"--body-T-ref: is given, but .* has no attitude"):
        load_reference(path, body_T_ref=toml(tmp_path))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("body_T_cam = [[1", "is no TOML"),
        ("T = 3", "holds T; expected one key body_T_<frame>"),
        ("body_T_cam = [[1, 0], [0, 1]]", "four rows of four"),
        (f"body_T_cam = {np.diag([1.0, 1, -1, 1]).tolist()}", "is no rotation"),
        (f"body_T_cam = {np.diag([1.0, 1, 1, 2]).tolist()}", r"last row \[0.0, 0.0, 0.0, 2.0\]"),
        (f"body_T_cam = {np.diag([2.0, 1, 1, 1]).tolist()}", "is no rotation"),
    ],
)
def test_transform_faults(tmp_path, text, part):
    with pytest.raises(SessionError, match=part):
        load_transform(write(tmp_path, text, "t.toml"))


def test_ground_truth_of_a_euroc_folder_is_the_reference(tmp_path):
    (tmp_path / "mav0/imu0").mkdir(parents=True)
    rows = "".join(f"{i * 5_000_000},0,0,0.1,9.81,0,0\n" for i in range(200))
    (tmp_path / "mav0/imu0/data.csv").write_text("#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n" + rows)
    with pytest.raises(SessionError, match="holds no reference trajectory"):
        load_reference(tmp_path)
    (tmp_path / "mav0/state_groundtruth_estimate0").mkdir()
    truth = "#timestamp,p_x,p_y,p_z,q_w,q_x,q_y,q_z\n5000000,1,2,3,1,0,0,0\n10000000,1.5,2,3,1,0,0,0\n"
    (tmp_path / "mav0/state_groundtruth_estimate0/data.csv").write_text(truth)
    found = load_reference(tmp_path)
    np.testing.assert_array_equal(found.enu, [[1, 2, 3], [1.5, 2, 3]])
    np.testing.assert_array_equal(found.t_ns, [5_000_000, 10_000_000])
    archive = shutil.make_archive(str(tmp_path / "log"), "zip", tmp_path, "mav0")
    for load in (load_reference, load_trajectory):
        np.testing.assert_array_equal(load(archive).enu, found.enu)


def test_a_folder_that_a_reader_of_another_package_knows(tmp_path, monkeypatch):
    kept = Session(reference=Reference(t_ns=np.array([1, 2]), enu=np.array([[1.0, 2, 3], [4, 5, 6]])))
    reader = readers.Reader("own", "", "", lambda source: source == str(tmp_path), lambda *_: kept)
    monkeypatch.setattr(readers, "known_readers", lambda: {"own": reader})
    np.testing.assert_array_equal(load_reference(tmp_path).enu, kept.reference.enu)


def test_rows_that_may_be_cut_are_said(tmp_path, warned):
    rows = [f"{104 + i / 10:.1f} {i} 0 0 0 0 0 1" for i in range(9)]
    load_reference(write(tmp_path, "\n".join(rows) + "\n"))
    assert warned() == ""
    load_reference(write(tmp_path, "\n".join([rows[0][2:], *rows[1:-1], rows[-1][:9]])))
    assert "row 0 lies 100.1 s before row 1, others 0.1 s" in warned()
    assert "1 cut at the end of the file left out" in warned()
