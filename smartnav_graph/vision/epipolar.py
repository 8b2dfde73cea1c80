"""Coplanarity of two rays and the baseline between them, with exact derivatives.

Of a match (x0, x1) in undistorted normalised coordinates and the second camera's pose (R, t) in the first one's axes,
X0 = R X1 + t:

    e = x0~^T E x1~,  E = [t]x R,       l0 = E x1~,  l1 = E^T x0~
    r = e / s,        s^2 = l0_x^2 + l0_y^2 + l1_x^2 + l1_y^2 + floor^2

r is the distance (to first order) by which the match misses the epipolar geometry, in normalised units; it does not
depend on the length of t. The floor keeps pairs without a baseline harmless: there e and its derivatives vanish.

Source: Sampson (1982), Fitting conic sections to very scattered data; Luong, Faugeras (1996), The fundamental matrix,
IJCV 17(1), 4.2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Sampson(NamedTuple):
    """Residuals (m,) and their derivatives (m, 3) by rotation (R <- R Exp(w)) and by translation."""

    residual: Floats
    by_rotation: Floats
    by_translation: Floats


def rays(xy_n: Floats) -> Floats:
    """Homogeneous coordinates (m, 3) of points (m, 2)."""
    return np.column_stack([xy_n, np.ones(len(xy_n))])


def essential(R: Floats, t: Floats) -> Floats:
    """E (..., 3, 3) = [t]x R of c0_R_c1 (..., 3, 3) and c0_t_c1 (..., 3)."""
    return np.asarray(np.cross(t[..., None, :], np.swapaxes(R, -1, -2)).swapaxes(-1, -2))


def sampson(R: Floats, t: Floats, x0: Floats, x1: Floats, floor: float = 0.0) -> Sampson:
    """How far matches miss the epipolar geometry of their cameras.

    Parameters
    ----------
    R : (m, 3, 3) or (3, 3), c0_R_c1
    t : (m, 3) or (3,), c0_t_c1; without a floor only its direction matters
    x0, x1 : (m, 2) undistorted normalised coordinates
    floor : length in units of t, below which a baseline says little
    """
    a, b = rays(x0), rays(x1)
    y = _turned(R, b)
    t = np.broadcast_to(t, y.shape)
    l0 = np.cross(t, y)
    l1 = _turned_back(R, np.cross(a, t))
    g0, g1 = _flat(l0), _flat(l1)
    e = np.einsum("mi,mi->m", a, l0)
    square = np.einsum("mi,mi->m", g0, g0) + np.einsum("mi,mi->m", g1, g1) + floor**2
    s = np.sqrt(np.maximum(square, np.finfo(float).tiny))
    shrink = (e / s**2)[:, None]
    by_t = np.cross(y, a) - shrink * (np.cross(y, g0) - np.cross(a, _turned(R, g1)))
    by_w = np.cross(b, l1) - shrink * (np.cross(b, _turned_back(R, np.cross(g0, t))) - np.cross(l1, g1))
    return Sampson(e / s, by_w / s[:, None], by_t / s[:, None])


def _flat(lines: Floats) -> Floats:
    """Lines with their third component left out."""
    out = lines.copy()
    out[:, 2] = 0.0
    return out


def _turned(R: Floats, x: Floats) -> Floats:
    """R x, row by row."""
    return np.asarray((R @ x[:, :, None])[:, :, 0]) if R.ndim == 3 else x @ R.T


def _turned_back(R: Floats, x: Floats) -> Floats:
    """R^T x, row by row."""
    return _turned(np.swapaxes(R, -1, -2), x)
