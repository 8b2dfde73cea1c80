"""Ctrl-C and the end that the system asks for: raised as an exception, and held back while a result takes its place."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Interrupted(KeyboardInterrupt):
    """A signal that ends the process; `number` says which."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextmanager
def raising() -> Iterator[list[int]]:
    """Raise `Interrupted` at each of `SIGNALS`, also those that end a process at once by default.

    Yields the numbers of the signals that came: compiled code may turn the exception into another. Signals that are
    ignored, as those of a process in the background are, stay so.
    """
    received: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise Interrupted(number)

    before = _handled(interrupt)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def held() -> Iterator[None]:
    """Hold the signals back until the block has ended."""
    pending: list[int] = []
    before = _handled(lambda number, frame: pending.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in pending[:1]:
            signal.raise_signal(number)


def _handled(handler: object) -> dict[int, signal._HANDLER]:
    """Set a handler for each of the signals that is not ignored; gives those before. Only the main thread may."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    heard = [number for number in SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    return {number: signal.signal(number, handler) for number in heard}  # type: ignore[arg-type]
