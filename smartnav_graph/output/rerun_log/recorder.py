"""One open recording: the time lines every row carries, and which entities hold data."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from smartnav_graph.core.arrays import Times
from smartnav_graph.estimate.result.diagnostics import window_of
from smartnav_graph.output.rerun_log import colours

APPLICATION = "smartnav_graph"
# Numbers at the axis of a small plot before they run into each other.
MOST_NUMBERS = 6.5
# How many times larger than what it shows a plot may be for the sake of a second number.
MOST_ROOM = 1.7

# Days on which TAI - UTC grew by one second since GPS time began (IERS Bulletin C).
_LEAP_DAYS = (
    *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
    *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
    *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
_GPS_EPOCH_NS = int(np.datetime64("1980-01-06", "ns").astype(np.int64))
_YEAR_2000_NS = int(np.datetime64("2000-01-01", "ns").astype(np.int64))


def utc_from_gps(t_ns: Times) -> Times:
    """Unix nanoseconds (UTC) of nanoseconds since 1980-01-06 in GPS time, leap seconds taken off."""
    steps = np.array(_LEAP_DAYS, dtype="datetime64[ns]").astype(np.int64) + np.arange(1, len(_LEAP_DAYS) + 1) * 10**9
    continuous = np.asarray(t_ns, dtype=np.int64) + _GPS_EPOCH_NS
    return np.asarray(continuous - np.searchsorted(steps, continuous, side="right") * 10**9)


@dataclass(frozen=True)
class Clock:
    """Stamps of a session -> the index columns `elapsed`, `utc` or `device`, and `keyframe`.

    `elapsed` counts from the session's time zero. `utc` exists where the session's clock is a date (unix, gps), else
    `device` holds the raw reading. A "gps" or "unix" clock that reads before the year 2000 counts seconds of a week
    or a day: it is no date. `keyframe` numbers the window between keyframes (`keyframe_ns` (n,)) that a stamp lies in
    by the keyframe at its end; without keyframes there is no such time line.
    """

    t0_ns: int
    epoch: str = "unknown"
    keyframe_ns: Times = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def is_date(self) -> bool:
        """Whether the stamps are dates."""
        return self.epoch in ("unix", "gps") and int(self.utc(np.array([self.t0_ns]))[0]) >= _YEAR_2000_NS

    def utc(self, t_ns: Times) -> Times:
        """Unix nanoseconds of stamps of a unix or gps clock."""
        return utc_from_gps(t_ns) if self.epoch == "gps" else t_ns

    def columns(self, t_ns: ArrayLike) -> list[Any]:
        """Index columns for rows at `t_ns` (n,)."""
        import rerun as rr

        t = np.asarray(t_ns, dtype=np.int64)
        columns = [rr.TimeColumn("elapsed", duration=(t - self.t0_ns).astype("timedelta64[ns]"))]
        if self.is_date:
            columns.append(rr.TimeColumn("utc", timestamp=self.utc(t).astype("datetime64[ns]")))
        else:
            columns.append(rr.TimeColumn("device", duration=t.astype("timedelta64[ns]")))
        if len(self.keyframe_ns):
            columns.append(rr.TimeColumn("keyframe", sequence=window_of(t, self.keyframe_ns)))
        return columns


@dataclass
class Recorder:
    """Writes columns and static data, and remembers the entities, so that the blueprint shows only what is there.

    `limits` keeps a plot's value range where the viewer's own choice would cut off the bands, `bounds` the lower and
    upper corner (2, 2) of a flat drawing.
    """

    stream: Any
    clock: Clock
    paths: set[str] = field(default_factory=set)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    bounds: dict[str, NDArray[np.floating[Any]]] = field(default_factory=dict)

    def static(self, path: str, *archetypes: Any) -> None:
        """Data that holds at all times."""
        self.stream.log(path, *archetypes, static=True, strict=True)
        self.paths.add(path)

    def style(self, path: str, *archetypes: Any) -> None:
        """Static colours and names of an entity whose data are rows; once an entity, as two would come in any order."""
        self.stream.log(path, *archetypes, static=True, strict=True)

    def rows(self, path: str, t_ns: ArrayLike, columns: Iterable[Any]) -> None:
        """One row a time stamp; nothing is written without rows."""
        if len(np.asarray(t_ns)):
            self.stream.send_columns(path, self.clock.columns(t_ns), columns, strict=True)
            self.paths.add(path)

    def states(self, path: str, t_ns: ArrayLike, states: Sequence[str]) -> None:
        """What state something is in from each stamp on; only changes are written."""
        import rerun as rr

        t = np.asarray(t_ns, dtype=np.int64)
        new = [i for i, state in enumerate(states) if i == 0 or state != states[i - 1]]
        self.rows(path, t[new], rr.StateChange.columns(state=[states[i] for i in new]))
        values = sorted(set(states))
        colors = [colours.of_status(value) for value in values]
        self.style(path, rr.StateConfiguration(values=values, labels=values, colors=colors))

    def name(self, device: str, identity: str) -> None:
        """What the viewer lists the recording as: device, date where the clock is one, and a bit of the identity."""
        day = f", {np.datetime64(int(self.clock.utc(np.array([self.clock.t0_ns]))[0]), 'ns').astype('datetime64[m]')}"
        self.stream.send_recording_name(f"{device}{day if self.clock.is_date else ''}, {identity[:6]}")

    def clear(self, path: str, t_ns: ArrayLike) -> None:
        """End what an entity shows at these times: a stream that stops must not be joined by a line."""
        import rerun as rr

        t = np.asarray(t_ns, dtype=np.int64)
        if len(t) and path in self.paths:
            cleared = rr.Clear.columns(is_recursive=np.zeros(len(t), dtype=bool))
            self.stream.send_columns(path, self.clock.columns(t), cleared, strict=True)

    def widen(self, path: str, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Let a plot reach from `low` to `high`, but for their extreme half percent."""
        if not (np.isfinite(low).any() and np.isfinite(high).any()):
            return
        bottom, top = float(np.nanpercentile(low, 0.5)), float(np.nanpercentile(high, 99.5))
        if top > bottom:
            self.limits[path] = readable(bottom, top)

    def has(self, prefix: str) -> bool:
        """Whether this entity, or one below it, holds data."""
        return any(path == prefix or path.startswith(prefix + "/") for path in self.paths)


