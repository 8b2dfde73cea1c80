"""Images in a whole run: a handheld camera in a room holds what inertial data alone lose, and bad images do no harm."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate import config
from smartnav_graph.estimate.replay import replay
from smartnav_graph.estimate.run import smooth
from smartnav_graph.factors.coplanarity import CONTRARY, IN_USE, REASONS
from smartnav_graph.session.session import Mount
from smartnav_graph.simulation.scenarios import simulate


def options(**sections):
    return config.from_dict(sections, "test")


def errors(solution, reference):
    """RMS of position m and attitude deg at the reference's stamps that the solution has."""
    rows = np.isin(reference.t_ns, solution.t_ns)
    at = np.searchsorted(solution.t_ns, reference.t_ns[rows])
    R = Rotation.from_quat(reference.quat[rows][:, [1, 2, 3, 0]])
    turn = (Rotation.from_matrix(solution.nav_R_body[at]) * R.inv()).magnitude()
    apart = np.linalg.norm(solution.nav_t_body[at] - reference.enu[rows], axis=1)
    return np.sqrt((apart**2).mean()), np.degrees(np.sqrt((turn**2).mean()))


@pytest.fixture(scope="module")
def room():
    return simulate("room-30s", 0)


@pytest.fixture(scope="module")
def seen(room):
    return smooth(room, options())


def test_images_hold_what_inertial_data_lose(room, seen):
    alone = smooth(room, options(image_pairs={"enabled": False}))
    without, (metres, degrees) = errors(alone.solution, room.reference), errors(seen.solution, room.reference)
    assert without[0] > 5.0  # m: half a minute of a phone's accelerometer
    assert metres < 0.05 and degrees < 0.5
    assert metres < 0.02 * without[0] and degrees < 0.5 * without[1]


def test_the_covariance_is_consistent(room, seen):
    rows = np.isin(room.reference.t_ns, seen.solution.t_ns)
    at = np.searchsorted(seen.solution.t_ns, room.reference.t_ns[rows])
    error = seen.solution.nav_t_body[at] - room.reference.enu[rows]
    P = seen.solution.covariance[at][:, 3:6, 3:6]
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error).mean() / 3
    assert 0.1 < nees < 3.0  # one walk is a few independent samples


def test_the_account_of_pairs_and_matches_is_complete(room, seen):
    summary = seen.summary
    pairs = summary["image_pairs"]
    builder = next(b for b in seen.problem.builders if b.name == "image_pairs")
    assert sum(pairs.values()) == len(builder.seen)
    assert summary["factors"]["image_pairs"] == pairs[REASONS[IN_USE]] + pairs[REASONS[CONTRARY]]
    assert summary["chi2_per_dof"]["image_pairs"] == pytest.approx(1.0, abs=0.3)
    assert pairs[REASONS[IN_USE]] > 200
    inside = seen.solution.residuals.of("image_pairs")
    assert (inside & seen.solution.residuals.used).sum() > 20 * pairs[REASONS[IN_USE]]


def test_every_image_has_a_pose(room, seen):
    stamps = room.tracks.t_ns
    inside = stamps[(stamps >= seen.solution.t_ns[0]) & (stamps <= seen.solution.t_ns[-1])]
    assert np.isin(inside, seen.solution.t_ns).all()


@pytest.mark.parametrize("smoother", ["fixed-lag"])
def test_a_replay_holds_on_to_images_too(room, smoother):
    run = replay(room, options(replay={"smoother": smoother, "polish": False}))
    metres, degrees = errors(run.solution, room.reference)
    assert metres < 0.1 and degrees < 0.5
    assert errors(run.causal, room.reference)[0] < 0.2


def test_a_tracker_that_slips_as_a_whole_is_found(room, seen):
    """All tracks of one image are off by 17 px: the pairs with it contradict the way, whatever pose they would fit."""
    tracks = room.tracks
    images = next(b for b in seen.problem.builders if b.name == "image_pairs").seen.t_ns
    one = images[len(images) // 2]
    bad = tracks.t_ns == one
    slipped = replace(tracks, xy_n=tracks.xy_n + np.where(bad[:, None], [17 / 575, 0.0], 0.0), xy_px=None)
    run = smooth(room.replace(tracks=slipped), options())
    metres, degrees = errors(run.solution, room.reference)
    clean = errors(seen.solution, room.reference)
    assert metres < clean[0] + 0.02 and degrees < clean[1] + 0.1
    builder = next(b for b in run.problem.builders if b.name == "image_pairs")
    touched = (builder.seen.t_ns[builder.seen.images] == one).any(axis=1)
    assert touched.sum() == 8 and not (run.diagnostics.pairs.verdict[touched] == IN_USE).any()


def test_images_of_something_else_are_refused(room):
    """Tracks that have nothing to do with the motion: refused and reported, and the result is that without images."""
    rng = np.random.default_rng(0)
    noise = room.replace(tracks=replace(room.tracks, xy_n=rng.uniform(-0.5, 0.5, room.tracks.xy_n.shape), xy_px=None))
    run, alone = smooth(noise, options()), smooth(room, options(image_pairs={"enabled": False}))
    assert any("image_pairs: refused" in text for text in run.summary["warnings"])
    wrong, without = errors(run.solution, room.reference), errors(alone.solution, room.reference)
    assert wrong[0] <= 1.1 * without[0] and wrong[1] <= 1.1 * without[1]


def test_camera_states_find_what_is_wrong(room):
    """Boresight off by half a degree and clock by 15 ms, reported with sigmas: found."""
    mount = room.sensors["camera"] if "camera" in room.sensors else next(iter(room.sensors.values()))
    name = next(key for key, value in room.sensors.items() if value is mount)
    off = np.radians([0.4, -0.3, 0.2])
    R = np.array(mount.body_R) @ Rotation.from_rotvec(off).as_matrix().T
    wrong = room.replace(
        sensors={**room.sensors, name: Mount(mount.body_t, tuple(map(tuple, R.tolist())))},
        tracks=replace(room.tracks, t_ns=room.tracks.t_ns - 15 * NS // 1000),
    )
    run = smooth(wrong, options(image_pairs={"boresight_sigma_deg": 1.0, "time_offset_sigma": 0.05}))
    states = run.summary["states"]
    assert states["images_time_offset_s"]["value"] == pytest.approx(0.015, abs=0.002)
    found = np.array(states["camera_boresight_rad"]["value"])
    sigma = np.array(states["camera_boresight_rad"]["sigma"])
    assert (np.abs(found - off) < np.maximum(4 * sigma, 1e-3)).all(), (found, off, sigma)
