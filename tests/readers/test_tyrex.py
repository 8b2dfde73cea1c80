"""Phones under motion capture: synthetic recordings with known values, and the public ones."""

import gzip

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import interpolate
from smartnav_graph.evaluation.align import fit_alignment

TURN = Rotation.from_euler("z", 90, degrees=True)  # body x points north


def write(folder, name, rows):
    """A gzip-ed text file of rows of numbers, digits as they are."""
    text = "\n".join(" ".join(map(str, row)) for row in rows) + "\n"
    (folder / f"{name}.txt.gz").write_bytes(gzip.compress(text.encode()))


def capture(folder, name, positions, rotations, rate=60.0):
    (folder / "qualisys").mkdir(exist_ok=True)
    body = {"Positions": positions, "Rotations": rotations}
    savemat(folder / "qualisys" / f"{name}.mat", {"any_name": {"FrameRate": rate, "RigidBodies": body}})


@pytest.fixture
def android(tmp_path):
    """Gyro at 0.1 .. 0.5 s, accelerometer at the same stamps from 0.2 s on."""
    folder = tmp_path / "android" / "walk"
    folder.mkdir(parents=True)
    stamps = ("0.1", "0.2", "0.3", "0.4", "0.5")
    write(folder, "gyroscope", [(t, 0.3, 0.2, 0.1, 0.1, 0.2, 0.3) for t in stamps])
    write(folder, "accelerometer", [(t, k, 2, 9.5) for k, t in enumerate(stamps[1:])])
    write(folder, "magnetometer", [(t, 60, -70, 380, 59, -74, 413) for t in stamps])
    x, y, z, w = TURN.as_quat()
    write(folder, "rotation-vector", [(t, x, y, z, w, 0.17) for t in ("0.25", "0.5")])
    (folder / "record.properties").write_text("[Device]\nManufacturer = LGE\nModel = Nexus 5\n[Time]\nStartTime = 1\n")
    (folder / "timeAlignment.txt").write_text("  -2.0000000e-01\n")
    positions = np.array([[1000.0, 2000, 3000], [np.nan] * 3, [1000, 2000, 4000]]).T
    rotations = np.array([TURN.as_matrix().T.ravel()] * 3).T  # column by column
    capture(tmp_path, "walk", positions, rotations, rate=10.0)
    return folder


@pytest.fixture
def ios(tmp_path):
    folder = tmp_path / "ios" / "walk"
    folder.mkdir(parents=True)
    write(folder, "accelerometer", [("57557.1", 0.0, 0.0, -1.0), ("57557.3", 0.0, 0.2, -1.0)])
    write(folder, "gyroscope", [("57557.15", 0.1, 0.2, 0.3), ("57557.2", 0.1, 0.2, 0.3), ("57557.35", 0.1, 0.2, 0.3)])
    (folder / "description.txt").write_text("[Time]\nBootTime = 57557.05")
    return folder


def test_android(android):
    assert readers.find(android).name == "tyrex"
    session = readers.read(android)
    assert (session.device.name, session.device.forward, session.clock_epoch) == ("LGE Nexus 5", "+y", "unknown")
    assert session.imu.t_ns.tolist() == [200_000_000, 300_000_000, 400_000_000, 500_000_000]
    np.testing.assert_allclose(session.imu.gyro[0], [0.2, 0.0, -0.2], atol=1e-15)  # the system's bias is off
    assert session.imu.extra["system_bias_z_rad_s"].tolist() == [0.3] * 4
    assert session.imu.accel.tolist() == [[k, 2, 9.5] for k in range(4)]
    assert session.magnetometer.field_ut[0].tolist() == [1, 4, -33]
    assert session.dropped == {
        "imu": {"of the gyro outside the accelerometer's span dropped": 1},
        "reference": {"of frames without markers dropped": 1},
    }


def test_truth_is_on_the_phones_clock_and_in_metres(android):
    reference = readers.read(android).reference
    assert reference.t_ns.tolist() == [200_000_000, 400_000_000]  # frame k at k / 10 Hz + 0.2 s
    assert reference.enu.tolist() == [[1, 2, 3], [1, 2, 4]]
    w, x, y, z = reference.quat[0]
    np.testing.assert_allclose(Rotation.from_quat([x, y, z, w]).apply([1.0, 0, 0]), [0, 1, 0], atol=1e-12)
    own = np.stack([reference.extra[f"system_q{axis}"] for axis in "wxyz"], axis=-1)
    assert np.isnan(own[0]).all()  # before the system's first
    np.testing.assert_allclose(own[1], reference.quat[1], atol=1e-12)


def test_ios_counts_in_g_with_the_opposite_sign_and_has_two_clocks(ios):
    session = readers.read(ios)
    assert (session.device.name, session.clock_epoch) == ("iPhone", "boot")
    assert session.imu.t_ns.tolist() == [57557_150_000_000, 57557_200_000_000]
    # a quarter and a half of the way from 0 to 0.2 g
    np.testing.assert_allclose(session.imu.accel[:, 1], [-0.05 * 9.80665, -0.1 * 9.80665], atol=1e-12)
    np.testing.assert_allclose(session.imu.accel[:, 2], 9.80665, atol=1e-12)
    assert session.dropped["imu"] == {
        "of the gyro outside the accelerometer's span dropped": 1,
        "of the accelerometer outside the gyro's span dropped": 2,
        "with the acceleration interpolated to the gyro's stamp": 2,
    }
    assert session.reference is None and session.magnetometer is None


