"""Pose fixes from a reconstruction: a small one, made from simulated points, comes back to the millimetre."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.core.errors import SessionError, SolverError
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.session.streams import GnssFix, Images
from smartnav_graph.vision.map import KnownPositions, map_pose_fixes, own_fixes

COUNT = 12
T0_NS, STEP_NS, OFFSET_S = 10**12, 5 * 10**8, 0.02
FOCAL, SIZE = 400.0, (640, 480)
BODY_R_CAM = Rotation.from_euler("xyz", [-88.0, 3.0, -85.0], degrees=True).as_matrix()
BODY_T_CAM = (0.12, -0.05, 0.08)
# nav -> the map: another scale, frame and origin
SCALE, MAP_R_NAV, MAP_T_NAV = 0.37, Rotation.from_euler("xyz", [20, -130, 75], degrees=True), np.array([3.0, -8.0, 1.0])


def truth():
    """nav_t_body (n, 3) and nav_R_body (n, 3, 3) on an arc, the camera looking to its middle."""
    angle = np.linspace(0.0, 2.0, COUNT)
    t = np.column_stack([4.0 * np.cos(angle), 4.0 * np.sin(angle), 0.4 * np.sin(3.0 * angle)])
    ahead = np.column_stack([-np.cos(angle), -np.sin(angle), 0.1 * np.cos(angle)])
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1)[:, None]
    nav_R_cam = np.stack([right, np.cross(ahead, right), ahead], axis=2)
    return t, nav_R_cam @ BODY_R_CAM.T


def session(files=None):
    files = [f"cam0/{k:04d}.png" for k in range(COUNT)] if files is None else files
    images = Images(
        t_ns=T0_NS + STEP_NS * np.arange(len(files)),
        image_id=np.arange(len(files)),
        file=np.array(files, dtype=object),
        camera=np.full(len(files), "cam0", dtype=object),
    )
    camera = Camera(*SIZE, FOCAL, FOCAL, 320.0, 240.0, time_offset_s=OFFSET_S)
    return Session(
        images=images,
        sensors={"cam0": Mount(BODY_T_CAM, tuple(map(tuple, BODY_R_CAM)))},
        calibration=Calibration(device="simulated", cameras={"cam0": camera}),
    )


def known(t=None, **options):
    t = truth()[0] if t is None else t
    return KnownPositions(T0_NS + round(OFFSET_S * 1e9) + STEP_NS * np.arange(len(t)), t, **options)


def cameras_from_map():
    """cam_from_world of every image."""
    t, R = truth()
    nav_R_cam, nav_t_cam = R @ BODY_R_CAM, t + R @ np.array(BODY_T_CAM)
    map_R_cam = MAP_R_NAV.as_matrix() @ nav_R_cam
    map_t_cam = SCALE * nav_t_cam @ MAP_R_NAV.as_matrix().T + MAP_T_NAV
    return [pycolmap.Rigid3d(pycolmap.Rotation3d(a.T), -a.T @ b) for a, b in zip(map_R_cam, map_t_cam, strict=True)]


def reconstruction(names=None, without_pose=(), moved=0.0):
    """Points in the middle of the arc, seen by all images; poses moved by so much (map units, rad) from the truth."""
    names = [f"{k:04d}.png" for k in range(COUNT)] if names is None else names
    rng = np.random.default_rng(1)
    points = SCALE * rng.normal(0.0, 0.8, (80, 3)) @ MAP_R_NAV.as_matrix().T + MAP_T_NAV
    built = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[FOCAL, 320, 240], camera_id=1)
    built.add_camera_with_trivial_rig(camera)
    for k, (name, pose) in enumerate(zip(names, cameras_from_map(), strict=False), 1):
        seen = pose.rotation.matrix() @ points.T + pose.translation[:, None]
        pixels = (FOCAL * seen[:2] / seen[2]).T + np.array([320, 240])
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=k)
        turn = pycolmap.Rotation3d(Rotation.from_rotvec(rng.normal(0.0, moved, 3)).as_quat())
        off = pycolmap.Rigid3d(turn, rng.normal(0.0, moved, 3))
        if k - 1 in without_pose:
            built.add_image_with_trivial_frame(image)
        else:
            built.add_image_with_trivial_frame(image, off * pose)
    there = [k for k in range(1, len(names) + 1) if k - 1 not in without_pose]
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for k in there:
            track.add_element(k, row)
        built.add_point3D(point + rng.normal(0.0, moved, 3), track)
    return built


def worst(found, rows=slice(None)):
    """Largest position error m and rotation error deg."""
    t, R = (x[rows] for x in truth())
    turns = Rotation.from_quat(np.roll(found.fixes.quat, -1, axis=1)).as_matrix()
    off = np.degrees((Rotation.from_matrix(R).inv() * Rotation.from_matrix(turns)).magnitude())
    return np.abs(found.fixes.enu - t).max(), off.max()


def test_the_poses_of_a_reconstruction_come_back():
    found = map_pose_fixes(reconstruction(), session(), known())
    position, rotation = worst(found)
    assert position < 1e-6 and rotation < 1e-5
    assert found.similarity.scale == pytest.approx(1.0 / SCALE, rel=1e-9)
    assert found.counts == {"used": COUNT, "aligned": COUNT, "unknown": 0, "unregistered": 0}
    np.testing.assert_array_equal(found.fixes.t_ns, known().t_ns)  # on the clock of the IMU
    assert set(found.fixes.source) == {"colmap"}
    assert np.all(found.fixes.sigma == 0.01) and np.allclose(found.fixes.sigma_rot, np.radians(0.1), rtol=1e-3)


def test_an_adjusted_reconstruction_comes_back_to_the_millimetre(tmp_path):
    built = reconstruction(moved=0.003)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    assert worst(map_pose_fixes(built, session(), known()))[0] > 0.005
    pycolmap.bundle_adjustment(built, options)
    built.write(tmp_path)
    position, rotation = worst(map_pose_fixes(tmp_path, session(), known()))
    assert position < 1e-3 and rotation < 0.02


def test_a_wrong_mount_shows():
    moved = session().replace(sensors={"cam0": Mount((0.12, 0.95, 0.08), tuple(map(tuple, BODY_R_CAM)))})
    assert map_pose_fixes(reconstruction(), session(), known()).similarity.sigma < 1e-9
    assert map_pose_fixes(reconstruction(), moved, known()).similarity.sigma > 1e-3
    turned = session().replace(sensors={"cam0": Mount(BODY_T_CAM, tuple(map(tuple, BODY_R_CAM.T)))})
    assert worst(map_pose_fixes(reconstruction(), turned, known()))[1] > 10.0


def test_sigmas_come_from_what_the_positions_leave():
    rng = np.random.default_rng(3)
    ratios, sigmas = [], []
    for _ in range(40):
        noisy = known(truth()[0] + rng.normal(0.0, 0.1, (COUNT, 3)))
        found = map_pose_fixes(reconstruction(), session(), noisy)
        sigmas.append(found.fixes.sigma[0, 0])
        turn = Rotation.from_matrix(found.similarity.nav_R_map @ MAP_R_NAV.as_matrix()).as_rotvec()
        ratios.append(turn**2 / found.similarity.rotation_sigma**2)
    assert 0.6 < np.mean(ratios) < 1.5  # 120 squares, 1 +- 0.13
    assert 0.094 < np.mean(sigmas) < 0.106  # 0.1 +- 0.002


def test_positions_known_of_some_images_serve_for_all():
    t = truth()[0]
    few = KnownPositions(known().t_ns[:6], t[:6])
    found = map_pose_fixes(reconstruction(), session(), few)
    assert found.counts["aligned"] == 6 and found.counts["used"] == COUNT
    assert worst(found)[0] < 1e-6
    rows = [0, 1, 6, 11]  # up to 2.5 s apart: nothing is interpolated
    between = KnownPositions(known().t_ns[rows], t[rows])
    assert map_pose_fixes(reconstruction(), session(), between).counts["aligned"] == 4
    with pytest.raises(SolverError, match="0 images with a known position; expected at least 4"):
        map_pose_fixes(reconstruction(), session(), KnownPositions(np.zeros(0, dtype=np.int64), np.zeros((0, 3))))


def test_images_without_a_pose_or_unknown_are_counted():
    names = [f"{k:04d}.png" for k in range(COUNT - 1)] + ["other.png"]
    found = map_pose_fixes(reconstruction(names, without_pose=(2, 5)), session(), known())
    assert found.counts == {"used": COUNT - 3, "aligned": COUNT - 3, "unknown": 1, "unregistered": 2}
    rows = [k for k in range(COUNT - 1) if k not in (2, 5)]
    assert worst(found, rows)[0] < 1e-6


def test_what_cannot_be_aligned_is_refused():
    with pytest.raises(SolverError, match="3 images with a known position; expected at least 4"):
        map_pose_fixes(reconstruction(), session(), known(truth()[0][:3]))
    line = np.linspace(0.0, 5.0, COUNT)[:, None] * np.array([[1.0, 0.5, 0.0]])
    with pytest.raises(SolverError, match=r"deg only|on one line"):
        map_pose_fixes(reconstruction(), session(), known(line))
    with pytest.raises(SolverError, match=r"deg only|on one line"):
        map_pose_fixes(reconstruction(), session(), known(np.zeros((COUNT, 3))))


def test_wrong_input_is_named(tmp_path):
    with pytest.raises(SessionError, match="cannot be read"):
        map_pose_fixes(tmp_path / "none", session(), known())
    (tmp_path / "cameras.bin").write_bytes(b"x")
    with pytest.raises(SessionError, match="cannot be read"):
        map_pose_fixes(tmp_path, session(), known())
    with pytest.raises(SessionError, match=r"none of its 12 registered images is the session's \(such as a00.png"):
        map_pose_fixes(reconstruction([f"a{k:02d}.png" for k in range(COUNT)]), session(), known())
    with pytest.raises(SessionError, match="no images"):
        map_pose_fixes(reconstruction(), session().replace(images=None), known())


def test_wrong_positions_are_named():
    t = truth()[0]
    for wrong in (t[:5], np.where(np.arange(3) == 1, np.nan, t)):
        with pytest.raises(SessionError, match="known positions: 12 times and positions"):
            map_pose_fixes(reconstruction(), session(), known()._replace(nav_t=wrong))
    with pytest.raises(SessionError, match="expected ascending times"):
        map_pose_fixes(reconstruction(), session(), known()._replace(t_ns=known().t_ns[::-1]))


def test_a_real_model_agrees_with_its_own_text(dataset):
    folder = dataset("lund_door")
    recorded = sn.load(str(folder))
    reference = recorded.reference
    where = KnownPositions(reference.t_ns, 2.5 * reference.enu)
    found = map_pose_fixes(folder / "colmap_ground_truth", recorded, where)
    assert found.counts == {"used": 12, "aligned": 12, "unknown": 0, "unregistered": 0}
    assert found.similarity.scale == pytest.approx(2.5, rel=1e-6)
    np.testing.assert_allclose(found.fixes.enu, where.nav_t, atol=1e-5)
    both = (Rotation.from_quat(np.roll(quat, -1, axis=1)) for quat in (found.fixes.quat, reference.quat))
    one, other = both
    assert np.degrees((one.inv() * other).magnitude()).max() < 1e-4


def test_the_antenna_stands_beside_the_camera():
    """Fixes of a receiver: laid on where its antenna was, reported for the body."""
    arm = (0.3, -0.8, 1.1)
    t, R = truth()
    at_antenna = known(t + R @ np.array(arm))
    found = map_pose_fixes(reconstruction(), session(), at_antenna._replace(body_t=arm))
    assert worst(found)[0] < 1e-6
    assert worst(map_pose_fixes(reconstruction(), session(), at_antenna))[0] > 0.1
    fixes = GnssFix(t_ns=at_antenna.t_ns, enu=at_antenna.nav_t)
    recorded = session().replace(gnss=fixes, sensors={**session().sensors, "gnss": Mount(arm)})
    assert worst(map_pose_fixes(reconstruction(), recorded, own_fixes(recorded)))[0] < 1e-6
    with pytest.raises(SessionError, match=r"no gnss fixes to align a map.*--known RUN"):
        own_fixes(session())


def test_fixes_of_a_sensor_beside_the_body_are_refused():
    placed = session().replace(sensors={**session().sensors, "pose_fixes": Mount((0.0, 0.1, 0.0))})
    with pytest.raises(SessionError, match=r"places a sensor of pose fixes.*\[sensors.pose_fixes\]"):
        map_pose_fixes(reconstruction(), placed, known())


def test_two_files_of_one_name_need_their_folder():
    files = [f"{folder}/{k:04d}.png" for folder in ("left", "right") for k in range(COUNT // 2)]
    names = [f"left/{k:04d}.png" for k in range(COUNT // 2)]
    assert map_pose_fixes(reconstruction(names), session(files), known()).counts["used"] == COUNT // 2
    with pytest.raises(SessionError, match="none of its 6 registered images"):
        map_pose_fixes(reconstruction([name.split("/")[1] for name in names]), session(files), known())
