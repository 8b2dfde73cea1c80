"""Progress of a long command, on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn
from rich.progress import Progress as Bar

from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.output.text import duration

# Seconds between two updates of the bar, and of a line of text.
PERIOD_S = 0.1
PLAIN_PERIOD_S = 0.5


@contextmanager
def progress(quiet: bool, *, notebook: bool = False) -> Iterator[Progress]:
    """One line on stderr with stage, items done, rate and time left; removed at the end.

    Gives a function of stage, done and total (0: unknown; then the elapsed time is shown). Where stderr is no terminal,
    nothing is written, or with `notebook` one line of text, which every update overwrites.
    """
    if quiet or sys.stderr is None or not (notebook or sys.stderr.isatty()):
        yield silent
        return
    if not sys.stderr.isatty():
        line = _PlainLine()
        yield line
        line.clear()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[status]}"))
    with Bar(*columns, console=Console(file=sys.stderr), transient=True, refresh_per_second=1 / PERIOD_S) as bar:
        yield _Line(bar, bar.add_task("", total=None, visible=False, status=""))


class _PlainLine:
    """The line of the current stage as text, for what understands no escapes of a terminal."""

    def __init__(self) -> None:
        self._stage, self._begun, self._drawn, self._width = "", 0.0, 0.0, 0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.perf_counter()
        if stage != self._stage:
            self._stage, self._begun = stage, now
        elif now - self._drawn < PLAIN_PERIOD_S and done < total:
            return
        self._drawn = now
        self._write(f"{stage}: {_Status(done, total, self._begun)}")

    def clear(self) -> None:
        """Remove the line."""
        self._write("")

    def _write(self, text: str) -> None:
        sys.stderr.write(f"\r{text:<{self._width}}" if text else f"\r{'':<{self._width}}\r")
        sys.stderr.flush()
        self._width = len(text)


class _Line:
    """The line of the current stage."""

    def __init__(self, bar: Bar, task: TaskID) -> None:
        self._bar, self._task = bar, task
        self._stage, self._begun, self._drawn = "", 0.0, 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.perf_counter()
        new = stage != self._stage
        if new:
            self._stage, self._begun = stage, now
        elif now - self._drawn < PERIOD_S and done < total:
            return
        self._drawn = now
        status, whole = _Status(done, total, self._begun), total or None
        self._bar.update(
            self._task, description=stage, completed=done, total=whole, status=status, visible=True, refresh=new
        )


@dataclass(frozen=True)
class _Status:
    """The text behind the bar when it is drawn; of a stage of unknown length the elapsed time."""

    done: int
    total: int
    begun: float

    def __str__(self) -> str:
        elapsed = time.perf_counter() - self.begun
        return counted(self.done, self.total, elapsed) if self.total else time_text(elapsed)


def counted(done: int, total: int, seconds: float) -> str:
    """Items done, rate and time left: ``120 of 505, 240/s, 2 s left``."""
    if not done or seconds <= 0.0:
        return f"{done} of {total}"
    rate = done / seconds
    speed = f"{rate:.0f}" if rate >= 100 else f"{rate:.3g}"
    return f"{done} of {total}, {speed}/s, {time_text((total - done) / rate)} left"


def time_text(seconds: float) -> str:
    """Seconds as text: ``2 s``, ``3 min 05 s``, ``1 h 02 min``."""
    whole = round(seconds)
    return f"{whole} s" if whole < 60 else duration(whole)
