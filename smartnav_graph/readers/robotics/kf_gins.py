"""Text files of KF-GINS and OB_GINS (Wuhan University): fixes, inertial increments; one file, or a folder of them.

No headings; the first column is GPS time of week in s, the week is not in the file. Fixes: latitude and longitude deg,
height m, sigmas north, east, down m [, velocity north, east, down m/s and their sigmas]. IMU: increments of angle rad
and velocity m/s since the row before, axes forward, right, down (Niu et al., KF-GINS dataset README). Where the time of
week begins anew, a week is added.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError, warn
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.robotics.device_axes import device_axes
from smartnav_graph.readers.samples import Samples, in_time_order
from smartnav_graph.readers.source import Reader, first_bytes
from smartnav_graph.readers.text import TextTable, read_text
from smartnav_graph.session.session import Session

_log = logging.getLogger(__name__)

WEEK_S = 604_800
WEEK_NS = WEEK_S * NS
_LONGEST_STEP_S = 600.0
FIX_WIDTHS = (7, 10, 13)
_GRAVITY_SHARE = 0.2  # by which the mean specific force of a vehicle differs from gravity, at most


def _rows(path: Path) -> Floats:
    """The first rows (n, k) of a file of numbers without heading; (0, 0) for anything else. Never raises."""
    lines = first_bytes(str(path)).decode("ascii", errors="replace").splitlines()[:-1]
    try:
        rows = np.array([line.replace(",", " ").split() for line in lines[:50] if line.strip()], dtype=np.float64)
    except ValueError:  # a word, or rows of different length
        return np.zeros((0, 0))
    good = rows.ndim == 2 and len(rows) >= 3 and rows.shape[1] in FIX_WIDTHS and np.isfinite(rows).all()
    return rows if good else np.zeros((0, 0))


def _kind(path: Path) -> str:
    """``gnss`` or ``imu``; empty for anything else."""
    rows = _rows(path)
    if not rows.size:
        return ""
    step = np.mod(np.diff(rows[:, 0]), WEEK_S)
    if rows[:, 0].min() < 0 or rows[:, 0].max() > WEEK_S or not ((step > 0) & (step < _LONGEST_STEP_S)).all():
        return ""
    force = np.linalg.norm(rows[1:, 4:7], axis=1) / step
    if rows.shape[1] == 7 and np.abs(force.mean() / STANDARD_GRAVITY - 1.0) < _GRAVITY_SHARE and step.max() < 0.2:
        return "imu"
    lat, lon, height, sigma = rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:7]
    on_earth = (np.abs(lat) <= 90.0).all() and (np.abs(lon) <= 360.0).all() and (np.abs(height) < 20_000.0).all()
    near = np.ptp(lat) < 1.0 and np.ptp(lon) < 2.0 and bool(lat.any() and lon.any())
    return "gnss" if on_earth and near and (sigma > 0.0).all() and (sigma < 1000.0).all() else ""


def _files(source: str) -> dict[str, list[Path]]:
    """The files of each kind. Never raises."""
    found: dict[str, list[Path]] = {}
    try:
        path = Path(source)
        listed = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
        for file in listed:
            if kind := _kind(file):
                found.setdefault(kind, []).append(file)
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return {}
    return found


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    files = _files(source)
    several = [file for kind in files.values() if len(kind) > 1 for file in kind]
    if several or not files:
        found = f"holds {', '.join(file.name for file in several) or 'no such file'}"
        raise SessionError(source, found, "one file of fixes and one of the IMU", "give the file, or join two of them")
    parts = LogParts()
    if "imu" in files:
        parts.add_imu(*_inertial(files["imu"][0], repairs))
    if "gnss" in files:
        parts.add_fixes(files["gnss"][0], _fixes(files["gnss"][0]), may_repeat=True)
    axes = device_axes(Path(source), parts)
    _log.info("%s: stamps are GPS time of week; the week is not in the file", source)
    return log_session(parts, repairs, name="KF-GINS", epoch="unknown", forward=axes.forward, up=axes.up)


def _table(path: Path) -> tuple[TextTable, Times, Floats]:
    """The rows of a file: text, stamps (n,), and the other columns (n, k)."""
    width = _rows(path).shape[1]
    table = read_text(path, names=[str(column) for column in range(width)])
    t_ns = table.times("0")
    begins = np.concatenate([[False], np.diff(t_ns) < -WEEK_NS // 2])
    if begins.any():
        warn(f"{path}: the time of week begins anew at row {int(np.argmax(begins))}: a week is added")
    return table, t_ns + np.cumsum(begins) * WEEK_NS, table.floats(*map(str, range(1, width)))


def _inertial(path: Path, repairs: tuple[str, ...]) -> tuple[Samples, Samples]:
    """Increments over the time since the row before -> angular rate and specific force."""
    _, t_ns, increments = _table(path)
    samples = in_time_order(path, t_ns, increments, repairs)
    period = np.diff(samples.t_ns, prepend=2 * samples.t_ns[0] - samples.t_ns[min(1, len(samples) - 1)]) / NS
    period = np.where(period > 3.0 * np.median(period), np.median(period), period)  # a gap: of the period alone
    rates = samples.values / np.where(period > 0.0, period, np.nan)[:, None]
    return Samples(path, samples.t_ns, rates[:, :3], samples.counts), Samples(path, samples.t_ns, rates[:, 3:])


def _fixes(path: Path) -> LoggedFixes:
    _, t_ns, rows = _table(path)
    velocity = rows[:, 6:9] * np.array([1.0, 1.0, -1.0]) if rows.shape[1] >= 9 else None
    return LoggedFixes(
        *(t_ns, rows[:, 0], rows[:, 1], rows[:, 2]),
        sigma=rows[:, [4, 3, 5]],
        velocity=None if velocity is None else velocity[:, [1, 0, 2]],
        velocity_sigma=rows[:, [10, 9, 11]] if rows.shape[1] >= 12 else None,
    )


READER = Reader(
    name="kf-gins",
    summary="KF-GINS and OB_GINS text: fixes, inertial increments, GPS time of week",
    recognised_by="numbers without heading, 7, 10 or 13 a row, whose first is a time of week; a file, or a folder",
    matches=lambda source: bool(_files(source)),
    read_source=_read,
)
