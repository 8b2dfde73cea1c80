"""A log with several sensors of one kind: which is read, and how another is chosen: ``FILE#NAME,NAME``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from smartnav_graph.core.errors import SessionError, warn

_ALIKE = 0.9  # rates within this ratio count as equal


class LogSensor(Protocol):
    """One sensor of a log: its name in the log, and how many rows a second it has."""

    @property
    def name(self) -> str:
        """What the log calls it."""

    @property
    def rate_hz(self) -> float:
        """Rows a second."""


P = TypeVar("P", bound=LogSensor)


def split_source(source: str) -> tuple[Path, tuple[str, ...]]:
    """A file or folder, and the names of the sensors chosen behind ``#``."""
    if "#" not in source or Path(source).exists():
        return Path(source), ()
    name, _, parts = source.partition("#")
    return Path(name), tuple(part for part in parts.split(",") if part)


def select_sensor(path: Path, what: str, parts: Sequence[P], names: Sequence[str]) -> P:
    """The sensor that is named, else the fastest, of those equally fast the first; the others are reported.

    Parameters
    ----------
    what : the kind of sensor, for the report
    names : of `split_source`; of other kinds, too
    """
    named = [part for part in parts if part.name in names]
    fastest = max(part.rate_hz for part in parts)
    found = named[0] if named else next(part for part in parts if part.rate_hz >= _ALIKE * fastest)
    if not named and len(parts) > 1:
        others = ", ".join(f"{part.name} ({part.rate_hz:.0f} Hz)" for part in parts if part is not found)
        chosen = f"{what} of {found.name} ({found.rate_hz:.0f} Hz), the fastest or first"
        warn(f"{path}: {chosen}; there are also {others}: choose one by {path.name}#NAME")
    return found


def check_sensor_names(path: Path, names: Sequence[str], known: Sequence[str]) -> None:
    """Raise SessionError where a sensor is named that the log does not have."""
    for name in names:
        if name not in known:
            raise SessionError(f"{path}#{name}", "is not in the log", f"one of {', '.join(known)}"[:500])
