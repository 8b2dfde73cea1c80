"""Two cameras on one body, from pictures of a board that both took at the same moments.

    right pixel = project_board(theta_r, R (R_v X + t_v) + t),    x_right = R x_left + t

Least squares over both cameras, R, t and the pose of every pair of views; the poses are eliminated as in `interior`,
and the covariance is raised to what pairs show. Lengths are those of the board. Source: Zhang (2000), see `interior`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from smartnav_graph.calibrate.board import Board
from smartnav_graph.calibrate.camera import INTERIOR, find_views, left_out_lines, picture_files
from smartnav_graph.calibrate.interior import (
    LEAST_VIEWS,
    OUTLIER,
    BoardView,
    CameraFit,
    Normal,
    calibrate_camera,
    interior_camera,
    minimise_views,
    normal_of,
    pose_of,
    project_board,
)
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.clustered import clustered_covariance
from smartnav_graph.core.errors import CalibrationError, ConfigError
from smartnav_graph.core.so3 import exp, log
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Residual, Value

WHERE = "calibrate stereo"
PAIRING = "name pictures that were taken at the same moment by the same number, as left01.jpg and right01.jpg"

Pair = tuple[BoardView, BoardView]


@dataclass(frozen=True, kw_only=True)
class StereoOptions:
    """Two cameras on one body, from two folders of pictures of a board that were taken at the same moments (alike
    numbers in their names): both cameras, and turn and baseline between them.
    """

    board: str = ""
    """As for smartnav calibrate camera: chessboard:9x6:0.025 (inner corners, side of a square in m) ..."""
    model: Literal["brown", "rational", "fisheye"] = "brown"
    """Distortion of both: as for smartnav calibrate camera."""
    cameras: tuple[str, str] = ("cam0", "cam1")
    """Names of the left and the right camera, as images of sessions carry them."""


@dataclass(frozen=True)
class StereoFit:
    """theta : of the left camera (p,), of the right one (p,), rotation vector and position (6,) of x_right = R x_left +
    t; covariance : of these; residuals : px, of each pair, left and right (n, 2); left_out : name of a pair, reason"""

    theta: Floats
    covariance: Floats
    residuals: tuple[Floats, ...]
    pairs: tuple[Pair, ...]
    left_out: tuple[tuple[str, str], ...]

    @property
    def rms_px(self) -> float:
        """Of the distances between observed and projected corners."""
        return float(np.sqrt(np.concatenate([(r**2).sum(axis=1) for r in self.residuals]).mean()))


def fit(sources: Sequence[Path], options: StereoOptions) -> CalibrationResult:
    """Calibrate two cameras by pairs of pictures.

    Raises
    ------
    CalibrationError
        Not two folders, too few pairs, or what a camera alone refuses.
    """
    if not options.board:
        expected = "what the pictures show, as chessboard:9x6:0.025"
        raise ConfigError("--board", "is missing", expected, "see smartnav calibrate stereo --help")
    if len(sources) != 2:
        remedy = "give the folder of the left camera, then that of the right one"
        raise CalibrationError(WHERE, f"{len(sources)} sources", "two folders of pictures", remedy)
    board = Board.parse(options.board)
    seen = [find_views(picture_files([s], name), board) for s, name in zip(sources, options.cameras, strict=True)]
    alone = [calibrate_camera(found.views, found.size, options.model) for found in seen]
    pairs, unpaired = paired(alone[0].views, alone[1].views)
    found = calibrate_stereo(alone[0], alone[1], pairs)
    by_camera = [one for s, a in zip(seen, alone, strict=True) for one in (*s.left_out, *a.left_out)]
    dropped = [*by_camera, *unpaired, *found.left_out]
    warnings = [text for part in seen for text in part.warnings]
    return _result(found, alone, options, [*left_out_lines(dropped), *warnings])


def pair_numbers(left: Sequence[str], right: Sequence[str]) -> list[list[str]]:
    """The numbers of every file name of both folders, by which pictures are paired. Leading ones that all names of a
    folder share are left out: the camera's own, as in cam0_0001.png and cam1_0001.png."""
    parts = [[[str(int(part)) for part in re.findall(r"\d+", Path(n).stem)] for n in names] for names in (left, right)]
    while all(_shared(names) for names in parts):
        parts = [[numbers[1:] for numbers in names] for names in parts]
    return [["_".join(numbers) for numbers in names] for names in parts]


