"""The window that opens shows what there is."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import T0, make_session, make_solution, truth, write

from smartnav_graph.output.rerun_log import blueprint, recorder, spatial


def test_every_view_has_data_and_every_kind_of_data_a_view(recording):
    names = recording.view_names()
    assert {"Report", "Map", "IMU accel m/s²", "IMU gyro rad/s", "States", "Log", "Residuals GNSS (σ)"} <= set(names)
    assert {"Position error m, bands 1σ", "Accelerometer bias m/s², bands 1σ", "Rotation error °"} <= set(names)
    each = {f"Position error {axis} m, bands 1σ 3σ" for axis in ("east", "north", "up")}
    assert each | {f"Gyroscope bias {axis} rad/s, bands 1σ 3σ" for axis in "xyz"} <= set(names)
    assert {"Speed m/s", "Heading, pitch, roll °", "Height m", "Behind the body"} <= set(names)
    absent = ("Camera", "Points", "Magnetometer", "Updates", "Matches", "Factor graph", "States of the session")
    assert not [name for name in names if name.startswith(absent)]


def test_session_alone_shows_what_was_recorded(tmp_path):
    found = write(tmp_path / "s.rrd", solution=None, evaluation=None, summary=None, report_markdown=None)
    assert not [path for path in found.paths if path.startswith(("/world/est", "/bias", "/error", "/residuals"))]
    left, right = {"Path (ENU)", "Legend", "Map"}, {"IMU accel m/s²", "IMU gyro rad/s", "States", "Log"}
    assert set(found.view_names()) == left | right
    gap = found.texts("/status/imu", "StateChange:state")
    assert gap == ["recorded", "no samples", "recorded"]  # found in the stream itself


def test_eye_sees_every_point():
    points = truth(np.arange(0, 60, 0.5))
    extent = spatial.Extent(points.min(axis=0), points.max(axis=0), np.zeros(3), points)
    for direction, up in ((np.array([0.35, 0.62, -0.7]), [0, 0, 1.0]), (np.array([0, 1e-3, -1.0]), [0, 1.0, 0])):
        ahead = direction / np.linalg.norm(direction)
        rays = points - blueprint.eye_position(extent, direction, np.array(up))
        right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
        depth, x, y = rays @ ahead, rays @ right, rays @ np.cross(right, ahead)
        half = np.tan(np.radians(55.0 / 2))
        assert (depth > 0).all() and (np.abs(y) < half * depth).all() and (np.abs(x) < 1.6 * half * depth).all()
        assert max((np.abs(y) / depth).max() / half, (np.abs(x) / depth).max() / half / 1.6) > 0.8  # and is near


@pytest.mark.parametrize(
    ("paths", "gnss", "solved", "kind", "first"),
    [
        ({"/imu/accel", "/temperature"}, False, False, "calibration", None),
        ({"/imu/accel", "/world/gnss/fixes"}, True, False, "session", None),
        ({"/world/est/body", "/motion/speed"}, True, True, "car", "/motion/speed"),
        ({"/world/est/body", "/motion/height"}, False, True, "indoor", "/motion/height"),
        ({"/world/est/body", "/world/est/body/cam0/image"}, True, True, "vision", "/motion/attitude"),
    ],
)
def test_layout_goes_by_what_the_session_holds(paths, gnss, solved, kind, first):
    session = make_session() if gnss else make_session(gnss=None)
    held = recorder.Recorder(None, recorder.RecordingClock(T0), paths=paths)
    assert blueprint.recording_kind(held, session, make_solution() if solved else None) == kind
    assert blueprint._FIRST.get(kind) == first
