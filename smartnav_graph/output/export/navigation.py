"""SBET and NMEA 0183: trajectories as survey software reads them. Both need dates: a clock of the Unix or GPS epoch.

SBET (Applanix, smoothed best estimate of trajectory): 17 little-endian doubles a row. Time in seconds of the GPS week
in which the run begins, rising beyond its end; latitude and longitude rad, ellipsoidal height m; velocity m/s north,
east, down; roll, pitch, heading rad; the azimuth of the frame of velocities, zero; acceleration m/s^2 with gravity
removed, and angular rate rad/s, forward, right, down (zero where the run holds no inertial data).

NMEA: GGA of quality 6 (estimated), RMC, GST, and THS (true heading). Heights are ellipsoidal, and the geoid separation
is zero; it is empty where heights are above mean sea level.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.so3 import rotate_back
from smartnav_graph.core.timebase import NS, gps_from_utc, interpolate, utc_from_gps
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.output.export.geographic import lla_of

WEEK_NS = 7 * 86_400 * NS
KNOTS = 3600.0 / 1852.0  # in 1 m/s


def utc_ns(solution: Solution, clock_epoch: str, format: str) -> Times:
    """Unix nanoseconds (n,) of the stamps.

    Raises
    ------
    SessionError
        The clock has no date.
    """
    if clock_epoch not in ("unix", "gps"):
        found = f"the clock of the session has no date (epoch {clock_epoch})"
        remedy = "set epoch in [clock] of session.toml and smooth again, or export csv"
        raise SessionError(f"--format {format}", found, "a clock of the Unix or GPS epoch", remedy)
    return solution.t_ns if clock_epoch == "unix" else utc_from_gps(solution.t_ns)


def write_sbet(solution: Solution, path: Path, clock_epoch: str) -> None:
    """One row an epoch."""
    utc = utc_ns(solution, clock_epoch, "sbet")
    gps = solution.t_ns if clock_epoch == "gps" else gps_from_utc(utc)
    week_s = (gps - gps[:1] // WEEK_NS * WEEK_NS) / NS
    lat, lon, height = lla_of(solution).T
    east, north, up = solution.nav_v_body.T
    heading, pitch, roll = np.radians(solution.heading_pitch_roll_deg).T
    heading = (heading + np.pi) % (2 * np.pi) - np.pi
    rows = [week_s, np.radians(lat), np.radians(lon), height, north, east, -up, roll, pitch, heading]
    rows += [np.zeros(len(solution)), *inertial_frd(solution).T]
    np.column_stack(rows).astype("<f8").tofile(path)


def inertial_frd(solution: Solution) -> Floats:
    """Acceleration and angular rate (n, 6), forward, right, down; zeros where the run holds no inertial data."""
    if solution.imu is None:
        return np.zeros((len(solution), 6))
    imu = solution.imu
    known = np.clip(solution.t_ns, imu.t_ns[0], imu.t_ns[-1])
    force, rate = (interpolate(known, imu.t_ns, values) for values in (imu.accel, imu.gyro))
    up = rotate_back(solution.nav_R_body, np.broadcast_to([0.0, 0.0, solution.gravity], force.shape))
    frd_R_body = (frames.body_R_vehicle(solution.forward, solution.up) * [1.0, -1.0, -1.0]).T
    both = (force - solution.accel_bias - up, rate - solution.gyro_bias)
    return np.concatenate([values @ frd_R_body.T for values in both], axis=1)


def write_nmea(solution: Solution, path: Path, clock_epoch: str) -> None:
    """Four sentences an epoch."""
    with open(path, "w", encoding="ascii", newline="") as file:
        file.writelines(_sentences(solution, utc_ns(solution, clock_epoch, "nmea")))


def _sentences(solution: Solution, t_ns: Times) -> Iterator[str]:
    lla, heading = lla_of(solution).tolist(), solution.heading_pitch_roll_deg[:, 0].tolist()
    speed = (np.linalg.norm(solution.nav_v_body[:, :2], axis=1) * KNOTS).tolist()
    course = (np.degrees(np.arctan2(*solution.nav_v_body[:, :2].T)) % 360.0).tolist()
    sigma = solution.sigmas[:, POS].tolist()
    separation = "0.0" if solution.heights == frames.ELLIPSOIDAL else ""
    for row, stamp in enumerate(((t_ns + 500_000) // 1_000_000).tolist()):
        seconds, ms = divmod(stamp, 1000)
        when = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
        at = f"{when:%H%M%S}.{ms:03d}"
        lat, lon, height = lla[row]
        place = f"{_degrees(lat, 2, 'NS')},{_degrees(lon, 3, 'EW')}"
        e, n, u = sigma[row]
        yield _closed(f"GPGGA,{at},{place},6,,,{height:.4f},M,{separation},M,,")
        yield _closed(f"GPRMC,{at},A,{place},{speed[row]:.3f},{_turn(course[row], 2)},{when:%d%m%y},,,E")
        yield _closed(f"GPGST,{at},,,,,{n:.4f},{e:.4f},{u:.4f}")
        yield _closed(f"GPTHS,{_turn(heading[row], 3)},E")


def _turn(value: float, digits: int) -> str:
    """Degrees below 360 after rounding, too."""
    return f"{round(value, digits) % 360.0:.{digits}f}"


def _degrees(value: float, width: int, letters: str) -> str:
    """Degrees and minutes, to 1e-7 minutes (0.2 mm)."""
    units = round(abs(value) * 60e7)
    whole, minutes = divmod(units, 60 * 10**7)
    return f"{whole:0{width}d}{minutes // 10**7:02d}.{minutes % 10**7:07d},{letters[value < 0]}"


def _closed(body: str) -> str:
    sum_ = 0
    for letter in body.encode("ascii"):
        sum_ ^= letter
    return f"${body}*{sum_:02X}\r\n"
