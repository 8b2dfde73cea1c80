"""Writes a minimal ULog file (PX4 user guide, ULog file format): formats, subscriptions, data."""

from __future__ import annotations

import struct

MAGIC = b"ULog\x01\x12\x35"
_SIZES = {"uint64_t": "Q", "float": "f", "double": "d", "int32_t": "i", "uint32_t": "I", "uint8_t": "B", "bool": "?"}


def _message(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(formats, rows, info=(("sys_name", "PX4"), ("ver_hw", "TESTED_V5"))):
    """The bytes of a log.

    Parameters
    ----------
    formats : message -> fields, each (type, name); ``float[3] x`` counts as one field of three numbers
    rows : (message, instance, values) in the order of the log
    """
    out = bytearray(MAGIC + b"\x01" + struct.pack("<Q", 20_000_000))
    out += _message("B", bytes(40))
    for key, text in info:
        name = f"char[{len(text)}] {key}".encode()
        out += _message("I", bytes([len(name)]) + name + text.encode())
    for message, fields in formats.items():
        text = "".join(f"{kind} {name};" for kind, name in fields)
        out += _message("F", f"{message}:{text}".encode())
    known = {}
    for message, instance, values in rows:
        if (message, instance) not in known:
            number = known[message, instance] = len(known)
            out += _message("A", struct.pack("<BH", instance, number) + message.encode())
        codes = ""
        for kind, _ in formats[message]:
            base, _, count = kind.rstrip("]").partition("[")
            codes += (count or "1") + _SIZES[base]
        out += _message("D", struct.pack("<H", known[message, instance]) + struct.pack(f"<{codes}", *values))
    return bytes(out)
