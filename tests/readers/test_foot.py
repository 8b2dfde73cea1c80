"""Foot-mounted recordings: synthetic files with known values, and the public ones."""

import numpy as np
import pytest
from scipy.io import savemat

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

# Rows typed from measData (MIT licence, Hu and Hu 2025): sample 5028 of the recording.
LEFT = [0.331804215908051, 0.778443872928619, 9.87296390533447, 0.00894264110794468, 0.0062325470051393]
HEADING = "time_index,acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z,is_zero_vel\n"
TRUTH = "time_index,pos_left_x,pos_left_y,pos_left_z,pos_right_x,pos_right_y,pos_right_z\n"


@pytest.fixture
def recording(tmp_path):
    """Four rows: the right foot's columns count from 0, the left's from 6."""
    folder = tmp_path / "dataPreparation"
    folder.mkdir()
    savemat(folder / "ImuFootLeft.mat", {"ImuFootLeft": np.arange(4 * 17.0).reshape(4, 17)})
    savemat(folder / "posFoot.mat", {"posFoot": np.tile([1.0, 2.0, 3.0], (4, 1))})
    savemat(folder / "posLeft.mat", {"posLeft": np.tile([4.0, 5.0, 6.0], (4, 1))})
    return tmp_path


def test_each_foot_is_a_session(recording):
    right, left = (readers.read(f"{recording}#{foot}") for foot in ("right", "left"))
    assert right.imu.accel[0].tolist() == [0, 1, 2] and right.imu.gyro[0].tolist() == [3, 4, 5]
    assert left.imu.accel[0].tolist() == [6, 7, 8] and left.imu.gyro[0].tolist() == [9, 10, 11]
    assert right.reference.enu[0].tolist() == [1, -2, -3] and left.reference.enu[0].tolist() == [4, -5, -6]
    assert left.imu.t_ns.tolist() == [0, 16666667, 33333333, 50000000]  # k / 60 s
    assert (left.device.vehicle, left.device.up, left.clock_epoch) == ("foot", "+z", "unknown")


@pytest.mark.parametrize(("foot", "found"), [("", "holds two feet"), ("#third", "names the foot 'third'")])
def test_the_foot_must_be_chosen(recording, foot, found):
    with pytest.raises(SessionError, match=f"{found}; expected one foot; give .*#left or .*#right"):
        readers.read(f"{recording}{foot}")


def test_a_walk_of_one_foot(tmp_path):
    row = ",".join(map(repr, LEFT))
    (tmp_path / "imuMeasLeft.csv").write_text(f"{HEADING}0,{row},-0.0036,1\n1,{row},-0.0036,1\n")
    (tmp_path / "positionGt.csv").write_text(f"{TRUTH}0,1,2,3,7,8,9\n1,1,2,3,7,8,9\n")
    session = readers.read(tmp_path / "imuMeasLeft.csv")
    assert session.imu.accel[0].tolist() == LEFT[:3] and session.imu.gyro[1].tolist() == [*LEFT[3:], -0.0036]
    assert session.reference.enu.tolist() == [[1, -2, -3]] * 2
    assert session.imu.t_ns.tolist() == [0, 16666667]


def test_faults_name_file_and_variable(recording):
    folder = recording / "dataPreparation"
    savemat(folder / "posLeft.mat", {"posLeft": np.zeros((3, 3))})
    with pytest.raises(SessionError, match=r"posLeft.mat: posLeft has shape \(3, 3\); expected \(4, 3\)"):
        readers.read(f"{recording}#left")
    (folder / "posLeft.mat").unlink()
    with pytest.raises(SessionError, match=r"posLeft.mat: is missing; expected a MATLAB file"):
        readers.read(f"{recording}#left")
    (folder / "ImuFootLeft.mat").write_bytes(b"no matlab" * 50)
    with pytest.raises(SessionError, match=r"ImuFootLeft.mat: cannot be read"):
        readers.read(f"{recording}#right")
    savemat(folder / "ImuFootLeft.mat", {"other": np.zeros(3)})
    with pytest.raises(SessionError, match=r"variable ImuFootLeft is missing; .* the file has other"):
        readers.read(f"{recording}#right")


