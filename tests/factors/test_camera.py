"""What builders that look through a camera share: turns by the gyroscope, times of rows, rays turned back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.camera import BodyRates, CameraModel, Motion, seen_from
from smartnav_graph.factors.coplanar_rows import Rig
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.streams import Imu

T0 = 1_700_000_000 * NS
BODY_R_CAM = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
RIG = Rig(BODY_R_CAM, np.array([0.0, 0.3, 0.0]), boresight=True, timed=True)
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(0.1, 0.0, 0.0, 0.0))
EYE = CameraModel(CAMERA, RIG, 0.03, 0.01, 0.02)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def rates(rate, seconds=2.0):
    """A gyroscope at 100 Hz; rate of time s -> (3,) rad/s."""
    t = np.arange(round(seconds * 100)) / 100
    gyro = np.array([rate(s) for s in t])
    return BodyRates(Imu(t_ns=T0 + np.round(t * NS).astype(np.int64), gyro=gyro, accel=np.zeros_like(gyro)))


def test_turns_are_integrals_of_the_rate():
    ramp = rates(lambda s: np.array([s, -2.0 * s, 0.5]))
    at = np.array([T0 + NS, T0 + NS // 2])
    found = ramp.turn(at, np.array([0.03, 0.1]))
    expected = [[0.5 * (1.03**2 - 1), 1 - 1.03**2, 0.015], [0.5 * (0.6**2 - 0.25), 0.25 - 0.36, 0.05]]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(ramp.mean(at[:1], 0.03), found[:1] / 0.03, atol=1e-9)
    np.testing.assert_allclose(ramp.mean(at[:1], 0.0), [[1.0, -2.0, 0.5]], atol=1e-9)


def test_a_row_is_seen_after_its_share_of_the_readout():
    """By its row in the picture as it was taken, distortion included; rows outside are those at its rim."""
    pixels = np.array([[0.0, 0.0], [600.0, 479.0], [10.0, 239.5], [320.0, 500.0]])
    np.testing.assert_allclose(EYE.delay(CAMERA.normalised(pixels)), [0.0, 0.03, 0.015, 0.03], atol=1e-6)


def test_rays_are_turned_back_to_the_first_row(rng):
    """A camera that turns and sees a far point later would have seen it elsewhere before."""
    world = rng.uniform([-3, -3, 8], [3, 3, 12], (20, 3))
    rate = np.array([0.4, -0.7, 1.1])  # rad/s, body axes
    delay = rng.uniform(0.0, 0.03, 20)
    rotate = Rotation.from_rotvec(delay[:, None] * (BODY_R_CAM.T @ rate))
    later = rotate.inv().apply(world)
    at = np.full(20, T0 + NS)
    bias = np.full((20, 3), 0.02)
    turns = EYE.turns(rates(lambda s: rate + 0.02), at, delay, bias)
    np.testing.assert_allclose(seen_from(later[:, :2] / later[:, 2:], turns), world[:, :2] / world[:, 2:], atol=1e-9)


def test_the_camera_moves_with_its_lever_arm():
    motion = Motion(
        Rotation.from_euler("z", [[90.0]], degrees=True).as_matrix(), np.array([[1.0, 0.0, 0.0]]), np.zeros((1, 3))
    )
    # the body turns left at 2 rad/s: its point 0.3 m along y, which is -e here, moves along -x, which is -n
    np.testing.assert_allclose(EYE.velocity(motion, np.array([[0.0, 0.0, 2.0]])), [[1.0, -0.6, 0.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("boresight", "timed", "focal", "letters"),
    [(True, True, True, "TAI"), (False, True, False, "T"), (False, False, True, "I"), (False, False, False, "")],
)
def test_only_states_that_are_asked_for(boresight, timed, focal, letters):
    rig = Rig(BODY_R_CAM, np.zeros(3), boresight, timed, focal=focal)
    camera_model = CameraModel(CAMERA, rig, 0.0, 0.01, 0.02, 0.02)
    assert "".join(camera_model.states()) == letters
