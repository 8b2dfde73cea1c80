"""The baseline of two-view geometry: OpenCV's findEssentialMat and recoverPose alone, and the matches for both.

    python scripts/bare_two_view.py        one JSON line: processor seconds a pair, median errors deg

100 pairs of 300 matches at 0.7 px (focal length 467 px), of which 30 % lie anywhere; points 2 to 10 m off, a baseline
of 0.32 m, mostly sideways, and a turn of 3 deg. No covariance, no kind of geometry, no refinement over all inliers.
"""

from __future__ import annotations

import json
import time
from typing import NamedTuple

import cv2
import numpy as np

PAIRS, MATCHES, WRONG = 100, 300, 0.3
FOCAL, NOISE_PX, HALF_FIELD = 467.0, 0.7, 0.45
T, TURN = np.array([0.3, 0.05, 0.1]), np.array([0.02, 0.05, -0.01])


class Pair(NamedTuple):
    """Normalised points (m, 2) of both images."""

    xy0: np.ndarray
    xy1: np.ndarray


def pair(seed: int) -> Pair:
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-HALF_FIELD, HALF_FIELD, (MATCHES, 2)), np.ones(MATCHES)])
    far = rays * rng.uniform(2.0, 10.0, (MATCHES, 1))
    near = (far - T) @ cv2.Rodrigues(TURN)[0]
    sigma = NOISE_PX / FOCAL
    xy0, xy1 = (x[:, :2] / x[:, 2:] + rng.normal(0.0, sigma, (MATCHES, 2)) for x in (far, near))
    wrong = round(WRONG * MATCHES)
    xy1[:wrong] = rng.uniform(-HALF_FIELD, HALF_FIELD, (wrong, 2))
    return Pair(xy0, xy1)


def errors_deg(R: np.ndarray, t: np.ndarray) -> tuple[float, float]:
    """Of c0_R_c1 and of the direction c0_t_c1."""
    turn = np.linalg.norm(cv2.Rodrigues(R.T @ cv2.Rodrigues(TURN)[0])[0])
    cosine = t @ T / np.linalg.norm(t) / np.linalg.norm(T)
    return float(np.degrees(turn)), float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def summary(seconds: float, errors: list[tuple[float, float]]) -> dict[str, float]:
    """Seconds a pair, median errors."""
    rotation, direction = np.median(errors, axis=0)
    return {"seconds": seconds / PAIRS, "rotation_deg": round(rotation, 4), "direction_deg": round(direction, 4)}


def main() -> None:
    K, found = np.diag([FOCAL, FOCAL, 1.0]), []
    pairs = [pair(seed) for seed in range(PAIRS)]
    begin = time.process_time()
    for xy0, xy1 in pairs:
        px0, px1 = FOCAL * xy0, FOCAL * xy1
        E, mask = cv2.findEssentialMat(px0, px1, K, cv2.USAC_MAGSAC, 0.999, 1.0)
        _, R, t, _ = cv2.recoverPose(E, px0, px1, K, mask=mask)
        found.append((R.T, -R.T @ t.ravel()))
    print(json.dumps(summary(time.process_time() - begin, [errors_deg(R, t) for R, t in found])))


if __name__ == "__main__":
    main()
