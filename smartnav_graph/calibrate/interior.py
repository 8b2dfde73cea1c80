"""Interior orientation of a camera from pictures of a flat board, with covariance.

    pixel = project_board(theta, R_v X + t_v) + noise,    theta = fx, fy, cx, cy, distortion

Least squares over theta and the pose of every view v; the poses are eliminated, which leaves for theta

    S = sum_v S_v,  S_v = A_v' A_v - A_v' B_v (B_v' B_v)^-1 B_v' A_v,   cov(theta) = s^2 S^-1

A_v, B_v : derivatives of the pixels of a view by theta and by its pose; s^2 : sum of squared residuals over degrees of
freedom. Errors within a view are not independent (blur, a board that is not flat, a model that does not fit): the
covariance is raised to what the scatter between views shows (`core.clustered`).

Source: Zhang (2000), A flexible new technique for camera calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.clustered import clustered_covariance
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.so3 import exp
from smartnav_graph.session.calibration.camera import Camera

# Models of a camera and their distortion coefficients.
MODELS = {
    "brown": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
PINHOLE = ("fx", "fy", "cx", "cy")
WHERE = "calibrate camera"
TILT = (
    "tilt the board by 20 to 45 deg to all sides, near enough to fill half of the picture; turns within its plane do "
    "not count"
)
LEAST_VIEWS = 4
LEAST_TILT_DEG = 8.0  # largest angle between the normals of two views
ALIKE_DEG, ALIKE_SHARE = 1.0, 0.02  # views that differ by less in turn, and in position over the distance, are one
OUTLIER = 3.0  # root mean square of a view over the median of all
LARGEST_FOCAL_SIGMA = 0.05  # over the focal length
_ITERATIONS, _CONVERGED = 60, 1e-10
_LEAST_PX = 1e-4  # noise of a corner, however exact
_NONLINEAR = 3.0  # largest factor by which the sum of squares departs from a parabola at two sigmas
_SINGULAR = 1e-13  # least eigenvalue of S with unit diagonal


@dataclass(frozen=True)
class BoardView:
    """One picture of the board: name, points of the board (n, 3) m, pixels (n, 2)."""

    name: str
    points: Floats
    xy: Floats


class Normal(NamedTuple):
    """One linearisation: residuals of each view (n, 2), derivatives by theta (2 n, p) reduced by the pose of the view,
    S (p, p), right side (p,), and what the steps of the poses need."""

    residuals: list[Floats]
    reduced: list[Floats]
    S: Floats
    g: Floats
    poses: list[tuple[Floats, Floats, Floats]]  # B' B, B' A, B' r

    @property
    def cost(self) -> float:
        """Sum of the squared residuals."""
        return float(sum((r**2).sum() for r in self.residuals))


@dataclass(frozen=True)
class CameraFit:
    """A calibration.

    model : one of `MODELS`; theta (p,), covariance (p, p) by `names`; poses (v, 6) : rotation vector and position of
    the board in camera axes, m; views, residuals : observed less projected, px, of each view
    noise_px : of one coordinate of a corner; inflation : of variances by errors that are not independent, 1 for none
    left_out : name of a view, reason
    """

    model: str
    width: int
    height: int
    theta: Floats
    covariance: Floats
    poses: Floats
    views: tuple[BoardView, ...]
    residuals: tuple[Floats, ...]
    noise_px: float
    inflation: float
    left_out: tuple[tuple[str, str], ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return (*PINHOLE, *MODELS[self.model])

    @property
    def sigmas(self) -> Floats:
        """Of the parameters (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def rms_px(self) -> float:
        """Root mean square of the distances between observed and projected corners, as OpenCV gives it."""
        squares = np.concatenate([(r**2).sum(axis=1) for r in self.residuals])
        return float(np.sqrt(squares.mean()))

    @property
    def view_rms_px(self) -> Floats:
        """The same of each view (v,)."""
        return np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in self.residuals])

    @property
    def camera(self) -> Camera:
        """As calibration.toml holds it."""
        return interior_camera(self.model, (self.width, self.height), self.theta)


