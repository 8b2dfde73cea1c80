"""Pose fixes: attitudes through a turned mount, known and unknown latency, outliers, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from exact import LEVER, START_NS, angle_deg, record
from numeric import assert_observation, random_rotations
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.replay import replay
from smartnav_graph.factors.pose_fix import AttitudeFix, PoseFixConfig, attitudes, undo_latency
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.streams import PoseFix
from smartnav_graph.smoothers.incremental import ReplayConfig

TURN = np.array([0.02, -0.03, 0.04])  # rad
SIGMA_M, SIGMA_RAD = 0.02, 0.01


def fixes(recording, every_s=1.0, delay_s=0.0, seed=0, lever=LEVER, attitude=True):
    """Noisy fixes of a sensor at `lever`, turned by `TURN`; stamps are early by `delay_s`."""
    t = np.arange(0.4, recording.trajectory.duration - 0.5, every_s)
    there = recording.trajectory.sample(t + delay_s)
    white = np.random.default_rng(seed).standard_normal((2, len(t), 3))
    rotate = Rotation.from_rotvec(SIGMA_RAD * white[0]) * Rotation.from_matrix(there.nav_R_body)
    quat = (rotate * Rotation.from_rotvec(TURN)).as_quat()[:, [3, 0, 1, 2]]
    return PoseFix(
        t_ns=START_NS + ns_from_seconds(t),
        enu=there.nav_t_body + there.nav_R_body @ np.array(lever) + SIGMA_M * white[1],
        sigma=np.full((len(t), 3), SIGMA_M),
        **({"quat": quat, "sigma_rot": np.full((len(t), 3), SIGMA_RAD)} if attitude else {}),
    )


@pytest.fixture(scope="module")
def made():
    return record(noise=DEVICE_CLASSES["mems"], seed=3)


def session_of(made, stream):
    return made.session.replace(gnss=None, control=None, sensors={}, pose_fixes=stream)


def errors(made, solution):
    """Largest position error m and attitude error deg after the first second."""
    truth = made.truth(solution.t_ns)
    inner = solution.seconds > 1.0
    place = np.linalg.norm(solution.nav_t_body - truth.nav_t_body, axis=1)
    return place[inner].max(), angle_deg(solution.nav_R_body, truth.nav_R_body)[inner].max()


@pytest.mark.parametrize("extra", [(), ("A",)])
def test_derivatives_of_an_attitude(extra):
    rng = np.random.default_rng(1)
    m = 7
    data = np.concatenate(
        [
            random_rotations(rng, m).reshape(m, 9),
            random_rotations(rng, m).reshape(m, 9),
            rng.uniform(0.1, 1.0, (m, 3)),
        ],
        axis=1,
    )
    states = [rng.uniform(-1.0, 1.0, (m, 3)) for _ in extra]
    zeros = np.zeros((m, 3))
    assert_observation(AttitudeFix(extra), random_rotations(rng, m), zeros, zeros, states, data)


def test_mount_lever_arm_and_clock_are_found(made):
    run = sn.run(session_of(made, fixes(made, delay_s=0.05, lever=(0.05, -0.1, 0.08))))
    found = run.summary["states"]
    assert found["pose_fixes_time_offset_s"]["value"] == pytest.approx(0.05, abs=0.005)
    np.testing.assert_allclose(found["pose_fixes_mount_correction_rad"]["value"], TURN, atol=0.01)
    np.testing.assert_allclose(found["pose_fixes_lever_arm_correction_m"]["value"], (0.05, -0.1, 0.08), atol=0.03)
    place, turn = errors(made, run.solution)
    assert place < 0.15 and turn < 1.5  # before the first and after the last fix it is only foretold
    assert run.summary["mode"] == "batch" and run.summary["used"]["pose_fixes"] == 30


def test_positions_alone_hold_a_trajectory(made):
    run = sn.run(session_of(made, fixes(made, attitude=False, lever=(0.0, 0.0, 0.0))))
    assert "pose_fixes_mount_correction_rad" not in run.summary["states"]
    place, turn = errors(made, run.solution)
    assert place < 0.15 and turn < 3.0


def test_rows_without_an_attitude_stand_beside_rows_with_one(made):
    stream = fixes(made, lever=(0.0, 0.0, 0.0))
    quat = np.array(stream.quat)
    quat[::2] = np.nan
    run = sn.run(session_of(made, replace(stream, quat=quat)))
    residuals = run.solution.residuals
    assert residuals.of("pose_fixes").sum() == 3 * 30 and residuals.of("pose_attitude").sum() == 3 * 15


def test_known_latency_is_the_time_the_row_speaks_of(made):
    stream = fixes(made, lever=(0.0, 0.0, 0.0))
    late = replace(stream, t_ns=stream.t_ns + NS)
    config = Config(pose_fixes=PoseFixConfig(latency_s=1.0))
    shifted = undo_latency(session_of(made, late), config.pose_fixes).pose_fixes
    assert (shifted.t_ns == stream.t_ns).all() and (shifted.arrival_ns == late.t_ns).all()
    place, turn = errors(made, sn.smooth(session_of(made, late), config))
    assert place < 0.15 and turn < 1.5  # before the first and after the last fix it is only foretold


def test_late_fixes_in_replay_are_used_at_the_time_they_speak_of(made):
    prompt = fixes(made, lever=(0.0, 0.0, 0.0))
    late = replace(prompt, arrival_ns=prompt.t_ns + NS)
    runs = [replay(session_of(made, stream), Config(replay=ReplayConfig(polish=False))) for stream in (prompt, late)]
    last = [run.causal.nav_t_body[-1] for run in runs]
    truth = [made.truth(run.causal.t_ns[-1:]).nav_t_body[0] for run in runs]
    # the last second is foretold twice as long; a fix taken at its arrival would be off by 1.5 m
    assert all(np.linalg.norm(p - q) < 0.5 for p, q in zip(last, truth, strict=True))
    assert runs[1].summary["dropped"].get("pose_fixes", {}).keys() <= {"arrived after the end"}


def test_a_wrong_fix_is_found(made):
    stream = fixes(made, lever=(0.0, 0.0, 0.0))
    enu = np.array(stream.enu)
    enu[[7, 18]] += [[5.0, 0.0, 0.0], [0.0, -40.0, 3.0]]
    run = sn.run(session_of(made, replace(stream, enu=enu)))
    assert run.summary["rejected"]["pose_fixes"] == 2
    assert errors(made, run.solution)[0] < 0.15


def test_what_is_refused(made):
    stream = fixes(made)
    with pytest.raises(SessionError, match=r"pose_fixes: quaternion norm 2 at row 0; expected 1 within 0.01"):
        attitudes(replace(stream, quat=2.0 * stream.quat))
    with pytest.raises(ConfigError, match="latency_s or a sigma < 0"):
        PoseFixConfig(latency_s=-1.0)
    with pytest.raises(ConfigError, match="loss = 'square'"):
        PoseFixConfig(loss="square")
