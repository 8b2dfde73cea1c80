"""Corners tracked from picture to picture, with the gyroscope as prediction.

    x1~ ~ c1_R_c0 x0~,   c1_R_c0 = (body_R_cam)^T (b0_R_b1)^T body_R_cam,   b0_R_b1 the integrated body rate

(through the camera's distortion; without it that is the homography K R K^-1). A corner is dropped if tracking back,
with the inverse rotation as prediction, does not return to it. New corners are detected away from the others.

Source: Lucas, Kanade (1981); Bouguet (2000), Pyramidal implementation of the Lucas Kanade feature tracker; Shi, Tomasi
(1994), Good features to track; Hwangbo, Kim, Kanade (2009), Inertial-aided KLT feature tracking, IROS.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.streams import Imu
from smartnav_graph.vision.epipolar import rays
from smartnav_graph.vision.images import Gray

WINDOW_PX = 21
LEVELS = 3
# Largest distance between a corner and its position after tracking forth and back, px.
RETURN_PX = 0.5
QUALITY = 0.01
# Least distance between corners over that of a square grid of the same number.
SPACING = 0.6


@dataclass(frozen=True)
class Gyro:
    """Attitude by the gyroscope alone: t_ns (n,), rate (n, 3) rad/s, start_R_body (n, 3, 3)."""

    t_ns: NDArray[np.int64]
    rate: Floats
    start_R_body: Floats

    @classmethod
    def of(cls, imu: Imu) -> Gyro:
        """Integrate the body rate, the mean of two samples between them."""
        dt = np.diff(imu.t_ns) / NS
        turns = np.tile(np.eye(3), (len(imu), 1, 1))
        turns[1:] = exp(0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * dt[:, None])
        step = 1
        while step < len(turns):  # running products by doubling
            turns[step:] = turns[:-step] @ turns[step:]
            step *= 2
        return cls(imu.t_ns, imu.gyro, turns)

    def turn(self, t0_ns: int, t1_ns: int) -> Floats | None:
        """b0_R_b1 (3, 3): the body's axes at t1 in those at t0; None outside the recording."""
        first, second = self._at(t0_ns), self._at(t1_ns)
        return None if first is None or second is None else first.T @ second

    def _at(self, t_ns: int) -> Floats | None:
        if not self.t_ns[0] <= t_ns <= self.t_ns[-1]:
            return None
        row = int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1
        rest = exp(self.rate[row] * (t_ns - self.t_ns[row]) / NS)
        return np.asarray(self.start_R_body[row] @ rest)


@dataclass
class Tracker:
    """Corners of one camera.

    camera, body_R_cam (3, 3); gyro : None: no prediction; count : number of corners; ids : gives the track ids
    """

    camera: Camera
    body_R_cam: Floats
    gyro: Gyro | None
    count: int
    ids: Iterator[int]
    predicted: int = 0
    blind: int = 0
    _gray: Gray | None = None
    _t_ns: int = 0
    _px: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    _id: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def step(self, gray: Gray, t_ns: int) -> tuple[NDArray[np.int64], Floats]:
        """Track ids (n,) and pixels (n, 2) of the corners in the next picture, taken at `t_ns` (camera clock)."""
        if self._gray is not None and len(self._px):
            turn = self._turn(t_ns)
            found, good = follow(self._gray, gray, self._px, self.camera, turn)
            self._px, self._id = found[good], self._id[good]
        self._gray, self._t_ns = gray, t_ns
        fresh = self._corners(gray)
        self._px = np.concatenate([self._px, fresh])
        self._id = np.concatenate([self._id, [next(self.ids) for _ in fresh]]).astype(np.int64)
        return self._id, self._px

    def _turn(self, t_ns: int) -> Floats | None:
        """c1_R_c0 from the last picture to this one; counts pictures without gyroscope data."""
        offset = round(self.camera.time_offset_s * NS)
        turn = None if self.gyro is None else self.gyro.turn(self._t_ns + offset, t_ns + offset)
        self.predicted += turn is not None
        self.blind += turn is None
        return None if turn is None else self.body_R_cam.T @ turn.T @ self.body_R_cam

    def _corners(self, gray: Gray) -> Floats:
        """New corners, away from the present ones."""
        import cv2

        wanted = self.count - len(self._px)
        if wanted <= 0:
            return np.zeros((0, 2))
        apart = SPACING * np.sqrt(gray.size / self.count)
        mask = np.full(gray.shape, 255, dtype=np.uint8)
        for x, y in self._px:
            cv2.circle(mask, (round(x), round(y)), round(apart), 0, -1)
        found = cv2.goodFeaturesToTrack(gray, wanted, QUALITY, apart, mask=mask)
        return np.zeros((0, 2)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2)


def rotated(px: Floats, camera: Camera, c1_R_c0: Floats | None) -> Floats:
    """Pixels (n, 2) of points at infinity after a rotation of the camera; unchanged if the rotation is unknown."""
    if c1_R_c0 is None or not len(px):
        return px
    x, y, z = c1_R_c0 @ rays(camera.normalised(px)).T
    ahead = z > 0.1  # no pixel beside or behind the camera
    z = np.where(ahead, z, 1.0)
    return np.where(ahead[:, None], camera.pixels(np.stack([x / z, y / z], axis=1)), px)


def follow(
    before: Gray, now: Gray, px: Floats, camera: Camera, c1_R_c0: Floats | None
) -> tuple[Floats, NDArray[np.bool_]]:
    """Pixels (n, 2) of corners (n, 2) in the next picture, and which (n,) of them were found there and back."""
    there, found = _flow(before, now, px, rotated(px, camera, c1_R_c0))
    back_R = None if c1_R_c0 is None else c1_R_c0.T
    back, returned = _flow(now, before, there, rotated(there, camera, back_R))
    height, width = now.shape
    inside = ((there >= 0) & (there <= [width - 1, height - 1])).all(axis=1)
    near = np.linalg.norm(back - px, axis=1) <= RETURN_PX
    return there, found & returned & inside & near


def _flow(one: Gray, other: Gray, px: Floats, guess: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    import cv2

    found, status, _ = cv2.calcOpticalFlowPyrLK(
        one,
        other,
        px.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2).copy(),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=LEVELS,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found, dtype=np.float64).reshape(-1, 2), status.ravel() == 1