def interior_camera(model: str, size: tuple[int, int], theta: Floats) -> Camera:
    """The camera of one of `MODELS` with the parameters (p,)."""
    fx, fy, cx, cy, *distortion = map(float, theta)
    return Camera(*size, fx, fy, cx, cy, "fisheye" if model == "fisheye" else "brown", tuple(distortion))


def project_board(model: str, theta: Floats, pose: Floats, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Pixels (n, 2) of points (n, 3), and their derivatives by theta (2 n, p) and by rotation vector and
    position (2 n, 6) of the board."""
    import cv2

    K = np.array([[theta[0], 0.0, theta[2]], [0.0, theta[1], theta[3]], [0.0, 0.0, 1.0]])
    distortion = np.ascontiguousarray(theta[4:])
    if model == "fisheye":
        xy, J = cv2.fisheye.projectPoints(points[:, None], pose[:3], pose[3:], K, distortion)
        return xy.reshape(-1, 2), J[:, :8], J[:, 8:14]
    xy, J = cv2.projectPoints(points, pose[:3], pose[3:], K, distortion)
    return xy.reshape(-1, 2), J[:, 6 : 6 + len(theta)], J[:, :6]


def pose_of(found: CameraFit, view: BoardView) -> Floats:
    """Rotation vector and position (6,) of the board in a view, by the calibration."""
    import cv2

    xy = np.ascontiguousarray(found.camera.normalised(view.xy))
    _, turn, place = cv2.solvePnP(view.points, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    turn, place = cv2.solvePnPRefineLM(view.points, xy, np.eye(3), None, turn, place)
    return np.concatenate([turn.ravel(), place.ravel()])


def linearise(model: str, theta: Floats, poses: Floats, views: Sequence[BoardView]) -> Normal:
    """Residuals and normal matrix of theta."""
    projected = (project_board(model, theta, pose, view.points) for view, pose in zip(views, poses, strict=True))
    return normal_of(len(theta), ((view.xy - xy, A, B) for view, (xy, A, B) in zip(views, projected, strict=True)))


def normal_of(p: int, views: Iterable[tuple[Floats, Floats, Floats]]) -> Normal:
    """Of residuals (n, 2) of views, their derivatives by theta (2 n, p), and by the pose of each (2 n, 6)."""
    S, g = np.zeros((p, p)), np.zeros(p)
    residuals, reduced, kept = [], [], []
    for r, A, B in views:
        BB, BA, Br = B.T @ B, B.T @ A, B.T @ r.ravel()
        A_v = A - B @ np.linalg.solve(BB, BA)
        S += A_v.T @ A_v
        g += A_v.T @ r.ravel()
        residuals.append(r)
        reduced.append(A_v)
        kept.append((BB, BA, Br))
    return Normal(residuals, reduced, S, g, kept)


def minimise_views(
    linearised: Callable[[Floats, Floats], Normal], theta: Floats, poses: Floats
) -> tuple[Floats, Floats, Normal]:
    """Levenberg-Marquardt over theta and the poses; where it does not converge, S is nearly singular."""
    now, damping = linearised(theta, poses), 1e-6
    for _ in range(_ITERATIONS):
        step = np.linalg.solve(now.S + damping * np.diag(np.diag(now.S)), now.g)
        moves = [np.linalg.solve(BB, Br - BA @ step) for BB, BA, Br in now.poses]
        tried = linearised(theta + step, poses + np.array(moves))
        if tried.cost <= now.cost:
            small = now.cost - tried.cost <= _CONVERGED * now.cost
            theta, poses, now, damping = theta + step, poses + np.array(moves), tried, max(damping / 10, 1e-12)
            if small:
                return theta, poses, now
        elif damping > 1e8:
            break
        else:
            damping *= 10
    return theta, poses, now


def _fit(model: str, size: tuple[int, int], views: Sequence[BoardView], theta: Floats, poses: Floats) -> CameraFit:
    theta, poses, normal = minimise_views(lambda t, p: linearise(model, t, p, views), theta, poses)
    names = (*PINHOLE, *MODELS[model])
    scale = np.sqrt(np.diag(normal.S))
    values, axes = np.linalg.eigh(normal.S / np.outer(scale, scale))
    worst = names[int(np.argmax(np.abs(axes[:, 0])))]
    check_orientations(views, poses)
    if not values[0] > _SINGULAR:
        raise _open_term(model, worst)
    freedom = sum(r.size for r in normal.residuals) - len(theta) - 6 * len(views)
    variance = normal.cost / freedom
    variance = max(variance, _LEAST_PX**2)
    step = axes[:, 0] / scale / np.sqrt(values[0] / variance)  # one sigma in the direction that is known least
    if not _is_linear(model, theta, poses, views, normal, step, variance):
        raise _open_term(model, worst)
    scores = np.array([A.T @ r.ravel() for A, r in zip(normal.reduced, normal.residuals, strict=True)])
    covariance = clustered_covariance(np.array([A.T @ A for A in normal.reduced]), scores, variance)
    f = float(np.trace(covariance @ normal.S)) / (variance * len(theta))
    residuals = tuple(normal.residuals)
    return CameraFit(model, *size, theta, covariance, poses, tuple(views), residuals, float(np.sqrt(variance)), f)


def _open_term(model: str, name: str) -> CalibrationError:
    if name in PINHOLE:
        remedy = TILT
    else:
        remedy = "take a model with fewer terms, or views with the board near the edges of the picture"
    found = f"{name} of model {model} has no finite interval: other terms can replace it"
    return CalibrationError(WHERE, found, "views that determine it", remedy)


def _is_linear(
    model: str, theta: Floats, poses: Floats, views: Sequence[BoardView], best: Normal, step: Floats, variance: float
) -> bool:
    """Whether two sigmas along `step` raise the sum of squares by four variances, within a factor."""
    for sign in (-2.0, 2.0):
        moved = theta + sign * step
        there = poses + np.array([-np.linalg.solve(BB, BA @ (sign * step)) for BB, BA, _ in best.poses])
        for _ in range(3):
            now = linearise(model, moved, there, views)
            there = there + np.array([np.linalg.solve(BB, Br) for BB, _, Br in now.poses])
        rise = (linearise(model, moved, there, views).cost - best.cost) / (4.0 * variance)
        if not 1.0 / _NONLINEAR < rise < _NONLINEAR:
            return False
    return True


def calibrate_camera(
    views: Sequence[BoardView], size: tuple[int, int], model: str = "brown", *, keep: bool = False
) -> CameraFit:
    """The camera that took these views, of pictures of `size` (width, height) px.

    A view is left out where its residuals exceed `OUTLIER` times the median of all views, one after the other, unless
    all are to be kept.

    Raises
    ------
    CalibrationError
        Too few or alike views, one orientation of the board only, or a term that the views do not determine.
    """
    check_count(views)
    theta, poses = _start(model, size, views)
    left_out: list[tuple[str, str]] = []
    while True:
        found = _fit(model, size, views, theta, poses)
        rms = found.view_rms_px
        worst, usual = int(np.argmax(rms)), float(np.median(rms))
        if keep or rms[worst] <= OUTLIER * usual or len(views) <= LEAST_VIEWS:
            break
        why = f"residuals of {rms[worst]:.2f} px, {rms[worst] / usual:.1f} times the median of all views"
        left_out.append((views[worst].name, why))
        views = [view for i, view in enumerate(views) if i != worst]
        theta, poses = found.theta, np.delete(found.poses, worst, axis=0)
    _check_focal(found)
    return replace(found, left_out=tuple(left_out))


def _start(model: str, size: tuple[int, int], views: Sequence[BoardView]) -> tuple[Floats, Floats]:
    """First theta (p,) and poses (v, 6)."""
    import cv2

    if model == "fisheye":
        return _fisheye_start(size, views)
    points, xy = ([np.ascontiguousarray(part, np.float32) for part in parts] for parts in _parts(views))
    fixed = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, K, k, turns, places = cv2.calibrateCamera(points, xy, size, None, None, flags=fixed)
    except cv2.error as error:
        found = "OpenCV finds no first values"
        raise CalibrationError(WHERE, found, "a flat board in every view", "check --board") from error
    theta = np.zeros(len(PINHOLE) + len(MODELS[model]))
    theta[:6] = K[0, 0], K[1, 1], K[0, 2], K[1, 2], *k.ravel()[:2]
    return theta, np.hstack([np.reshape(turns, (-1, 3)), np.reshape(places, (-1, 3))])


def _parts(views: Sequence[BoardView]) -> tuple[list[Floats], list[Floats]]:
    return [view.points for view in views], [view.xy for view in views]


def _fisheye_start(size: tuple[int, int], views: Sequence[BoardView]) -> tuple[Floats, Floats]:
    """The best of some focal lengths, from a picture over 250 deg to one over 70 deg of equal angles."""
    width, height = size
    best: tuple[Floats, Floats, Normal] | None = None
    for degrees in (250.0, 180.0, 130.0, 100.0, 70.0):
        f = max(size) / np.radians(degrees)
        theta = np.array([f, f, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0, 0.0, 0.0])
        poses = _fisheye_poses(theta, views)
        if poses is None:
            continue
        try:
            found = minimise_views(lambda t, p: linearise("fisheye", t, p, views), theta, poses)
        except (CalibrationError, np.linalg.LinAlgError):
            continue
        if np.isfinite(found[2].cost) and (best is None or found[2].cost < best[2].cost):
            best = found
    if best is None:
        raise CalibrationError(WHERE, "no first values for model fisheye", "views of one lens", "try --model rational")
    return best[0], best[1]


def _fisheye_poses(theta: Floats, views: Sequence[BoardView]) -> Floats | None:
    import cv2

    f, centre, found = theta[0], theta[2:4], []
    for view in views:
        from_axis = (view.xy - centre) / f
        angle = np.linalg.norm(from_axis, axis=1)
        near = angle < 1.3  # rad: the tangent is that of a picture in front
        if near.sum() < 8:
            return None
        flat = from_axis[near] * (np.tan(angle[near]) / np.maximum(angle[near], 1e-9))[:, None]
        there, turn, place = cv2.solvePnP(view.points[near], flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        if not there:
            return None
        found.append(np.concatenate([turn.ravel(), place.ravel()]))
    return np.array(found)


def check_count(views: Sequence[BoardView]) -> None:
    """Refuse too few views."""
    if len(views) < LEAST_VIEWS:
        remedy = "take 15 to 30 pictures with the board at different places, tilts and distances"
        raise CalibrationError(WHERE, f"the board in {len(views)} pictures", f"at least {LEAST_VIEWS}", remedy)


def check_orientations(views: Sequence[BoardView], poses: Floats) -> None:
    """Refuse views that are alike, or in which the board has one orientation only."""
    from scipy.spatial.transform import Rotation

    R = exp(poses[:, :3])
    distinct: list[int] = []
    for i in range(len(poses)):
        turns = Rotation.from_matrix(R[distinct] @ R[i].T).magnitude() if distinct else np.zeros(0)
        apart = np.linalg.norm(poses[distinct, 3:] - poses[i, 3:], axis=1) / np.linalg.norm(poses[i, 3:])
        if not ((turns < np.radians(ALIKE_DEG)) & (apart < ALIKE_SHARE)).any():
            distinct.append(i)
    if len(distinct) < LEAST_VIEWS:
        apart_by = f"{ALIKE_DEG:g} deg or {ALIKE_SHARE:.0%} of the distance"
        what = f"{len(poses)} views, of which {len(distinct)} differ by {apart_by}"
        raise CalibrationError(WHERE, what, f"at least {LEAST_VIEWS}", "move and tilt the board between pictures")
    normals = R[:, :, 2]
    tilt = float(np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T), 0.0, 1.0)).max()))
    if tilt < LEAST_TILT_DEG:
        found = f"one orientation of the board: its normals differ by {tilt:.1f} deg at most"
        raise CalibrationError(WHERE, found, f"at least {LEAST_TILT_DEG:g} deg, else the focal length is open", TILT)


def _check_focal(found: CameraFit) -> None:
    share = float((found.sigmas[:2] / found.theta[:2]).max())
    if share > LARGEST_FOCAL_SIGMA:
        what = f"focal length {found.theta[0]:.0f} +- {found.sigmas[0]:.0f} px"
        raise CalibrationError(WHERE, what, f"a sigma of at most {LARGEST_FOCAL_SIGMA:.0%}", TILT)
