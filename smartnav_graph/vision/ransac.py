"""Initial values of a relative pose from matches of which some are wrong: samples, tested on all other matches.

Deterministic: the seed is passed in.

Source: Torr, Zisserman (2000), MLESAC (the truncated cost); Barath et al. (2020), MAGSAC++ (through OpenCV);
Kneip, Chli, Siegwart (2011), Robust real-time visual odometry with a single camera and an IMU (two points once the
rotation is known).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.vision.epipolar import rays
from smartnav_graph.vision.gating import Geometry
from smartnav_graph.vision.refine import GATE, MatchedPoints, angle

if TYPE_CHECKING:
    import cv2

Pose = tuple[Floats, Floats]  # c0_R_c1 (3, 3), c0_t_c1 (3,) of unit length

SAMPLES = 64  # of two matches: with 60 % outliers all samples hold one only once in 10^5
THRESHOLD_OF_MAGSAC = 1.5  # in sigmas; MAGSAC++ integrates over the noise
CONFIDENCE = 0.999
MOST_TRIALS = 2000
PIXELS_A_SIGMA = 0.7
PIXELS_OF_COLMAP = 2.0  # threshold
OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])
LEAST = 6  # matches for a general pose: five unknowns and one to test it


def _samples(m: int, seed: int) -> NDArray[np.int64]:
    """Pairs (SAMPLES, 2) of different rows."""
    draw = np.random.default_rng(seed)
    first = draw.integers(0, m, SAMPLES)
    return np.column_stack([first, (first + draw.integers(1, m, SAMPLES)) % m])


def rotation_by_samples(matched: MatchedPoints, seed: int) -> Floats:
    """The rotation (3, 3) without a baseline that most matches agree with."""
    u0, u1 = (_unit(rays(xy)) for xy in (matched.xy0, matched.xy1))
    pairs = _samples(len(u0), seed)
    candidates = _triad(u0[pairs]) @ _triad(u1[pairs]).transpose(0, 2, 1)
    candidates = np.concatenate([np.eye(3)[None], candidates])
    products = (u0[:, :, None] * u1[:, None, :]).reshape(-1, 9)
    square = 2.0 - 2.0 * candidates.reshape(-1, 9) @ products.T  # |u0 - R u1|^2
    cost = np.minimum(square / (2.0 * GATE**2 * matched.sigma**2), 1.0).sum(axis=1)
    return np.asarray(candidates[int(np.argmin(cost))])


def _triad(pairs: Floats) -> Floats:
    """Orthonormal axes (n, 3, 3) from two unit rays (n, 2, 3)."""
    along = _unit(pairs[:, 0] + pairs[:, 1])
    across = _unit(np.cross(pairs[:, 0], pairs[:, 1]))
    return np.stack([along, across, np.cross(along, across)], axis=2)


def direction_by_samples(matched: MatchedPoints, R: Floats, spread: float, seed: int) -> Pose:
    """R with the direction of the baseline that most matches agree with; the sign is open.

    With the rotation known every match gives a plane that contains the baseline, n . t = 0 with n = x0~ x R x1~; two
    planes intersect in a direction. `spread` rad is the sigma of the rotation.
    """
    one_pair = np.ones((1, len(matched.xy0)), dtype=bool)
    geometry = Geometry(rays(matched.xy0)[None], (rays(matched.xy1) @ R.T)[None], R[None], one_pair)
    n, pairs = geometry.normals[0], _samples(len(matched.xy0), seed)
    t = _unit(np.cross(n[pairs[:, 0]], n[pairs[:, 1]]))
    gate = GATE**2 * (matched.sigma**2 + spread**2)
    miss = geometry.square(t[:, None])[:, 0]
    cost = np.where(t.any(axis=1), np.minimum(miss / gate, 1.0).sum(axis=1), np.inf)  # a point matched twice: no t
    best = int(np.argmin(cost))
    return R, np.asarray(t[best] if np.isfinite(cost[best]) else OPTICAL_AXIS)


def usac(seed: int) -> cv2.UsacParams:
    """Options of OpenCV's MAGSAC++ for points in the pixels of `pixels_a_unit`."""
    import cv2

    params = cv2.UsacParams()
    params.confidence, params.maxIterations, params.randomGeneratorState = CONFIDENCE, MOST_TRIALS, seed
    params.threshold = THRESHOLD_OF_MAGSAC * PIXELS_A_SIGMA
    params.score, params.loMethod = cv2.SCORE_METHOD_MAGSAC, cv2.LOCAL_OPTIM_SIGMA
    return params


def pixels_a_unit(matched: MatchedPoints) -> float:
    """Focal length of a camera whose sigma is `PIXELS_A_SIGMA`: the constants of OpenCV and pycolmap are in pixels.

    (On normalised coordinates MAGSAC++ is three times less accurate, and fails on homographies.)
    """
    return PIXELS_A_SIGMA / float(np.median(matched.sigma))


def magsac(matched: MatchedPoints, near: Floats, seed: int) -> list[Pose]:
    """Pose of the essential matrix that OpenCV's MAGSAC++ finds, of its two rotations the one nearer to `near` (3, 3);
    the sign is open. Empty: none found."""
    import cv2

    focal = pixels_a_unit(matched)
    K = np.diag([focal, focal, 1.0])
    E, _ = cv2.findEssentialMat(focal * matched.xy0, focal * matched.xy1, K, K, None, None, usac(seed))
    if E is None or E.shape != (3, 3) or not np.isfinite(E).all():
        return []
    first, second, t = cv2.decomposeEssentialMat(E)
    R = min(first.T, second.T, key=lambda turn: angle(near.T @ turn))
    return [(np.asarray(R), np.asarray(-R @ t.ravel()))]


def colmap(matched: MatchedPoints, near: Floats, seed: int) -> list[Pose]:
    """Pose of pycolmap's two-view geometry (LO-RANSAC on five points, four for a plane), which needs no `near`.
    Empty: none found."""
    import pycolmap

    focal = pixels_a_unit(matched)
    camera = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId.SIMPLE_PINHOLE, focal, 0, 0)
    camera.params = np.array([focal, 0.0, 0.0])
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose, options.min_num_inliers = True, LEAST
    options.detect_watermark = False
    options.ransac.random_seed, options.ransac.max_error = seed, PIXELS_OF_COLMAP
    rows = np.arange(len(matched.xy0), dtype=np.uint32)
    found = pycolmap.estimate_calibrated_two_view_geometry(
        camera, matched.xy0 * focal, camera, matched.xy1 * focal, np.column_stack([rows, rows]), options
    )
    if found is None or found.cam2_from_cam1 is None:
        return []
    pose = found.cam2_from_cam1.inverse()
    length = float(np.linalg.norm(pose.translation))
    if not length > 0:
        return []
    return [(np.asarray(pose.rotation.matrix()), np.asarray(pose.translation / length))]


def _unit(x: Floats) -> Floats:
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), np.finfo(float).tiny))
