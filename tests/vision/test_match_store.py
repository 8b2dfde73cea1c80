"""What the session keeps: read again where it was made alike, refused where not; the command line over it."""

import json
import shutil

import numpy as np
import pytest
from scenes2d import CAMERA, centred, seen, session_of, texture

import smartnav_graph as sn
from smartnav_graph.cli import main
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import write_table
from smartnav_graph.session.calibration import model as calibration_model
from smartnav_graph.vision import match_store
from smartnav_graph.vision.front_end import FrontEndConfig

PLANE = texture(seed=7)
SHIFT = np.array([[1, 0, 6.0], [0, 1, -4.0], [0, 0, 1]])
PICTURES = [seen(PLANE, np.linalg.matrix_power(SHIFT, k) @ centred(PLANE)) for k in range(4)]
CONFIG = FrontEndConfig(count=150, spans=(1,))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kept") / "s"
    session_of(PICTURES, folder)
    return folder, match_store.match(folder, CONFIG)


@pytest.fixture
def folder(made, tmp_path):
    shutil.copytree(made[0], tmp_path / "s")  # other time stamps of the files, the same content
    return tmp_path / "s"


def test_a_second_call_reads_what_the_first_one_kept(made, folder, monkeypatch):
    def never(*_args, **_options):
        raise AssertionError("computed again")

    monkeypatch.setattr(match_store, "run_front_end", never)
    again = match_store.match(folder, CONFIG)
    assert made[1].computed and not again.computed
    assert again.report == made[1].report
    for name, column in made[1].matches.columns().items():
        np.testing.assert_array_equal(again.matches.columns()[name], column)
    assert len(sn.load(folder).matches) == again.report.matches  # every reader of sessions sees them


def refused(folder, config=CONFIG) -> str:
    with pytest.raises(SessionError) as caught:
        match_store.match(folder, config)
    assert "add --force to replace it" in str(caught.value)
    return str(caught.value)


def test_other_options_are_refused_and_force_replaces(folder):
    other = FrontEndConfig(count=150, spans=(1, 2), policy="thesis")
    text = refused(folder, other)
    assert "matches.parquet: was made with policy ratio (asked for: thesis), spans [1] (asked for: [1, 2])" in text
    assert match_store.match(folder, other, force=True).computed
    assert not match_store.match(folder, other).computed
    assert "policy thesis (asked for: ratio)" in refused(folder)


def test_tracks_stand_beside_matches(folder):
    found = match_store.match(folder, FrontEndConfig(features="klt", count=50))
    session = sn.load(folder)
    assert found.computed and len(session.tracks) == len(found.tracks) and len(session.matches)
    assert not match_store.match(folder, FrontEndConfig(features="klt", count=50)).computed


def test_changed_pictures_or_calibration_are_noticed(folder):
    calibration = (folder / "calibration.toml").read_text()
    (folder / "calibration.toml").write_text(calibration.replace("fx = 300.0", "fx = 301.0"))
    assert "was made with other pictures or another calibration" in refused(folder)
    (folder / "calibration.toml").write_text(calibration)
    assert not match_store.match(folder, CONFIG).computed
    shutil.copy(folder / "images" / "000.png", folder / "images" / "003.png")
    assert "was made with other pictures or another calibration" in refused(folder)


def test_rows_of_unknown_origin_are_not_taken_for_ours(folder):
    (folder / "matches.toml").unlink()
    assert "does not say how it was made" in refused(folder)
    (folder / "matches.toml").write_text("no toml")
    assert "does not say how it was made" in refused(folder)


def test_edited_rows_are_noticed(folder):
    session = sn.load(folder)
    write_table(session.matches.take(slice(1, None)).columns(), folder / "matches.parquet")
    assert "was changed since it was made" in refused(folder)


def call(capsys, *arguments) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    said = capsys.readouterr()
    return code, said.out, said.err


def test_the_command_makes_and_keeps_matches(folder, capsys):
    code, out, err = call(capsys, "match", folder, "--features", "akaze", "--quiet")
    assert code == 1 and "features orb (asked for: akaze)" in err and out == ""
    code, out, err = call(capsys, "match", folder, "--features", "akaze", "--quiet", "--force")
    assert (code, err) == (0, "")
    assert "pictures: 4 of 4 used" in out and f"matches: {folder}/matches.parquet\n" in out
    code, out, _ = call(capsys, "match", folder, "--features", "akaze")
    assert code == 0 and "read from an earlier call" in out
    code, out, _ = call(capsys, "match", folder, "--features", "akaze", "--json")
    reported = json.loads(out)
    assert reported["computed"] is False and reported["pairs"] == 5 and reported["skipped"] == {}


def test_match_files_go_out_and_in(folder, tmp_path, capsys):
    before = sn.load(folder).matches
    file = tmp_path / "m.txt"
    code, out, _ = call(capsys, "match", folder, "--to-file", file)
    assert code == 0 and f"{len(before)} matches of cam0" in out
    assert call(capsys, "match", folder, "--to-file", file)[0] == 1  # exists
    code, _, err = call(capsys, "match", folder, "--from-file", file)
    assert code == 1 and "exists already" in err
    code, out, _ = call(capsys, "match", folder, "--from-file", file, "--force", "--json")
    assert json.loads(out) == {
        "from_file": str(file),
        "rows": len(before),
        "matches": len(before),
        "rows_without_images": 0,
    }
    after = sn.load(folder).matches
    np.testing.assert_array_equal(after.image_id_1, before.image_id_1)
    pitch = 4540.0 / CAMERA.width * CAMERA.fx  # um a unit of normalised coordinates
    np.testing.assert_allclose(after.xy0_n, before.xy0_n, atol=0.001 / pitch)
    assert f"was taken from {file.name}" in refused(folder)


@pytest.mark.parametrize(
    ("arguments", "code", "part"),
    [
        (("--spans", "1,x"), 1, "--spans: '1,x'; expected whole numbers"),
        (("--policy", "best"), 2, "best"),
        (
            ("--camera", "cam7", "--from-file", "m.txt", "--force"),
            1,
            "--camera: 'cam7'; expected one with images: cam0",
        ),
        (("--from-file", "absent.txt", "--force"), 1, "absent.txt: is missing"),
        (("--from-file", "a", "--to-file", "b"), 1, "one of them"),
        (("--features", "klt", "--benchmark"), 1, "klt in a benchmark"),
        (("--benchmark",), 1, "has no reference with attitude"),
    ],
)
def test_what_the_command_refuses(folder, capsys, monkeypatch, arguments, code, part):
    monkeypatch.chdir(folder)
    found, out, err = call(capsys, "match", folder, *arguments)
    assert found == code and out == "" and part in err


def test_a_camera_without_calibration_cannot_read_match_files(folder, tmp_path, capsys):
    (folder / "calibration.toml").write_text(calibration_model.calibration_toml(calibration_model.Calibration()))
    code, _, err = call(capsys, "match", folder, "--to-file", tmp_path / "m.txt")
    assert code == 1 and "has no camera cam0; expected [cameras.cam0]" in err


def test_a_log_is_imported_first(capsys):
    code, _, err = call(capsys, "match", "gtsam-euroc")
    assert code == 1 and "smartnav import" in err
