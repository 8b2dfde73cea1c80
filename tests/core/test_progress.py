"""Progress: reported in order, and on a terminal only."""

import io
import os
import pty
import sys

import pytest

from smartnav_graph.core.progress import under, watched
from smartnav_graph.output import progress as shown


def collected():
    reported = []
    return reported, lambda *row: reported.append(row)


def test_items_are_reported_when_they_are_done():
    reported, progress = collected()
    assert list(watched("pass 1", ["a", "b"], progress)) == ["a", "b"]
    assert reported == [("pass 1", 0, 2), ("pass 1", 1, 2), ("pass 1", 2, 2)]


def test_an_item_that_was_not_finished_is_not_reported():
    reported, progress = collected()
    for item in watched("replay", [1, 2, 3], progress):
        if item == 2:
            break
    assert reported == [("replay", 0, 3), ("replay", 1, 3)]


def test_stages_under_a_name():
    reported, progress = collected()
    under("run 2 of 6", progress)("replay", 5, 9)
    assert reported == [("run 2 of 6, replay", 5, 9)]


@pytest.mark.parametrize(
    ("done", "total", "seconds", "text"),
    [
        (0, 505, 0.0, "0 of 505"),
        (120, 505, 0.5, "120 of 505, 240/s, 2 s left"),
        (1, 500, 1.0, "1 of 500, 1/s, 8 min 19 s left"),
        (2, 20000, 2.0, "2 of 20000, 1/s, 5 h 33 min left"),
    ],
)
def test_what_is_done_how_fast_and_what_is_left(done, total, seconds, text):
    assert shown.counted(done, total, seconds) == text


def run_stages(quiet: bool = False) -> None:
    with shown.progress(quiet) as show:
        show("reading", 0, 0)
        for i in range(3):
            show("replay", i + 1, 3)


def test_not_a_byte_where_stderr_is_no_terminal(monkeypatch):
    pipe = io.StringIO()
    monkeypatch.setattr(sys, "stderr", pipe)
    monkeypatch.setenv("FORCE_COLOR", "1")  # what makes rich take a pipe for a terminal
    run_stages()
    assert pipe.getvalue() == ""


@pytest.mark.parametrize("quiet", [False, True])
def test_a_terminal_shows_the_stage_unless_quiet(monkeypatch, quiet):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "70")
    master, slave = pty.openpty()
    with os.fdopen(slave, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        run_stages(quiet)
        print("end", file=terminal, flush=True)
        text = ""
        while "end\r\n" not in text:  # a terminal gives what it has, not all
            text += os.read(master, 100_000).decode()
    os.close(master)
    assert ("reading" in text) == ("3 of 3" in text) == (not quiet)
    assert text.endswith("end\r\n")
