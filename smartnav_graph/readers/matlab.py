"""MATLAB files (version 5) -> named arrays, errors name the file and the variable."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table
from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.mat5 import variable_names


def names_in(path: Path) -> frozenset[str]:
    """Names of the variables in a file; none where it is no MATLAB file."""
    return frozenset(variable_names(path))


def read_mat(path: Path) -> Table:
    """The variables of a file.

    Raises
    ------
    SessionError
        Missing, unreadable, or no MATLAB file of version 5.
    """
    from scipy.io import loadmat

    try:
        return {name: value for name, value in loadmat(str(path), appendmat=False).items() if not name.startswith("__")}
    except FileNotFoundError as error:
        raise SessionError(path, "is missing", "a MATLAB file", "fetch the whole data set") from error
    except (ValueError, OSError, NotImplementedError, TypeError) as error:
        raise SessionError(path, f"cannot be read ({error})", "a MATLAB file of version 5") from error


def matrix(path: Path, variables: Table, name: str, width: int, rows: int | None = None) -> Floats:
    """One variable as numbers (rows, width); rows of any count by default.

    Raises
    ------
    SessionError
        The variable is missing or of another shape.
    """
    if name not in variables:
        there = ", ".join(sorted(variables))
        raise SessionError(path, f"variable {name} is missing", f"one of shape (n, {width})", f"the file has {there}")
    value = np.asarray(variables[name], dtype=np.float64)
    if value.ndim != 2 or value.shape[1] < width or (rows is not None and len(value) != rows):
        expected = f"({'n' if rows is None else rows}, {width})"
        raise SessionError(path, f"{name} has shape {value.shape}", expected, "check the file's origin")
    return value[:, :width]
