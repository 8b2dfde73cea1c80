"""The registry: recognition by content, archives, and errors that name the formats."""

import shutil
import stat
import tarfile
import zipfile
from pathlib import Path

import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.readers.source import example_file

IMU = "t_ns,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,accel_x_m_s2,accel_y_m_s2,accel_z_m_s2\n"
ROWS = "10,0,0,0,0,0,9.81\n20,0,0,0,0,0,9.81\n"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "log").mkdir()
    (tmp_path / "log" / "imu.csv").write_text(IMU + ROWS)
    return tmp_path / "log"


def test_every_reader_says_what_it_is():
    assert {"gtsam-kitti", "gtsam-euroc", "euroc", "csv", "comma2k19"} <= set(readers.READERS)
    for name, reader in readers.READERS.items():
        assert reader.name == name
        for line in (reader.summary, reader.recognised_by):
            assert line and "\n" not in line and len(line) < 100


@pytest.mark.parametrize("name", ["gtsam-kitti", "gtsam-euroc"])
def test_literal_names_match_one_reader(name):
    assert [reader.name for reader in readers.READERS.values() if reader.matches(name)] == [name]


def test_public_recordings_match_one_reader(dataset):
    for name, expected in (("euroc_v101", "euroc"), ("car_comma2k19", "comma2k19")):
        source = str(dataset(name))
        assert [reader.name for reader in readers.READERS.values() if reader.matches(source)] == [expected]


def test_no_reader_chokes_on_foreign_sources(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(bytes(range(256)) * 20)
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "photo.jpg", tmp_path / "empty", tmp_path / "absent", "", "\0"):
        assert not any(reader.matches(str(source)) for reader in readers.READERS.values())


def test_none_matches(tmp_path):
    with pytest.raises(SessionError) as caught:
        readers.read(tmp_path)
    for part in (f"{tmp_path}: is of no known format", "gtsam-kitti, gtsam-euroc, euroc", "smartnav formats"):
        assert part in str(caught.value)


def test_several_match(folder):
    (folder / "imu0").mkdir()
    (folder / "imu0" / "data.csv").write_text("")
    with pytest.raises(
        SessionError, match="is recognised as euroc, csv; expected one format; choose one with --format"
    ):
        readers.read(folder)
    assert len(readers.read(folder, "csv").imu) == 2


@pytest.mark.parametrize("name", [None, "csv", "gtsam-kitti"])
def test_missing_source(tmp_path, name):
    with pytest.raises(SessionError, match="nowhere: does not exist"):
        readers.read(tmp_path / "nowhere", name)


def test_unknown_format_and_repair(folder):
    with pytest.raises(SessionError, match="--format: unknown format 'rosbag'; expected one of gtsam-kitti"):
        readers.read(folder, "rosbag")
    with pytest.raises(ConfigError, match="unknown repair magic"):
        readers.read(folder, repairs=("magic",))


@pytest.mark.parametrize("kind", ["zip", "gztar"])
@pytest.mark.parametrize("top", [True, False])
def test_archives(folder, tmp_path, kind, top):
    root = {"root_dir": tmp_path, "base_dir": "log"} if top else {"root_dir": folder}
    archive = shutil.make_archive(str(tmp_path / "packed"), kind, **root)
    assert len(readers.read(archive).imu) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["log", archive.rsplit("/", 1)[1]])


def test_faults_in_archives_name_the_archive(folder, tmp_path):
    (folder / "imu.csv").write_text(IMU + ROWS.replace("20,0", "20,x"))
    archive = shutil.make_archive(str(tmp_path / "packed"), "zip", root_dir=folder)
    with pytest.raises(SessionError, match=r"packed.zip/imu.csv: gyro_x_rad_s is 'x' at row 1"):
        readers.read(archive)
    damaged = tmp_path / "damaged.zip"
    data = bytearray((tmp_path / "packed.zip").read_bytes())
    data[60:90] = b"\0" * 30
    damaged.write_bytes(data)
    with pytest.raises(SessionError, match=r"damaged.zip: cannot be unpacked"):
        readers.read(damaged)


@pytest.mark.parametrize(("name", "kind"), [("../evil.txt", tarfile.REGTYPE), ("link", tarfile.SYMTYPE)])
def test_an_archive_that_reaches_outside_itself_is_refused(tmp_path, name, kind):
    member = tarfile.TarInfo(name)
    member.type, member.linkname = kind, "/etc/passwd" if kind == tarfile.SYMTYPE else ""
    with tarfile.open(tmp_path / "log.tar", "w") as archive:
        archive.addfile(member)
    with pytest.raises(SessionError, match=r"log\.tar: cannot be unpacked"):
        readers.read(tmp_path / "log.tar")
    assert [path.name for path in tmp_path.iterdir()] == ["log.tar"]


def packed(tmp_path, folder, **others):
    """A zip file of a folder, and more members by name."""
    archive = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", root_dir=folder))
    with zipfile.ZipFile(archive, "a", zipfile.ZIP_DEFLATED) as file:
        for name, data in others.items():
            file.writestr(name, data)
    return archive


def test_links_and_repeated_members_are_left_out_and_counted(folder, tmp_path):
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    archive = packed(tmp_path, folder)
    with zipfile.ZipFile(archive, "a") as file:
        file.writestr(link, "/etc/passwd")
        with pytest.warns(UserWarning, match="Duplicate name"):
            file.writestr("imu.csv", "")
    session = readers.read(archive)
    assert len(session.imu) == 2 and list(session.dropped["archive"].values()) == [1, 1]


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("../evil", "leads outside"),
        ("/evil", "leads outside"),
        ("a/..\\..\\evil", "leads outside"),
        ("C:\\evil", "outside"),
    ],
)
def test_names_that_lead_outside_a_zip_file(folder, tmp_path, name, found):
    with pytest.raises(SessionError, match=rf"packed\.zip: cannot be unpacked \(the member .*{found}"):
        readers.read(packed(tmp_path, folder, **{name: "x"}))


def test_an_archive_that_would_fill_the_disk(folder, tmp_path):
    with pytest.raises(SessionError, match=r"cannot be unpacked \(it holds more than 100000000 bytes"):
        readers.read(packed(tmp_path, folder, bomb=bytes(150_000_000)))


def test_an_encrypted_archive(folder, tmp_path):
    archive = packed(tmp_path, folder)
    data = bytearray(archive.read_bytes())
    for mark, place in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        data[data.index(mark) + place] |= 1
    archive.write_bytes(data)
    with pytest.raises(SessionError, match=r"imu\.csv is encrypted; unpack it with its password first"):
        readers.read(archive)


def test_an_archive_of_a_single_log_file(tmp_path):
    shutil.make_archive(
        str(tmp_path / "packed"), "zip", example_file("eqvio_processed_30s.csv").parent, "eqvio_processed_30s.csv"
    )
    assert len(readers.read(tmp_path / "packed.zip").imu) == 6001