def walk(**changes):
    """Three rows at 200 Hz under VICON, z down."""
    rows = np.tile([0.1, 0.2, -9.8, 0.01, 0.02, 0.03], (3, 1))
    table = {"imu_data": rows, "strideIndex": [[1]], "GCP": [[0.5, 0.7]], "timestamps": [[0.01]]}
    table |= {"timestamps_all": [[0.0, 0.005, 0.01]], "gt": [[0.0, 0.0], [0.1, 0.2], [0.3, 0.4]]}
    return {name: value for name, value in (table | changes).items() if value is not None}


def test_a_walk_under_vicon(tmp_path):
    savemat(tmp_path / "walk.mat", walk())
    assert readers.find(tmp_path / "walk.mat").name == "pyshoe"
    session = readers.read(tmp_path / "walk.mat")
    assert session.imu.accel[0].tolist() == [0.1, 0.2, -9.8] and session.imu.gyro[0].tolist() == [0.01, 0.02, 0.03]
    assert session.imu.t_ns.tolist() == [0, 5_000_000, 10_000_000]
    assert session.reference.enu.tolist() == [[0, 0, 0], [0.1, -0.2, 0], [0.3, -0.4, 0]]  # y turned
    assert (session.device.up, session.device.vehicle, session.control) == ("-z", "foot", None)


def test_a_walk_over_marked_points(tmp_path):
    savemat(tmp_path / "walk.mat", walk(gt=None, timestamps_all=None, timestamps=[[0.0, 0.005, 0.01]]))
    session = readers.read(tmp_path / "walk.mat")
    assert session.reference is None
    assert session.control.t_ns.tolist() == [5_000_000] and session.control.point_id.tolist() == ["stride 0"]
    assert session.control.enu.tolist() == [[0.5, -0.7, 0]]
    assert session.control.sigma.tolist() == [[0.1, 0.1, 100.0]]  # the height was not measured


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"timestamps_all": [[0.0, 0.005]]}, "timestamps_all has 2 stamps; expected 3, one per inertial row"),
        ({"gt": [[0.0, 0.0]]}, r"gt has shape \(1, 2\); expected \(3, 2\)"),
        ({"imu_data": [[1.0, 2.0]]}, r"imu_data has shape \(1, 2\); expected \(n, 6\)"),
        ({"gt": None, "timestamps": [[0.0, 0.1, 0.2]], "strideIndex": [[3]]}, "strideIndex up to 3; expected row"),
    ],
)
def test_faulty_walks(tmp_path, changes, message):
    savemat(tmp_path / "walk.mat", walk(**changes))
    with pytest.raises(SessionError, match=f"walk.mat: {message}"):
        readers.read(tmp_path / "walk.mat")


def test_public_recording_of_both_feet(dataset):
    source = f"{dataset('foot_dual_zupt')}#left"
    assert readers.find(source).name == "foot-dual-zupt"
    whole, one = readers.read(source), readers.read(dataset("foot_dual_zupt") / "measData" / "imuMeasLeft.csv")
    assert len(whole.imu) == 17402 and len(one.imu) == 7201
    np.testing.assert_allclose(whole.imu.accel[5027], LEFT[:3], atol=1e-12)
    for name, part in (("accel", one.imu.accel), ("gyro", one.imu.gyro)):
        np.testing.assert_allclose(getattr(whole.imu, name)[5027:12228], part, atol=1e-9)
    np.testing.assert_allclose(whole.reference.enu[5027:12228], one.reference.enu, atol=1e-9)
    # rest before the walk: specific force points up, and the foot neither moves nor sinks
    assert whole.imu.accel[1535:5020, 2].mean() == pytest.approx(9.87, abs=0.02)
    assert np.ptp(whole.reference.enu[1535:5020], axis=0).max() < 0.02  # m


def test_public_walk_under_vicon(dataset):
    session = readers.read(dataset("foot_pyshoe_vicon") / "2017-11-22-11-22-03_LLIO.mat")
    assert len(session.imu) == len(session.reference) == 6490
    assert session.imu.t_ns[[0, -1]].tolist() == [5191300, 32449891965]
    assert session.imu.accel[:200, 2].mean() == pytest.approx(-9.377, abs=0.001)
    points = readers.read(dataset("foot_pyshoe_vicon") / "SensorConnectData_31_LLIO.mat").control
    assert len(points) == 34 and points.t_ns[0] == 2134995222
    np.testing.assert_allclose(points.enu[1], [-0.65223348, 0.00441425, 0], atol=1e-8)
