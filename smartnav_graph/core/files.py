"""Reading TOML files and tables, and atomic writing: a failure leaves the old file as it was."""

from __future__ import annotations

import os
import shutil
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from smartnav_graph.core.arrays import Column, Table
from smartnav_graph.core.errors import SessionError, SmartnavError

ROW_GROUP = 1 << 20


def read_toml(path: Path, fault: type[SmartnavError], what: str) -> dict[str, Any]:
    """The tables of a TOML file; `what` it should be (``a config.toml``) is part of the `fault` raised otherwise."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise fault(path, f"cannot be read ({error.strerror})", what) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise fault(path, f"is no TOML ({error})", what) from error


def refuse_existing(path: Path, force: bool) -> None:
    """Raise unless `path` is free (or an empty folder), or may be replaced."""
    taken = path.exists() and not (path.is_dir() and not any(path.iterdir()))
    if taken and not force:
        raise SessionError(path, "exists already", "a new name", "choose another --out, or add --force to replace it")


@contextmanager
def replacing(path: str | Path, *, force: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`; move it into place only when the block ends well.

    Works for files and for folders (create the one wanted at the yielded path). On any failure, an interrupt or a
    full disk included, the temporary is removed and `path` is left as it was.

    Raises
    ------
    SessionError
        `path` exists and `force` is not given, or the system refuses to write.
    """
    path = Path(path)
    refuse_existing(path, force)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise SessionError(path, f"cannot be written ({error.strerror})", "a writable place") from error
    new = scratch / path.name
    try:
        yield new
        if path.is_dir():
            os.replace(path, scratch / "replaced")
        os.replace(new, path)
    except OSError as error:
        if (scratch / "replaced").exists() and not path.exists():
            os.replace(scratch / "replaced", path)
        raise SessionError(
            path,
            f"could not be written ({error.strerror or error})",
            "space on the disk and permission to write",
            "nothing was changed; free some space or choose another place",
        ) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


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
