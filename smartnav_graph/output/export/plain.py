"""Text tables: the columns of trajectory.csv, and TUM."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.graph.solution import Solution


def write_trajectory_csv(solution: Solution, path: str | Path, further: Mapping[str, Floats] | None = None) -> None:
    """The columns of trajectory.csv and `further` ones: t_ns as integer, floats in the shortest text that reads back
    the same.

    Unknown values are empty: latitude, longitude and height without an origin. Writes directly to `path`.
    """
    import pyarrow as pa
    import pyarrow.csv

    columns = solution.trajectory_columns() | dict(further or {})
    table = pa.table({name: pa.array(values, from_pandas=True) for name, values in columns.items()})
    with open(path, "wb") as file:
        file.write((",".join(columns) + "\n").encode())  # pyarrow would quote the names
        pyarrow.csv.write_csv(table, file, pyarrow.csv.WriteOptions(include_header=False))


def write_tum(solution: Solution, path: str | Path) -> None:
    """Lines ``t x y z qx qy qz qw`` (Sturm et al. 2012): seconds on the solution's clock, nav metres, nav_R_body."""
    values = np.concatenate([solution.nav_t_body, solution.quat_wxyz[:, [1, 2, 3, 0]]], axis=1).tolist()
    stamps = map(_decimal_seconds, solution.t_ns.tolist())
    lines = (f"{t} {' '.join(map(repr, row))}\n" for t, row in zip(stamps, values, strict=True))
    with open(path, "w", encoding="ascii") as file:
        file.writelines(lines)


def _decimal_seconds(t_ns: int) -> str:
    # a binary float would round a Unix epoch to 0.2 us
    whole, rest = divmod(abs(t_ns), NS)
    return f"{'-' if t_ns < 0 else ''}{whole}.{rest:09d}"
