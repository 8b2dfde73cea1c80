"""Streams from tables in memory: arrays by name, or a pandas DataFrame; times and names are checked."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NoReturn, cast

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Column, Table, Times
from smartnav_graph.core.errors import InputTypeError, SessionError, warn
from smartnav_graph.core.frames import Origin
from smartnav_graph.session.stream import Located, Stream
from smartnav_graph.session.streams import STREAMS

if TYPE_CHECKING:
    import pandas as pd

TIME_NAMES = ("t_ns", "time", "timestamp")
SHORTEST_NS = 10_000  # median period of a sensor: shorter ones are of another unit than ns
SECONDS = "seconds as floating numbers lose digits: convert them once with np.round(seconds * 1e9).astype('int64')"


def times_ns(values: ArrayLike, where: str) -> tuple[Times, str]:
    """Stamps (n,) int64 ns, and the epoch that their type shows: ``unix`` of datetimes, else ``unknown``.

    Parameters
    ----------
    values : (n,) datetime64 of any unit, pandas datetimes (without time zone: UTC), timedelta64, or whole nanoseconds
    where : what an error names

    Raises
    ------
    InputTypeError
        Floating numbers, texts and other types; a single time; times with and without time zone.
    SessionError
        Missing times, or whole numbers that are no nanoseconds.
    """
    array = _naive(values, where)
    if array.ndim != 1:
        found = f"of shape {array.shape}" if array.ndim else "one time alone"
        raise InputTypeError(f"{where}: times", f"are {found}", "(n,), one time per row", "give an array or a list")
    if array.dtype.kind in "Mm":
        return _exact_ns(array, where), "unix" if array.dtype.kind == "M" else "unknown"
    if array.dtype.kind not in "iu":
        what = "floating numbers" if array.dtype.kind == "f" else f"of type {array.dtype}"
        remedy = SECONDS if array.dtype.kind == "f" else "convert them with pandas.to_datetime(..., utc=True)"
        raise InputTypeError(f"{where}: times", f"are {what}", "datetime64 or whole nanoseconds", remedy)
    if array.dtype.kind == "u" and len(array) and array.max() > np.iinfo(np.int64).max:
        _refuse_range(where)
    t_ns = np.asarray(array, dtype=np.int64)
    period = float(np.median(np.diff(t_ns))) if len(t_ns) > 2 else np.inf
    if 0 < period < SHORTEST_NS:
        found = f"whole numbers {period:g} apart"
        remedy = "multiply milliseconds by 1_000_000, microseconds by 1_000"
        raise SessionError(f"{where}: times", found, "nanoseconds", remedy, stream=where)
    return t_ns, "unknown"


def _naive(values: ArrayLike, where: str) -> Column:
    """Times as an array; those with a time zone in UTC."""
    dtype = getattr(values, "dtype", None)
    if getattr(dtype, "kind", "") == "M" and not isinstance(dtype, np.dtype):  # a Series or an index of pandas
        import pandas as pd

        index = pd.DatetimeIndex(cast("pd.Series", values))
        return index.to_numpy() if index.tz is None else index.tz_convert("UTC").tz_localize(None).to_numpy()
    array = np.asarray(values)
    return _of_datetimes(array, where) if array.dtype == object and array.ndim == 1 and len(array) else array


def _of_datetimes(array: Column, where: str) -> Column:
    """Datetimes of Python or pandas (n,) as datetime64 in UTC, NaT where one is missing; other objects as they are."""
    import pandas as pd

    there = ~pd.isna(array)
    if not there.any() or not all(hasattr(one, "utcoffset") for one in array[there]):
        return array
    zoned = {one.utcoffset() is not None for one in array[there]}
    if len(zoned) > 1:
        remedy = "convert them with pandas.to_datetime(..., utc=True)"
        raise InputTypeError(f"{where}: times", "some with, some without time zone", "one kind", remedy)
    try:
        return pd.to_datetime(pd.Index(array, dtype=object), utc=True).tz_localize(None).to_numpy()
    except pd.errors.OutOfBoundsDatetime:
        _refuse_range(where)


def _refuse_range(where: str) -> NoReturn:
    raise SessionError(f"{where}: times", "do not fit int64 nanoseconds", "1678 to 2262", "correct the dates")


def _exact_ns(array: Column, where: str) -> Times:
    """Nanoseconds of datetimes or timedeltas of any unit."""
    missing = np.flatnonzero(np.isnat(array))
    if len(missing):
        found = f"no time (NaT) at row {missing[0]} ({len(missing)} such rows in all)"
        raise SessionError(f"{where}: times", found, "a time in every row", "leave the rows out", row=int(missing[0]))
    kind = "datetime64[ns]" if array.dtype.kind == "M" else "timedelta64[ns]"
    t_ns = array.astype(kind)
    if not (t_ns.astype(array.dtype) == array).all():
        _refuse_range(where)
    return np.asarray(t_ns.astype(np.int64))


def columns_of_frame(frame: pd.DataFrame, where: str) -> Table:
    """Columns of a DataFrame; its index is their time where no column is."""
    columns: Table = {}
    twice = [str(name) for name in frame.columns[frame.columns.duplicated()]]
    if twice:
        remedy = "frame.loc[:, ~frame.columns.duplicated()] keeps the first"
        raise SessionError(where, f"several columns {', '.join(dict.fromkeys(twice))}", "one of each name", remedy)
    for name in frame.columns:
        if str(name) not in TIME_NAMES:
            column = frame[name]
            floats = column.dtype.kind == "f"  # a missing value of pandas is NaN
            columns[str(name)] = column.to_numpy(dtype=np.float64, na_value=np.nan) if floats else column.to_numpy()
    named = [name for name in TIME_NAMES if name in frame.columns]
    if named:
        t_ns, epoch = times_ns(frame[named[0]], f"{where}.{named[0]}")
    elif frame.index.name in TIME_NAMES or frame.index.dtype.kind in "mM" or hasattr(frame.index.dtype, "tz"):
        t_ns, epoch = times_ns(frame.index, f"{where}: index")
    else:
        expected = f"a column {' or '.join(TIME_NAMES)}, or a DatetimeIndex"
        raise SessionError(where, f"no times: columns {', '.join(columns)}", expected, "frame.set_index(...)")
    return {"time": t_ns.astype("datetime64[ns]") if epoch == "unix" else t_ns} | columns


def file_columns(kind: type[Stream], given: Mapping[str, ArrayLike]) -> tuple[Table, str]:
    """Columns as in a file of a stream, and the epoch, of arrays by name of field (``gyro`` (n, 3)) or of column
    (``gyro_x_rad_s``), with their times as ``time`` or ``t_ns``.

    Raises
    ------
    InputTypeError, SessionError
        A time, a shape or a name that does not fit; a required column is missing.
    """
    where = kind.NAME
    named = [name for name in TIME_NAMES if name in given]
    if not named:
        raise SessionError(where, f"no times among {', '.join(given)}", f"{TIME_NAMES[0]} or time", "add the times")
    t_ns, epoch = times_ns(given[named[0]], where)
    fields = {spec.name: spec.metadata["columns"] for spec in kind.specs() if spec.name != "t_ns"}
    known = {column for names in fields.values() for column in names}
    table: Table = {"t_ns": t_ns}
    for name, values in given.items():
        if name in named:
            continue
        names = fields.get(name, (name,))
        array = times_ns(values, f"{where}.{name}")[0] if name.endswith("_ns") else np.asarray(values)
        shape = (len(t_ns),) if len(names) == 1 else (len(t_ns), len(names))
        if array.shape != shape:
            raise SessionError(f"{where}.{name}", f"shape {array.shape}", f"{shape}, one row per time", stream=where)
        table |= {names[0]: array} if len(names) == 1 else dict(zip(names, array.T, strict=True))
    unknown = [name for name in table if name not in known | {"t_ns"}]
    _refuse_other_names(kind, table, unknown)
    if unknown:
        warn(f"{where}: unknown column {', '.join(unknown)}; kept, but not used")
    return table, epoch


def _refuse_other_names(kind: type[Stream], table: Table, unknown: list[str]) -> None:
    """A column that is missing is named, and the one that may be meant."""
    for spec in kind.specs():
        names = spec.metadata["columns"]
        missing = [name for name in names if name not in table]
        if missing and (len(missing) < len(names) or spec.default is spec.default_factory):
            near = {name: close[0] for name in missing if (close := difflib.get_close_matches(name, unknown, 1, 0.6))}
            hint = "; ".join(f"is {given} meant for {name}? then convert its unit" for name, given in near.items())
            fields = f"columns {', '.join(names)}" + (f", or {spec.name} (n, {len(names)})" if len(names) > 1 else "")
            if {"height_m", "u_m"} & set(missing) and len(missing) == 1:
                hint = f"add {missing[0]}, NaN where the height is not known"
            hint = hint or (f"rename {', '.join(unknown)}" if unknown else "add them")
            raise SessionError(kind.NAME, f"{', '.join(missing)} missing", fields, hint, stream=kind.NAME)


def stream_of(name: str, given: object) -> tuple[Stream | Table, str]:
    """The stream, or the columns of one, that an argument gives, and its epoch.

    Raises
    ------
    InputTypeError
        It is neither a stream, nor a mapping of arrays, nor a DataFrame.
    """
    kind = STREAMS.get(name)
    if kind is None:
        close = difflib.get_close_matches(name, STREAMS, 1)
        hint = f"did you mean {close[0]}?" if close else ""
        raise InputTypeError("Session", f"no stream {name!r}", f"some of {', '.join(STREAMS)}", hint)
    if isinstance(given, Stream):
        if not isinstance(given, kind):
            raise InputTypeError(name, f"is {type(given).__name__}", kind.__name__, f"build a {kind.__name__}")
        return given, ""
    if hasattr(given, "columns") and hasattr(given, "index") and not isinstance(given, Mapping):
        given = columns_of_frame(cast("pd.DataFrame", given), name)
    if not isinstance(given, Mapping):
        _refuse_type(name, kind, given)
    return file_columns(kind, given)


def _refuse_type(name: str, kind: type[Stream], given: object) -> NoReturn:
    fields = [f.name for f in kind.specs() if f.default is f.default_factory and f.name != "t_ns"]
    fields += [" or ".join(kind.ONE_OF)] if kind.ONE_OF else []
    rule = f"a DataFrame, a {kind.__name__}, or a mapping of arrays"
    remedy = f"build {name}={{'time': datetimes, {', '.join(f'{field!r}: ...' for field in fields)}}}"
    raise InputTypeError(name, f"is {type(given).__name__}", rule, remedy)


def first_origin(stream: Located) -> Origin | None:
    """The first geodetic position as the origin of the local frame; height zero where none is known."""
    if stream.lla is None or not len(stream):
        return None
    heights = stream.lla[stream.has_height, 2]
    lat, lon = stream.lla[0, :2]
    return Origin(float(lat), float(lon), float(heights[0]) if len(heights) else 0.0)


def build_streams(
    given: Mapping[str, object], clock_epoch: str | None, repairs: Iterable[str]
) -> tuple[dict[str, Any], str, dict[str, dict[str, int]]]:
    """Checked streams of the arguments of `Session.from_arrays`, by name; their epoch; what repairs touched."""
    from smartnav_graph.session.folder import build_stream  # which needs the session

    if not given:
        raise InputTypeError("Session", "no streams", f"some of {', '.join(STREAMS)}", "give imu=...")
    epochs, built, dropped = dict[str, str](), dict[str, Stream](), dict[str, dict[str, int]]()
    for name, value in given.items():
        found, epochs[name] = stream_of(name, value)
        if isinstance(found, Stream):
            built[name] = found
            continue
        built[name], counts = build_stream(STREAMS[name], found, name, repairs)
        dropped |= {name: counts} if counts else {}
    return built, common_epoch(epochs, clock_epoch), dropped


def common_epoch(epochs: Mapping[str, str], asked: str | None) -> str:
    """The epoch of all streams.

    Raises
    ------
    SessionError
        Datetimes in one stream, other times in another.
    """
    found = {epoch for epoch in epochs.values() if epoch}
    if len(found) > 1:
        text = ", ".join(f"{name}: {'datetimes' if e == 'unix' else 'other times'}" for name, e in epochs.items() if e)
        raise SessionError("Session", text, "one clock for all streams", "convert all of them to datetimes")
    shown = next(iter(found), "unknown")
    if asked is not None and shown == "unix" and asked != "unix":
        raise SessionError("clock_epoch", f"{asked!r}, but the times are datetimes", "unix", "give whole nanoseconds")
    return asked or shown
