"""What was there before a failure is there after it; nothing half-written is left."""

from __future__ import annotations

import errno
import os
import signal

import pytest

from smartnav_graph.core import files
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import refuse_existing, refuse_foreign, replacing


@pytest.fixture(params=["file", "folder"])
def target(request, tmp_path):
    """An old result, as a file or a folder."""
    path = tmp_path / "result"
    write(path, request.param, "old")
    return path, request.param


def write(path, kind, text):
    if kind == "folder":
        path.mkdir()
        path = path / "inside.txt"
    path.write_text(text)


def read(path):
    return (path / "inside.txt" if path.is_dir() else path).read_text()


def break_off(path, kind, fault):
    """Half a new result, then a fault."""
    with replacing(path) as new:
        write(new, kind, "half")
        raise fault


def names(path):
    return sorted(entry.name for entry in path.iterdir())


def test_the_new_takes_the_place_of_the_old(target):
    path, kind = target
    with replacing(path) as new:
        assert not new.exists() and new.parent.parent == path.parent  # the same disk: a move, not a copy
        write(new, kind, "new")
        assert read(path) == "old"
    assert read(path) == "new" and names(path.parent) == ["result"]


def test_folders_on_the_way_are_made(tmp_path):
    with replacing(tmp_path / "a" / "b" / "c") as new:
        new.write_text("here")
    assert (tmp_path / "a" / "b" / "c").read_text() == "here"


@pytest.mark.parametrize("fault", [KeyboardInterrupt, ValueError, SystemExit])
def test_an_interrupt_leaves_the_old_and_no_leftovers(target, fault):
    path, kind = target
    with pytest.raises(fault):
        break_off(path, kind, fault())
    assert read(path) == "old" and names(path.parent) == ["result"]


