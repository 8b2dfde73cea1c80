"""An open recording: the time lines of its rows, and the entities that have data."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike, NDArray
from rerun.chunk import RrdReader

from smartnav_graph.core.arrays import Times
from smartnav_graph.core.timebase import utc_from_gps
from smartnav_graph.estimate.result.diagnostics import window_of
from smartnav_graph.output.rerun_log import colours

APPLICATION = "smartnav_graph"
# Most tick labels of a small plot.
MOST_NUMBERS = 6.5
# How many times larger than its data the range of a plot may become for a second tick label.
MOST_ENLARGED = 1.7

_YEAR_2000_NS = int(np.datetime64("2000-01-01", "ns").astype(np.int64))


@dataclass(frozen=True)
class RecordingClock:
    """Index columns of stamps: `elapsed`, `utc` or `device`, and `keyframe`.

    `elapsed` counts from the session's time zero. `utc` exists where the session's clock is a date (unix, gps), else
    `device` holds the raw reading. A "gps" or "unix" clock before the year 2000 counts seconds of a week or a day: it
    is no date. `keyframe` is the keyframe (`keyframe_ns` (n,)) at the end of the window of a stamp; without keyframes
    there is no such time line.
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

    def columns(self, t_ns: ArrayLike) -> list[rr.TimeColumn]:
        """Index columns for rows at `t_ns` (n,)."""
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
    """Writes columns and static data, and remembers the entities for the blueprint.

    `limits` is the value range of plots with bands, which the viewer would cut off; `bounds` the lower and upper corner
    (2, 2) of a 2D drawing.
    """

    stream: rr.RecordingStream
    clock: RecordingClock
    paths: set[str] = field(default_factory=set)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    bounds: dict[str, NDArray[np.floating]] = field(default_factory=dict)

    def static(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Data valid at all times."""
        self.stream.log(path, *archetypes, static=True, strict=True)
        self.paths.add(path)

    def style(self, path: str, *archetypes: rr.AsComponents) -> None:
        """Static colours and names of an entity whose data are rows; once an entity, as two would come in any order."""
        self.stream.log(path, *archetypes, static=True, strict=True)

    def rows(self, path: str, t_ns: ArrayLike, columns: Iterable[rr.ComponentColumn]) -> None:
        """One row a time stamp; nothing is written without rows."""
        if len(np.asarray(t_ns)):
            self.stream.send_columns(path, self.clock.columns(t_ns), columns, strict=True)
            self.paths.add(path)

    def states(self, path: str, t_ns: ArrayLike, states: Sequence[str]) -> None:
        """A status from each stamp on; only changes are written."""
        t = np.asarray(t_ns, dtype=np.int64)
        new = [i for i, state in enumerate(states) if i == 0 or state != states[i - 1]]
        self.rows(path, t[new], rr.StateChange.columns(state=[states[i] for i in new]))
        values = sorted(set(states))
        colors = [colours.of_status(value) for value in values]
        self.style(path, rr.StateConfiguration(values=values, labels=values, colors=colors))

    def name(self, device: str, identity: str) -> None:
        """The name of the recording in the viewer: device, date where known, and the first digits of the identity."""
        day = f", {np.datetime64(int(self.clock.utc(np.array([self.clock.t0_ns]))[0]), 'ns').astype('datetime64[m]')}"
        self.stream.send_recording_name(f"{device}{day if self.clock.is_date else ''}, {identity[:6]}")

    def clear(self, path: str, t_ns: ArrayLike) -> None:
        """End the data of an entity at these times: no line may connect the two sides of an outage."""
        t = np.asarray(t_ns, dtype=np.int64)
        if len(t) and path in self.paths:
            cleared = rr.Clear.columns(is_recursive=np.zeros(len(t), dtype=bool))
            self.stream.send_columns(path, self.clock.columns(t), cleared, strict=True)

    def widen(self, path: str, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        """Extend the range of a plot to `low` and `high`, without their extreme half percent."""
        if not (np.isfinite(low).any() and np.isfinite(high).any()):
            return
        bottom, top = float(np.nanpercentile(low, 0.5)), float(np.nanpercentile(high, 99.5))
        if top > bottom:
            self.limits[path] = readable(bottom, top)

    def has(self, prefix: str) -> bool:
        """Whether this entity, or one below it, has data."""
        return any(path == prefix or path.startswith(prefix + "/") for path in self.paths)


def readable(low: float, high: float) -> tuple[float, float]:
    """A value range with a margin and two tick labels, which a small plot has at steps of powers of ten; without the
    second label where the plot would be half empty."""
    margin = 0.03 * (high - low)
    step = 10.0 ** np.ceil(np.log10((high - low + 2 * margin) / MOST_NUMBERS))
    bottom, top = low - margin, high + margin
    while np.floor(top / step) - np.ceil(bottom / step) < 1:
        above, below = step - top % step, bottom % step or step
        # a label on the edge would be cut off
        bottom, top = (bottom, top + above + margin) if above <= below else (bottom - below - margin, top)
        if top - bottom > MOST_ENLARGED * (high - low):
            return low - margin, high + margin
    return float(bottom), float(top)


@contextmanager
def recording_file(path: Path, recording_id: str) -> Iterator[rr.RecordingStream]:
    """A stream into the file `path` without wall-clock time: the same data give the same recording.

    Raises
    ------
    OSError
        The file is not complete at the end.
    """
    # the default divides static rows into chunks by wall-clock time
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


def _finish(stream: rr.RecordingStream, path: Path) -> None:
    """Close the file and check that it is complete: the thread that writes it does not report a full disk."""
    try:
        stream.flush()
        stream.disconnect()
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a missing footer gives only a warning
            RrdReader(path).recordings()
    except (RuntimeError, Warning) as error:
        raise OSError(f"the recording is not complete: {error}") from error


class _Digest(Protocol):
    def update(self, data: bytes, /) -> None: ...


def fingerprint(*parts: object) -> str:
    """Hexadecimal digest of the numbers and texts in arrays, dataclasses, mappings and sequences."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        _feed(digest, part)
    return digest.hexdigest()


def _feed(digest: _Digest, part: object) -> None:
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
