"""The recording read back row by row: what the viewer shows is what was estimated."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartnav_graph import session as sessions
from smartnav_graph.errors import SessionError, SmartnavError
from smartnav_graph.frames import LocalFrame, Origin
from smartnav_graph.rerun_log import blueprint, events, recorder, signals, spatial, viewer, write_recording
from smartnav_graph.session import Device, Session
from smartnav_graph.solution import POS, Residuals, Solution
from smartnav_graph.streams import ControlPoint, GnssFix, Images, Imu, Reference, StaticPeriod, Tracks
from smartnav_graph.timebase import NS, Gap

T0 = 1_777_629_600 * NS  # 2026-05-01 10:00:00 UTC
ORIGIN = Origin(48.1, 11.5, 520.0)
N = 40
REJECTED_ROWS = [7, 30]
OUTAGE = (12, 20)


def stamps(seconds):
    return T0 + np.rint(np.asarray(seconds) * NS).astype(np.int64)


def truth(t):
    return np.stack([200 * np.sin(0.1 * t), 120 * np.sin(0.2 * t), 5 + np.sin(0.3 * t)], axis=-1)


def make_session(**changes):
    rng = np.random.default_rng(1)
    t = np.concatenate([np.arange(0, 25, 0.02), np.arange(26.5, N, 0.02)])
    imu = Imu(t_ns=stamps(t), gyro=rng.normal(size=(len(t), 3)), accel=rng.normal(9.81, 1.0, (len(t), 3)))
    seconds = np.array([s for s in range(N) if not OUTAGE[0] <= s < OUTAGE[1]], dtype=float)
    lla = LocalFrame(ORIGIN).lla_from_nav(truth(seconds))
    fixes = GnssFix(t_ns=stamps(seconds), lla=lla)
    control = ControlPoint(t_ns=stamps([1.0]), enu=truth(np.array([1.0])), point_id=np.array(["P1"], dtype=object))
    still = StaticPeriod(t_ns=stamps([0.0]), t_end_ns=stamps([3.0]))
    reference = Reference(t_ns=stamps(np.arange(N)), enu=truth(np.arange(N)))
    session = Session(
        device=Device(name="test car"),
        clock_epoch="unix",
        origin=ORIGIN,
        imu=imu,
        gnss=fixes,
        control=control,
        static=still,
        reference=reference,
    )
    return session.replace(**changes)


def make_solution(**changes):
    rng = np.random.default_rng(2)
    seconds = np.arange(N, dtype=float)
    root = rng.normal(size=(N, 15, 15)) * 0.1
    fixes = make_session().gnss.t_ns
    used = np.ones(len(fixes), dtype=bool)
    used[REJECTED_ROWS] = False
    residuals = Residuals(
        t_ns=np.repeat(fixes, 3),
        sensor=np.array(["gnss"] * 3 * len(fixes), dtype=object),
        axis=np.tile([0, 1, 2], len(fixes)),
        whitened=rng.normal(size=3 * len(fixes)),
        weight=np.ones(3 * len(fixes)),
        used=np.repeat(used, 3),
    )
    solution = Solution(
        t_ns=stamps(seconds),
        nav_R_body=Rotation.random(N, random_state=3).as_matrix(),
        nav_t_body=truth(seconds) + 0.1,
        nav_v_body=rng.normal(size=(N, 3)),
        accel_bias=rng.normal(size=(N, 3)) * 0.1,
        gyro_bias=rng.normal(size=(N, 3)) * 0.01,
        covariance=root @ root.transpose(0, 2, 1),
        t0_ns=T0,
        origin=ORIGIN,
        residuals=residuals,
    )
    return dataclasses.replace(solution, **changes)


EVALUATION = SimpleNamespace(
    t_ns=stamps(np.arange(N)),
    error_enu_m=np.linspace(-1, 1, 3 * N).reshape(N, 3),
    sigma_enu=np.linspace(0.5, 1, 3 * N).reshape(N, 3),
    rotation_error_deg=np.linspace(0, 2, N),
)
SUMMARY = {
    "gaps": [{"start_s": 24.98, "length_s": 1.52, "kind": "missing"}],
    "warnings": ["gnss: sigmas missing"],
    "initialisation": {"mode": "dynamic", "heading_deg": 12.5},
}


def write(path, **changes):
    arguments = {
        "session": make_session(),
        "solution": make_solution(),
        "evaluation": EVALUATION,
        "summary": SUMMARY,
        "report_markdown": "# Report",
    }
    write_recording(path, **(arguments | changes))
    return Recording(path)


class Recording:
    """Chunks of a file by entity."""

    def __init__(self, path):
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        self.identity = reader.recordings()[0].recording_id
        self.application = reader.recordings()[0].application_id
        self.chunks = list(reader.stream())
        self.blueprint = [chunk for entry in reader.blueprints() for chunk in reader.stream(store=entry)]

    @property
    def paths(self):
        return {str(chunk.entity_path) for chunk in self.chunks}

    def batches(self, path, component, static=False):
        for chunk in self.chunks:
            if str(chunk.entity_path) == path and chunk.is_static == static:
                batch = chunk.to_record_batch()
                if component in batch.schema.names:
                    yield batch

    def rows(self, path, component, static=False):
        return [row for batch in self.batches(path, component, static) for row in batch.column(component).to_pylist()]

    def values(self, path, component, static=False):
        return np.array(self.rows(path, component, static))

    def texts(self, path, component):
        return [row[0] for row in self.rows(path, component)]

    def index(self, path, component, timeline):
        columns = [batch.column(timeline).cast("int64").to_numpy() for batch in self.batches(path, component)]
        return np.concatenate(columns)

    def view_names(self):
        names = []
        for chunk in self.blueprint:
            batch = chunk.to_record_batch()
            if "ViewBlueprint:display_name" in batch.schema.names:
                names += [row[0] for row in batch.column("ViewBlueprint:display_name").to_pylist()]
        return names


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write(tmp_path_factory.mktemp("recording") / "run.rrd")


def test_poses_are_the_solution_row_by_row(recording):
    solution = make_solution()
    at = recording.values("/world/est/body", "Transform3D:translation")[:, 0]
    np.testing.assert_array_equal(at, solution.nav_t_body.astype(np.float32))
    xyzw = recording.values("/world/est/body", "Transform3D:quaternion")[:, 0]
    np.testing.assert_allclose(Rotation.from_quat(xyzw).as_matrix(), solution.nav_R_body, atol=1e-6)
    path = recording.values("/world/est/path", "LineStrips3D:strips", static=True)[0, 0]
    np.testing.assert_array_equal(path, solution.nav_t_body.astype(np.float32))
    arrows = recording.values("/world/est/velocity", "Arrows3D:vectors")[:, 0]
    np.testing.assert_array_equal(arrows, solution.nav_v_body.astype(np.float32))


def test_time_lines_count_from_time_zero_and_stand_everywhere(recording):
    t = make_solution().t_ns
    component = "Transform3D:translation"
    np.testing.assert_array_equal(recording.index("/world/est/body", component, "elapsed"), t - T0)
    np.testing.assert_array_equal(recording.index("/world/est/body", component, "utc"), t)
    np.testing.assert_array_equal(recording.index("/world/est/body", component, "keyframe"), np.arange(N))
    rows = [chunk for chunk in recording.chunks if not chunk.is_static]
    assert {frozenset(chunk.timeline_names) - {"keyframe"} for chunk in rows} == {frozenset({"elapsed", "utc"})}
    keyed = {str(chunk.entity_path) for chunk in rows if "keyframe" in chunk.timeline_names}
    assert {"/world/est/body", "/world/est/covariance", "/bias/accel", "/sigma/position"} <= keyed
    assert "/imu/accel" not in keyed


def test_raw_clock_stands_in_for_a_clock_that_is_no_date(tmp_path):
    found = write(tmp_path / "run.rrd", session=make_session(clock_epoch="boot"))
    names = {name for chunk in found.chunks for name in chunk.timeline_names}
    assert names == {"elapsed", "device", "keyframe"}
    imu = make_session().imu
    raw = found.index("/imu/gyro", "Scalars:scalars", "device")
    np.testing.assert_array_equal(raw, imu.t_ns)


def test_gps_time_is_shown_as_utc():
    # GPS week 2295, second 0 began 2023-12-31 00:00:00 GPS = 2023-12-30 23:59:42 UTC: 18 leap seconds since 2017.
    shown = recorder.utc_from_gps(np.array([2295 * 604_800 * NS, 0]))
    assert str(shown[:1].astype("datetime64[ns]")[0]).startswith("2023-12-30T23:59:42.000")
    assert shown[1] == np.datetime64("1980-01-06", "ns").astype(np.int64)
    # the last second of 2016 was a leap second: 17 s before it, 18 s after it
    epoch = np.datetime64("1980-01-06", "ns")
    gps = np.array(["2017-01-01T00:00:16", "2017-01-01T00:00:18"], "datetime64[ns]") - epoch
    utc = recorder.utc_from_gps(gps.astype(np.int64)).astype("datetime64[ns]").astype("datetime64[s]")
    assert [str(t) for t in utc] == ["2016-12-31T23:59:59", "2017-01-01T00:00:00"]
    assert not recorder.Clock(46_534 * NS, "gps").is_date  # seconds of a day


def test_ellipsoids_hold_the_position_covariance(recording):
    half = recording.values("/world/est/covariance", "Ellipsoids3D:half_sizes")[:, 0]
    xyzw = recording.values("/world/est/covariance", "Ellipsoids3D:quaternions")[:, 0]
    axes = Rotation.from_quat(xyzw).as_matrix()
    covariance = np.einsum("nij,nj,nkj->nik", axes, (half / 3.0) ** 2, axes)
    np.testing.assert_allclose(covariance, make_solution().covariance[:, POS, POS], atol=1e-5)


def test_ellipsoid_axes_are_a_rotation_even_when_eigenvectors_are_a_mirror():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(50, 3, 3))
    covariance = root @ root.transpose(0, 2, 1)
    vectors = np.linalg.eigh(covariance)[1]
    assert (np.linalg.det(vectors) < 0).any()  # the case at hand occurs
    half, xyzw = spatial.ellipsoids(covariance)
    axes = Rotation.from_quat(xyzw).as_matrix()
    np.testing.assert_allclose(np.einsum("nij,nj,nkj->nik", axes, half**2, axes), covariance, atol=1e-9)


def test_ellipsoids_along_the_path_are_magnified_by_a_round_factor_that_the_view_names(recording):
    half = recording.values("/world/est/covariances", "Ellipsoids3D:half_sizes", static=True)[0]
    true = recording.values("/world/est/covariance", "Ellipsoids3D:half_sizes")[:, 0]
    factor = half / true
    np.testing.assert_allclose(factor, factor[0, 0], rtol=1e-5)
    assert f"Path (ENU), 3σ ellipsoids ×{factor[0, 0]:g}" in recording.view_names()


def test_one_long_outage_does_not_bury_the_path_under_ellipsoids():
    covariance = (
        np.eye(3) * np.where(np.arange(100) < 95, 0.1, 100.0)[:, None, None] ** 2
    )  # sigmas 0.1 m, five of 100 m
    assert spatial.magnification(covariance, 1000.0) == 0.05
    assert spatial.magnification(covariance[:95], 1000.0) == 10.0


def test_legend_names_what_is_drawn_and_nothing_else(recording):
    legend = recording.rows("/legend", "TextDocument:text", static=True)[0][0]
    named = {line.split("]")[0][3:] for line in legend.splitlines() if line.startswith("* [")}
    assert named < recording.paths
    drawn = {path for path in recording.paths if path.startswith("/world/")} - {"/world/gnss/current"}
    assert named == drawn


def test_biases_and_errors_carry_their_variances(recording):
    solution = make_solution()
    np.testing.assert_array_equal(recording.values("/bias/accel", "Measurements:values"), solution.accel_bias)
    variances = recording.values("/bias/gyro", "Measurements:variances")
    np.testing.assert_allclose(variances, solution.sigmas[:, 12:15] ** 2, rtol=1e-12)
    np.testing.assert_array_equal(recording.values("/error/position", "Measurements:values"), EVALUATION.error_enu_m)
    variances = recording.values("/error/position", "Measurements:variances")
    np.testing.assert_allclose(variances, EVALUATION.sigma_enu**2, rtol=1e-12)
    np.testing.assert_array_equal(recording.values("/sigma/position", "Scalars:scalars"), solution.sigmas[:, POS])


def test_inertial_samples_are_all_there_and_end_where_data_stop(recording):
    imu = make_session().imu
    np.testing.assert_array_equal(recording.values("/imu/accel", "Scalars:scalars"), imu.accel)
    ends = recording.index("/imu/accel", "Clear:is_recursive", "elapsed")
    assert ends.tolist() == [25_000_000_000]  # one period after the last sample before the gap


def test_rejected_fixes_and_residuals_are_apart(recording):
    session = make_session()
    enu = session.nav_position(session.gnss)
    drawn = recording.values("/world/gnss/rejected", "Points3D:positions", static=True)[0]
    np.testing.assert_array_equal(drawn, enu[REJECTED_ROWS].astype(np.float32))
    used = np.delete(enu, REJECTED_ROWS, axis=0)
    drawn = recording.values("/world/gnss/fixes", "Points3D:positions", static=True)[0]
    np.testing.assert_array_equal(drawn, used.astype(np.float32))
    geo = recording.values("/geo/gnss/rejected", "GeoPoints:positions", static=True)[0]
    np.testing.assert_allclose(geo, session.gnss.lla[REJECTED_ROWS, :2], atol=1e-10)  # degrees, doubles
    whitened = make_solution().residuals.whitened.reshape(-1, 3)
    rejected = recording.values("/residuals/gnss/rejected", "Scalars:scalars")
    np.testing.assert_array_equal(rejected, whitened[REJECTED_ROWS])
    kept = recording.values("/residuals/gnss", "Scalars:scalars")
    np.testing.assert_array_equal(kept, np.delete(whitened, REJECTED_ROWS, axis=0))


def test_states_switch_at_gaps_outages_and_standstills(recording):
    component = "StateChange:state"
    assert recording.texts("/status/gnss", component) == ["fix", "outage", "fix"]
    times = recording.index("/status/gnss", component, "elapsed") / NS
    np.testing.assert_allclose(times, [0, OUTAGE[0] - 1, OUTAGE[1]])
    assert recording.texts("/status/imu", component) == ["recorded", "missing", "recorded"]
    np.testing.assert_allclose(recording.index("/status/imu", component, "elapsed") / NS, [0, 24.98, 26.5])
    assert recording.texts("/status/motion", component) == ["still", "moving"]
    gate = recording.index("/status/gnss_gate", component, "elapsed") / NS
    assert gate[1] == make_session().seconds(make_session().gnss.t_ns)[REJECTED_ROWS[0]]


def test_log_tells_warnings_initialisation_gaps_and_rejections_in_order(recording):
    texts = recording.texts("/log", "TextLog:text")
    times = recording.index("/log", "TextLog:text", "elapsed")
    assert (np.diff(times) >= 0).all()
    assert "gnss: sigmas missing" in texts
    assert "initialised: mode dynamic, heading_deg 12.5" in texts
    assert times[texts.index("imu: missing for 1.52 s")] == 24_980_000_000
    assert times[texts.index("gnss: fix rejected at 7.00 s")] == 7 * NS
    assert times[texts.index("gnss: no fix used for 9.0 s")] == (OUTAGE[0] - 1) * NS


def test_every_view_has_data_and_every_kind_of_data_a_view(recording):
    names = recording.view_names()
    assert {"Report", "Map", "Accelerometer m/s²", "Gyroscope rad/s", "States", "Log", "Residuals gnss (σ)"} <= set(
        names
    )
    assert {"Position error m, band 1σ", "Accelerometer bias m/s², band 1σ", "Rotation error °"} <= set(names)
    assert not [name for name in names if "Camera" in name or "Tracks" in name or "Magnetometer" in name]


def test_session_alone_shows_what_was_recorded(tmp_path):
    found = write(tmp_path / "s.rrd", solution=None, evaluation=None, summary=None, report_markdown=None)
    assert not [path for path in found.paths if path.startswith(("/world/est", "/bias", "/error", "/residuals"))]
    left, right = {"Path (ENU)", "Legend", "Map"}, {"Accelerometer m/s²", "Gyroscope rad/s", "States", "Log"}
    assert set(found.view_names()) == left | right
    gap = found.texts("/status/imu", "StateChange:state")
    assert gap == ["recorded", "missing", "recorded"]  # found in the stream itself


def test_without_origin_the_path_is_seen_from_above_and_far_coordinates_keep_centimetres(tmp_path):
    far = np.array([691_000.0, 5_334_000.0, 500.0])
    gnss = GnssFix(t_ns=make_session().gnss.t_ns, enu=truth(np.arange(N - 8)) + far)
    session = make_session(origin=None, gnss=gnss, reference=None, control=None)
    solution = make_solution(origin=None, nav_t_body=truth(np.arange(N)) + far)
    found = write(tmp_path / "run.rrd", session=session, solution=solution)
    assert "Top view (ENU)" in found.view_names() and "Map" not in found.view_names()
    at = found.values("/world/est/body", "Transform3D:translation")[:, 0].astype(float)
    assert np.abs(at - (truth(np.arange(N)) + far - [691_000.0, 5_334_000.0, 0.0])).max() < 1e-3  # m
    texts = found.texts("/log", "TextLog:text")
    assert [text for text in texts if "less 691000, 5334000, 0 m" in text]


def test_unknown_positions_are_left_out_of_the_scene(tmp_path):
    position = truth(np.arange(N))
    position[5] = np.nan
    found = write(tmp_path / "run.rrd", solution=make_solution(nav_t_body=position), evaluation=None)
    for path, component in (
        ("/world/est/path", "LineStrips3D:strips"),
        ("/world/est/body", "Transform3D:translation"),
        ("/world/est/covariance", "Ellipsoids3D:centers"),
    ):
        values = found.values(path, component, static=path.endswith("path"))
        assert np.isfinite(values).all(), path
    assert 5 not in found.index("/world/est/body", "Transform3D:translation", "keyframe")


def test_same_data_give_the_same_recording_and_other_data_another(tmp_path):
    first, second = tmp_path / "a.rrd", tmp_path / "b.rrd"
    one, two = write(first), write(second)
    assert one.identity == two.identity and one.application == "smartnav_graph"
    components = {name for chunk in one.chunks for name in chunk.to_record_batch().schema.names}
    assert not components & {"log_time", "log_tick", "RecordingInfo:start_time"}  # no wall clock
    binary = str(viewer.executable())
    verified = subprocess.run([binary, "rrd", "verify", str(first)], capture_output=True, text=True)
    assert verified.returncode == 0, verified.stderr
    compared = subprocess.run([binary, "rrd", "compare", str(first), str(second)], capture_output=True, text=True)
    assert compared.returncode == 0, compared.stderr
    bias = make_solution().accel_bias.copy()
    bias[0, 0] += 1e-12
    assert write(second, solution=make_solution(accel_bias=bias)).identity != one.identity
    assert write(second, report_markdown="# Other").identity != one.identity
    assert write(second, summary=SUMMARY | {"timings_s": {"total": 3.0}}).identity == one.identity


def test_images_and_pixel_tracks_lie_over_each_other(tmp_path):
    import cv2

    (tmp_path / "session" / "images").mkdir(parents=True)
    for name in ("0.png", "1.jpg"):
        cv2.imwrite(str(tmp_path / "session" / "images" / name), np.full((20, 30, 3), 80, dtype=np.uint8))
    t = stamps([1.0, 2.0, 3.0])
    images = Images(
        t_ns=t,
        image_id=np.arange(3),
        file=np.array(["0.png", "1.jpg", "absent.jpg"], dtype=object),
        camera=np.array(["cam0"] * 3, dtype=object),
    )
    xy = np.arange(10.0).reshape(5, 2)
    tracks = Tracks(
        t_ns=t[[0, 0, 0, 1, 1]], image_id=np.array([0, 0, 0, 1, 1]), track_id=np.arange(5), xy_n=xy / 100, xy_px=xy
    )
    session = make_session(images=images, tracks=tracks, path=tmp_path / "session")
    found = write(tmp_path / "run.rrd", session=session, solution=None, evaluation=None)
    files = [(tmp_path / "session" / "images" / name).read_bytes() for name in ("0.png", "1.jpg")]
    assert [bytes(row[0]) for row in found.rows("/camera/cam0/image", "EncodedImage:blob")] == files
    rows = found.rows("/camera/cam0/image/tracks", "Points2D:positions")
    assert [np.array(row).tolist() for row in rows] == [xy[:3].tolist(), xy[3:].tolist()]
    texts = found.texts("/log", "TextLog:text")
    assert "images: 1 files of cam0 not shown (no such JPEG or PNG)" in texts
    assert "Camera cam0" in found.view_names() and "/tracks" not in found.paths


def test_many_residuals_of_one_time_stay_apart():
    rows = Residuals(
        t_ns=np.array([5, 5, 5, 7, 7]),
        sensor=np.array(["cam"] * 5, dtype=object),
        axis=np.array([0, 0, 1, 0, 1]),
        whitened=np.array([1.0, 2.0, 3.0, 4.0, 5.0]),
        weight=np.ones(5),
        used=np.ones(5, dtype=bool),
    )
    t, table = signals.residual_rows(rows, "cam", used=True)
    assert t.tolist() == [5, 5, 7]
    np.testing.assert_array_equal(table, [[1.0, 3.0], [2.0, np.nan], [4.0, 5.0]])


def test_fixes_without_residual_are_withheld_and_a_time_offset_does_not_confuse():
    solution = make_solution()
    session = make_session()
    kept = np.isin(solution.residuals.t_ns, session.gnss.t_ns[::2])
    shifted = {f.name: getattr(solution.residuals, f.name)[kept] for f in dataclasses.fields(Residuals)}
    shifted["t_ns"] = shifted["t_ns"] + 60_000_000  # the receiver's clock 0.06 s off
    use = events.fix_use(session.gnss, make_solution(residuals=Residuals(**shifted)))
    expected = np.where(np.arange(len(session.gnss)) % 2 == 0, events.USED, events.WITHHELD)
    expected[[row for row in REJECTED_ROWS if row % 2 == 0]] = events.REJECTED
    np.testing.assert_array_equal(use, expected)


def test_states_between_touching_spans():
    t, states = events.switches(0, [Gap(0, 5, "still"), Gap(10, 20, "a"), Gap(20, 30, "b")], "moving")
    assert list(zip(t.tolist(), states, strict=True)) == [
        (0, "still"),
        (5, "moving"),
        (10, "a"),
        (20, "b"),
        (30, "moving"),
    ]


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


def test_nothing_is_left_behind_and_the_old_file_stands_when_the_disk_is_full(tmp_path):
    pytest.importorskip("resource")
    target = tmp_path / "run.rrd"
    target.write_text("old")
    program = (
        "import resource, signal, sys; sys.path.insert(0, 'tests');"
        "from test_rerun_log import write; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000));"
        f"write({str(target)!r})"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "run.rrd: could not be written" in done.stderr and "SessionError" in done.stderr
    assert target.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["run.rrd"]


def test_existing_file_is_kept_without_force(tmp_path):
    (tmp_path / "run.rrd").write_text("old")
    with pytest.raises(SessionError, match=r"run\.rrd: exists already"):
        write_recording(tmp_path / "run.rrd", session=make_session(), solution=None, force=False)


def test_importing_the_package_does_not_load_rerun():
    code = "import sys, smartnav_graph, smartnav_graph.rerun_log; print('rerun' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_view_opens_recordings_runs_and_sessions(tmp_path, monkeypatch):
    sessions.save(make_session(), tmp_path / "session")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.rrd").write_bytes(b"")
    opened = []

    def run(command, check):
        opened.append(command)
        assert all(viewer.Path(file).is_file() for file in command[1:] if file.endswith(".rrd"))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(viewer.subprocess, "run", run)
    monkeypatch.setenv("DISPLAY", ":0")
    viewer.view([tmp_path / "session", tmp_path / "run"])
    assert [file.rsplit("/", 1)[-1] for file in opened[0][1:]] == ["--bind", "127.0.0.1", "0.rrd", "run.rrd"]
    viewer.view([tmp_path / "run"], web=True)
    assert "--web-viewer" in opened[1]


def test_view_says_what_is_wrong(tmp_path, monkeypatch):
    with pytest.raises(SessionError, match=r"absent: does not exist; expected a \.rrd file, a run folder or a session"):
        viewer.view([tmp_path / "absent"], web=True)
    with pytest.raises(SessionError, match=r"holds no run\.rrd and no session\.toml"):
        viewer.view([tmp_path], web=True)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(viewer.sys, "platform", "linux")
    with pytest.raises(SmartnavError, match=r"no display .*; expected a graphical desktop; add --web"):
        viewer.view([])
