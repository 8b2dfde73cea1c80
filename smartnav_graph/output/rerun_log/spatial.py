"""Paths, poses, covariance, fixes: the three-dimensional scene (local ENU metres) and the map (degrees)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.events import REJECTED, USED, WITHHELD, Events, stops
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.session.session import Session

MOST_ELLIPSOIDS = 150
MOST_PATH_POINTS = 50_000
ELLIPSOID_SIGMAS = 3.0


@dataclass(frozen=True)
class Extent:
    """Box of the path in nav metres: `low`, `high` (3,), with some of its `points` (n, 3).

    `shift` (3,) is subtracted from everything drawn. The viewer has 32-bit floats: far from the origin (projected
    coordinates of a session without origin) they would lose decimetres, so whole kilometres are subtracted.
    """

    low: Floats
    high: Floats
    shift: Floats
    points: Floats

    @property
    def size(self) -> float:
        """Largest side in metres, at least 1."""
        return max(1.0, float((self.high - self.low).max()))

    @property
    def centre(self) -> Floats:
        """Centre (3,) m, as drawn."""
        return np.asarray((self.low + self.high) / 2 - self.shift)

    @property
    def floor(self) -> float:
        """Height of the lowest point, as drawn."""
        return float(self.low[2] - self.shift[2])


def finite_rows(points: Floats) -> Floats:
    """Rows without NaN: one such point makes the whole 3D view empty."""
    return points[np.isfinite(points).all(axis=1)]


def extent_of(session: Session, solution: Solution | None, causal: Solution | None) -> Extent | None:
    """Box of the first of solution, causal solution, reference, fixes and points that has positions."""
    candidates = [s.nav_t_body for s in (solution, causal) if s is not None]
    candidates += [session.reference.enu] if session.reference is not None else []
    streams = (session.gnss, session.pose_fixes, session.control)
    candidates += [session.nav_position(stream) for stream in streams if stream is not None]
    for points in map(finite_rows, candidates):
        if len(points):
            return extent_around(points)
    return None


def extent_around(points: Floats) -> Extent:
    """Box of points (n, 3) m, n >= 1."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre = (low + high) / 2
    shift = np.where(np.abs(centre) > 20_000.0, np.round(centre, -3), 0.0)
    return Extent(low, high, shift, thinned(points, 2000))


