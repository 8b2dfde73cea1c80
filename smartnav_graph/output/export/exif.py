"""Replace the EXIF data of a JPEG or PNG file; every other byte stays the same.

Sources: CIPA DC-008-2023 (Exif 3.0), ch. 4.5.4 and 4.7 (JPEG), W3C Portable Network Graphics 3rd ed., 11.3.2.9 (eXIf).
"""

from __future__ import annotations

import struct
import zlib

HEADER = b"Exif\0\0"
JPEG, PNG = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
LONGEST = 0xFFFF - 2  # bytes of a JPEG segment
APP0, APP1, SCAN = 0xE0, 0xE1, 0xDA


def with_exif(picture: bytes, tiff: bytes) -> bytes:
    """The bytes of a JPEG or PNG file, its EXIF replaced by the TIFF structure `tiff`.

    Raises
    ------
    ValueError
        The file is neither, is truncated, or the EXIF does not fit.
    """
    try:
        if picture.startswith(JPEG):
            return _jpeg(picture, HEADER + tiff)
        if picture.startswith(PNG):
            return _png(picture, tiff)
    except (struct.error, IndexError) as error:
        raise ValueError("is truncated") from error
    raise ValueError("is neither JPEG nor PNG")


def _jpeg(picture: bytes, exif: bytes) -> bytes:
    """Segments up to the first scan: the new EXIF comes first, or after a JFIF header."""
    if len(exif) > LONGEST:
        raise ValueError(f"has {len(exif)} bytes of EXIF, more than a JPEG holds")
    segments, at = list[tuple[int, bytes]](), 2
    while picture[at + 1] != SCAN:
        length = struct.unpack_from(">H", picture, at + 2)[0]
        segment = picture[at : at + 2 + length]
        if picture[at] != 0xFF or len(segment) != 2 + length:
            raise ValueError("is a damaged JPEG")
        if not (segment[1] == APP1 and segment[4:].startswith(HEADER)):
            segments.append((segment[1], segment))
        at += len(segment)
    jfif = [segment for kind, segment in segments if kind == APP0]
    rest = [segment for kind, segment in segments if kind != APP0]
    new = struct.pack(">BBH", 0xFF, APP1, 2 + len(exif)) + exif
    return b"".join([JPEG, *jfif, new, *rest, picture[at:]])


def _png(picture: bytes, tiff: bytes) -> bytes:
    """Chunks: the new eXIf follows the header."""
    chunks, at = list[bytes](), len(PNG)
    while at < len(picture):
        length, kind = struct.unpack_from(">I4s", picture, at)
        chunk = picture[at : at + 12 + length]
        if len(chunk) != 12 + length:
            raise ValueError("is truncated")
        if kind != b"eXIf":
            chunks.append(chunk)
        at += len(chunk)
    body = b"eXIf" + tiff
    new = struct.pack(">I", len(tiff)) + body + struct.pack(">I", zlib.crc32(body))
    return b"".join([PNG, chunks[0], new, *chunks[1:]])
