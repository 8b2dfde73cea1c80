"""Traces of the Indoor Location Competition 2.0 (Microsoft Research, XYZ10): a phone in hand, waypoints on a plan.

Lines of text, tab separated: Unix time in ms, type, values. Read are TYPE_ACCELEROMETER (specific force, m/s^2),
TYPE_GYROSCOPE (rad/s, less the system's bias) and TYPE_WAYPOINT (x right, y up, metres on the plan). Phone axes:
x right, y top, z out of the screen. Nothing ties the plan to north: magnetic field and rotation vector are left.

A waypoint is a place tapped on the map: `LABEL_SIGMA`. The floor is flat and the phone is carried at
one height, which is zero here: `HEIGHT_SIGMA`. The first waypoint is tapped a moment before the sensors start;
waypoints outside the inertial span by at most `EDGE_S` are moved to its first or last sample, counted in
`Session.dropped`.

The recorder polls: all sensors share its stamps, and a reading is up to one period old. Where the phone shakes that is
noise, which the calibration of the session includes (`polled_noise`).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.source import Reader, build_session, inertial_columns, vector_columns
from smartnav_graph.readers.text import TextTable, first_lines, read_bytes
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, Calibration, ImuNoise
from smartnav_graph.session.session import Device, Session
from smartnav_graph.session.streams import Imu

MS = NS // 1000
LABEL_SIGMA = 0.7  # m per axis: labels lie 0.5 to 1 m beside the line that was walked
HEIGHT_SIGMA = 0.2  # m
EDGE_S = 0.5  # a pedestrian moves less than the sigma of a label

VALUES = {
    "TYPE_ACCELEROMETER": ("x", "y", "z"),
    "TYPE_GYROSCOPE": ("x", "y", "z"),
    "TYPE_WAYPOINT": ("x", "y"),
}


def _matches(source: str) -> bool:
    path = Path(source)
    return path.is_file() and any("startTime:" in line and line.startswith("#") for line in first_lines(path, 1))


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    tables = _tables(path)
    imu = _imu(path, tables)
    control, moved = _control(path, tables["TYPE_WAYPOINT"], np.asarray(imu["t_ns"], dtype=np.int64))
    session = build_session(
        {"imu": (path, imu), "control": (path, control)},
        repairs,
        device=Device(name=_phone(path), forward="+y", up="+z", vehicle="foot"),
        clock_epoch="unix",
    )
    noise = polled_noise(session.require_imu())
    session = replace(session, calibration=Calibration(device=session.device.name, imu_noise=noise))
    if not moved:
        return session
    counts = dict(session.dropped.get("control", {}))
    counts[f"moved by at most {EDGE_S} s to the first or last inertial sample"] = moved
    return replace(session, dropped={**session.dropped, "control": counts})


def _tables(path: Path) -> dict[str, TextTable]:
    """Cells of the types that are read, each a table of t and values."""
    rows = _records(path)
    missing = [kind for kind, found in rows.items() if not found]
    if missing:
        raise SessionError(path, f"holds no {', '.join(missing)}", f"lines of {', '.join(VALUES)}")
    tables = {}
    for kind, found in rows.items():
        names = ("t", *(f"{kind} {axis}" for axis in VALUES[kind]))
        cells = zip(names, zip(*found, strict=True), strict=True)
        tables[kind] = TextTable.of(path, dict(cells))
    return tables


def _records(path: Path) -> dict[str, list[list[str]]]:
    """Stamp and values of every line, by type."""
    try:
        lines = read_bytes(path).decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise SessionError(path, f"is no UTF-8 text ({error})", "a trace of tab separated lines") from error
    rows: dict[str, list[list[str]]] = {kind: [] for kind in VALUES}
    for number, line in enumerate(lines, start=1):
        t, kind, *values = line.split("\t") if line.count("\t") else (line, "")
        if t.startswith("#") or kind not in VALUES:
            continue
        count = len(VALUES[kind])
        if len(values) not in (count, count + 1):  # the last may be the sensor's accuracy
            raise SessionError(
                path,
                f"line {number} has {len(values)} values behind {kind}",
                f"{count}, and an accuracy after those of a sensor",
                "put each record on a separate line",
                row=number,
            )
        rows[kind].append([t, *values[:count]])
    return rows


def _vectors(table: TextTable) -> Floats:
    return table.floats(*(name for name in table.cells if name != "t"))


def _imu(path: Path, tables: dict[str, TextTable]) -> Table:
    accel, gyro = tables["TYPE_ACCELEROMETER"], tables["TYPE_GYROSCOPE"]
    t_ns = accel.times("t", MS)
    if not np.array_equal(t_ns, gyro.times("t", MS)):
        raise SessionError(
            path, "accelerometer and gyroscope have different stamps", "one stamp for both, as in this format"
        )
    return inertial_columns(t_ns, _vectors(gyro), _vectors(accel))


def polled_noise(imu: Imu) -> ImuNoise:
    """Class noise and that of readings of any age up to one period h.

    Linear between samples, a reading is off by (age / h - 1/2) of its step d to the next: sigma = rms(d) / sqrt(12) a
    sample, density = sigma sqrt(h).
    """
    usual, period = DEVICE_CLASSES["mems"], float(np.median(np.diff(imu.t_ns))) / NS

    def density(rows: Floats) -> float:
        return float(np.sqrt((np.diff(rows, axis=0) ** 2).mean() / 12.0 * period))

    return replace(
        usual,
        accel_noise_density=float(np.hypot(usual.accel_noise_density, density(imu.accel))),
        gyro_noise_density=float(np.hypot(usual.gyro_noise_density, density(imu.gyro))),
    )


def _control(path: Path, table: TextTable, imu_ns: Times) -> tuple[Table, int]:
    """Columns of the waypoints, and how many were moved into the inertial span."""
    recorded, xy = table.times("t", MS), _vectors(table)
    inside = np.clip(recorded, imu_ns[0], imu_ns[-1])
    t_ns = np.where(np.abs(inside - recorded) <= EDGE_S * NS, inside, recorded)
    n = len(t_ns)
    place = vector_columns("{}_m", np.column_stack([xy, np.zeros(n)]), "enu")
    sigma = vector_columns("sigma_{}_m", np.tile([LABEL_SIGMA, LABEL_SIGMA, HEIGHT_SIGMA], (n, 1)), "enu")
    names = np.array([f"W{i}" for i in range(n)], dtype=object)
    return {"t_ns": t_ns, "point_id": names} | place | sigma, int((t_ns != recorded).sum())


def _phone(path: Path) -> str:
    """Brand and model, where the heading names them."""
    cells = [cell.partition(":") for line in first_lines(path, 10) if line.startswith("#") for cell in line.split("\t")]
    found = {name: value for name, _, value in cells}
    return " ".join(value for name in ("Brand", "Model") if (value := found.get(name, ""))) or "phone"


READER = Reader(
    name="indoor-waypoints",
    summary="Indoor Location Competition trace: phone IMU, waypoints on a floor plan",
    recognised_by="a text file that begins with # startTime:",
    matches=_matches,
    read_source=_read,
)