def nice(value: float) -> float:
    """The nearest 1, 2 or 5 times a power of ten at or below a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9)))


def ellipsoids(covariance: Floats) -> tuple[Floats, Floats]:
    """Half axes (n, 3) m of one sigma and quaternions (n, 4) x y z w of position covariances (n, 3, 3) in nav axes."""
    values, vectors = np.linalg.eigh(covariance)
    vectors[np.linalg.det(vectors) < 0, :, 0] *= -1.0  # eigenvectors may be a mirror; a quaternion cannot
    return np.sqrt(np.clip(values, 0.0, None)), np.asarray(Rotation.from_matrix(vectors).as_quat())


def magnification(covariance: Floats, size: float) -> float:
    """How many times larger the ellipsoids along the path are drawn, a round number.

    The 90 % quantile of their size reaches 1 % of the extent, unless the largest would then exceed 5 %. Ellipsoids
    that are that large anyway keep their true size; they shrink only where the largest would exceed 15 %.
    """
    spread = ELLIPSOID_SIGMAS * np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    largest = float(spread.max()) / size
    factor = min(0.01 * size / float(np.percentile(spread, 90)), 0.05 / largest)
    return 1.0 if factor < 1.0 and largest <= 0.15 else nice(factor)


def thinned(points: Floats, most: int = MOST_PATH_POINTS) -> Floats:
    """At most about `most` rows, evenly taken, the last one kept."""
    if len(points) <= most:
        return points
    return np.asarray(points[np.unique(np.linspace(0, len(points) - 1, most).astype(int))])


@dataclass(frozen=True)
class SpatialLog:
    """Writes positions to the 3D scene and, where an origin is known, to the map."""

    recorder: Recorder
    session: Session
    extent: Extent

    def local(self, enu: Floats) -> NDArray[np.float32]:
        """Nav metres as drawn, 32-bit."""
        return (enu - self.extent.shift).astype(np.float32)

    def path(self, name: str, enu: Floats, colour: list[int], width: float) -> None:
        """A polyline at /world/<name>/path and /geo/<name>."""
        points, thickness = thinned(finite_rows(enu)), rr.Radius.ui_points(width)
        if len(points) < 2:
            return
        self.recorder.static(
            f"/world/{name}/path", rr.LineStrips3D([self.local(points)], colors=colour, radii=thickness)
        )
        if self.session.frame is not None:
            lat_lon = self.session.frame.lla_from_nav(points)[:, :2]
            self.recorder.static(f"/geo/{name}", rr.GeoLineStrings(lat_lon=[lat_lon], colors=colour, radii=thickness))

    def points(self, path: str, enu: Floats, colour: list[int], size: float, labels: list[str] | None = None) -> None:
        """Points at /world/<path> and /geo/<path>."""
        good = np.isfinite(enu).all(axis=1)
        if not good.any():
            return
        names = None if labels is None else [labels[i] for i in np.flatnonzero(good)]
        radius = rr.Radius.ui_points(size)
        self.recorder.static(
            f"/world/{path}",
            rr.Points3D(
                self.local(enu[good]), colors=colour, radii=radius, labels=names, show_labels=names is not None
            ),
        )
        if self.session.frame is not None:
            lat_lon = self.session.frame.lla_from_nav(enu[good])[:, :2]
            self.recorder.static(f"/geo/{path}", rr.GeoPoints(lat_lon=lat_lon, colors=colour, radii=radius))

    def ellipsoids(self, path: str, t_ns: Times, enu: Floats, covariance: Floats, colour: list[int]) -> None:
        """The ellipsoid at the chosen time, at true size, at /world/<path>."""
        good = _known(covariance) & np.isfinite(enu).all(axis=1)
        half, quaternion = ellipsoids(covariance[good])
        columns = rr.Ellipsoids3D.columns(
            centers=self.local(enu[good]), half_sizes=ELLIPSOID_SIGMAS * half, quaternions=quaternion
        )
        self.recorder.rows(f"/world/{path}", t_ns[good], columns)
        style = rr.Ellipsoids3D.from_fields(colors=[*colour, 110], fill_mode="solid")
        self.recorder.style(f"/world/{path}", style)


def _known(covariance: Floats) -> Mask:
    """Whether each covariance (n, 3, 3) has an ellipsoid."""
    finite = np.isfinite(covariance).all(axis=(1, 2))
    return np.asarray(finite & (np.trace(covariance, axis1=1, axis2=2) > 0))


def log_solution(scene: SpatialLog, solution: Solution) -> float:
    """Path, moving body with axes and velocity, ellipsoids; returns the magnification of those along the path."""
    scene.path("est", solution.nav_t_body, colours.ESTIMATE, 1.5)
    good = np.isfinite(solution.nav_t_body).all(axis=1) & np.isfinite(solution.nav_R_body).all(axis=(1, 2))
    rows = np.flatnonzero(good)
    if not len(rows):
        return 1.0
    _log_body(scene, solution, rows)
    return _log_covariance(scene, solution, rows)


def _log_body(scene: SpatialLog, solution: Solution, rows: NDArray[np.intp]) -> None:
    recorder, t = scene.recorder, solution.t_ns[rows]
    at = scene.local(solution.nav_t_body[rows])
    quaternion = Rotation.from_matrix(solution.nav_R_body[rows]).as_quat(canonical=True)
    recorder.rows("/world/est/body", t, rr.Transform3D.columns(translation=at, quaternion=quaternion))
    recorder.style("/world/est/body", rr.TransformAxes3D(0.04 * scene.extent.size))
    velocity = np.nan_to_num(solution.nav_v_body[rows])
    recorder.rows("/world/est/velocity", t, rr.Arrows3D.columns(origins=at, vectors=velocity))
    style = rr.Arrows3D.from_fields(colors=colours.VELOCITY, radii=rr.Radius.ui_points(2.5))
    recorder.style("/world/est/velocity", style)
    if scene.session.frame is not None:
        lat_lon = scene.session.frame.lla_from_nav(solution.nav_t_body[rows])[:, :2]
        recorder.rows("/geo/body", t, rr.GeoPoints.columns(positions=lat_lon))
        recorder.style("/geo/body", rr.GeoPoints.from_fields(colors=colours.BODY, radii=rr.Radius.ui_points(8.0)))


def _log_covariance(scene: SpatialLog, solution: Solution, rows: NDArray[np.intp]) -> float:
    """The ellipsoid at the chosen time, true size, and some along the path, magnified by a round factor."""
    covariance = solution.covariance[rows][:, POS, POS]
    scene.ellipsoids("est/covariance", solution.t_ns[rows], solution.nav_t_body[rows], covariance, colours.COVARIANCE)
    known = _known(covariance)
    rows, covariance = rows[known], covariance[known]
    if not len(rows):
        return 1.0
    some = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST_ELLIPSOIDS)).astype(int))
    factor = magnification(covariance, scene.extent.size)
    half, quaternion = ellipsoids(covariance[some])
    scene.recorder.static(
        "/world/est/covariances",
        rr.Ellipsoids3D(
            centers=scene.local(solution.nav_t_body[rows[some]]),
            half_sizes=factor * ELLIPSOID_SIGMAS * half,
            quaternions=quaternion,
            colors=[*colours.COVARIANCE, 150],
            line_radii=rr.Radius.ui_points(0.5),
            fill_mode="majorwireframe",
        ),
    )
    return factor


def log_fixes(scene: SpatialLog, events: Events) -> None:
    """GNSS fixes by their use, the latest fix, and other positions."""
    session, recorder = scene.session, scene.recorder
    if session.gnss is not None:
        enu = session.nav_position(session.gnss)
        for name, use, colour, size in (
            ("fixes", USED, colours.FIX, 2.2),
            ("withheld", WITHHELD, colours.WITHHELD, 2.2),
            ("rejected", REJECTED, colours.REJECTED, 4.5),
        ):
            scene.points(f"gnss/{name}", enu[events.use["gnss"] == use], colour, size)
        used = events.use["gnss"] == USED
        t = session.gnss.t_ns[used]
        recorder.rows("/world/gnss/current", t, rr.Points3D.columns(positions=scene.local(enu[used])))
        style = rr.Points3D.from_fields(colors=colours.FIX, radii=rr.Radius.ui_points(6.0))
        recorder.style("/world/gnss/current", style)
        recorder.clear("/world/gnss/current", stops(t, events.end_ns))
    if session.pose_fixes is not None:
        scene.points("pose_fixes", session.nav_position(session.pose_fixes), colours.POSE_FIX, 4.0)
    if session.control is not None:
        names, first = np.unique(session.control.point_id.astype(str), return_index=True)
        enu = session.nav_position(session.control)[first]
        scene.points("control", enu, colours.CONTROL, 5.0, [str(name) for name in names])
    others = [stream for name, stream in session.positions().items() if name != "gnss"]
    rejected = [session.nav_position(stream)[events.use[stream.NAME] == REJECTED] for stream in others]
    scene.points("rejected", np.concatenate([np.zeros((0, 3)), *rejected]), colours.REJECTED, 6.0)