def _shared(names: Sequence[Sequence[str]]) -> bool:
    """Whether all names of a folder begin with one number, and have others."""
    return len(names) > 1 and min(map(len, names)) > 1 and len({numbers[0] for numbers in names}) == 1


def paired(left: Sequence[BoardView], right: Sequence[BoardView]) -> tuple[list[Pair], list[tuple[str, str]]]:
    """Views of the same number, and those without counterpart, with the reason.

    Raises
    ------
    CalibrationError
        Two pictures of one camera have one number, or too few have a counterpart.
    """
    keys = pair_numbers([view.name for view in left], [view.name for view in right])
    tables = [dict(zip(numbers, views, strict=True)) for numbers, views in zip(keys, (left, right), strict=True)]
    for table, views in zip(tables, (left, right), strict=True):
        if len(table) < len(views):
            found = f"{len(views)} pictures as {views[0].name} with {len(table)} numbers"
            raise CalibrationError(WHERE, found, "one number each", PAIRING)
    both = [key for key in tables[0] if key in tables[1]]
    if len(both) < LEAST_VIEWS:
        found = f"{len(both)} pairs of {len(left)} and {len(right)} views"
        raise CalibrationError(WHERE, found, f"at least {LEAST_VIEWS}", PAIRING)
    alone = [(v.name, "no view of the other camera") for t in tables for key, v in t.items() if key not in both]
    return [(tables[0][key], tables[1][key]) for key in both], alone


def calibrate_stereo(left: CameraFit, right: CameraFit, pairs: Sequence[Pair]) -> StereoFit:
    """Both cameras and their relative pose, without pairs whose residuals exceed `OUTLIER` times the median."""
    poses = np.array([pose_of(left, view) for view, _ in pairs])
    ordered = [_same_order(left, right, pair) for pair in pairs]
    between = np.array([_relative(left, right, pair) for pair in ordered])
    middle = between[int(np.argmin([np.linalg.norm(between[:, :3] - b[:3], axis=1).sum() for b in between]))]
    theta, left_out = np.concatenate([left.theta, right.theta, middle]), list[tuple[str, str]]()
    while True:
        theta, poses, normal = minimise_views(_linearised(left.model, right.model, ordered), theta, poses)
        rms = np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in normal.residuals])
        worst, usual = int(np.argmax(rms)), float(np.median(rms))
        if rms[worst] <= OUTLIER * usual or len(ordered) <= LEAST_VIEWS:
            break
        why = f"residuals of {rms[worst]:.2f} px, {rms[worst] / usual:.1f} times the median of all pairs"
        left_out.append((ordered[worst][0].name, why))
        ordered, poses = [p for i, p in enumerate(ordered) if i != worst], np.delete(poses, worst, axis=0)
    freedom = sum(r.size for r in normal.residuals) - len(theta) - 6 * len(ordered)
    variance = max(normal.cost / freedom, 1e-8)
    scores = np.array([A.T @ r.ravel() for A, r in zip(normal.reduced, normal.residuals, strict=True)])
    covariance = clustered_covariance(np.array([A.T @ A for A in normal.reduced]), scores, variance)
    return StereoFit(theta, covariance, tuple(normal.residuals), tuple(ordered), tuple(left_out))


def _relative(left: CameraFit, right: CameraFit, pair: Pair) -> Floats:
    """Rotation vector and position (6,) of x_right = R x_left + t by one pair."""
    one, two = pose_of(left, pair[0]), pose_of(right, pair[1])
    R = exp(two[:3]) @ exp(one[:3]).T
    return np.concatenate([log(R), two[3:] - R @ one[3:]])


def _same_order(left: CameraFit, right: CameraFit, pair: Pair) -> Pair:
    """The pair with corners in one order: a board that looks the same upside down may be found so in one picture."""
    one, two = pair
    if one.points.shape != two.points.shape or not np.array_equal(one.points, two.points):
        return pair  # numbered corners of which each picture shows some
    turned = replace(two, xy=two.xy[::-1])
    sizes = [float(np.linalg.norm(_relative(left, right, (one, view))[:3])) for view in (two, turned)]
    return (one, two) if sizes[0] <= sizes[1] else (one, turned)


def _linearised(left: str, right: str, pairs: Sequence[Pair]) -> Callable[[Floats, Floats], Normal]:
    """Residuals and normal matrix by both cameras and their relative pose."""
    return lambda theta, poses: normal_of(
        len(theta), (_of_pair(left, right, theta, *both) for both in zip(pairs, poses, strict=True))
    )


