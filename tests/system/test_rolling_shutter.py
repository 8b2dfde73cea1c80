"""A camera that reads its rows one after the other: each point at the time of its own row."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_coplanarity import errors

from smartnav_graph.estimate import config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.run import smooth
from smartnav_graph.factors.camera import Motion
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.simulation.scenarios import SCENARIOS
from smartnav_graph.vision.epipolar import sampson

READOUT_S = 0.03
ROOM = SCENARIOS["room-30s"]
ROLLING = replace(ROOM, camera=replace(ROOM.camera, camera=replace(ROOM.camera.camera, readout_s=READOUT_S)))


def options(row_time=True, **sections):
    return config.from_dict({"image_pairs": {"row_time": row_time}, **sections}, "test")


@pytest.fixture(scope="module")
def room():
    return ROLLING(0)


def misses(session, row_time):
    """Median and largest residual, px, of all matches at the true motion."""
    problem = prepare(session, options(row_time))
    builder = next(b for b in problem.builders if b.name == "image_pairs")
    truth = session.reference
    at = np.searchsorted(truth.t_ns, builder.image_ns)
    R = Rotation.from_quat(truth.quat[at], scalar_first=True).as_matrix()
    motion = Motion(R, truth.velocity[at], truth.gyro_bias[at])
    pairs, rig = builder.with_motion(builder.selection(PassState()), 0.0, 0.0, motion).pairs, builder.rig
    R, place = R @ rig.body_R_cam, truth.enu[at] + R @ rig.body_t_cam
    i, j = pairs.images[pairs.pair].T
    turn, way = R[i].transpose(0, 2, 1) @ R[j], (R[i].transpose(0, 2, 1) @ (place[j] - place[i])[..., None])[..., 0]
    shift = None if pairs.shift is None else pairs.shift[:, None]
    residual = np.abs(sampson(turn, way, pairs.x0[:, None], pairs.x1[:, None], 1e-3, shift).residual)
    far = np.linalg.norm(way, axis=1) > 0.1  # m
    return np.quantile(residual[far], [0.5, 0.99]) * builder.camera_model.camera.focal


def test_nothing_is_left_at_the_truth():
    """Features and gyroscope without noise: what is left is of second order in 30 ms."""
    camera = replace(
        ROLLING.camera, camera=replace(ROLLING.camera.camera, noise_px=1e-6), faults=type(ROOM.camera.faults)()
    )
    session = replace(ROLLING, camera=camera)(0)
    without, with_rows = misses(session, False), misses(session, True)
    assert without[0] > 0.8 and without[1] > 5.0  # px
    assert with_rows[0] < 0.05 and with_rows[1] < 0.3  # without the way of the camera meanwhile 0.2 and 1.9


def test_a_run_with_row_times_is_as_good_as_with_a_global_shutter(room):
    still, rolled, ignored = (
        smooth(*case) for case in ((ROOM(0), options()), (room, options()), (room, options(row_time=False)))
    )
    metres = [errors(run.solution, run.session.reference)[0] for run in (still, rolled, ignored)]
    assert metres[1] < 0.05 and metres[1] < metres[0] + 0.02
    assert metres[2] > 3.0 * metres[1]
    # half of the readout is what a clock offset takes over
    assert ignored.summary["states"]["images_time_offset_s"]["value"] == pytest.approx(READOUT_S / 2, abs=0.004)
    assert rolled.summary["states"]["images_time_offset_s"]["value"] == pytest.approx(0.0, abs=0.002)


def test_a_replay_has_row_times_too(room):
    runs = [replay(room, options(on, replay={"polish": False})) for on in (True, False)]
    with_rows, without = (errors(run.causal, room.reference)[0] for run in runs)
    assert with_rows < 0.2 and with_rows < 0.7 * without


def test_the_readout_is_that_of_the_images_or_of_the_calibration(room):
    def readout(session, row_time=True):
        builders = prepare(session, options(row_time)).builders
        return next(b for b in builders if b.name == "image_pairs").camera_model.readout_s

    assert readout(room) == READOUT_S
    assert readout(room, row_time=False) == 0.0
    own = replace(room.images, readout_ns=np.full(len(room.images), 25_000_000))
    assert readout(room.replace(images=own)) == 0.025
    assert readout(room.replace(images=replace(room.images, readout_ns=None))) == READOUT_S
