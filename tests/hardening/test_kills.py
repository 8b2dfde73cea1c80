"""Killed or interrupted at any moment: the old or the new, whole; what a kill leaves is cleared up."""

import os
import signal
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import kills

from smartnav_graph.core import files
from smartnav_graph.core.interrupts import Interrupted, raising


def write(path, text):
    path.mkdir()
    for name in "ab":
        (path / name).write_text(text)


def replaced_in_a_child(path, number, stop):
    """Exit code of a child that replaces a folder, and gets a signal at its change number `stop` (0: none)."""
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    code, count = 70, 0

    def on_event(event, detail):
        nonlocal count
        if event in kills.CHANGES:
            count += 1
            if count == stop:
                os.kill(os.getpid(), number)

    try:
        sys.addaudithook(on_event)
        with raising():
            try:
                with files.replacing(path) as new:
                    write(new, "new")
                code = 0 if stop else 100 + count
            except Interrupted:
                code = 1
            finally:
                files.remove_unfinished()
    finally:
        os._exit(code)


@pytest.mark.parametrize("exchange", [True, False])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_a_signal_at_every_change_of_the_disk(tmp_path, monkeypatch, number, exchange):
    path = tmp_path / "result"
    if not exchange:
        monkeypatch.setattr(files, "_exchange", lambda first, second: False)
    write(path, "old")
    changes = replaced_in_a_child(path, number, 0) - 100
    assert changes > 8
    for stop in range(1, changes + 1):
        for entry in [*path.iterdir(), path] if path.exists() else ():
            entry.rmdir() if entry.is_dir() else entry.unlink()
        write(path, "old")
        code = replaced_in_a_child(path, number, stop)
        if number == signal.SIGKILL:
            assert code == -number
            with pytest.raises(KeyboardInterrupt), files.replacing(path):  # the next start clears up
                raise KeyboardInterrupt
        texts = {(path / name).read_text() for name in "ab"}
        assert texts == {"old"} or texts == {"new"}, stop
        assert [entry.name for entry in tmp_path.iterdir()] == ["result"], stop


@pytest.mark.slow
def test_five_hundred_commands(tmp_path, monkeypatch):
    kills.workshop(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert kills.strikes(tmp_path, 500, 0, list(kills.COMMANDS)) == []