def _of_pair(left: str, right: str, theta: Floats, pair: Pair, pose: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals (n, 2), derivatives by theta (2 n, p) and by the pose of the board in the left camera (2 n, 6)."""
    import cv2

    one, two = pair
    middle, between = (len(theta) - 6) // 2, theta[-6:]
    xy, A, B = project_board(left, theta[:middle], pose, one.points)
    turn, place, *by = cv2.composeRT(pose[:3], pose[3:], between[:3], between[3:])
    there = np.concatenate([turn.ravel(), place.ravel()])
    seen, A_r, B_r = project_board(right, theta[middle:-6], there, two.points)
    drdr1, drdt1, drdr2, drdt2, dtdr1, dtdt1, dtdr2, dtdt2 = by
    by_pose, by_between = np.block([[drdr1, drdt1], [dtdr1, dtdt1]]), np.block([[drdr2, drdt2], [dtdr2, dtdt2]])
    by_theta = np.zeros((len(A) + len(A_r), len(theta)))
    by_theta[: len(A), :middle], by_theta[len(A) :, middle:-6], by_theta[len(A) :, -6:] = A, A_r, B_r @ by_between
    return np.concatenate([one.xy - xy, two.xy - seen]), by_theta, np.concatenate([B, B_r @ by_pose])


def _result(
    found: StereoFit, alone: Sequence[CameraFit], options: StereoOptions, warnings: Sequence[str]
) -> CalibrationResult:
    sigmas, middle = np.sqrt(np.diag(found.covariance)), (len(found.theta) - 6) // 2
    names = [f"{camera}_{name}" for camera in options.cameras for name in alone[0].names]
    units = (["px"] * 4 + ["1"] * (middle - 4)) * 2
    rows = zip(names, found.theta, sigmas, units, strict=False)
    values = {name: Value(float(value), float(sigma), unit) for name, value, sigma, unit in rows}
    turn, place = found.theta[-6:-3], found.theta[-3:]
    beside = list(zip("xyz", turn, sigmas[-6:-3], place, sigmas[-3:], strict=True))
    values |= {f"turn_{a}": Value(float(np.degrees(w)), float(np.degrees(s)), "deg") for a, w, s, _, _ in beside}
    values |= {f"shift_{a}": Value(float(t), float(s), "m") for a, _, _, t, s in beside}
    base = float(np.linalg.norm(place))
    along = place / base
    values["baseline"] = Value(base, float(np.sqrt(along @ found.covariance[-3:, -3:] @ along)), "m")
    values["rms"] = Value(found.rms_px, np.nan, "px")
    residuals = {
        pair[0].name: Residual(float(np.sqrt((r**2).sum(axis=1).mean())), len(r), "px")
        for pair, r in zip(found.pairs, found.residuals, strict=True)
    }
    number = np.arange(1.0, len(found.pairs) + 1)
    dots = Series("root mean square", number, np.array([r.rms for r in residuals.values()]), "dots")
    chart = Chart("Residuals of pairs", "Pair", "Residual [px]", (dots,))
    thetas = (found.theta[:middle], found.theta[middle:-6])
    cameras = [interior_camera(a.model, (a.width, a.height), theta) for a, theta in zip(alone, thetas, strict=True)]

    def change(known: Calibration) -> Calibration:
        both = dict(known.cameras)
        for name, camera in zip(options.cameras, cameras, strict=True):
            before = both.get(name)
            both[name] = camera if before is None else replace(before, **{k: getattr(camera, k) for k in INTERIOR})
        left, right = (both[name] for name in options.cameras)
        if left.body_R:
            axes = np.reshape(left.body_R, (3, 3)) @ exp(turn).T
            both[options.cameras[1]] = replace(
                right, body_R=tuple(axes.ravel().tolist()), boresight_sigma_deg=left.boresight_sigma_deg
            )
            if left.body_t:  # the right camera is where x_right = 0
                centre = np.asarray(left.body_t) - axes @ place
                both[options.cameras[1]] = replace(both[options.cameras[1]], body_t=tuple(centre.tolist()))
        return replace(known, cameras=both)

    order = (*names, *(f"turn_{a}" for a in "xyz"), *(f"shift_{a}" for a in "xyz"))
    scale = np.concatenate([np.ones(len(names)), np.full(3, np.degrees(1.0)), np.ones(3)])
    covariance = found.covariance * np.outer(scale, scale)
    return CalibrationResult(
        values, residuals, {}, tuple(warnings), change, (chart,), order, tuple(covariance.ravel().tolist())
    )
