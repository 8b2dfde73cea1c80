"""From a COLMAP model to a run: pose fixes in the session by one command, and the trajectory they hold."""

import json

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from test_coplanarity import errors

import smartnav_graph as sn
from smartnav_graph.cli import main
from smartnav_graph.core.frames import Origin
from smartnav_graph.output.run_folder import read_run
from smartnav_graph.session.folder import save as save_session
from smartnav_graph.session.streams import PoseFix
from smartnav_graph.simulation.scenarios import simulate

# nav -> the model: another scale, frame and origin; noise of its poses
SCALE, MAP_R_NAV, MAP_T_NAV = 0.21, Rotation.from_euler("xyz", [70, -20, 140], degrees=True), np.array([5.0, 2.0, -3.0])
NOISE_M, NOISE_DEG = 0.01, 0.2
EVERY = 5  # images of the session that are in the model


def model_of(session, folder):
    """What a reconstruction of some of the pictures would be: true poses moved, scaled, and a little wrong."""
    rng, truth = np.random.default_rng(4), session.reference
    mount, built = session.mount("cam0"), pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[575, 320, 240], camera_id=1)
    built.add_camera_with_trivial_rig(camera)
    for row in range(0, len(session.images), EVERY):
        at = np.searchsorted(truth.t_ns, session.images.t_ns[row])
        R = Rotation.from_quat(truth.quat[at], scalar_first=True)
        centre = truth.enu[at] + R.apply(mount.body_t) + rng.normal(0, NOISE_M, 3)
        turn = MAP_R_NAV * R * Rotation.from_matrix(mount.body_R)
        turn = turn * Rotation.from_rotvec(rng.normal(0, np.radians(NOISE_DEG), 3))
        place = SCALE * MAP_R_NAV.apply(centre) + MAP_T_NAV
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.inv().as_quat()), -turn.inv().apply(place))
        image = pycolmap.Image(
            name=str(session.images.file[row]), keypoints=np.zeros((0, 2)), camera_id=1, image_id=row + 1
        )
        built.add_image_with_trivial_frame(image, pose)
    folder.mkdir()
    built.write(str(folder))


@pytest.fixture(scope="module")
def workshop(tmp_path_factory):
    """A session with named pictures, its run without a model, and the model."""
    folder = tmp_path_factory.mktemp("map")
    room = simulate("room-30s", 0)
    files = np.array([f"{k:04d}.jpg" for k in range(len(room.images))], dtype=object)
    columns = {**room.images.columns(), "file": files}
    room = room.replace(images=type(room.images).from_columns(columns))
    save_session(room, folder / "room")
    model_of(room, folder / "model")
    assert main(["smooth", f"{folder}/room", "--out", f"{folder}/without", "--quiet"]) == 0
    return folder, room


def match(folder, *options):
    return main(["match", f"{folder}/room", "--map", f"{folder}/model", *options])


def test_a_model_holds_the_trajectory(workshop, capsys):
    folder, room = workshop
    assert match(folder) == 1
    assert "no gnss fixes to align a map" in capsys.readouterr().err
    assert match(folder, "--known", f"{folder}/without", "--json") == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["used"] == reported["aligned"] == len(room.images) // EVERY and reported["unknown"] == 0
    assert reported["metres_a_unit"] == pytest.approx(1 / SCALE, rel=0.02)
    assert 0.005 < reported["sigma_m"] < 0.05  # m: of the model, and of the drift of the run
    fixes = sn.load(f"{folder}/room").pose_fixes
    assert set(fixes.source) == {"colmap"}

    assert match(folder, "--known", f"{folder}/without") == 1
    assert "exists already; expected a session without it; add --force" in capsys.readouterr().err
    assert match(folder, "--known", f"{folder}/without", "--force") == 0
    reported = capsys.readouterr().out
    assert f"{len(fixes)} images of the session" in reported and "one unit of the model is 4.7" in reported

    arguments = ["smooth", f"{folder}/room", "--quiet", "--sensors", "pose_fixes", "--out", f"{folder}/alone"]
    assert main(arguments) == 0
    before, after = (errors(read_run(folder / name).solution, room.reference) for name in ("without", "alone"))
    assert after[0] < 0.05 and after[1] < 0.5  # m, deg: inertial data alone lose many metres
    summary = read_run(folder / "alone").summary
    assert summary["mode"] == "batch" and summary["factors"]["pose_fixes"] == len(fixes)
    assert after[0] < 2.0 * before[0]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--known", "nowhere", "--force"], "nowhere"),
        (["--to-file", "x.txt"], "--map: is given with --to-file"),
    ],
)
def test_wrong_usage_is_named(workshop, capsys, options, text):
    assert match(workshop[0], *options) == 1
    assert text in capsys.readouterr().err


def test_a_run_without_a_model_is_nothing(workshop, capsys):
    folder, _ = workshop
    assert main(["match", f"{folder}/room", "--known", f"{folder}/without"]) == 1
    assert "--known: is given without --map" in capsys.readouterr().err


def test_fixes_of_others_are_not_lost(workshop, capsys, tmp_path):
    folder, room = workshop
    for source in (None, np.array(["total station"], dtype=object)):
        fixes = PoseFix(t_ns=room.images.t_ns[:1], enu=np.zeros((1, 3)), source=source)
        save_session(room.replace(pose_fixes=fixes), tmp_path / "room", force=True)
        reported = ["match", f"{tmp_path}/room", "--map", f"{folder}/model", "--known", f"{folder}/without", "--force"]
        assert main(reported) == 1
        assert "which --force would lose" in capsys.readouterr().err
        assert len(sn.load(f"{tmp_path}/room").pose_fixes) == 1


def test_a_run_in_another_frame_is_refused(workshop, capsys, tmp_path):
    folder, room = workshop
    elsewhere = room.replace(origin=Origin(48.0, 9.0, 300.0))
    save_session(elsewhere, tmp_path / "room")
    assert main(["match", f"{tmp_path}/room", "--map", f"{folder}/model", "--known", f"{folder}/without"]) == 1
    assert "has the origin" in capsys.readouterr().err
