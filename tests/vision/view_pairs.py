"""Two simulated cameras: matched points of rooms and planes, with noise and wrong matches."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

SIGMA = 0.0015  # 0.7 px at a focal length of 467 px
HALF_FIELD = 0.45  # half a picture, normalised
SIDEWAYS, FORWARD, SHORT, NOWHERE = (0.3, 0.05, 0.1), (0.05, 0.02, 0.5), (0.05, 0.0, 0.0), (0.0, 0.0, 0.0)
TURN = (0.02, 0.05, -0.01)  # rad
PLANE = np.array([0.3, 0.2, 1.0]) / 4.0  # m . X = 1


class View(NamedTuple):
    """Matched points, the true c0_R_c1 and unit c0_t_c1 (zero without a baseline), and which matches are right."""

    xy0: np.ndarray
    xy1: np.ndarray
    R: np.ndarray
    t: np.ndarray
    right: np.ndarray


def view(seed, matches=300, wrong=0.0, *, t=SIDEWAYS, w=TURN, plane=False, sigma=SIGMA):
    """Points 2 to 10 m off (or on a plane 4 m off); a share of `wrong` matches lies anywhere in the second picture."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.from_rotvec(w).as_matrix(), np.array(t)
    rays = np.column_stack([rng.uniform(-HALF_FIELD, HALF_FIELD, (matches, 2)), np.ones(matches)])
    depth = 1.0 / (rays @ PLANE) if plane else rng.uniform(2.0, 10.0, matches)
    far = rays * depth[:, None]
    near = (far - t) @ R
    xy0, xy1 = (x[:, :2] / x[:, 2:] + rng.normal(0.0, sigma, (matches, 2)) for x in (far, near))
    right = np.arange(matches) >= round(wrong * matches)
    xy1[~right] = rng.uniform(-HALF_FIELD, HALF_FIELD, ((~right).sum(), 2))
    return View(xy0, xy1, R, t / max(np.linalg.norm(t), 1e-12), right)


def turned(R, seed, sigma):
    """A rotation as a gyro gives it: off by `sigma` rad an axis."""
    return R @ Rotation.from_rotvec(np.random.default_rng(seed + 10_000).normal(0.0, sigma, 3)).as_matrix()
