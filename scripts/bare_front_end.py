"""The baseline of the front end: OpenCV's own calls, one picture after the other, and the pictures for both.

    python scripts/bare_front_end.py make FOLDER [COUNT]     textured pictures 640 x 480 of a camera on the move
    python scripts/bare_front_end.py FOLDER                  ORB 1500, neighbours matched; one JSON line

Of each picture: read, ORB with 1500 points, undistorted; of each pair of neighbours: the two nearest of each point both
ways, the ratio test and mutual agreement, in Python as OpenCV's tutorials do it. OpenCV uses the threads that it likes.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
DISTORTION = np.array([-0.28, 0.07, 2e-4, 2e-5])
K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])


def texture(seed: int, size: int = 1600) -> np.ndarray:
    """Noise at three scales with straight edges over it."""
    rng = np.random.default_rng(seed)
    out = np.zeros((size, size), np.float32)
    for sigma in (1.2, 4.0, 14.0):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        out += layer / layer.std()
    for _ in range(400):
        (x, y), (w, h), shade = rng.integers(0, size, 2), rng.integers(8, 60, 2), rng.normal(0, 2)
        out[y : y + h, x : x + w] += shade
    return np.clip(128 + 30 * out, 0, 255).astype(np.uint8)


def make(folder: Path, count: int) -> None:
    """Pictures of a plane from a camera that turns, shifts and shivers."""
    folder.mkdir(parents=True, exist_ok=True)
    plane, rng = texture(0), np.random.default_rng(1)
    for k in range(count):
        angle, scale = 0.5 * np.sin(k / 15), 1 + 0.2 * np.sin(k / 11)
        middle = np.array([800 + 300 * np.sin(k / 19), 800 + 260 * np.cos(k / 23)])
        turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        H = np.column_stack([turn, np.array([WIDTH, HEIGHT]) / 2 - turn @ middle])
        seen = cv2.warpAffine(plane, H, (WIDTH, HEIGHT))
        noisy = np.clip(seen + rng.normal(0, 3, seen.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{k:04d}.png"), noisy)


def measure(folder: Path) -> dict[str, float]:
    """Wall and processor seconds, pairs and matches."""
    begin, cpu = time.perf_counter(), time.process_time()
    orb, matcher = cv2.ORB_create(1500), cv2.BFMatcher(cv2.NORM_HAMMING)
    before, pairs, matches = None, 0, 0
    for file in sorted(folder.glob("*.png")):
        points, described = orb.detectAndCompute(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), None)
        xy = cv2.undistortPoints(cv2.KeyPoint_convert(points)[:, None], K, DISTORTION)[:, 0]
        if before is not None:
            there = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(before[1], described, 2) if _clear(m, n)}
            back = {m.queryIdx: m.trainIdx for m, n in matcher.knnMatch(described, before[1], 2)}
            good = [(i, j) for i, j in there.items() if back[j] == i]
            rows = np.array(good, dtype=np.intp).reshape(-1, 2)
            assert len(before[0][rows[:, 0]]) == len(xy[rows[:, 1]])
            pairs, matches = pairs + 1, matches + len(good)
        before = (xy, described)
    return {
        "seconds": time.perf_counter() - begin,
        "cpu_s": time.process_time() - cpu,
        "pairs": pairs,
        "matches": matches,
    }


def _clear(first: cv2.DMatch, second: cv2.DMatch) -> bool:
    return first.distance <= 0.8 * second.distance


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 101)
    else:
        print(json.dumps(measure(Path(sys.argv[1]))))
