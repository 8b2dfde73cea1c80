"""A strict reader of MATLAB files of version 5: names of variables, and objects such as timetables.

Plain Python, bounds checked: a file of another origin raises an error and nothing worse. Objects (class MCOS) refer to
the subsystem of the file, whose first cell lists the properties of each object (as worked out by the authors of matio
and mat-io).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.errors import SessionError

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPRESSED, _MATRIX = 15, 14
_CELL, _STRUCT, _OBJECT, _CHAR, _OPAQUE = 1, 2, 3, 4, 17
_LONGEST = 1 << 30  # bytes of one variable
_REFERENCE = 0xDD000000
_FAULTS = (
    *(struct.error, IndexError, ValueError, KeyError, zlib.error, TypeError, RecursionError, OverflowError),
    *(MemoryError, AttributeError),
)


@dataclass(frozen=True)
class Matrix:
    """A variable: `values` an array, text, a list of cells, or fields by name; of an object what it refers to."""

    name: str
    kind: str
    values: np.ndarray[tuple[int, ...], np.dtype[np.generic]] | str | Sequence[Matrix | None] | dict[str, Matrix | None]
    cls: str = ""


def _elements(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        if kind >> 16:  # a small element
            kind, size, begin, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        else:
            begin = at + 8
            step = 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if begin + size > len(data) or (step == 8 and size > 4 and begin == at + 4):
            raise ValueError(f"an element of {size} bytes at {at} of {len(data)}")
        body = data[begin : begin + size]
        at += step
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            inner = unpacker.decompress(body, _LONGEST)
            if unpacker.unconsumed_tail or not unpacker.eof:
                raise ValueError(f"a variable is cut, or longer than {_LONGEST} bytes")
            yield from _elements(inner)
        else:
            yield kind, body


def _numbers(kind: int, body: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.generic]]:
    return np.frombuffer(body, dtype=f"<{_NUMBERS[kind]}")


def _matrix(body: bytes) -> Matrix | None:
    parts = list(_elements(body))
    if not parts:
        return None
    flags = int(struct.unpack_from("<I", parts[0][1])[0])
    kind, complex_ = flags & 0xFF, bool(flags & 0x800)
    if kind == _OPAQUE:
        name, _, cls = (part[1].decode("latin-1") for part in parts[1:4])
        inner = _matrix(parts[4][1])
        return None if inner is None else Matrix(name, "object", inner.values, cls)
    dims = np.frombuffer(parts[1][1], dtype="<i4")
    name = parts[2][1].decode("latin-1")
    if kind == _CELL:
        return Matrix(name, "cell", [_matrix(part[1]) for part in parts[3:]])
    if kind in (_STRUCT, _OBJECT):
        first = 4 if kind == _OBJECT else 3
        length = int(np.frombuffer(parts[first][1], dtype="<i4")[0])
        text = parts[first + 1][1]
        names = [text[i : i + length].split(b"\0")[0].decode("latin-1") for i in range(0, len(text), max(length, 1))]
        fields = dict(zip(names, (_matrix(part[1]) for part in parts[first + 2 :]), strict=False))
        return Matrix(name, "struct", fields)
    if kind == _CHAR:
        letters = parts[3] if len(parts) > 3 else (1, b"")
        coding = {4: "utf-16-le", 17: "utf-16-le", 18: "utf-32-le"}.get(letters[0], "utf-8")
        return Matrix(name, "char", letters[1].decode(coding, errors="replace"))
    values = _numbers(*parts[3]) if len(parts) > 3 else np.zeros(0)
    if complex_ and len(parts) > 4:
        values = values.astype(np.float64) + 1j * _numbers(*parts[4]).astype(np.float64)
    shape = tuple(int(size) for size in dims)
    return Matrix(name, "number", values.reshape(shape, order="F") if values.size == np.prod(shape) else values)


def _bytes_of(path: Path) -> bytes:
    data = path.read_bytes()
    if len(data) < 128 or data[:6] != b"MATLAB" or data[126:128] != b"IM":
        raise ValueError("no MATLAB file of version 5 of a little-endian computer")
    return data


def variable_names(path: Path) -> dict[str, str]:
    """Names of the variables and, of objects, their classes; none where it is no such file. Never raises."""
    try:
        if path.suffix.lower() != ".mat" or not path.is_file():
            return {}
        found = {}
        for kind, body in _elements(_bytes_of(path)[128:]):
            parts = _elements(body) if kind == _MATRIX else iter(())
            flags = next(parts, (0, b""))[1]
            if len(flags) < 4:
                continue
            opaque = flags[0] == _OPAQUE
            first, second = next(parts, (0, b""))[1], next(parts, (0, b""))[1]
            cls = next(parts, (0, b""))[1].decode("latin-1") if opaque else ""
            found[(first if opaque else second).decode("latin-1")] = cls
        return {name: cls for name, cls in found.items() if name}
    except (OSError, *_FAULTS):
        return {}


@dataclass(frozen=True)
class ObjectFile:
    """The variables of a file, and the properties of the objects that they refer to."""

    variables: dict[str, Matrix]
    cells: Sequence[Matrix | None]
    properties: Sequence[dict[str, int]]

    def object_of(self, reference: Matrix | None) -> dict[str, Matrix | None]:
        """Properties of the object that a variable or a value refers to; none where it refers to no object."""
        values = None if reference is None else reference.values
        if not isinstance(values, np.ndarray) or values.size < 6 or int(values.flat[0]) != _REFERENCE:
            return {}
        index = int(values.flat[-2])
        found = self.properties[index] if index < len(self.properties) else {}
        return {name: self.cells[cell] for name, cell in found.items() if cell < len(self.cells)}


def read_objects(path: Path) -> ObjectFile:
    """Variables and objects of a file.

    Raises
    ------
    SessionError
        Missing, damaged, or no MATLAB file of version 5.
    """
    try:
        data = _bytes_of(path)
        variables: dict[str, Matrix] = {}
        cells: Sequence[Matrix | None] = ()
        for kind, body in _elements(data[128:]):
            one = _matrix(body) if kind == _MATRIX else None
            if one is not None and one.name:
                variables[one.name] = one
            elif one is not None and isinstance(one.values, np.ndarray):
                cells = _subsystem(one.values.astype(np.uint8).tobytes()) or cells
        first = cells[0].values if cells and cells[0] is not None else np.zeros(0)
        table = first.astype(np.uint8).tobytes() if isinstance(first, np.ndarray) else b""
        return ObjectFile(variables, cells, _properties(table) if table else ())
    except OSError as error:
        raise SessionError(path, f"cannot be read ({error})", "a MATLAB file", "check the path") from error
    except _FAULTS as error:
        raise SessionError(
            path, f"is damaged, or no MATLAB file of version 5 ({error})", "a whole .mat file"
        ) from error


def _subsystem(data: bytes) -> Sequence[Matrix | None]:
    """The cells of the subsystem: a file without header inside a variable."""
    for kind, body in _elements(data[8:]):
        found = _matrix(body) if kind == _MATRIX else None
        fields = found.values if found is not None and isinstance(found.values, dict) else {}
        wrapped = fields.get("MCOS")
        if wrapped is not None and isinstance(wrapped.values, list):
            return wrapped.values
    return ()


def _properties(table: bytes) -> list[dict[str, int]]:
    """Cell of every property, by object: those saved by the class itself, and those of plain classes."""
    words = np.frombuffer(table[: len(table) // 4 * 4], dtype="<u4")
    count, offsets = int(words[1]), [int(word) for word in words[2:8]]
    names = [name.decode("latin-1") for name in table[40 : offsets[0]].split(b"\0")[:count]]
    saved, plain = _blocks(words, offsets[1], offsets[2]), _blocks(words, offsets[3], offsets[4])
    objects = words[offsets[2] // 4 : offsets[3] // 4]
    found: list[dict[str, int]] = []
    for row in objects[: len(objects) // 6 * 6].reshape(-1, 6).tolist():
        block = saved[row[3]] if 0 < row[3] < len(saved) else plain[row[4]] if 0 < row[4] < len(plain) else []
        found.append({names[name - 1]: value + 2 for name, flag, value in block if flag == 1 and name <= len(names)})
    return found


def _blocks(words: np.ndarray[tuple[int, ...], np.dtype[np.uint32]], begin: int, end: int) -> list[list[list[int]]]:
    """Blocks of (name, flag, value), each behind its count and padded to eight bytes."""
    found, at = [], begin // 4
    while at < end // 4:
        count = int(words[at])
        rows = words[at + 1 : at + 1 + 3 * count]
        found.append(rows[: len(rows) // 3 * 3].reshape(-1, 3).tolist())
        at += 1 + 3 * count
        at += at % 2
    return found
