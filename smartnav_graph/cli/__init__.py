"""The command line: sub-commands, no logic. Exit codes: 0 done, 1 a named error, 2 wrong usage, 130 interrupted."""

from __future__ import annotations

import difflib
import importlib
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import TYPE_CHECKING

from smartnav_graph.core.errors import SmartnavError

if TYPE_CHECKING:
    from smartnav_graph.cli.options import Command

# name -> module, class, one line. Modules are imported when their command is called.
COMMANDS: dict[str, tuple[str, str, str]] = {
    "demo": ("demo", "Demo", "smooth, evaluate and draw the two recordings that come with gtsam"),
    "formats": ("sessions", "Formats", "the readers, and how a file is recognised"),
    "import": ("sessions", "Import", "a foreign log -> a session folder"),
    "info": ("sessions", "Info", "what a session holds, what is missing, what looks wrong"),
    "simulate": ("sessions", "Simulate", "a named simulated session with its truth"),
    "degrade": ("sessions", "DegradeSession", "a session -> a noisier, faulty one"),
    "match": ("match", "Match", "the pictures of a session -> matched points or tracks; or how good features are"),
    "smooth": ("runs", "Smooth", "a session -> a run: the smoothed trajectory with its covariance"),
    "replay": ("runs", "Replay", "the same one window at a time, causal"),
    "evaluate": ("scores", "Evaluate", "a run against a reference"),
    "intervals": ("intervals", "Intervals", "how far a solution strays between fixes"),
    "explain": ("inspection", "Explain", "what determined the state of a run at one instant"),
    "compare": ("inspection", "Compare", "a run against another run"),
    "export": ("runs", "Export", "a run as TUM, KML, GeoJSON, GPX or CSV"),
    "view": ("sessions", "View", "sessions and runs in the Rerun viewer"),
}


def overview() -> str:
    """The text of ``smartnav --help``."""
    lines = ["usage: smartnav COMMAND ... [--quiet] [--debug]", "", "commands:"]
    lines += [f"  {name:<10}{summary}" for name, (_, _, summary) in COMMANDS.items()]
    lines += ["", "`smartnav COMMAND --help` shows the options and an example.", "", "Begin with: smartnav demo"]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    argv : arguments without the program's name; those of the process by default

    Returns
    -------
    The exit code.
    """
    try:
        code = _dispatch(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output (head, less) has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _dispatch(arguments: list[str]) -> int:
    if not arguments:
        print(overview(), file=sys.stderr)
        return 2
    name, *rest = arguments
    if name in ("-h", "--help", "help"):
        print(overview())
        return 0
    if name == "--version":
        print(f"smartnav {version('smartnav-graph')}")
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, 1)
        hint = f"; did you mean {close[0]}?" if close else ";"
        print(f"smartnav: no command {name!r}{hint} see smartnav --help", file=sys.stderr)
        return 2
    return _run(name, rest)


def _run(name: str, rest: list[str]) -> int:
    try:
        with _interrupt_ends_process():
            kind = command_class(name)
        from smartnav_graph.cli.options import parse

        command = parse(kind, name, rest)
        logging.basicConfig(level=logging.ERROR if command.quiet else logging.WARNING, format="%(message)s")
        command.run()
        return 0
    except SmartnavError as error:
        if "--debug" in rest:
            traceback.print_exc()
        print(f"smartnav: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("smartnav: interrupted; nothing was written", file=sys.stderr)
        return 130
    except SystemExit as exit:  # help was asked for, or the arguments are wrong
        return exit.code if isinstance(exit.code, int) else 2


@contextmanager
def _interrupt_ends_process() -> Iterator[None]:
    """Ctrl-C while compiled libraries load would come out of them as an ImportError: let it end the process instead."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def command_class(name: str) -> type[Command]:
    """The class of a command."""
    module, kind, _ = COMMANDS[name]
    found: type[Command] = getattr(importlib.import_module(f"smartnav_graph.cli.{module}"), kind)
    return found
