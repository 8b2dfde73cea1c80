"""The command line: sub-commands, no logic.

Exit codes: 0 done, 1 a named error, 2 wrong usage, 3 done and written but the measurements contradict each other, 130
interrupted, 143 terminated.
"""

from __future__ import annotations

import difflib
import importlib
import logging
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import TYPE_CHECKING, TextIO

from smartnav_graph.core import interrupts
from smartnav_graph.core.errors import SmartnavError, SmartnavWarning
from smartnav_graph.core.text import inert

if TYPE_CHECKING:
    from smartnav_graph.cli.options import Command

# name -> module, class, one line. Modules are imported when their command is called.
COMMANDS: dict[str, tuple[str, str, str]] = {
    "demo": ("demo", "Demo", "process the two recordings of the gtsam package, with report"),
    "formats": ("sessions", "Formats", "list the formats that can be imported"),
    "import": ("sessions", "Import", "import a log of another program into a session folder"),
    "info": ("sessions", "Info", "check a session: streams, rates, data gaps, clock, units"),
    "simulate": ("sessions", "Simulate", "simulate a session with its ground truth"),
    "degrade": ("sessions", "DegradeSession", "add noise and faults to a session"),
    "match": ("match", "Match", "match or track points in the images of a session; compare features"),
    "smooth": ("runs", "Smooth", "compute the trajectory of a session (batch smoothing)"),
    "replay": ("runs", "Replay", "compute the causal trajectory, one window at a time"),
    "evaluate": ("inspection", "Evaluate", "compare a run with a reference trajectory"),
    "intervals": ("intervals", "Intervals", "drift between fixes (simulated outages)"),
    "calibrate": ("calibrate", "Calibrate", "calibrate sensors, camera, clocks; show, compare, apply"),
    "config": ("config", "ConfigCommand", "show the configuration, as the text of a config.toml"),
    "explain": ("inspection", "Explain", "explain which measurements determine the state at one epoch"),
    "compare": ("inspection", "Compare", "compare a run with another run"),
    "export": ("runs", "Export", "export a run: TUM, KML, GPX, CSV, SBET, NMEA, GeoPackage ..."),
    "completion": ("completion", "Completion", "print the script of bash, zsh or fish that completes commands"),
    "view": ("sessions", "View", "show sessions and runs in the Rerun viewer"),
}


def overview() -> str:
    """The text of ``smartnav --help``."""
    lines = ["usage: smartnav COMMAND ... [--quiet] [--debug]", "", "commands:"]
    lines += [f"  {name:<11}{summary}" for name, (_, _, summary) in COMMANDS.items()]
    lines += ["", "`smartnav COMMAND --help` shows the options and an example.", "Begin with: smartnav demo"]
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
    if "_ARGCOMPLETE" in os.environ:  # the shell asks
        from smartnav_graph.cli.completion import answer

        answer()
    try:
        code = _dispatch(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of the output (head, less) was closed
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
        return _carry_out(kind, name, rest)
    except SmartnavError as error:
        if "--debug" in rest:
            traceback.print_exc()
        print(f"smartnav: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as error:
        return _interrupted(error.number if isinstance(error, interrupts.Interrupted) else signal.SIGINT)
    except SystemExit as exit:  # --help, or wrong arguments
        return exit.code if isinstance(exit.code, int) else 2


class _Inert(logging.Formatter):
    """Messages without escapes of the terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return inert(super().format(record))


def _carry_out(kind: type[Command], name: str, rest: list[str]) -> int:
    from smartnav_graph.cli.help import help_text
    from smartnav_graph.cli.options import parse
    from smartnav_graph.core.files import remove_unfinished, written

    written.clear()
    with interrupts.raising() as received, _plain_warnings("--quiet" in rest):
        try:
            kind, name, rest = kind.narrowed(name, rest)
            if asked := {"-h", "--help", "--help-all"} & set(rest):
                print(help_text(kind, name, everything="--help-all" in asked))
                return 0
            command = parse(kind, name, rest)
            handler = logging.StreamHandler()
            handler.setFormatter(_Inert("%(message)s"))
            logging.basicConfig(level=logging.ERROR if command.quiet else logging.WARNING, handlers=[handler])
            return command.run() or 0
        except (SmartnavError, BrokenPipeError, SystemExit):
            raise
        except Exception as error:
            if not received:
                raise
            raise interrupts.Interrupted(received[0]) from error  # compiled code made another exception of it
        finally:
            with interrupts.held():
                remove_unfinished()


@contextmanager
def _plain_warnings(quiet: bool) -> Iterator[None]:
    """Warnings of the package as lines on stderr, every one of them; none where `quiet`."""
    with warnings.catch_warnings():
        others = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, SmartnavWarning):
                print(message, file=sys.stderr)
            else:
                others(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        warnings.simplefilter("ignore" if quiet else "always", SmartnavWarning)
        yield


def _interrupted(number: int) -> int:
    """Say what was written before the signal came; the exit code."""
    from smartnav_graph.core.files import written

    there = [str(path) for path in written if path.exists()]
    found = f"{', '.join(there)} written before" if there else "nothing was written"
    print(f"smartnav: {'interrupted' if number == signal.SIGINT else 'terminated'}; {found}", file=sys.stderr)
    return 128 + number


@contextmanager
def _interrupt_ends_process() -> Iterator[None]:
    """End the process on Ctrl-C while compiled libraries load: they would raise an ImportError instead."""
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
