"""Camera against gyroscope: planted clock, turn and readout are found; what a recording does not show is refused."""

from dataclasses import replace

import numpy as np
import pytest
from simulated import Coverage

import smartnav_graph as sn
from smartnav_graph.calibrate import calibrate_into
from smartnav_graph.calibrate.apply import applied
from smartnav_graph.calibrate.camera_imu import CameraImuOptions, fit
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.so3 import exp, log
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.calibration.model import load_calibration
from smartnav_graph.simulation.scenarios import SCENARIOS

TURN = (0.0, 3.0, 0.0)  # deg, about the axes of the camera
ROOM = SCENARIOS["room-30s"]


def recorded(seed=0, readout_s=0.0, turn=TURN, clock_s=0.04, count=(120, 160)):
    """A walk through a room with 40 ms and 3 deg that the session does not know."""
    camera = replace(ROOM.camera.camera, readout_s=readout_s)
    model = replace(ROOM.camera, camera=camera, boresight_deg=turn, clock_s=clock_s, count=count)
    session = replace(ROOM, camera=model)(seed)
    known = replace(session.calibration, cameras={"cam0": replace(camera, readout_s=0.0)})
    return session.replace(calibration=known)


def covered(seeds):
    count = Coverage()
    for seed in seeds:
        session = recorded(seed)
        values = fit([session], CameraImuOptions()).values
        count.add("clock", values["cam0_time_offset"], 0.04)
        for axis, turn, place in zip("xyz", TURN, session.mount("cam0").body_t, strict=True):
            count.add("turn", values[f"cam0_turn_from_mount_{axis}"], turn)
            count.add("position", values[f"cam0_position_{axis}"], place)
    return count


@pytest.fixture(scope="module")
def room():
    return recorded()


@pytest.fixture(scope="module")
def found(room):
    return fit([room], CameraImuOptions())


def test_clock_and_turn_are_found(found):
    """40 ms to 1 ms; 3 deg to 0.1 deg an axis, within three sigmas (the noise of this gyro allows 0.05 in 30 s)."""
    assert found.values["cam0_time_offset"].value == pytest.approx(0.04, abs=1e-3)
    turn = [found.values[f"cam0_turn_from_mount_{axis}"] for axis in "xyz"]
    assert np.allclose([value.value for value in turn], TURN, atol=0.1)
    assert all(abs(v.value - true) < 3.0 * v.sigma and v.sigma < 0.08 for v, true in zip(turn, TURN, strict=True))
    assert "not significant" in found.refused["cam0_readout"]


def off_position(values, true):
    place = [values[f"cam0_position_{axis}"] for axis in "xyz"]
    return (np.array([v.value for v in place]) - true) / [v.sigma for v in place], max(v.sigma for v in place)


def test_the_position_is_found(room, found):
    """Within three sigmas, to 15 mm; used only where the session does not have it, and refused in a short recording."""
    off, sigma = off_position(found.values, room.mount("cam0").body_t)
    assert np.abs(off).max() < 3.0 and sigma < 0.015 and "cam0_position" not in found.refused
    assert found.change(room.calibration).cameras["cam0"].body_t == ()
    bare = fit([room.replace(sensors={})], CameraImuOptions()).change(room.calibration)
    assert np.allclose(room.replace(sensors={}, calibration=bare).mount("cam0").body_t, (0.02, 0.05, -0.01), atol=0.03)
    until = room.t0_ns + 10 * 10**9
    short = room.replace(tracks=room.tracks.take(room.tracks.t_ns < until))
    assert "move it by 0.3 m" in fit([short], CameraImuOptions()).refused["cam0_position"]


def test_the_calibration_is_used_by_the_session(room, tmp_path):
    """Written, read and applied: the session's mount is the true one, its camera clock 40 ms."""
    session_folder.save(room, tmp_path / "room")
    out = tmp_path / "calibration.toml"
    calibrate_into(out, "camera-imu", [str(tmp_path / "room")])
    calibrated = applied(load_calibration(out), room)
    true = np.asarray(room.sensors["cam0"].body_R) @ exp(np.radians(TURN))
    assert np.degrees(np.abs(log(true.T @ np.asarray(calibrated.mount("cam0").body_R)))).max() < 0.1
    camera = calibrated.calibration.cameras["cam0"]
    assert camera.time_offset_s == pytest.approx(0.04, abs=1e-3) and camera.time_offset_sigma_s < 0.02
    assert calibrated.mount("cam0").body_t == room.mount("cam0").body_t


