"""Zip and tar archives: unpacked to a temporary folder that is removed after reading."""

from __future__ import annotations

import shutil
import tarfile
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.apps.excel import is_excel


def is_archive(path: Path) -> bool:
    """Whether `path` is a zip or tar file, by content; an Excel file, a zip file inside, is none."""
    try:
        return path.is_file() and (zipfile.is_zipfile(path) or tarfile.is_tarfile(path)) and not is_excel(path)
    except OSError:
        return False


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Yield a temporary folder with the content of an archive; a single folder on top is entered.

    Errors raised inside name the archive and the path within it.

    Raises
    ------
    SessionError
        The archive is damaged, or does not fit the temporary folder.
    """
    kind = "zip" if zipfile.is_zipfile(path) else "tar"
    with tempfile.TemporaryDirectory() as scratch:
        top = Path(scratch)
        try:
            _unpack(path, top, kind)
        except (OSError, EOFError, zipfile.BadZipFile, tarfile.TarError) as error:
            raise SessionError(path, f"cannot be unpacked ({error})", "a whole zip or tar file") from error
        inside = list(top.iterdir())
        folder = inside[0] if len(inside) == 1 and inside[0].is_dir() else top
        try:
            yield folder
        except SessionError as error:
            raise error.located(error.where.replace(scratch, str(path))) from error


def _unpack(path: Path, folder: Path, kind: str) -> None:
    if kind == "zip":
        shutil.unpack_archive(path, folder, "zip")
        return
    with tarfile.open(path) as archive:
        if hasattr(tarfile, "data_filter"):
            archive.extractall(folder, filter="data")
        else:  # Python before 3.11.4
            _refuse_harmful(archive, folder.resolve())
            archive.extractall(folder)


def _refuse_harmful(archive: tarfile.TarFile, folder: Path) -> None:
    """What the filter of newer Pythons does: nothing outside the folder, and only files and folders."""
    for member in archive.getmembers():
        if not (member.isfile() or member.isdir()) or not (folder / member.name).resolve().is_relative_to(folder):
            raise tarfile.TarError(f"{member.name} is no file or folder inside the archive")
