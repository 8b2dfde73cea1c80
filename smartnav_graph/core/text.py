"""Text from a log or a file name, made harmless for terminals."""

from __future__ import annotations

import unicodedata

# Control characters and escapes, marks that turn the direction of writing, halves of characters.
_STEERING = ("Cc", "Cf", "Cs")


def inert(text: str) -> str:
    """The text with marks that would steer a terminal written out, as ``\\x1b``; ends of lines and tabs stay."""
    if text.isascii() and text.isprintable():
        return text
    steering = {mark for mark in set(text) - set("\n\t") if unicodedata.category(mark) in _STEERING}
    return "".join(repr(mark)[1:-1] if mark in steering else mark for mark in text)