def test_any_turn_of_the_camera_is_found():
    """Mounted upside down and sideways: no first value is needed."""
    turned = fit([recorded(1, turn=(20.0, -35.0, 150.0), clock_s=-0.3)], CameraImuOptions()).values
    true = np.degrees(log(exp(np.radians([20.0, -35.0, 150.0]))))
    turn = [turned[f"cam0_turn_from_mount_{axis}"].value for axis in "xyz"]
    assert np.allclose(turn, true, atol=0.3)
    assert turned["cam0_time_offset"].value == pytest.approx(-0.3, abs=2e-3)


@pytest.mark.slow
def test_a_rolling_shutter_is_found():
    """30 ms from the first row to the last, to 1 ms in the mean of three; the offset is that of the first row."""
    readouts, offsets = [], []
    for seed in range(3):
        values = fit([recorded(seed, readout_s=0.03)], CameraImuOptions()).values
        readouts.append(values["cam0_readout"].value)
        offsets.append(values["cam0_time_offset"].value)
    assert np.mean(readouts) == pytest.approx(0.03, abs=1e-3)
    assert np.allclose(readouts, 0.03, atol=3e-3) and np.allclose(offsets, 0.04, atol=2e-3)


def test_what_a_recording_does_not_show_is_named(room):
    with pytest.raises(CalibrationError, match=r"2 recordings.*expected one"):
        fit([room, room], CameraImuOptions())
    with pytest.raises(CalibrationError, match=r"no tracks and no matches.*smartnav match"):
        fit([room.replace(tracks=None)], CameraImuOptions())
    with pytest.raises(CalibrationError, match=r"camera back without calibration.*calibrate camera"):
        fit([room], CameraImuOptions(camera="back"))
    imu = room.imu
    still = room.replace(imu=replace(imu, gyro=np.tile(imu.gyro.mean(axis=0), (len(imu), 1))))
    with pytest.raises(CalibrationError, match=r"rates of 0\.000 rad/s.*about all of its axes"):
        fit([still], CameraImuOptions())
    order = np.random.default_rng(0).permutation(len(imu) // 50)
    mixed = np.concatenate([imu.gyro[50 * i : 50 * i + 50] for i in order])
    imu = replace(imu, t_ns=imu.t_ns[: len(mixed)], gyro=mixed, accel=imu.accel[: len(mixed)])
    with pytest.raises(CalibrationError, match=r"no lag beats the others|show a rotation"):
        fit([room.replace(imu=imu)], CameraImuOptions())


def test_half_a_minute_of_euroc():
    """Its clocks are synchronised: zero within two sigmas; the mount of its calibration within 0.3 deg."""
    values = fit([sn.load("gtsam-euroc")], CameraImuOptions()).values
    offset = values["cam0_time_offset"]
    assert abs(offset.value) <= 2.0 * offset.sigma and offset.sigma < 1e-3
    turn = [values[f"cam0_turn_from_mount_{axis}"].value for axis in "xyz"]
    assert np.abs(turn).max() < 0.3
    off, sigma = off_position(values, (-0.0216, -0.0647, 0.0098))  # m, of its sensor.yaml
    assert np.abs(off).max() < 3.0 and sigma < 0.015


def test_a_hand_held_device_with_a_late_clock(dataset):
    """Offset of the middle row -40 to -60 ms; the parts of the recording scatter."""
    result = fit([sn.load(dataset("vision_cases") / "handheld_no_rest")], CameraImuOptions())
    assert "not used" in result.refused["cam0_position"]
    values = result.values
    middle = values.get("cam0_time_offset_middle_row", values["cam0_time_offset"])
    assert -0.060 < middle.value < -0.040
