"""MATLAB files (version 5) -> named arrays, errors name the file and the variable."""

from __future__ import annotations

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table
from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.mat5 import variable_names

LARGEST, LONGEST_S = 6 << 30, 120.0  # bytes of memory and seconds that reading a file may take
# A damaged file can end the interpreter inside SciPy's compiled reader: it is read by another process.
_LOAD = """
import pickle, resource, sys
from scipy.io import loadmat
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]), int(sys.argv[2])))
pickle.dump(loadmat(sys.argv[1], appendmat=False), sys.stdout.buffer, protocol=5)
"""


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
    if not path.is_file():
        raise SessionError(path, "is missing", "a MATLAB file", "fetch the whole data set")
    command = [sys.executable, "-I", "-c", _LOAD, str(path), str(LARGEST)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=LONGEST_S, check=False)
        found = done.stderr.decode(errors="replace").strip().rpartition("\n")[2][-300:]
        table: Table = pickle.loads(done.stdout) if done.returncode == 0 else {}
    except subprocess.TimeoutExpired:
        table, found = {}, f"not read after {LONGEST_S:g} s"
    except (pickle.UnpicklingError, EOFError, MemoryError) as error:
        table, found = {}, str(error)
    if not table:
        raise SessionError(path, f"cannot be read ({found or 'damaged'})", "a MATLAB file of version 5")
    return {name: value for name, value in table.items() if not name.startswith("__")}


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
