"""Zip and tar archives: unpacked to a temporary folder that is removed after reading.

Only files and folders inside the archive are unpacked, up to bounds on their number and size; links and devices are
left out and counted. What is encrypted, or leads outside the archive, is refused.
"""

from __future__ import annotations

import lzma
import shutil
import stat
import struct
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import name_inside
from smartnav_graph.readers.apps.excel import is_excel

_FAULTS = (
    OSError,
    EOFError,
    ValueError,
    RuntimeError,
    LookupError,
    ArithmeticError,
    struct.error,
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    lzma.LZMAError,
)
# Bounds: an archive of recordings is far below them, one made to fill the disk is not.
LARGEST_RATIO, ALWAYS_ALLOWED = 200, 100_000_000  # unpacked over packed bytes, and bytes of any archive
MOST_MEMBERS = 200_000
LARGEST_HEADER = 1 << 20
_CHUNK = 1 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
LINKS = "links or devices left out"
REPEATED = "of the name of another left out"


def is_archive(path: Path) -> bool:
    """Whether `path` is a zip or tar file, by content; an Excel file, a zip file inside, is none."""
    try:
        return path.is_file() and (zipfile.is_zipfile(path) or tarfile.is_tarfile(path)) and not is_excel(path)
    except _FAULTS:
        return False


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, dict[str, int]]]:
    """Yield a temporary folder with the content of an archive, and what was left out; a single folder on top is
    entered.

    Errors raised inside name the archive and the path within it.

    Raises
    ------
    SessionError
        The archive is damaged or encrypted, leads outside itself, or is larger than the bounds or the disk.
    """
    with tempfile.TemporaryDirectory() as scratch:
        top = Path(scratch)
        try:
            left_out = _Unpacking(path, top).run()
        except _FAULTS as error:
            raise SessionError(
                path, f"cannot be unpacked ({error})", "a whole zip or tar file of recordings"
            ) from error
        inside = list(top.iterdir())
        folder = inside[0] if len(inside) == 1 and inside[0].is_dir() else top
        try:
            yield folder, left_out
        except SessionError as error:
            raise error.located(error.where.replace(scratch, str(path))) from error


class _Header(tarfile.TarInfo):
    """A member whose headers are bounded: they are read into memory."""

    def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
        if not (self.isreg() or self.issparse()) and self.size > LARGEST_HEADER:
            raise tarfile.ReadError(f"{self.name} has a header of {self.size} bytes")
        found: tarfile.TarInfo = super()._proc_member(archive)  # type: ignore[misc]
        return found


class _Unpacking:
    """One archive on its way into a folder, its members and bytes counted."""

    def __init__(self, path: Path, folder: Path) -> None:
        self.path, self.folder = path, folder
        self.left_out: dict[str, int] = {}
        self.members = self.bytes = 0
        free = shutil.disk_usage(folder).free
        self.largest = min(max(LARGEST_RATIO * path.stat().st_size, ALWAYS_ALLOWED), int(0.9 * free))

    def run(self) -> dict[str, int]:
        """Unpack; the counts of what was left out."""
        if zipfile.is_zipfile(self.path):
            self._zip()
        else:
            self._tar()
        if not any(self.folder.iterdir()):
            raise ValueError("it holds no files" + "".join(f"; {count} {why}" for why, count in self.left_out.items()))
        return self.left_out

    def _zip(self) -> None:
        with zipfile.ZipFile(self.path) as archive:
            for member in archive.infolist():
                kind = stat.S_IFMT(member.external_attr >> 16)
                if member.is_dir():
                    self._place(member.filename).mkdir(parents=True, exist_ok=True)
                elif kind not in (0, stat.S_IFREG):
                    self._leave_out(LINKS)
                elif member.flag_bits & 1:
                    raise ValueError(f"{member.filename} is encrypted; unpack it with its password first")
                elif member.compress_type not in _METHODS:
                    raise ValueError(f"{member.filename} is packed by the unknown method {member.compress_type}")
                else:
                    with archive.open(member) as source:
                        self._write(member.filename, source)

    def _tar(self) -> None:
        with tarfile.open(self.path, tarinfo=_Header) as archive:
            for member in archive:
                if member.isdir():
                    self._place(member.name).mkdir(parents=True, exist_ok=True)
                elif not member.isreg():
                    self._leave_out(LINKS)
                elif (source := archive.extractfile(member)) is not None:
                    self._write(member.name, source)

    def _leave_out(self, why: str) -> None:
        self._count()
        self.left_out[why] = self.left_out.get(why, 0) + 1

    def _count(self) -> None:
        self.members += 1
        if self.members > MOST_MEMBERS:
            raise ValueError(f"it has more than {MOST_MEMBERS} members")

    def _place(self, name: str) -> Path:
        self._count()
        name = name.replace("\\", "/")  # of an archive made by Windows
        if not name_inside(name):
            raise ValueError(f"the member {name!r} leads outside the archive")
        return self.folder / name

    def _write(self, name: str, source: IO[bytes]) -> None:
        place = self._place(name)
        if place.is_file():
            self._leave_out(REPEATED)
            return
        place.parent.mkdir(parents=True, exist_ok=True)
        with open(place, "xb") as file:
            while chunk := source.read(_CHUNK):
                self.bytes += len(chunk)
                if self.bytes > self.largest:
                    raise ValueError(
                        f"it holds more than {self.largest} bytes, {LARGEST_RATIO} times its own or the disk"
                    )
                file.write(chunk)
