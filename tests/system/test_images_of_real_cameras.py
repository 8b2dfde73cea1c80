"""Cameras of others: each fault of a calibration or a start is found, or the images count for less."""

import csv

import numpy as np
import pytest
from planted_faults import focal_length
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core.so3 import best_rotation

CASES = "vision_cases"


def off_reference(session, run):
    """Rows of the solution and of the reference with the same stamp, and the horizontal errors (n, 2) m there."""
    truth, found = session.reference, run.solution
    rows, at = np.isin(found.t_ns, truth.t_ns), np.isin(truth.t_ns, found.t_ns)
    return rows, at, (found.nav_t_body[rows] - truth.enu[at])[:, :2]


@pytest.mark.parametrize("name", ["F3_car_klt_worse", "F3_car_orb"])
def test_a_car_with_every_tenth_fix_is_better_for_its_images(dataset, name):
    session = sn.load(dataset(CASES) / name)
    run = sn.run(session, withhold=("gnss:every=10",), rate="10")
    truth, found = session.reference, run.solution
    rows, at, off = off_reference(session, run)
    turned = Rotation.from_matrix(found.nav_R_body[rows]) * Rotation.from_quat(truth.quat[at], scalar_first=True).inv()
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.40  # m; 0.48 without images
    assert np.degrees(np.sqrt((turned.as_rotvec()[:, 2] ** 2).mean())) < 0.35  # deg; 4.5 without images
    inside = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance[rows, 3:5, 3:5]), off) < 5.99
    assert 0.88 < inside.mean() < 0.99  # 0.42 to 0.58 where every pair counted in full
    assert run.summary["camera"]["direction_sigma_deg"] >= 0.5
    assert any("contradict the motion between images" in warning for warning in run.summary["warnings"])


@pytest.mark.parametrize("name", ["F3_car_klt_worse", "F3_car_orb"])
def test_a_focal_length_3_percent_too_short_is_found(dataset, name):
    """Coordinates of the images by a focal length that is that much too short are too large."""
    wrong = focal_length(1.0 / 1.03)(sn.load(dataset(CASES) / name), np.random.default_rng(0))
    run = sn.run(wrong, withhold=("gnss:every=10",), rate="10")
    assert run.summary["states"]["camera_focal_length_correction"]["value"] == pytest.approx(-0.03, abs=0.008)
    assert any("focal length" in reason["text"] for reason in run.summary["verdict"]["reasons"])


def test_fixes_of_a_decimetre_keep_a_car_where_it_is(dataset):
    """All fixes: images that contradict them bend the path by centimetres, and the run is not good."""
    session = sn.load(dataset(CASES) / "F3_car_orb")
    run = sn.run(session, rate="10")
    _, _, off = off_reference(session, run)
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.15  # m; 0.074 without images, 0.81 with the weight of their matches
    assert run.summary["verdict"]["level"] == "doubtful"


def test_a_camera_in_a_hand_without_rest_or_fix(dataset):
    folder = dataset(CASES) / "handheld_no_rest"
    session = sn.load(folder)
    run = sn.run(session, rate="20")
    clock = run.summary["states"]["images_time_offset_s"]
    assert -0.06 < clock["value"] < -0.04 and clock["sigma"] > 0.002  # s; it drifts
    assert run.summary["initialisation"]["method"] == "visual"
    with (folder / "colmap_poses.csv").open() as file:
        poses = [[float(row[name]) for name in ("t_ns", "x", "y", "z")] for row in csv.DictReader(file)]
    t_ns, model = np.array(poses)[:, 0] + clock["value"] * 1e9, np.array(poses)[:, 1:]
    place = np.stack([np.interp(t_ns, run.solution.t_ns, column) for column in run.solution.nav_t_body.T], axis=1)
    R, values = best_rotation(model, place)
    centred = model - model.mean(axis=0)
    scale = float(values.sum() / (centred**2).sum())
    left = place - place.mean(axis=0) - scale * centred @ R.T
    assert 0.075 < scale < 0.115 and np.sqrt((left**2).sum(axis=1).mean()) < 0.05  # m a unit of the model; m
