"""The similarity from a map of unknown scale and frame to known positions: Umeyama's, with lever arms.

    nav_t_body = nav_R_map (s map_t_cam - map_t_lever) + nav_t_map,   map_t_lever = map_R_body body_t_cam  (metres)

The lever arms do not scale with the map, so scale and rotation are computed in turn, each in closed form.

Source: Umeyama (1991), Least-squares estimation of transformation parameters between two point patterns, PAMI 13(4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SolverError
from smartnav_graph.core.so3 import best_rotation

LEAST = 4  # positions: seven unknowns, and residuals
LEAST_WIDTH = 0.01  # width over length of the path: narrower is a line
LARGEST_ROTATION_SIGMA = np.radians(5.0)
ITERATIONS, CONVERGED = 100, 1e-12


@dataclass(frozen=True)
class Similarity:
    """s, nav_R_map (3, 3), nav_t_map (3,) m; `sigma` m of one coordinate from the residuals, and the
    standard deviations `rotation_sigma` (3,) rad of the rotation about the nav axes."""

    scale: float
    nav_R_map: Floats
    nav_t_map: Floats
    sigma: float
    rotation_sigma: Floats

    def positions(self, map_t_cam: Floats, map_t_lever: Floats) -> Floats:
        """nav_t_body (n, 3)."""
        return np.asarray((self.scale * map_t_cam - map_t_lever) @ self.nav_R_map.T + self.nav_t_map)


def fit_similarity(map_t_cam: Floats, map_t_lever: Floats, nav_t_body: Floats, where: str = "map") -> Similarity:
    """The similarity of least squares.

    Parameters
    ----------
    map_t_cam : (n, 3) camera centres, units of the map
    map_t_lever : (n, 3) m, from the body to the camera, in the axes of the map
    nav_t_body : (n, 3) m

    Raises
    ------
    SolverError
        Too few positions; all on one line or at one place, so that the rotation is not determined.
    """
    n = len(map_t_cam)
    if n < LEAST:
        raise SolverError(where, f"{n} images with a known position", f"at least {LEAST}", "give more positions")
    scale = _spread(nav_t_body) / max(_spread(map_t_cam), np.finfo(float).tiny)
    R = np.eye(3)
    for _ in range(ITERATIONS):
        R, _ = best_rotation(scale * map_t_cam - map_t_lever, nav_t_body)
        centred = map_t_cam - map_t_cam.mean(axis=0)
        before, scale = scale, float(np.sum(centred * (nav_t_body @ R + map_t_lever)) / np.sum(centred**2))
        if abs(scale - before) <= CONVERGED * abs(scale):
            break
    found = (scale * map_t_cam - map_t_lever) @ R.T
    shift = (nav_t_body - found).mean(axis=0)
    residual = nav_t_body - found - shift
    sigma = float(np.sqrt(np.sum(residual**2) / (3 * n - 7)))
    rotation_sigma = _rotation_sigma(found - found.mean(axis=0), sigma, where)
    return Similarity(scale, R, shift, sigma, rotation_sigma)


def _spread(x: Floats) -> float:
    return float(np.linalg.norm(x - x.mean(axis=0)))


def _rotation_sigma(centred: Floats, sigma: float, where: str) -> Floats:
    """Standard deviations (3,) rad of the rotation about the nav axes, from the extent of the positions."""
    length, width, _ = np.linalg.svd(centred, compute_uv=False)
    if not width > LEAST_WIDTH * length:
        found = f"the known positions lie on one line ({length / np.sqrt(len(centred)):.3g} m, RMS)"
        raise SolverError(where, found, "a path that turns (no rotation about a line)", "give more positions")
    moment = np.sum(centred**2) * np.eye(3) - centred.T @ centred
    covariance = sigma**2 * np.linalg.inv(moment)
    worst = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if worst > LARGEST_ROTATION_SIGMA:
        found = f"the rotation is known to {np.degrees(worst):.1f} deg only (positions fit to {sigma:.3g} m)"
        expected = f"{np.degrees(LARGEST_ROTATION_SIGMA):.0f} deg"
        raise SolverError(where, found, expected, "give better positions, or of a longer path")
    return np.asarray(np.sqrt(np.diag(covariance)))
