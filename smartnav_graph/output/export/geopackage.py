"""GeoPackage (OGC 12-128r19): the path as a line, and every epoch as a point with time, one sigma, attitude and speed.

Needs pyogrio, which the extra ``geopackage`` installs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import unix_ns
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.output.export.coordinates import transformed
from smartnav_graph.output.export.geographic import SIGMAS, lla_of

LINE_Z, POINT_Z = 1002, 1001  # OGC 06-103r4, table 7
WGS84 = "EPSG:4326"


def write_geopackage(solution: Solution, path: Path, clock_epoch: str, crs: str | None) -> None:
    """Two layers, ``trajectory`` and ``epochs``, in `crs`, by default WGS84 with ellipsoidal heights."""
    try:
        from pyogrio.raw import write
    except ImportError as error:
        found = "needs pyogrio, which is not installed"
        remedy = "pip install 'smartnav-graph[geopackage]', or export geojson"
        raise SessionError("--format gpkg", found, "the extra geopackage", remedy) from error
    lla = lla_of(solution)
    xyz = lla[:, [1, 0, 2]] if crs is None else np.column_stack(transformed(lla, crs)[1])
    columns = _columns(solution, clock_epoch)
    common = {"driver": "GPKG", "crs": crs or WGS84, "dataset_options": {"VERSION": "1.3"}}
    about = [np.array([float(solution.path_length())]), np.array([float(np.ptp(solution.seconds))])]
    line, points = np.array([_wkb(LINE_Z, xyz)], dtype=object), np.array([_wkb(POINT_Z, row) for row in xyz], object)
    write(path, line, about, ["length_m", "duration_s"], layer="trajectory", geometry_type="LineString Z", **common)
    write(
        path,
        points,
        list(columns.values()),
        list(columns),
        layer="epochs",
        geometry_type="Point Z",
        append=True,
        **common,
    )


def _columns(solution: Solution, clock_epoch: str) -> dict[str, NDArray[np.generic]]:
    heading, pitch, roll = solution.heading_pitch_roll_deg.T
    columns: dict[str, NDArray[np.generic]] = {"t_ns": solution.t_ns, "elapsed_s": solution.seconds}
    unix = unix_ns(solution.t_ns, clock_epoch)
    if unix is not None:
        columns["time_utc"] = unix.astype("datetime64[ns]").astype("datetime64[ms]")
    columns |= dict(zip(SIGMAS, solution.sigmas[:, POS].T, strict=True))
    columns |= {"heading_deg": heading, "pitch_deg": pitch, "roll_deg": roll}
    columns |= {"sigma_heading_deg": solution.sigma_heading_deg}
    columns["speed_m_s"] = np.linalg.norm(solution.nav_v_body, axis=1)
    return columns


def _wkb(kind: int, xyz: Floats) -> bytes:
    """A point (3,) or a line (n, 3) as well-known binary, little-endian."""
    count = np.array([len(xyz)], "<u4").tobytes() if kind == LINE_Z else b""
    return b"\x01" + np.array([kind], "<u4").tobytes() + count + xyz.astype("<f8").tobytes()
