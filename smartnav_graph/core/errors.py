"""Errors that say where, what was found, what was expected and what to do.

Every message reads ``<where>: <what was found>; expected <rule>; <what to do>``.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Self

from smartnav_graph.core.text import inert


class SmartnavError(Exception):
    """Base of every named input or solver fault.

    Parameters
    ----------
    where : str or Path
        File, stream, option or epoch the fault was found at.
    found : str
        What the value is, with number and unit.
    expected : str, optional
        The rule it breaks.
    remedy : str, optional
        What the user can do about it.
    row : int, optional
        Zero-based data row.
    stream : str, optional
        Name of the session stream concerned.
    """

    def __init__(
        self,
        where: str | Path,
        found: str,
        expected: str = "",
        remedy: str = "",
        *,
        row: int | None = None,
        stream: str | None = None,
    ) -> None:
        self.where = str(where)
        self.found = found
        self.expected = expected
        self.remedy = remedy
        self.row = row
        self.stream = stream
        parts = [f"{self.where}: {found}"]
        if expected:
            parts.append(f"expected {expected}")
        if remedy:
            parts.append(remedy)
        super().__init__(inert("; ".join(parts)))

    def located(self, where: str | Path) -> Self:
        """The same fault with the file it was read from."""
        return type(self)(where, self.found, self.expected, self.remedy, row=self.row, stream=self.stream)


class SessionError(SmartnavError):
    """A recorded session, or a foreign log, is missing, unreadable or inconsistent."""


class CalibrationError(SmartnavError):
    """A device calibration is unreadable or physically impossible."""


class ConfigError(SmartnavError):
    """A configuration file, option or withholding specification is wrong."""


class SolverError(SmartnavError):
    """The estimation problem is unobservable, diverged or left without data."""


class InputTypeError(SmartnavError, TypeError):
    """An argument of another type than a function takes; the message says what to build."""


class SmartnavWarning(UserWarning):
    """Data that are not used or were corrected, and results that are not to be relied upon."""


def warn(message: str) -> None:
    """Issue a `SmartnavWarning` at the line of the caller outside this package."""
    package = os.path.dirname(os.path.dirname(__file__)) + os.sep
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(package):
        frame, level = frame.f_back, level + 1
    warnings.warn(inert(message), SmartnavWarning, stacklevel=level)
