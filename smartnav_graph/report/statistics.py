"""Figures of one run, computed from its states and its recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.report.facts import Certainty, room, sensor_name, withheld_counts
from smartnav_graph.report.text import Row, Table, as_float, count, distance, duration, fixed, metres, number
from smartnav_graph.session import Session
from smartnav_graph.solution import POS, Solution

Floats = NDArray[np.float64]

AT_S = 300.0
STILL_M_S = 0.1


def certainty(solution: Solution) -> Certainty | None:
    """Median and worst horizontal one-sigma position of the run."""
    horizontal = np.linalg.norm(solution.sigmas[:, POS][:, :2], axis=1)
    if not len(horizontal) or not np.isfinite(horizontal).all() or horizontal.max() <= 0:
        return None
    worst = int(np.argmax(horizontal))
    return Certainty(float(np.median(horizontal)), float(horizontal[worst]), float(solution.seconds[worst]))


def sigma_at(solution: Solution) -> tuple[float, Floats] | None:
    """Time s and position sigmas (3,) east, north, up at 300 s, or in the middle of a run that does not reach it."""
    t, sigma = solution.seconds, solution.sigmas[:, POS]
    if not len(t) or not np.isfinite(sigma).all() or sigma.max() <= 0:
        return None
    at = AT_S if t[0] <= AT_S <= t[-1] else round(float(t[0] + t[-1]) / 2, 1)
    return at, np.array([np.interp(at, t, column) for column in sigma.T])


def key_figures(summary: Mapping[str, Any], sure: Certainty | None) -> list[tuple[str, str]]:
    """Four to six tiles."""
    tiles = [
        ("Duration", duration(summary.get("duration_s"))),
        ("Distance", distance(summary.get("path_m"))),
        ("Median 1 sigma", metres(sure.median_m) if sure else "–"),
        ("χ² / dof", number(room(summary, "chi2_per_dof").get("overall"))),
    ]
    if room(summary, "rejected"):
        tiles.append(("Rejected", count(sum(as_float(n) or 0 for n in room(summary, "rejected").values()))))
    for name in withheld_counts(summary):
        rms = room(room(summary, "withheld"), name).get("rms_horizontal_m")
        if as_float(rms) is not None:
            tiles.append((f"Withheld {sensor_name(name)}, RMS", metres(rms)))
    return tiles


def table(session: Session, solution: Solution, summary: Mapping[str, Any]) -> Table:
    """Times, lengths, speeds, heights and what the IMU felt."""
    rows = [
        ("Duration", duration(summary.get("duration_s", _span(solution)))),
        ("Distance along the path", distance(summary.get("path_m", solution.path_length()))),
        ("Epochs (keyframes)", count(summary.get("keyframes", len(solution)))),
        *_images(session),
        *_motion(solution),
        *_felt(session, solution),
    ]
    return Table(("", ""), [Row(cells) for cells in rows])


def _span(solution: Solution) -> float:
    return float(solution.seconds[-1] - solution.seconds[0]) if len(solution) else 0.0


def _images(session: Session) -> list[tuple[str, str]]:
    if session.images is not None:
        return [("Images", count(len(session.images)))]
    if session.tracks is not None:
        return [("Images with tracked points", count(len(np.unique(session.tracks.image_id))))]
    return []


def _motion(solution: Solution) -> list[tuple[str, str]]:
    if not len(solution):
        return []
    t, speed = solution.seconds, np.linalg.norm(solution.nav_v_body, axis=1)
    fastest = int(np.argmax(speed))
    known = solution.origin is not None
    height = solution.trajectory_columns()["height_m"] if known else solution.nav_t_body[:, 2]
    above = "ellipsoidal" if known else "above the local origin"
    rows = [
        (
            "Largest speed",
            f"{number(speed[fastest])} m/s ({fixed(3.6 * speed[fastest], 0)} km/h) at {fixed(t[fastest], 1)} s",
        ),
        (f"Height, {above}", f"{fixed(height.min(), 2)} to {fixed(height.max(), 2)} m"),
    ]
    still = float(np.diff(t)[(speed[1:] < STILL_M_S) & (speed[:-1] < STILL_M_S)].sum())
    if still > 0:
        rows.append((f"Standing still (below {STILL_M_S} m/s)", duration(still)))
    return rows


def _felt(session: Session, solution: Solution) -> list[tuple[str, str]]:
    """Extremes of the IMU inside the run."""
    imu = session.imu
    if imu is None or not len(solution):
        return []
    inside = (imu.t_ns >= solution.t_ns[0]) & (imu.t_ns <= solution.t_ns[-1])
    if not inside.any():
        return []
    t = session.seconds(imu.t_ns[inside])
    force = np.linalg.norm(imu.accel[inside], axis=1)
    rate = np.degrees(np.linalg.norm(imu.gyro[inside], axis=1))
    excess = np.abs(force - session.gravity)
    f, a, r = int(np.argmax(force)), int(np.argmax(excess)), int(np.argmax(rate))
    return [
        ("Largest specific force (IMU)", f"{number(force[f])} m/s² at {fixed(t[f], 1)} s"),
        ("Largest departure from gravity (IMU)", f"{number(excess[a])} m/s² at {fixed(t[a], 1)} s"),
        ("Largest rotation rate (IMU)", f"{number(rate[r])} °/s at {fixed(t[r], 1)} s"),
    ]


def uncertainty_table(solution: Solution) -> Table:
    """Median, 95 % and largest one-sigma of position and heading."""
    sigma = solution.sigmas[:, POS]
    columns = {
        "East [m]": sigma[:, 0],
        "North [m]": sigma[:, 1],
        "Up [m]": sigma[:, 2],
        "Horizontal [m]": np.linalg.norm(sigma[:, :2], axis=1),
        "Heading [°]": solution.sigma_heading_deg,
    }
    rows = [
        Row([name, *(number(v) for v in (*np.percentile(s, [50, 95]), s.max()))])
        for name, s in columns.items()
        if np.isfinite(s).all()
    ]
    return Table(("1 sigma", "Median", "95 %", "Largest"), rows)
