"""Reading TOML files and tables, and atomic writing: a failure leaves the old file as it was."""

from __future__ import annotations

import ctypes
import fcntl
import os
import shutil
import stat
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from smartnav_graph.core.arrays import Column, Table
from smartnav_graph.core.errors import SessionError, SmartnavError, warn
from smartnav_graph.core.interrupts import held

ROW_GROUP = 1 << 20
LARGEST_TOML = 10_000_000  # bytes
UNFINISHED = ".writing"  # ending of the temporary folders
_REPLACED = "replaced"
# What this process has written, and the temporary folders that it holds, with their locks.
written: list[Path] = []
_claimed: dict[Path, int] = {}


def read_toml(path: Path, fault: type[SmartnavError], what: str) -> dict[str, Any]:
    """The tables of a TOML file; `what` it should be (``a config.toml``) is part of the `fault` raised otherwise."""
    try:
        if not stat.S_ISREG(path.stat().st_mode) or path.stat().st_size > LARGEST_TOML:
            raise fault(path, "is no file, or a very large one", f"{what} of at most {LARGEST_TOML} bytes")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise fault(path, f"cannot be read ({error.strerror})", what) from error
    except RecursionError as error:
        raise fault(path, "is nested too deeply", what) from error
    except ValueError as error:  # no TOML, no UTF-8, a number of thousands of digits
        raise fault(path, f"is no TOML ({error})", what) from error


def refuse_existing(path: Path, force: bool) -> None:
    """Raise unless `path` is free (or an empty folder), or may be replaced."""
    taken = path.exists() and not (path.is_dir() and not any(path.iterdir()))
    if taken and not force:
        raise SessionError(path, "exists already", "a new name", "choose another --out, or add --force to replace it")


@contextmanager
def replacing(path: str | Path, *, force: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it into place only when the block ends well.

    Works for files and for folders (create the one wanted at the yielded path). At any failure, interrupt or end of
    the process `path` holds the old or the new, whole. The temporary folder ``.NAME.writing`` stays only where the
    process is killed; the next that writes there says so and removes it.

    Raises
    ------
    SessionError
        `path` exists and `force` is not given, another process is writing there, or the system refuses to write.
    """
    path = Path(os.path.abspath(path))
    refuse_existing(path, force)
    scratch = path.parent / f".{path.name}{UNFINISHED}"
    try:
        with held():
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                _claim(scratch, path)
            except OSError as error:
                raise SessionError(path, f"cannot be written ({error.strerror})", "a writable place") from error
        yield scratch / path.name
        with held():
            _put(scratch / path.name, path, scratch / _REPLACED)
            written.append(path)
    except OSError as error:
        raise SessionError(
            path,
            f"could not be written ({error.strerror or error})",
            "space on the disk and permission to write",
            "nothing was changed; free some space or choose another place",
        ) from error
    finally:
        with held():
            _release(scratch)


def remove_unfinished() -> None:
    """Remove what this process has begun to write and will not end."""
    for scratch in list(_claimed):
        _release(scratch)


def _claim(scratch: Path, path: Path) -> None:
    """Make the temporary folder and lock it; what a killed process left there is named, put back or removed."""
    while True:
        scratch.mkdir(exist_ok=True)
        lock = os.open(scratch, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(lock)
            found = "is being written by another process"
            raise SessionError(path, found, "one at a time", "wait for it, or choose another --out") from error
        if scratch.is_dir() and os.path.samestat(os.fstat(lock), os.stat(scratch)):
            break
        os.close(lock)  # the other process has ended and removed its folder since
    _claimed[scratch] = lock
    if (scratch / _REPLACED).exists() and not os.path.lexists(path):
        os.replace(scratch / _REPLACED, path)
    for old in scratch.iterdir():
        warn(f"{old}: left by a process that was killed; removed")
        _remove(old)
    for other in path.parent.glob(f".*{UNFINISHED}"):
        if other not in _claimed:
            warn(f"{other}: of a process that is writing, or was killed; in the latter case remove it")


def _release(scratch: Path) -> None:
    lock = _claimed.pop(scratch, None)
    if lock is not None:
        shutil.rmtree(scratch, ignore_errors=True)
        os.close(lock)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink()


def _put(new: Path, path: Path, aside: Path) -> None:
    """Move `new` to `path` in one step where the system can; what was at `path` is left beside `new`."""
    if not os.path.lexists(path) or not (new.is_dir() or path.is_dir()):
        os.replace(new, path)
    elif not _exchange(new, path):  # two steps: a kill between them leaves the old in `aside`
        os.replace(path, aside)
        try:
            os.replace(new, path)
        except OSError:
            os.replace(aside, path)
            raise


def _exchange(first: Path, second: Path) -> bool:
    """Exchange two paths in one step (renameat2 of Linux); whether the system and the disk can."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    at_cwd, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return rename is not None and rename(at_cwd, os.fsencode(first), at_cwd, os.fsencode(second), exchange) == 0


def name_inside(name: str) -> bool:
    """Whether a name from a log or an archive names a place inside the folder that it counts from.

    Not so: absolute names, ``..``, drives, zero bytes, names that are no UTF-8 or too long for a disk.
    """
    parts = name.replace("\\", "/").split("/")
    try:
        long = max(len(part.encode()) for part in parts) > 255 or len(name.encode()) > 4000
    except UnicodeEncodeError:
        return False
    return not (long or parts[0] == "" or ".." in parts or "\0" in name or parts[0][1:] == ":")


def file_inside(folder: Path, name: str) -> Path | None:
    """The file `name` of a folder; None where there is none, or the name or a link leads outside, or it is a device."""
    path = folder / name
    try:
        there = name_inside(name) and path.is_file() and path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # too long; links in a circle
        return None
    return path if there else None


def refuse_foreign(path: str | Path, mark: str) -> None:
    """Raise where `path` is a folder with something in it, but not the `mark` file of the kind to be replaced.

    A mistyped ``--out`` with ``--force`` must not replace a folder of another kind.
    """
    path = Path(path)
    if path.exists() and not (path.is_dir() and (not any(path.iterdir()) or (path / mark).is_file())):
        raise SessionError(
            path, f"holds no {mark}, so it is not replaced", f"a new name or a folder with {mark}", "remove it yourself"
        )


def write_table(columns: Mapping[str, Column], path: Path) -> None:
    """Write columns as a Parquet file, `ROW_GROUP` rows at a time: no second copy of a long recording in memory."""
    schema = pa.schema(
        [(name, pa.array(column if column.dtype == object else column[:0]).type) for name, column in columns.items()]
    )
    count = max(map(len, columns.values()), default=0)
    with pq.ParquetWriter(path, schema) as file:
        for rows in (slice(first, first + ROW_GROUP) for first in range(0, max(count, 1), ROW_GROUP)):
            file.write_table(pa.table({name: pa.array(column[rows]) for name, column in columns.items()}, schema))


def read_table(path: Path) -> Table:
    """The columns of a Parquet file; empty cells of number columns become NaN.

    Raises
    ------
    SessionError
        Missing, unreadable or empty file.
    """
    try:
        table = pq.read_table(path)
    except FileNotFoundError as error:
        raise SessionError(path, "is missing", "a Parquet file", "check the path") from error
    except (OSError, pa.ArrowException) as error:
        raise SessionError(path, f"cannot be read ({error})", "a Parquet file", "import the log again") from error
    if table.num_rows == 0:
        raise SessionError(path, "has no rows", "at least one row", "delete the file if there was no such sensor")
    return {name: table.column(name).to_numpy() for name in table.column_names}
