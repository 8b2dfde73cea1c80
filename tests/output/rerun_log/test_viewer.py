"""Opening recordings, runs and sessions."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from recordings import (
    make_session,
)

from smartnav_graph.core.errors import SessionError, SmartnavError
from smartnav_graph.output.rerun_log import viewer
from smartnav_graph.session import folder as session_folder


def test_view_opens_recordings_runs_and_sessions(tmp_path, monkeypatch):
    session_folder.save(make_session(), tmp_path / "session")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.rrd").write_bytes(b"")
    opened = []

    def run(command, check, env):
        opened.append(command)
        assert all(viewer.Path(file).is_file() for file in command[1:] if file.endswith(".rrd"))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(viewer.subprocess, "run", run)
    monkeypatch.setenv("DISPLAY", ":0")
    viewer.view([tmp_path / "session", tmp_path / "run"])
    assert [file.rsplit("/", 1)[-1] for file in opened[0][1:]] == ["--bind", "127.0.0.1", "0.rrd", "run.rrd"]
    links = []
    viewer.view([tmp_path / "run"], web=True, announce=links.append)
    ports = [opened[1][opened[1].index(option) + 1] for option in ("--web-viewer-port", "--port")]
    assert "--serve-web" in opened[1] and len({*ports}) == 2
    assert links == [f"http://127.0.0.1:{ports[0]}/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{ports[1]}%2Fproxy"]
    (tmp_path / "run" / "latency.rrd").write_bytes(b"")  # of a replay
    viewer.view([tmp_path / "run"], web=True)
    assert [file.rsplit("/", 1)[-1] for file in opened[2][-2:]] == ["run.rrd", "latency.rrd"]


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
