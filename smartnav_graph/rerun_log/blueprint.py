"""The window that opens: only views that have data."""

from __future__ import annotations

from typing import Any

import numpy as np

from smartnav_graph.rerun_log import signals
from smartnav_graph.rerun_log.events import Events
from smartnav_graph.rerun_log.recorder import Recorder
from smartnav_graph.rerun_log.spatial import Extent, nice
from smartnav_graph.session import Session
from smartnav_graph.solution import Solution

_SIGNALS = (
    ("Accelerometer m/s²", "/imu/accel"),
    ("Gyroscope rad/s", "/imu/gyro"),
    ("Magnetometer µT", "/magnetometer"),
    ("Pressure hPa", "/barometer"),
    ("Temperature °C", "/temperature"),
    ("Velocity m/s (body)", "/velocity"),
    ("Wheel speed m/s", "/wheel"),
)
_ACCURACY = (
    ("Position error m, band 1σ", "/error/position"),
    ("Rotation error °", "/error/rotation"),
    ("Position σ m", "/sigma/position"),
    ("Heading σ °", "/sigma/heading"),
)
_BIASES = (("Accelerometer bias m/s², band 1σ", "/bias/accel"), ("Gyroscope bias rad/s, band 1σ", "/bias/gyro"))


def build(
    recorder: Recorder,
    session: Session,
    solution: Solution | None,
    extent: Extent | None,
    events: Events,
    factor: float,
) -> Any:
    """Left the path with report, map and camera; right the signals. `factor` magnifies the ellipsoids of the path."""
    import rerun.blueprint as rrb

    left = _stack([_tabs(_scenes(recorder, extent, factor)), _row(_flat_views(recorder, session, extent))], [3, 2])
    right = _right(recorder, solution, events)
    sides = [side for side in (left, right) if side is not None]
    return rrb.Blueprint(
        rrb.Horizontal(*sides, column_shares=[3, 2][: len(sides)]),
        rrb.TimePanel(timeline="elapsed", state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _stack(parts: list[Any], shares: list[float]) -> Any:
    import rerun.blueprint as rrb

    there = [(part, share) for part, share in zip(parts, shares, strict=True) if part is not None]
    if len(there) < 2:
        return there[0][0] if there else None
    return rrb.Vertical(*(part for part, _ in there), row_shares=[share for _, share in there])


def _tabs(views: list[Any]) -> Any:
    import rerun.blueprint as rrb

    if len(views) < 2:
        return views[0] if views else None
    return rrb.Tabs(*views, active_tab=0)


def _row(views: list[Any]) -> Any:
    import rerun.blueprint as rrb

    if len(views) < 2:
        return views[0] if views else None
    return rrb.Horizontal(*views)


def _scenes(recorder: Recorder, extent: Extent | None, factor: float) -> list[Any]:
    import rerun.blueprint as rrb

    views: list[Any] = []
    if extent is not None and recorder.has("/world"):
        name = "Path (ENU)"
        if recorder.has("/world/est/covariances"):
            name += f", 3σ ellipsoids ×{factor:g}"
        eye = extent.centre + extent.size * np.array([-0.45, -0.75, 0.7])
        views.append(_world(name, extent, eye, [0.0, 0.0, 1.0]))
    if recorder.has("/report"):
        views.append(rrb.TextDocumentView(name="Report", origin="/report"))
    return views


def _world(name: str, extent: Extent, eye: Any, up: list[float]) -> Any:
    import rerun as rr
    import rerun.blueprint as rrb

    return rrb.Spatial3DView(
        name=name,
        origin="/world",
        contents=["/world/**"],
        line_grid=rrb.LineGrid3D(
            visible=True,
            spacing=nice(extent.size / 10),
            plane=rr.components.Plane3D.XY.with_distance(extent.floor),
            color=[255, 255, 255, 40],
        ),
        eye_controls=rrb.EyeControls3D(position=eye, look_target=extent.centre, eye_up=up),
    )


def _flat_views(recorder: Recorder, session: Session, extent: Extent | None) -> list[Any]:
    import rerun.blueprint as rrb

    views: list[Any] = []
    if recorder.has("/geo") and extent is not None:
        views.append(_map(session, extent))
    elif recorder.has("/world") and extent is not None:
        above = extent.centre + np.array([0.0, -1e-3 * extent.size, 1.1 * extent.size])
        views.append(_world("Top view (ENU)", extent, above, [0.0, 1.0, 0.0]))
    cameras = sorted({path.split("/")[2] for path in recorder.paths if path.startswith("/camera/")})
    for camera in cameras:
        origin = f"/camera/{camera}"
        views.append(rrb.Spatial2DView(name=f"Camera {camera}", origin=origin, contents=[f"{origin}/**"]))
    if recorder.has("/tracks") and session.tracks is not None:
        low, high = session.tracks.xy_n.min(axis=0), session.tracks.xy_n.max(axis=0)
        margin = 0.05 * (high - low) + 1e-3
        bounds = rrb.VisualBounds2D(
            x_range=[low[0] - margin[0], high[0] + margin[0]], y_range=[low[1] - margin[1], high[1] + margin[1]]
        )
        views.append(rrb.Spatial2DView(name="Tracks (normalised)", origin="/tracks", visual_bounds=bounds))
    return views


def _map(session: Session, extent: Extent) -> Any:
    """Zoom so that the path fills most of a map some 400 points wide (256-point tiles, Web Mercator)."""
    import rerun.blueprint as rrb

    assert session.origin is not None
    metres_a_point = extent.size / 300.0
    earth = 40_075_017.0 * float(np.cos(np.radians(session.origin.lat_deg)))
    zoom = float(np.clip(np.log2(earth / 256.0 / metres_a_point), 1.0, 19.0))
    return rrb.MapView(name="Map", origin="/geo", zoom=zoom, background=rrb.MapProvider.OpenStreetMap)


def _right(recorder: Recorder, solution: Solution | None, events: Events) -> Any:
    import rerun.blueprint as rrb

    def series(names: tuple[tuple[str, str], ...]) -> list[Any]:
        return [_series(name, [path], events) for name, path in names if recorder.has(path)]

    raw = series(_SIGNALS)
    # Without a solution there is room to show every signal at once.
    signals_part = _tabs(raw) if solution is not None else _stack(raw, [2.0] * len(raw))
    states = rrb.StateTimelineView(name="States", origin="/status") if recorder.has("/status") else None
    log = rrb.TextLogView(name="Log", origin="/log") if recorder.has("/log") else None
    count = 2.0 if solution is not None else 2.0 * max(1, len(raw))
    return _stack(
        [
            signals_part,
            _tabs(series(_ACCURACY)),
            _tabs(series(_BIASES)),
            _tabs(_residuals(solution, events)),
            states,
            log,
        ],
        [count, 2.0, 2.0, 2.0, 1.6, 1.6],
    )


def _residuals(solution: Solution | None, events: Events) -> list[Any]:
    if solution is None:
        return []
    sensors = signals.sensors_of(solution.residuals)
    # Position sensors tell most: they stand first; the inertial residuals are many and small.
    sensors.sort(key=lambda name: (name == "imu", name == "prior", name))
    return [
        _series(f"Residuals {name} (σ)", [f"/residuals/{name}/**"], events, legend=_few(solution, name))
        for name in sensors
    ]


def _few(solution: Solution, sensor: str) -> bool:
    return int(solution.residuals.axis[solution.residuals.of(sensor)].max()) < 6


def _series(name: str, contents: list[str], events: Events, *, legend: bool = True) -> Any:
    import rerun as rr
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=contents,
        axis_x=rrb.TimeAxis(
            view_range=rr.TimeRange(
                start=rr.TimeRangeBoundary.absolute(nanos=0),
                end=rr.TimeRangeBoundary.absolute(nanos=events.end_ns - events.start_ns),
            )
        ),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=legend),
    )