def test_a_full_disk_is_reported_and_leaves_the_old(target):
    path, kind = target
    with pytest.raises(SessionError) as e:
        break_off(path, kind, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert str(e.value) == (
        f"{path}: could not be written (No space left on device); expected space on the disk and permission to write; "
        "nothing was changed; free some space or choose another place"
    )
    assert read(path) == "old" and names(path.parent) == ["result"]


def test_a_move_that_fails_puts_the_old_back(target, monkeypatch):
    path, kind = target
    real, moved = os.replace, []

    def replace(source, destination):
        moved.append(source)
        if os.path.basename(source) == "result" and str(destination) == str(path) and "replaced" not in str(source):
            raise OSError(errno.EIO, "Input/output error")
        real(source, destination)

    monkeypatch.setattr(files, "_exchange", lambda first, second: False)  # a disk that cannot
    monkeypatch.setattr(files.os, "replace", replace)
    with pytest.raises(SessionError, match=r"could not be written \(Input/output error\)"), replacing(path) as new:
        write(new, kind, "new")
    assert moved and read(path) == "old" and names(path.parent) == ["result"]


def test_a_disk_that_cannot_exchange(target, monkeypatch):
    path, kind = target
    monkeypatch.setattr(files, "_exchange", lambda first, second: False)
    with replacing(path) as new:
        write(new, kind, "new")
    assert read(path) == "new" and names(path.parent) == ["result"]


def test_a_second_writer_is_refused(target):
    path, kind = target
    with replacing(path) as new:
        write(new, kind, "new")
        held = files._claimed.pop(new.parent)  # as another process sees it
        with pytest.raises(SessionError, match="result: is being written by another process"), replacing(path):
            pytest.fail("the block must not run")
        files._claimed[new.parent] = held
    assert read(path) == "new" and names(path.parent) == ["result"]


def test_what_a_killed_process_left_is_named_and_removed(target, warned):
    path, kind = target
    scratch = path.parent / ".result.writing"
    scratch.mkdir()
    write(scratch / "result", kind, "half")
    with replacing(path) as new:
        write(new, kind, "new")
    assert warned() == f"{scratch / 'result'}: left by a process that was killed; removed"
    assert read(path) == "new" and names(path.parent) == ["result"]


def test_the_old_is_put_back_where_a_kill_came_between_two_moves(target, warned):
    path, kind = target
    scratch = path.parent / ".result.writing"
    scratch.mkdir()
    os.replace(path, scratch / "replaced")
    with pytest.raises(KeyboardInterrupt):
        break_off(path, kind, KeyboardInterrupt())
    assert read(path) == "old" and names(path.parent) == ["result"]


def test_another_unfinished_folder_is_named_and_stays(target, warned):
    path, kind = target
    (path.parent / ".other.writing").mkdir()
    with replacing(path) as new:
        write(new, kind, "new")
    assert ".other.writing: of a process that is writing, or was killed" in warned()
    assert names(path.parent) == [".other.writing", "result"]


def test_a_signal_waits_until_the_new_is_in_its_place(target, monkeypatch):
    path, kind = target
    moved = files._put

    def put(new, path, aside):
        signal.raise_signal(signal.SIGINT)
        moved(new, path, aside)

    monkeypatch.setattr(files, "_put", put)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by a process in the background
    try:
        with pytest.raises(KeyboardInterrupt), replacing(path) as new:
            write(new, kind, "new")
    finally:
        signal.signal(signal.SIGINT, before)
    assert read(path) == "new" and names(path.parent) == ["result"]


def test_nothing_is_replaced_without_leave(target):
    path, _ = target
    with pytest.raises(SessionError, match="exists already; expected a new name; choose another --out, or add --force"):
        refuse_existing(path, force=False)
    with pytest.raises(SessionError, match="exists already"), replacing(path, force=False):
        pytest.fail("the block must not run")
    refuse_existing(path, force=True)
    assert read(path) == "old"


def test_an_empty_folder_is_free(tmp_path):
    (tmp_path / "empty").mkdir()
    refuse_existing(tmp_path / "empty", force=False)
    with replacing(tmp_path / "empty", force=False) as new:
        write(new, "folder", "new")
    assert read(tmp_path / "empty") == "new"


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    remedy = r"cannot be written \(.*\); expected a writable place"
    with pytest.raises(SessionError, match=remedy), replacing(tmp_path / "file" / "below"):
        pytest.fail("the block must not run")


def test_force_does_not_replace_a_folder_of_somebodys_own(tmp_path):
    (tmp_path / "thesis.doc").write_text("")
    with pytest.raises(SessionError, match=r"holds no session\.toml, so it is not replaced") as e:
        refuse_foreign(tmp_path, "session.toml")
    assert "remove it yourself" in str(e.value)
    (tmp_path / "session.toml").write_text("")
    refuse_foreign(tmp_path, "session.toml")
    refuse_foreign(tmp_path / "new", "session.toml")
    with pytest.raises(SessionError):
        refuse_foreign(tmp_path / "thesis.doc", "session.toml")


@pytest.mark.parametrize(
    "name", ["../a", "/a", "a/../../b", "a\\..\\b", "C:\\a", "\0", "", "x" * 256, "\udcff", "a/" * 3000]
)
def test_names_that_lead_outside(tmp_path, name):
    assert not files.name_inside(name) and files.file_inside(tmp_path, name) is None


def test_only_files_inside_a_folder(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "out").write_text("secret")
    (tmp_path / "in" / "link").symlink_to(tmp_path / "out")
    (tmp_path / "in" / "circle").symlink_to("circle")
    os.mkfifo(tmp_path / "in" / "pipe")
    (tmp_path / "in" / "a").mkdir()
    (tmp_path / "in" / "a" / "picture.png").write_text("")
    (tmp_path / "folder").symlink_to("in")
    for name in ("link", "circle", "pipe", "a", "none"):
        assert files.file_inside(tmp_path / "in", name) is None
    assert files.file_inside(tmp_path / "folder", "a/picture.png") == tmp_path / "folder" / "a" / "picture.png"
