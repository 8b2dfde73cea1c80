"""Where the rays of tracks meet: one point a track, all tracks at once, whatever some of their observations claim.

    x_i = proj(nav_R_cam_i^T (X - nav_t_cam_i)),   proj(X, Y, Z) = (X / Z, Y / Z)

A point is begun where two of its rays come nearest to each other: of several pairs of rays the one that most
observations agree with (MSAC). Gauss-Newton steps under a redescending loss follow.

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

# Residual in sigmas up to which an observation agrees, pairs of rays tried, steps of the adjustment.
AGREES = 4.0
TRIED = 12
STEPS = 6
# Reach of the Cauchy loss, sigmas.
REACH = 2.0
# Smallest depth (in units of nav) at which a point is looked at.
NEAREST = 0.05


@dataclass(frozen=True)
class Sightings:
    """Tracks as they were seen in k images, padded to one length.

    track (n,) : name of each; image (n, l) : places of the images, ascending; xy (n, l, 2) : undistorted normalised
    coordinates; there (n, l) : places that hold an observation
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


def of_tracks(tracks: Tracks, stamps: NDArray[np.int64], most: int) -> Sightings:
    """Tracks in the images of these stamps (k,), those with more than `most` observations in parts of even length;
    what was seen in one image alone says nothing, and is left out, as is what has two places in one image. Ordered by
    their last image."""
    chosen = np.flatnonzero(np.isin(tracks.t_ns, stamps))
    image = np.searchsorted(stamps, tracks.t_ns[chosen])
    order = np.lexsort((image, tracks.track_id[chosen]))
    image, name, xy = image[order], tracks.track_id[chosen][order], tracks.xy_n[chosen][order]
    clear = _alone(image, name)
    image, name, xy = image[clear], name[clear], xy[clear]
    names, first, length = np.unique(name, return_index=True, return_counts=True)
    parts = -(-length // most)
    within = np.arange(len(name)) - np.repeat(first, length)
    part = within * np.repeat(parts, length) // np.repeat(length, length)
    group = np.repeat(np.concatenate([[0], np.cumsum(parts)])[:-1], length) + part
    return _padded(np.repeat(names, parts), group, image, xy)


def _alone(image: Ints, name: NDArray[np.int64]) -> Mask:
    """Rows (m,), sorted by name and image, that no neighbour repeats."""
    same = (image[1:] == image[:-1]) & (name[1:] == name[:-1])
    return np.asarray(~(np.concatenate([[False], same]) | np.concatenate([same, [False]])), dtype=bool)


def _padded(names: NDArray[np.int64], group: Ints, image: Ints, xy: Floats) -> Sightings:
    count = np.bincount(group, minlength=len(names))
    place = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    shape = len(names), max(int(count.max(initial=0)), 1)
    images, points, there = np.zeros(shape, np.intp), np.zeros((*shape, 2)), np.zeros(shape, bool)
    images[group, place], points[group, place], there[group, place] = image, xy, True
    last = np.where(there, images, -1).max(axis=1, initial=-1)
    rows = np.argsort(last, kind="stable")
    rows = rows[count[rows] > 1]
    return Sightings(names[rows], images[rows], points[rows], there[rows])


class Points(NamedTuple):
    """point (n, 3) nav m; residual (n, l, 2) predicted less seen, normalised; inside (n, l) : observations in use that
    agree and have the point ahead; parallax (n,) rad, largest angle between the first of their rays and another."""

    point: Floats
    residual: Floats
    inside: Mask
    parallax: Floats


class Cameras(NamedTuple):
    """Poses at every observation: nav_R_cam (n, l, 3, 3), nav_t_cam (n, l, 3)."""

    R: Floats
    t: Floats

    def seen(self, point: Floats) -> Floats:
        """Points (..., n, 3) in the axes of the cameras (..., n, l, 3)."""
        away = point[..., None, :] - self.t
        return np.asarray(np.einsum("nlji,...nlj->...nli", self.R, away))

    def project(self, point: Floats) -> Floats:
        """Where points (n, 3) are seen, (n, l, 2); nowhere in particular behind a camera."""
        there = self.seen(point)
        return np.asarray(there[..., :2] / np.where(there[..., 2:] > NEAREST, there[..., 2:], 1.0))


def meet(sightings: Sightings, cameras: Cameras, sigma: float, use: Mask, seed: int = 0) -> Points:
    """The points that observations in use (n, l) agree with best.

    sigma : of an observation, normalised coordinates
    """
    direction = np.einsum("nlij,nlj->nli", cameras.R, rays(sightings.xy))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    point = _begun(sightings, cameras, direction, sigma, use, np.random.default_rng(seed))
    for _ in range(STEPS):
        point = _stepped(sightings, cameras, point, sigma, use)
    residual, ahead = _residual(sightings, cameras, point)
    square = (residual**2).sum(axis=-1)
    inside = use & ahead & (square < (AGREES * sigma) ** 2)
    return Points(point, residual, inside, _parallax(direction, inside))


def _residual(sightings: Sightings, cameras: Cameras, point: Floats) -> tuple[Floats, Mask]:
    """Predicted less seen (..., n, l, 2) of points (..., n, 3), and which are ahead of the camera."""
    there = cameras.seen(point)
    ahead = there[..., 2] > NEAREST
    depth = np.where(ahead, there[..., 2], 1.0)
    return there[..., :2] / depth[..., None] - sightings.xy, ahead


def _begun(
    sightings: Sightings, cameras: Cameras, direction: Floats, sigma: float, use: Mask, rng: np.random.Generator
) -> Floats:
    """Points (n, 3) midway between two rays, of those tried the ones that most observations agree with."""
    n, limit = len(sightings), (AGREES * sigma) ** 2
    row, rank = np.arange(n), np.argsort(~use, axis=1, kind="stable")
    count = np.maximum(use.sum(axis=1), 1)
    best, cost = np.zeros((n, 3)), np.full(n, np.inf)
    for k in range(TRIED):
        draw = np.sort((rng.random((2, n)) * count).astype(np.intp), axis=0)
        draw[:, :] = np.where(k == 0, np.stack([np.zeros(n, np.intp), count - 1]), draw)
        i, j = rank[row, draw[0]], rank[row, draw[1]]
        point = _midway(cameras.t[row, i], direction[row, i], cameras.t[row, j], direction[row, j])
        residual, ahead = _residual(sightings, cameras, point)
        square = np.where(ahead, (residual**2).sum(axis=-1), np.inf)
        found = np.where(use, np.minimum(square, limit), 0.0).sum(axis=1)
        take = found < cost
        best, cost = np.where(take[:, None], point, best), np.where(take, found, cost)
    return best


def _midway(a: Floats, u: Floats, b: Floats, v: Floats) -> Floats:
    """Points (n, 3) midway between the rays a + s u and b + s v (n, 3) each, where those are nearest to each other."""
    w, uv = b - a, (u * v).sum(axis=-1)
    square = np.maximum((cross(u, v) ** 2).sum(axis=-1), 1e-12)
    uw, vw = (u * w).sum(axis=-1), (v * w).sum(axis=-1)
    s, t = (uw - uv * vw) / square, (uv * uw - vw) / square
    return np.asarray(0.5 * (a + s[:, None] * u + b + t[:, None] * v))


def _stepped(sightings: Sightings, cameras: Cameras, point: Floats, sigma: float, use: Mask) -> Floats:
    """One Gauss-Newton step under a Cauchy loss; a point that is behind all of its cameras stays."""
    there = cameras.seen(point)
    ahead = use & (there[..., 2] > NEAREST)
    inverse = 1.0 / np.where(ahead, there[..., 2], 1.0)
    residual = (there[..., :2] * inverse[..., None] - sightings.xy) / sigma
    flat = np.zeros((*there.shape[:2], 2, 3))
    flat[..., 0, 0] = flat[..., 1, 1] = inverse
    flat[..., :, 2] = -there[..., :2] * (inverse**2)[..., None]
    by_point = flat @ cameras.R.swapaxes(-1, -2) / sigma
    weight = ahead / (1.0 + (residual**2).sum(axis=-1) / REACH**2)
    normal = np.einsum("nlai,nl,nlaj->nij", by_point, weight, by_point)
    right = np.einsum("nlai,nl,nla->ni", by_point, weight, residual)
    held = normal + (1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    return np.asarray(point - np.linalg.solve(held, right[..., None])[..., 0])


def _parallax(direction: Floats, inside: Mask) -> Floats:
    """Largest angle (n,) rad between the first ray inside and another."""
    first = direction[np.arange(len(direction)), inside.argmax(axis=1)]
    sine = np.linalg.norm(cross(first[:, None], direction), axis=-1)
    return np.asarray(np.arcsin(np.clip(np.where(inside, sine, 0.0).max(axis=1, initial=0.0), 0.0, 1.0)))
