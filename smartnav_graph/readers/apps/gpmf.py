"""GPMF, the telemetry of GoPro cameras: key, type, size, repeat, values; nested, big-endian, padded to four bytes.

Source: github.com/gopro/gpmf-parser, docs. In an .mp4 file its samples are those of the track whose sample entry is
``gpmd`` (ISO/IEC 14496-12).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SessionError

_TYPES = {"b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8"}
_TYPES |= {"f": ">f4", "d": ">f8"}
_CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")


@dataclass(frozen=True)
class Item:
    """One key with its type, the size of a value in bytes, and the bytes."""

    key: str
    kind: str
    size: int
    data: bytes

    def text(self) -> str:
        """The value as text."""
        return self.data.rstrip(b"\0").decode("latin-1").strip()

    def numbers(self, kinds: str = "") -> Floats:
        """Values (n, k); `kinds` are the types of the columns of a complex value.

        Raises
        ------
        ValueError
            No numbers, or not a whole number of rows.
        """
        letters = kinds if self.kind == "?" else self.kind * (self.size // max(_width(self.kind), 1))
        known = letters and all(letter in _TYPES for letter in letters)
        row = np.dtype([(f"_{i}", _TYPES[letter]) for i, letter in enumerate(letters)]) if known else None
        if row is None or row.itemsize != self.size or not self.data:
            raise ValueError(f"{self.key} has values of type {self.kind!r} and {self.size} bytes")
        rows = np.frombuffer(self.data, dtype=row)
        return np.stack([rows[name].astype(np.float64) for name in row.names or ()], axis=-1)


def _width(kind: str) -> int:
    return np.dtype(_TYPES[kind]).itemsize if kind in _TYPES else 0


def items_in(data: bytes) -> Iterator[Item]:
    """The items of a payload, one level deep; a cut last one is left out."""
    at = 0
    while at + 8 <= len(data):
        key, kind, size, repeat = struct.unpack_from(">4scBH", data, at)
        length = size * repeat
        if at + 8 + length > len(data) or key == b"\0\0\0\0":
            return
        yield Item(key.decode("latin-1"), kind.decode("latin-1").strip("\0"), size, data[at + 8 : at + 8 + length])
        at += 8 + (length + 3) // 4 * 4


def is_gpmf(path: Path) -> bool:
    """Whether a file begins with a GPMF device, or is an .mp4 file with a track of it."""
    try:
        with path.open("rb") as file:
            head = file.read(12)
        if head[:5] == b"DEVC\0":
            return True
        return head[4:8] == b"ftyp" and b"gpmd" in _movie(path)
    except (OSError, ValueError):
        return False


def payloads(path: Path) -> tuple[list[bytes], list[float] | None]:
    """Payloads of a raw file or of an .mp4 file, and when each begins in the film, s; None for a raw file.

    Raises
    ------
    SessionError
        Missing, unreadable, or no such file.
    """
    try:
        data = path.read_bytes() if path.open("rb").read(4) == b"DEVC" else b""
    except OSError as error:
        raise SessionError(path, f"cannot be read ({error})", "a readable file", "check the path") from error
    if data:
        return _devices(data), None
    try:
        return _of_movie(path)
    except (OSError, ValueError, struct.error, IndexError, KeyError) as error:
        raise SessionError(path, f"has a damaged index ({error})", "a whole .mp4 file", "copy it again") from error


def _devices(data: bytes) -> list[bytes]:
    """Payloads of a raw stream: a new one begins where the first device comes again."""
    found: list[list[bytes]] = []
    first = ""
    at = 0
    for item in items_in(data):
        length = 8 + (len(item.data) + 3) // 4 * 4
        name = next((inner.text() for inner in items_in(item.data) if inner.key == "DVNM"), "")
        if item.key == "DEVC" and (not found or name == first):
            found.append([])
            first = name
        if found:
            found[-1].append(data[at : at + length])
        at += length
    return [b"".join(parts) for parts in found]


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        header = 8
        if size == 1:
            size, header = struct.unpack_from(">Q", data, at + 8)[0], 16
        if size < header:
            return
        yield kind, data[at + header : at + size]
        at += size


def _movie(path: Path) -> bytes:
    """The box ``moov`` of a file, found without reading the film; empty where there is none."""
    with path.open("rb") as file:
        while len(header := file.read(16)) >= 8:
            size, kind = struct.unpack_from(">I4s", header)
            if size == 1 and len(header) == 16:
                size = struct.unpack_from(">Q", header, 8)[0]
                begin = 16
            else:
                begin = 8
                file.seek(len(header) * -1 + 8, 1)
            if kind == b"moov":
                return file.read(size - begin)
            if size < begin:
                return b""
            file.seek(size - begin, 1)
    return b""


def _leaves(data: bytes) -> dict[bytes, bytes]:
    """Boxes below a track by name."""
    found: dict[bytes, bytes] = {}
    for kind, inner in _boxes(data):
        found |= _leaves(inner) if kind in _CONTAINERS else {kind: inner}
    return found


def _of_movie(path: Path) -> tuple[list[bytes], list[float]]:
    for kind, track in _boxes(_movie(path)):
        if kind != b"trak":
            continue
        box = _leaves(track)
        if b"gpmd" not in box.get(b"stsd", b""):
            continue
        scale = struct.unpack_from(">I", box[b"mdhd"], 20 if box[b"mdhd"][0] == 1 else 12)[0]
        sizes = _sizes(box[b"stsz"])
        offsets = _offsets(box, len(sizes))
        steps = [step for count, step in _pairs(box[b"stts"]) for _ in range(count)]
        starts = np.concatenate([[0], np.cumsum(steps)])[: len(sizes)] / scale
        with path.open("rb") as file:
            found = []
            for offset, size in zip(offsets, sizes, strict=True):
                file.seek(offset)
                found.append(file.read(size))
        return found, [float(start) for start in starts]
    raise SessionError(path, "has no track of telemetry (gpmd)", "a film of a GoPro camera", "use the original file")


def _pairs(data: bytes) -> list[tuple[int, int]]:
    count = struct.unpack_from(">I", data, 4)[0]
    return [struct.unpack_from(">II", data, 8 + 8 * i) for i in range(count)]


def _sizes(data: bytes) -> list[int]:
    one, count = struct.unpack_from(">II", data, 4)
    return [one] * count if one else list(struct.unpack_from(f">{count}I", data, 12))


def _offsets(box: dict[bytes, bytes], samples: int) -> list[int]:
    """Places of the samples in the file, of chunks and samples a chunk."""
    wide = b"co64" in box
    data = box[b"co64"] if wide else box[b"stco"]
    count = struct.unpack_from(">I", data, 4)[0]
    chunks = struct.unpack_from(f">{count}{'Q' if wide else 'I'}", data, 8)
    entries = struct.unpack_from(">I", box[b"stsc"], 4)[0]
    runs = [struct.unpack_from(">III", box[b"stsc"], 8 + 12 * i) for i in range(entries)]
    sizes, places, sample = _sizes(box[b"stsz"]), list[int](), 0
    for chunk, place in enumerate(chunks, start=1):
        each = next(run[1] for run in reversed(runs) if run[0] <= chunk)
        for _ in range(min(each, samples - sample)):
            places.append(place)
            place += sizes[sample]
            sample += 1
    return places
