"""Outliers among the matches of image pairs whose rotation is known: all pairs at once.

With R known, each match gives the normal n = R x1~ x x0~ of its epipolar plane, and the baseline is normal to all of
them: two matches give a hypothesis, and that with which most matches agree is taken (MSAC). The given rotation is
used, not one fitted to the matches: if all points of a pair shift alike, a fit would follow the wrong motion.

A wrong match on its epipolar line has the more influence the nearer its point seems: its weight grows with the square
of its parallax. So a point must lie in front of both cameras, and not much nearer than the others.

Source: Torr, Zisserman (2000), MLESAC, CVIU 78(1); Kneip, Chli, Siegwart (2011), Robust real-time visual odometry with
a single camera and an IMU, BMVC.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.vision.epipolar import cross, rays
from smartnav_graph.vision.pairs import Pairs

# Largest residual of an inlier in sigmas. With 30 % outliers half of the hypotheses are free of them.
INLIER_SIGMAS = 3.0
# Largest inverse distance of a point, in units of this quantile of the inliers' inverse distances.
MUCH_NEARER, NEAR_SHARE = 3.0, 0.75
HYPOTHESES = 40
# Matches times hypotheses computed in one batch, to fit the cache.
BATCH = 20_000


@dataclass(frozen=True)
class Gated:
    """inliers (n, k) of the padded matches; direction (n, 3) of c0_t_c1; parallax (n,) rad, median after the rotation
    is removed"""

    inliers: Mask
    direction: Floats
    parallax: Floats


def gate(pairs: Pairs, R: Floats, sigma: Floats, seed: int = 0) -> Gated:
    """Matches that agree with the given rotation and one baseline.

    Parameters
    ----------
    R : (n, 3, 3) c0_R_c1 of each pair; sigma : (n,) of a good match in normalised coordinates, the
    uncertainty of the rotation included
    """
    geometry = Geometry.of(pairs, R)
    limit = (INLIER_SIGMAS * sigma[:, None]) ** 2
    rng = np.random.default_rng(seed)
    best, cost = np.tile([0.0, 0.0, 1.0], (len(R), 1)), np.full(len(R), np.inf)
    count = np.maximum(pairs.count, 1)
    at_once = int(np.clip(BATCH // max(pairs.there.size, 1), 1, HYPOTHESES))
    for _ in range(-(-HYPOTHESES // at_once)):
        drawn = (rng.random((2, at_once, len(R))) * count).astype(np.intp)
        best, cost = _better(geometry, cross(*(geometry.normals_at(place) for place in drawn)), limit, best, cost)
    for _ in range(2):
        weight = (geometry.square(best) < limit) & pairs.there
        best, cost = _better(geometry, geometry.fitted(weight / geometry.scale(best))[None], limit, best, cost)
    inliers = (geometry.square(best) < limit) & pairs.there
    best = best * np.where(_median(geometry.inverse_distance(best)[0], inliers) < 0.0, -1.0, 1.0)[:, None]
    return Gated(inliers & geometry.plausible(best, sigma, inliers), best, geometry.parallax())


def _better(geometry: Geometry, hypotheses: Floats, limit: Floats, best: Floats, cost: Floats) -> tuple[Floats, Floats]:
    """The best of some baselines (h, n, 3) of each pair and the one before (n, 3), and its cost (n,)."""
    size = np.linalg.norm(hypotheses, axis=-1, keepdims=True)
    hypotheses = np.where(size > 1e-12, hypotheses / np.maximum(size, 1e-12), best)
    new = np.where(geometry.there, np.minimum(geometry.square(hypotheses), limit), 0.0).sum(axis=-1)
    first, row = new.argmin(axis=0), np.arange(len(best))
    take = new[first, row] < cost
    return np.where(take[:, None], hypotheses[first, row], best), np.where(take, new[first, row], cost)


class Geometry:
    """Pairs whose rotation R (n, 3, 3) is known: rays a, y (n, k, 3) of both images in the axes of the first one."""

    def __init__(self, a: Floats, y: Floats, R: Floats, there: Mask) -> None:
        self.a, self.y, self.R, self.there = a, y, R, there
        self.normals = cross(y, a)

    @classmethod
    def of(cls, pairs: Pairs, R: Floats) -> Geometry:
        """Rays of the matches of pairs, turned by R (n, 3, 3) = c0_R_c1 of each pair."""
        a, b = (rays(x) for x in pairs.matches[:2])
        return cls(a, b @ R.transpose(0, 2, 1), R, pairs.there)

    def normals_at(self, place: NDArray[np.intp]) -> Floats:
        """Normals (..., n, 3) of one match (..., n) a pair."""
        return np.asarray(self.normals[np.arange(place.shape[-1]), place])

    @cached_property
    def _lines(self) -> Floats:
        """(4, n, k, 3): rows whose products with t are the first two components of t x y and of R^T (a x t)."""
        none = np.zeros_like(self.y[..., 0])
        first = np.stack([none, self.y[..., 2], -self.y[..., 1]], axis=-1)
        second = np.stack([-self.y[..., 2], none, self.y[..., 0]], axis=-1)
        return np.stack([first, second, *(cross(self.R[:, None, :, i], self.a) for i in range(2))])

    def scale(self, t: Floats) -> Floats:
        """s^2 (..., n, k) of `epipolar.sampson`, of baselines t (..., n, 3)."""
        return np.asarray(sum(((line @ t[..., None])[..., 0]) ** 2 for line in self._lines) + 1e-18)

    def square(self, t: Floats) -> Floats:
        """Squared Sampson residuals (..., n, k) of baselines t (..., n, 3)."""
        e = (self.normals @ t[..., None])[..., 0]
        return np.asarray(e**2 / self.scale(t))

    def fitted(self, weight: Floats) -> Floats:
        """Baselines (n, 3) of least squares of weighted matches (n, k)."""
        moment = (self.normals * weight[..., None]).transpose(0, 2, 1) @ self.normals
        return np.asarray(np.linalg.eigh(moment)[1][:, :, 0])

    def inverse_distance(self, t: Floats) -> tuple[Floats, Floats]:
        """Inverse distance (n, k) along the rays of the first image, in units of the baselines t (n, 3), and its sigma
        for one of the points."""
        across = cross(t[:, None], self.y)
        square = np.maximum((across**2).sum(axis=-1), 1e-18)
        return -(self.normals * across).sum(axis=-1) / square, np.linalg.norm(self.y, axis=-1) / np.sqrt(square)

    def plausible(self, t: Floats, sigma: Floats, inliers: Mask) -> Mask:
        """Mask (n, k) of points in front of both cameras, and not much nearer than most of the inliers.

        t : (n, 3) baselines with their sign; sigma : (n,) of a match
        """
        near, spread = self.inverse_distance(t)
        doubt = INLIER_SIGMAS * sigma[:, None] * spread
        ahead = near > -doubt
        usual = _median(near, inliers & ahead, NEAR_SHARE)[:, None]
        return np.asarray(ahead & (near < MUCH_NEARER * np.maximum(usual, 0.0) + doubt))

    def parallax(self) -> Floats:
        """Median angle (n,) between the rays of a match."""
        apart = np.linalg.norm(self.normals, axis=-1)
        angle = apart / np.maximum(np.linalg.norm(self.a, axis=-1) * np.linalg.norm(self.y, axis=-1), 1e-12)
        return _median(angle, self.there)


def _median(values: Floats, mask: Mask, share: float = 0.5) -> Floats:
    """Quantile (n,) of the values (n, k) under a mask; zero where there are none."""
    rank = (share * np.maximum(mask.sum(axis=1) - 1, 0)).astype(np.intp)
    ordered = np.sort(np.where(mask, values, np.inf), axis=1)[np.arange(len(values)), rank]
    return np.where(np.isfinite(ordered), ordered, 0.0)
