"""Opening recordings, sessions and runs in the Rerun viewer."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import quote

from smartnav_graph.core.errors import SessionError, SmartnavError
from smartnav_graph.session.folder import load


def recordings(paths: Iterable[str | Path], scratch: Path) -> list[Path]:
    """The .rrd files of each recording, run folder (run.rrd inside, latency.rrd of a replay) or session folder (written
    to `scratch`).

    Raises
    ------
    SessionError
        A path is none of these.
    """
    return [file for number, path in enumerate(paths) for file in _recordings(Path(path), scratch / f"{number}.rrd")]


def _recordings(path: Path, new: Path) -> list[Path]:
    from smartnav_graph.output.rerun_log import write_recording

    if path.is_file() and path.suffix == ".rrd":
        return [path]
    if (path / "run.rrd").is_file():
        return [file for name in ("run.rrd", "latency.rrd") if (file := path / name).is_file()]
    if (path / "session.toml").is_file():
        write_recording(new, session=load(path), solution=None)
        return [new]
    found = "does not exist" if not path.exists() else "holds no run.rrd and no session.toml"
    raise SessionError(path, found, "a .rrd file, a run folder or a session folder", "check the path")


def view(paths: Iterable[str | Path], web: bool = False, *, announce: Callable[[str], None] | None = None) -> None:
    """Show recordings, runs and sessions in the Rerun viewer; returns when the viewer is closed.

    Parameters
    ----------
    paths : .rrd files, run folders, session folders; several open together
    web : serve the viewer to a browser instead of opening a window
    announce : called with the address to open in a browser

    Raises
    ------
    SessionError
        A path is no recording, run or session.
    SmartnavError
        There is no display for a window, or the viewer ended with an error.
    """
    if not web:
        _require_display()
    with tempfile.TemporaryDirectory(prefix="smartnav-view-") as scratch:
        files = recordings(paths, Path(scratch))
        # Only this machine may connect: the viewer listens to the whole network otherwise.
        options = ["--bind", "127.0.0.1"]
        if web:
            page, data = free_ports(2)
            options += ["--serve-web", "--web-viewer-port", str(page), "--port", str(data)]
            proxy = quote(f"rerun+http://127.0.0.1:{data}/proxy", safe="")
            (announce or _ignore)(f"http://127.0.0.1:{page}/?url={proxy}")
        command = [str(executable()), *options, *(str(file.resolve()) for file in files)]
        # the viewer's own messages name other addresses
        environment = {**os.environ, "RUST_LOG": "error"} if web else None
        code = subprocess.run(command, check=False, env=environment).returncode
    if code not in (0, -2, 130):  # closed, or interrupted by the user
        raise SmartnavError("Rerun viewer", f"ended with code {code}", "0", "read its messages above, or try --web")


def _ignore(address: str) -> None:
    pass


def free_ports(count: int) -> list[int]:
    """Ports of this machine that nothing listens to."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]


def _require_display() -> None:
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise SmartnavError(
            "Rerun viewer",
            "no display (neither DISPLAY nor WAYLAND_DISPLAY is set)",
            "a graphical desktop",
            "add --web to serve it to a browser, or copy the .rrd file to a desktop and open it there",
        )


def executable() -> Path:
    """The viewer's binary: its Python wrapper would leave the window open when it is interrupted."""
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise SmartnavError("Rerun viewer", "is not installed", "the package rerun-sdk", "pip install rerun-sdk")
    return Path(package.origin).parent / ("rerun.exe" if sys.platform == "win32" else "rerun")
