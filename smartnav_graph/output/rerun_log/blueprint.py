"""The layout of the viewer: only views that have data, ordered by the kind of recording."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.archetypes import TextLogColumns
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors import title_of
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.rerun_log import colours, signals
from smartnav_graph.output.rerun_log.cameras import CameraView
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.output.rerun_log.spatial import Extent, nice
from smartnav_graph.session.session import Session

View: TypeAlias = rrb.View | rrb.Container

Names = tuple[tuple[str, str], ...]

_MOTION: Names = (
    ("Speed m/s", "/motion/speed"),
    ("Heading, pitch, roll °", "/motion/attitude"),
    ("Height m", "/motion/height"),
)
_ACCURACY: Names = (
    ("Position error m", "/error/position"),
    ("Rotation error °", "/error/rotation"),
    ("Position σ m", "/sigma/position"),
    ("Heading σ °", "/sigma/heading"),
)
_BIASES: Names = (
    ("Accelerometer bias m/s²", "/bias/accel"),
    ("Gyroscope bias rad/s", "/bias/gyro"),
)
_UPDATES: Names = (
    ("Updates: states (latency ms in latency.rrd)", "/update/effort"),
    ("Change of earlier states m", "/update/change"),
    ("Rejected measurements by update", "/update/rejected"),
    ("Matches of image pairs", "/pairs/matches"),
)

# The viewer's vertical opening angle, a picture 1.6 times as wide as high, and the share of it that is filled.
OPENING_DEG, ASPECT, FILLED = 55.0, 1.6, 0.85
# A scene too small for a map, m.
SMALL = 50.0
# Distance of the view behind the body, as a share of the scene.
NEAR = 0.25


def recording_kind(recorder: Recorder, session: Session, solution: Solution | None) -> str:
    """``calibration`` (signals without a path), ``session`` (not solved yet), ``vision``, ``car`` (outdoors) or
    ``indoor``."""
    if solution is None:
        return "calibration" if not recorder.has("/world") else "session"
    if recorder.has("/pairs") or any("/image" in path for path in recorder.paths):
        return "vision"
    return "car" if session.gnss is not None else "indoor"


# The signal that each kind shows first.
_FIRST = {"car": "/motion/speed", "indoor": "/motion/height", "vision": "/motion/attitude"}


def build(
    recorder: Recorder,
    session: Session,
    solution: Solution | None,
    extent: Extent | None,
    factor: float,
    views: list[CameraView],
) -> rrb.Blueprint:
    """Left the path with graph, report, map and cameras; right the plots over time. `factor` magnifies the ellipsoids
    of the path."""
    kind = recording_kind(recorder, session, solution)
    flat_views = _flat_views(recorder, session, extent, views)
    flat = _single(flat_views, lambda: rrb.Horizontal(*flat_views))
    left = _stack([_tabs(_scenes(recorder, solution, extent, factor)), flat], [1, 1] if kind == "vision" else [3, 2])
    right = _right(recorder, session, solution, kind)
    sides = [side for side in (left, right) if side is not None]
    return rrb.Blueprint(
        rrb.Horizontal(*sides, column_shares=[3, 2][: len(sides)]),
        rrb.TimePanel(timeline="elapsed", state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _stack(parts: list[View | None], shares: list[float]) -> View | None:
    there = [(part, share) for part, share in zip(parts, shares, strict=True) if part is not None]
    views = [part for part, _ in there]
    return _single(views, lambda: rrb.Vertical(*views, row_shares=[share for _, share in there]))


def _tabs(views: list[View]) -> View | None:
    return _single(views, lambda: rrb.Tabs(*views, active_tab=0))


def _single(views: list[View], container: Callable[[], View]) -> View | None:
    """A container of several views; a single view alone."""
    return container() if len(views) > 1 else views[0] if views else None


def _scenes(recorder: Recorder, solution: Solution | None, extent: Extent | None, factor: float) -> list[View]:
    views: list[View] = []
    if extent is not None and recorder.has("/world"):
        name = "Path (ENU)"
        if recorder.has("/world/est/covariances"):
            name += f", 3σ ellipsoids ×{factor:g}"
        views.append(world_view(name, extent, np.array([0.35, 0.62, -0.7]), [0.0, 0.0, 1.0]))
        if solution is not None and recorder.has("/world/est/body"):
            views.append(_behind_body(solution, extent))
    if recorder.has("/graph"):
        (left, top), (right, bottom) = recorder.bounds["/graph"]
        bounds = rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])
        views.append(rrb.GraphView(name="Factor graph", origin="/graph", visual_bounds=bounds))
    documents = (("Report", "/report"), ("States of the session", "/states"), ("Legend", "/legend"))
    views += [rrb.TextDocumentView(name=name, origin=path) for name, path in documents if recorder.has(path)]
    return views


def _behind_body(solution: Solution, extent: Extent) -> rrb.Spatial3DView:
    """The scene from behind and above the moving body: with camera, velocity and the ellipsoid at true size."""
    ahead, _, up = frames.body_R_vehicle(solution.forward, solution.up).T
    near = NEAR * extent.size
    return rrb.Spatial3DView(
        name="Behind the body",
        origin="/world/est/body",
        contents=["/world/**", "- /world/est/covariances"],
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(position=near * (0.5 * up - ahead), look_target=near * (0.5 * ahead), eye_up=up),
    )


def world_view(name: str, extent: Extent, direction: Floats, up: list[float]) -> rrb.Spatial3DView:
    """The scene seen along `direction`, from where everything is visible."""
    return rrb.Spatial3DView(
        name=name,
        origin="/world",
        contents=["/world/**"],
        line_grid=rrb.LineGrid3D(
            visible=True,
            spacing=nice(extent.size / 10),
            plane=rr.components.Plane3D.XY.with_distance(extent.floor),
            color=colours.GRID,
        ),
        eye_controls=rrb.EyeControls3D(
            position=eye_position(extent, direction, np.array(up)), look_target=extent.centre, eye_up=up
        ),
    )


def eye_position(extent: Extent, direction: Floats, up: Floats) -> Floats:
    """Nearest eye (3,) on the line through the centre along `direction` that sees every point.

    A point (x, y, z) right of, above and behind the centre is inside where |x| <= a (d + z) and |y| <= b (d + z), with
    d the eye's distance and a, b the tangents of half the opening angles: d is the largest |x| / a - z, |y| / b - z.
    """
    ahead = direction / np.linalg.norm(direction)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    x, y, z = np.stack([right, np.cross(right, ahead), ahead]) @ (extent.points - extent.shift - extent.centre).T
    half = np.tan(np.radians(0.5 * OPENING_DEG)) * FILLED
    distance = max(float((np.abs(x) / (half * ASPECT) - z).max()), float((np.abs(y) / half - z).max()))
    return np.asarray(extent.centre - ahead * max(distance, 0.5 * extent.size))


def _flat_views(recorder: Recorder, session: Session, extent: Extent | None, cameras: list[CameraView]) -> list[View]:
    views: list[View] = []
    if recorder.has("/geo") and extent is not None and extent.size > SMALL:
        views.append(_map(session, extent))
    elif recorder.has("/world") and extent is not None:
        views.append(world_view("Top view (ENU)", extent, np.array([0.0, 1e-3, -1.0]), [0.0, 1.0, 0.0]))
    for view in cameras:
        if recorder.has(view.image) or (view.camera is not None and recorder.has(view.points)):
            views.append(_camera(view))
        if view.camera is None and recorder.has(view.origin):
            views.append(_normalised(view, session))
    return views


def _camera(view: CameraView) -> rrb.Spatial2DView:
    """The image of one camera, in pixels."""
    bounds = None
    if view.camera is not None:
        bounds = rrb.VisualBounds2D(x_range=[0, view.camera.width], y_range=[0, view.camera.height])
    contents = [f"{view.root}/**"]
    return rrb.Spatial2DView(name=f"Camera {view.name}", origin=view.root, contents=contents, visual_bounds=bounds)


def _normalised(view: CameraView, session: Session) -> rrb.Spatial2DView:
    """Points of a camera without calibration, in normalised image coordinates."""
    points = [] if session.tracks is None else [session.tracks.xy_n]
    points += [] if session.matches is None else [session.matches.xy0_n, session.matches.xy1_n]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    (left, top), (right, bottom) = low - 0.05 * (high - low) - 1e-3, high + 0.05 * (high - low) + 1e-3
    return rrb.Spatial2DView(
        name=f"Points of {view.name} (normalised)",
        origin=view.origin,
        visual_bounds=rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom]),
    )


def _map(session: Session, extent: Extent) -> rrb.MapView:
    """Zoom so that the path fills most of a map 800 by 260 points (256-point tiles, Web Mercator)."""
    assert session.origin is not None
    width, height = (extent.high - extent.low)[:2]
    metres_a_point = max(width / 800.0, height / 260.0, 1e-3)
    earth = 40_075_017.0 * float(np.cos(np.radians(session.origin.lat_deg)))
    zoom = float(np.clip(np.log2(earth / 256.0 / metres_a_point), 1.0, 19.0))
    return rrb.MapView(name="Map", origin="/geo", zoom=zoom, background=rrb.MapProvider.OpenStreetMap)


def _right(recorder: Recorder, session: Session, solution: Solution | None, kind: str) -> View | None:
    def series(names: Names, first: str = "") -> list[View]:
        there = [(name, path) for name, path in names if recorder.has(path)]
        there.sort(key=lambda item: item[1] != first)
        return [
            view for name, path in there for view in (banded(recorder, name, path) or [_series(recorder, name, path)])
        ]

    raw = series(tuple((signal.title, signal.path) for signal in signals.signals_of(session)))
    # Without a solution every signal is shown at once.
    shown = _stack(raw, [2.0] * len(raw)) if solution is None else _tabs(series(_MOTION, _FIRST.get(kind, "")) + raw)
    states = (
        rrb.StateTimelineView(name="States", origin="/status", time_view=_whole()) if recorder.has("/status") else None
    )
    log = rrb.TextLogView(name="Log", origin="/log", columns=log_columns()) if recorder.has("/log") else None
    count = 2.0 if solution is not None else 2.0 * max(1, len(raw))
    verdict = rrb.TextDocumentView(name="Verdict", origin="/verdict") if recorder.has("/verdict") else None
    parts = [
        verdict,
        shown,
        _tabs(series(_ACCURACY)),
        _tabs(series(_BIASES) + series(_clocks(recorder))),
        _tabs([*series(_UPDATES), *_residuals(recorder, solution)]),
        states,
        log,
    ]
    statuses = sum(path.startswith("/status/") for path in recorder.paths)
    return _stack(parts, [1.1, count, 2.0, 2.0, 2.0, 0.8 + 0.5 * statuses, 1.8])


def _series(recorder: Recorder, name: str, path: str) -> View:
    # with the latency of the updates, where the second recording is open; with what the wheels measured
    beside = {"/update/effort": ["/update/latency"], "/motion/speed": ["/wheel"]}.get(path, [])
    return series_view(name, [f"{path}/**", *beside], limits=recorder.limits.get(path))


def banded(recorder: Recorder, name: str, path: str) -> list[View]:
    """Views of lines with bands: all axes with one sigma, then each axis with one and three; empty where `path` has no
    bands."""
    bands = "bands 1σ 3σ"
    if f"{path}/three_sigma" in recorder.paths:
        return [series_view(f"{name}, {bands}", [f"{path}/**"], limits=recorder.limits.get(path))]
    axes = [axis for axis in signals.AXES if f"{path}/{axis}/three_sigma" in recorder.paths]
    if not axes:
        return []
    whole = series_view(f"{name}, bands 1σ", [f"{path}/{axis}" for axis in axes], limits=recorder.limits.get(path))
    what, _, unit = name.rpartition(" ")
    return [whole] + [
        series_view(
            f"{what} {axis} {unit}, {bands}", [at := f"{path}/{axis}", f"{at}/**"], limits=recorder.limits.get(at)
        )
        for axis in axes
    ]


def _clocks(recorder: Recorder) -> Names:
    sensors = sorted({path.split("/")[2] for path in recorder.paths if path.startswith("/clock/")})
    return tuple((f"Clock offset of {sensor} s", f"/clock/{sensor}") for sensor in sensors)


def _residuals(recorder: Recorder, solution: Solution | None) -> list[View]:
    if solution is None:
        return []
    # Position sensors first: the inertial residuals are many and small.
    sensors = sorted(solution.residuals.sensors(), key=lambda name: (name.startswith(("imu", "prior")), name))
    return [
        series_view(
            f"Residuals {title_of(name)} (σ)",
            [f"/residuals/{name}/**"],
            legend=_few(solution, name),
            limits=recorder.limits.get(f"/residuals/{name}"),
        )
        for name in sensors
    ]


def _few(solution: Solution, sensor: str) -> bool:
    return int(solution.residuals.axis[solution.residuals.of(sensor)].max()) < 3


def series_view(
    name: str,
    contents: list[str],
    *,
    legend: bool = True,
    limits: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:
    """A plot over the whole recording."""
    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=contents,
        axis_x=_whole(),
        axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
    )


def log_columns() -> TextLogColumns:
    """Time, level and text: all lines come from one entity."""
    return TextLogColumns(
        timeline_columns=[TimelineColumn("elapsed")],
        text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
    )


def _whole() -> rrb.TimeAxis:
    """The whole recording, on the chosen time line."""
    end = rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rr.TimeRange(start=end, end=end))
