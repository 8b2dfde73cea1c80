"""Triangulation of tracks: one point a track, all tracks at once, robust against wrong observations.

    x_i = proj(nav_R_cam_i^T (X - nav_t_cam_i)),   proj(X, Y, Z) = (X / Z, Y / Z)

The initial point lies midway between two of its rays: of several pairs of rays that with which most observations
agree (MSAC). Gauss-Newton steps under a redescending loss follow.

Source: Torr, Zisserman (2000), MLESAC, CVIU 78(1); Hartley, Zisserman (2004), Multiple View Geometry, 12.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.session.streams import Tracks
from smartnav_graph.vision.epipolar import cross, rays

Ints = NDArray[np.intp]

# Largest residual of an inlier in sigmas, number of pairs of rays, number of Gauss-Newton steps.
INLIER_SIGMAS = 4.0
HYPOTHESES = 12
STEPS = 6
# Scale of the Cauchy loss, sigmas.
LOSS_SCALE = 2.0
# Smallest depth of a point, m.
NEAREST = 0.05


@dataclass(frozen=True)
class TrackObservations:
    """Observations of tracks in k images, padded to one length.

    track (n,) : track_id of each; image (n, l) : index of the images, ascending; xy (n, l, 2) : undistorted normalised
    coordinates; there (n, l) : entries that hold an observation
    """

    track: NDArray[np.int64]
    image: Ints
    xy: Floats
    there: Mask

    def __len__(self) -> int:
        return len(self.track)

    @cached_property
    def count(self) -> Ints:
        """Observations (n,) of each track."""
        return np.asarray(self.there.sum(axis=1), dtype=np.intp)

    @cached_property
    def last(self) -> Ints:
        """The last image (n,) of each track."""
        return np.asarray(np.where(self.there, self.image, -1).max(axis=1, initial=-1), dtype=np.intp)


def observations_of_tracks(tracks: Tracks, stamps: NDArray[np.int64], most: int) -> TrackObservations:
    """Tracks in the images of these stamps (k,), those with more than `most` observations in parts of even length,
    ordered by their last image. Left out: points seen in one image only, and observations of one track at two places of
    one image."""
    rows = np.flatnonzero(np.isin(tracks.t_ns, stamps))
    image = np.searchsorted(stamps, tracks.t_ns[rows])
    order = np.lexsort((image, tracks.track_id[rows]))
    image, name, xy = image[order], tracks.track_id[rows][order], tracks.xy_n[rows][order]
    clear = _unique(image, name)
    image, name, xy = image[clear], name[clear], xy[clear]
    names, first, length = np.unique(name, return_index=True, return_counts=True)
    parts = -(-length // most)
    within = np.arange(len(name)) - np.repeat(first, length)
    part = within * np.repeat(parts, length) // np.repeat(length, length)
    group = np.repeat(np.concatenate([[0], np.cumsum(parts)])[:-1], length) + part
    return _padded(np.repeat(names, parts), group, image, xy)


def _unique(image: Ints, name: NDArray[np.int64]) -> Mask:
    """Rows (m,), sorted by name and image, that no neighbour repeats."""
    same = (image[1:] == image[:-1]) & (name[1:] == name[:-1])
    return np.asarray(~(np.concatenate([[False], same]) | np.concatenate([same, [False]])), dtype=bool)


def _padded(names: NDArray[np.int64], group: Ints, image: Ints, xy: Floats) -> TrackObservations:
    count = np.bincount(group, minlength=len(names))
    place = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    shape = len(names), max(int(count.max(initial=0)), 1)
    images, points, there = np.zeros(shape, np.intp), np.zeros((*shape, 2)), np.zeros(shape, bool)
    images[group, place], points[group, place], there[group, place] = image, xy, True
    last = np.where(there, images, -1).max(axis=1, initial=-1)
    rows = np.argsort(last, kind="stable")
    rows = rows[count[rows] > 1]
    return TrackObservations(names[rows], images[rows], points[rows], there[rows])


class TrackPoints(NamedTuple):
    """point (n, 3) nav m; residual (n, l, 2) predicted less observed, normalised; inside (n, l) : observations in use
    that agree and have the point in front; parallax (n,) rad, largest angle to the first of their rays."""

    point: Floats
    residual: Floats
    inside: Mask
    parallax: Floats


class Cameras(NamedTuple):
    """Poses at every observation: nav_R_cam (n, l, 3, 3), nav_t_cam (n, l, 3)."""

    R: Floats
    t: Floats

    def to_camera(self, point: Floats) -> Floats:
        """Points (..., n, 3) in the axes of the cameras (..., n, l, 3)."""
        away = point[..., None, :] - self.t
        return np.asarray(np.einsum("nlji,...nlj->...nli", self.R, away))

    def project(self, point: Floats) -> Floats:
        """Projections (n, l, 2) of points (n, 3), normalised; without meaning behind a camera."""
        there = self.to_camera(point)
        return np.asarray(there[..., :2] / np.where(there[..., 2:] > NEAREST, there[..., 2:], 1.0))


def triangulate(
    observations: TrackObservations, cameras: Cameras, sigma: float, use: Mask, seed: int = 0
) -> TrackPoints:
    """The points of least cost of the observations in use (n, l).

    sigma : of an observation, normalised coordinates
    """
    direction = np.einsum("nlij,nlj->nli", cameras.R, rays(observations.xy))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    point = _initial_points(observations, cameras, direction, sigma, use, np.random.default_rng(seed))
    for _ in range(STEPS):
        point = _gauss_newton_step(observations, cameras, point, sigma, use)
    residual, ahead = _residual(observations, cameras, point)
    square = (residual**2).sum(axis=-1)
    inside = use & ahead & (square < (INLIER_SIGMAS * sigma) ** 2)
    return TrackPoints(point, residual, inside, _parallax(direction, inside))


def _residual(observations: TrackObservations, cameras: Cameras, point: Floats) -> tuple[Floats, Mask]:
    """Predicted less observed (..., n, l, 2) of points (..., n, 3), and which are in front of the camera."""
    there = cameras.to_camera(point)
    ahead = there[..., 2] > NEAREST
    depth = np.where(ahead, there[..., 2], 1.0)
    return there[..., :2] / depth[..., None] - observations.xy, ahead


def _initial_points(
    observations: TrackObservations,
    cameras: Cameras,
    direction: Floats,
    sigma: float,
    use: Mask,
    rng: np.random.Generator,
) -> Floats:
    """Points (n, 3) midway between two rays: of the pairs of rays drawn those with which most observations agree."""
    n, limit = len(observations), (INLIER_SIGMAS * sigma) ** 2
    row, rank = np.arange(n), np.argsort(~use, axis=1, kind="stable")
    count = np.maximum(use.sum(axis=1), 1)
    best, cost = np.zeros((n, 3)), np.full(n, np.inf)
    for k in range(HYPOTHESES):
        draw = np.sort((rng.random((2, n)) * count).astype(np.intp), axis=0)
        draw[:, :] = np.where(k == 0, np.stack([np.zeros(n, np.intp), count - 1]), draw)
        i, j = rank[row, draw[0]], rank[row, draw[1]]
        point = _midway(cameras.t[row, i], direction[row, i], cameras.t[row, j], direction[row, j])
        residual, ahead = _residual(observations, cameras, point)
        square = np.where(ahead, (residual**2).sum(axis=-1), np.inf)
        found = np.where(use, np.minimum(square, limit), 0.0).sum(axis=1)
        take = found < cost
        best, cost = np.where(take[:, None], point, best), np.where(take, found, cost)
    return best


def _midway(a: Floats, u: Floats, b: Floats, v: Floats) -> Floats:
    """Points (n, 3) midway between the rays a + s u and b + s v (n, 3) each, at their closest approach."""
    w, uv = b - a, (u * v).sum(axis=-1)
    square = np.maximum((cross(u, v) ** 2).sum(axis=-1), 1e-12)
    uw, vw = (u * w).sum(axis=-1), (v * w).sum(axis=-1)
    s, t = (uw - uv * vw) / square, (uv * uw - vw) / square
    return np.asarray(0.5 * (a + s[:, None] * u + b + t[:, None] * v))


def _gauss_newton_step(
    observations: TrackObservations, cameras: Cameras, point: Floats, sigma: float, use: Mask
) -> Floats:
    """One Gauss-Newton step under a Cauchy loss; a point behind all of its cameras does not change."""
    there = cameras.to_camera(point)
    ahead = use & (there[..., 2] > NEAREST)
    inverse = 1.0 / np.where(ahead, there[..., 2], 1.0)
    residual = (there[..., :2] * inverse[..., None] - observations.xy) / sigma
    flat = np.zeros((*there.shape[:2], 2, 3))
    flat[..., 0, 0] = flat[..., 1, 1] = inverse
    flat[..., :, 2] = -there[..., :2] * (inverse**2)[..., None]
    by_point = flat @ cameras.R.swapaxes(-1, -2) / sigma
    weight = ahead / (1.0 + (residual**2).sum(axis=-1) / LOSS_SCALE**2)
    normal = np.einsum("nlai,nl,nlaj->nij", by_point, weight, by_point)
    right = np.einsum("nlai,nl,nla->ni", by_point, weight, residual)
    damped = normal + (1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    return np.asarray(point - np.linalg.solve(damped, right[..., None])[..., 0])


def _parallax(direction: Floats, inside: Mask) -> Floats:
    """Largest angle (n,) rad between the first ray inside and another."""
    first = direction[np.arange(len(direction)), inside.argmax(axis=1)]
    sine = np.linalg.norm(cross(first[:, None], direction), axis=-1)
    return np.asarray(np.arcsin(np.clip(np.where(inside, sine, 0.0).max(axis=1, initial=0.0), 0.0, 1.0)))