def readable(low: float, high: float) -> tuple[float, float]:
    """A value range with a margin, in which two numbers stand at the axis: a small plot has them at steps of powers of
    ten. Without them where that would leave it half empty."""
    margin = 0.03 * (high - low)
    step = 10.0 ** np.ceil(np.log10((high - low + 2 * margin) / MOST_NUMBERS))
    bottom, top = low - margin, high + margin
    while np.floor(top / step) - np.ceil(bottom / step) < 1:
        above, below = step - top % step, bottom % step or step
        # a number on the very edge would be cut off
        bottom, top = (bottom, top + above + margin) if above <= below else (bottom - below - margin, top)
        if top - bottom > MOST_ROOM * (high - low):
            return low - margin, high + margin
    return float(bottom), float(top)


@contextmanager
def recording_file(path: Path, recording_id: str) -> Iterator[Any]:
    """A stream into the file `path` that carries no wall-clock time: the same data give the same recording.

    Raises
    ------
    OSError
        The file is not complete at the end.
    """
    import rerun as rr

    # The default cuts static rows into chunks by a wall-clock tick.
    never = rr.ChunkBatcherConfig.NEVER()
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False, batcher_config=never)
    stream.save(path)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    try:
        yield stream
        _finish(stream, path)
    finally:
        stream.disconnect()


def _finish(stream: Any, path: Path) -> None:
    """End the file and make sure that all of it is there: a thread writes it, which does not tell of a full disk."""
    from rerun.chunk import RrdReader

    try:
        stream.flush()
        stream.disconnect()
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a missing footer is only warned of
            RrdReader(path).recordings()
    except (RuntimeError, Warning) as error:
        raise OSError(f"the recording is not complete: {error}") from error


def fingerprint(*parts: Any) -> str:
    """Hexadecimal digest of the numbers and texts in arrays, dataclasses, mappings and sequences."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        _feed(digest, part)
    return digest.hexdigest()


def _feed(digest: Any, part: Any) -> None:
    if isinstance(part, np.ndarray) and part.dtype != object:
        digest.update(f"{part.dtype.str}{part.shape}".encode())
        digest.update(np.ascontiguousarray(part).tobytes())
    elif is_dataclass(part) and not isinstance(part, type):
        for spec in fields(part):
            _feed(digest, spec.name)
            _feed(digest, getattr(part, spec.name))
    elif isinstance(part, Mapping):
        for key, value in part.items():
            _feed(digest, str(key))
            _feed(digest, value)
    elif isinstance(part, np.ndarray):
        texts, place = np.unique(part.astype(str), return_inverse=True)
        _feed(digest, texts.tolist())
        _feed(digest, place)
    elif isinstance(part, list | tuple):
        digest.update(f"[{len(part)}]".encode())
        for item in part:
            _feed(digest, item)
    else:
        digest.update(f"{part!r};".encode())