def test_ios_truth_counts_from_the_start_of_the_log(ios, tmp_path):
    capture(tmp_path, "walk", np.zeros((3, 1)), np.eye(3).reshape(9, 1))
    (ios / "timeAlignment.txt").write_text("-2.42")
    assert readers.read(ios).reference.t_ns.tolist() == [57559_470_000_000]  # 57557.05 + 2.42 s


def test_faults_name_the_file(android, tmp_path):
    (android / "timeAlignment.txt").unlink()
    with pytest.raises(SessionError, match=r"timeAlignment.txt: is missing"):
        readers.read(android)
    (android / "timeAlignment.txt").write_text("soon")
    with pytest.raises(SessionError, match=r"'soon' is no number"):
        readers.read(android)
    capture(tmp_path, "walk", np.zeros((2, 5)), np.zeros((9, 5)))
    with pytest.raises(SessionError, match=r"walk.mat: positions \(2, 5\), rotations \(9, 5\); expected \(3, n\)"):
        readers.read(android)
    savemat(tmp_path / "qualisys" / "walk.mat", {"other": np.zeros((2, 2))})
    with pytest.raises(SessionError, match=r"walk.mat: holds no rigid body"):
        readers.read(android)
    (android / "magnetometer.txt.gz").write_bytes(gzip.compress(bytes(range(48, 58)) * 900)[:40])
    with pytest.raises(SessionError, match=r"magnetometer.txt.gz: cannot be read"):
        readers.read(android)


def test_clocks_without_common_time(android):
    write(android, "accelerometer", [("7.0", 0, 0, 9.8), ("8.0", 0, 0, 9.8)])
    with pytest.raises(SessionError, match="gyroscope and accelerometer have no time in common"):
        readers.read(android)


GOLDEN = {
    "android/Jakob_Nexus5_NoDist_Texting": {
        "rows": {"imu": 24514, "magnetometer": 6121, "reference": 7200},
        "span": [426137392, 123858904286],
        "field_ut": 44.0,
        "own_deg": 3.0,
        "path_m": 80.0,
    },
    "ios/Guillaume_iPhone5_NoDist_Texting": {
        "rows": {"imu": 11748, "magnetometer": 3069, "reference": 7193},
        "span": [57557340400000, 57681293300000],
        "field_ut": 308.0,
        "own_deg": 6.6,
        "path_m": 44.0,
    },
}


@pytest.mark.parametrize("name", GOLDEN)
def test_public_recordings(dataset, name):
    expected = GOLDEN[name]
    session = readers.read(dataset("phone_mocap_tyrex") / name)
    assert {key: len(stream) for key, stream in session.streams().items()} == expected["rows"]
    assert session.imu.t_ns[[0, -1]].tolist() == expected["span"]
    norm = np.linalg.norm(session.magnetometer.field_ut, axis=1).mean()
    assert norm == pytest.approx(expected["field_ut"], abs=0.5)
    reference = session.reference
    path = np.linalg.norm(np.diff(reference.enu[::20], axis=0), axis=1).sum()  # at 3 Hz: without the markers' noise
    assert path == pytest.approx(expected["path_m"], abs=3.0)
    # gravity: the accelerometer turned to nav axes averages to g upwards over a closed walk
    R = Rotation.from_quat(reference.quat[:, [1, 2, 3, 0]])
    force = R.apply(interpolate(reference.t_ns, session.imu.t_ns, session.imu.accel)).mean(axis=0)
    np.testing.assert_allclose(force, [0, 0, 9.8], atol=0.25)  # m/s^2: bias, and 2 deg of the marker body
    # the system's own attitude, its yaw offset removed, is as good as published
    known = np.isfinite(reference.extra["system_qw"])
    own = Rotation.from_quat(np.stack([reference.extra[f"system_q{a}"][known] for a in "xyzw"], axis=-1))
    heads = [attitude.apply([0.0, 1.0, 0.0]) for attitude in (own, R[known])]
    back = fit_alignment("yaw", *heads).R
    error = np.degrees((R[known].inv() * Rotation.from_matrix(back) * own).magnitude())
    assert error.mean() == pytest.approx(expected["own_deg"], abs=0.3)


def test_public_calibration_recording(dataset):
    session = readers.read(dataset("phone_mocap_tyrex") / "android" / "calib_gyr_Nexus5_d1")
    assert session.reference is None
    bias = np.stack([session.imu.extra[f"system_bias_{a}_rad_s"] for a in "xyz"], axis=-1)
    assert np.ptp(bias, axis=0).max() > 1e-3  # the system revises it on the way: that must not step into the readings
    raw = session.imu.gyro + bias[0]
    seconds = raw[: len(raw) // 199 * 199].reshape(-1, 199, 3)
    rest = np.degrees(seconds[seconds.std(axis=1).sum(axis=1).argmin()].mean(axis=0))
    np.testing.assert_allclose(rest, [0.67, 0.01, 4.29], atol=0.1)  # deg/s, as the data's page has it
