"""Figures of one run, computed from its states and its session."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.frames import LOCAL_HEIGHTS, Origin
from smartnav_graph.core.timebase import interpolate, seconds_since, unix_ns
from smartnav_graph.factors import title_of
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.output.report.facts import Uncertainty, withheld_counts
from smartnav_graph.output.summary_json import Summary, numbers_of, table_of
from smartnav_graph.output.text import Row, Table, count, distance, duration, fixed, metres, number, plural
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Imu

HARD = "\u00a0"  # a space that no line breaks at
AT_S = 300.0
SLOW_M_S = 0.1


def horizontal_uncertainty(solution: Solution) -> Uncertainty | None:
    """Median and largest horizontal one-sigma position of the run."""
    horizontal = np.linalg.norm(solution.sigmas[:, POS][:, :2], axis=1)
    if not len(horizontal) or not np.isfinite(horizontal).all() or horizontal.max() <= 0:
        return None
    at = int(np.argmax(horizontal))
    return Uncertainty(float(np.median(horizontal)), float(horizontal[at]), float(solution.seconds[at]))


def sigma_at(solution: Solution) -> tuple[float, Floats] | None:
    """Time s and position sigmas (3,) east, north, up at 300 s, or in the middle of a run that does not reach it."""
    t, sigma = solution.seconds, solution.sigmas[:, POS]
    if not len(t) or not np.isfinite(sigma).all() or sigma.max() <= 0:
        return None
    at = AT_S if t[0] <= AT_S <= t[-1] else round(float(t[0] + t[-1]) / 2, 1)
    return at, np.array([np.interp(at, t, column) for column in sigma.T])


def key_figures(summary: Summary, uncertainty: Uncertainty | None) -> list[tuple[str, str]]:
    """Four to six tiles."""
    tiles = [
        ("Duration", duration(summary.get("duration_s"))),
        ("Distance", distance(summary.get("path_m"))),
        ("Median 1 sigma, horizontal", metres(uncertainty.median_m) if uncertainty else "–"),
        ("χ² / dof", number(table_of(summary, "chi2_per_dof").get("overall"))),
    ]
    if table_of(summary, "rejected"):
        tiles.append(("Rejected", count(sum(numbers_of(summary, "rejected").values()))))
    for name in withheld_counts(summary):
        rms = numbers_of(table_of(summary, "withheld"), name).get("rms_horizontal_m")
        if rms is not None:
            tiles.append((f"Withheld {title_of(name)}, RMS", metres(rms)))
    return tiles


def statistics_table(session: Session, solution: Solution, summary: Summary) -> Table:
    """Times, lengths, speeds, heights, extremes of the IMU."""
    rows = [
        *_when_and_where(session, solution),
        ("Duration", duration(summary.get("duration_s", _span(solution)))),
        ("Distance along the path", distance(summary.get("path_m", solution.path_length()))),
        ("Epochs (keyframes)", count(summary.get("keyframes", len(solution)))),
        *_images(session),
        *_motion(solution),
        *_standstills(summary),
        *_slow(solution),
        *_imu_extremes(session, solution),
    ]
    return Table(("", ""), [Row(cells) for cells in rows])


def _when_and_where(session: Session, solution: Solution) -> list[tuple[str, str]]:
    """Date and origin, where known."""
    rows = []
    unix = unix_ns(solution.t_ns[:1], session.clock_epoch)
    if unix is not None and len(unix):
        stamp = np.datetime_as_string(np.datetime64(int(unix[0]), "ns"), unit="s")
        rows.append(("Begin (UTC)", str(stamp).replace("T", " ")))
    if solution.origin is not None:
        rows.append(("Origin of east, north, up", place_of(solution.origin)))
    return rows


def place_of(origin: Origin) -> str:
    """Latitude, longitude and height as text."""
    north, east = "N" if origin.lat_deg >= 0 else "S", "E" if origin.lon_deg >= 0 else "W"
    lat, lon = f"{abs(origin.lat_deg):.6f}°{HARD}{north}", f"{abs(origin.lon_deg):.6f}°{HARD}{east}"
    return f"{lat}, {lon}, {fixed(origin.height_m, 1)}{HARD}m"


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
    above = solution.heights.removesuffix(" (WGS84)") if known else LOCAL_HEIGHTS
    largest = f"{number(speed[fastest])} m/s ({fixed(3.6 * speed[fastest], 0)} km/h) at {fixed(t[fastest], 1)} s"
    heights = f"{fixed(height.min(), 2)} to {fixed(height.max(), 2)} m"
    return [("Largest speed", largest), (f"Height, {above}", heights)]


def _slow(solution: Solution) -> list[tuple[str, str]]:
    """Time at nearly zero speed, for any reason."""
    slow = np.linalg.norm(solution.nav_v_body, axis=1) < SLOW_M_S
    return [(f"Slower than {SLOW_M_S} m/s", duration(float(np.diff(solution.seconds)[slow[1:] & slow[:-1]].sum())))]


def _standstills(summary: Summary) -> list[tuple[str, str]]:
    """Standstills, detected or listed in the session."""
    found = numbers_of(summary, "standstills")
    stops, total, rest = (found.get(key) for key in ("count", "total_s", "at_rest_s"))
    if stops is None or total is None:
        return []
    if not stops:
        return [("Standstills", "none detected")]
    rows = [("Standstills", f"{plural(stops, 'stop')}, {duration(total)} in all")]
    return [*rows, ("Of these completely at rest", duration(rest))] if rest is not None else rows


def _imu_extremes(session: Session, solution: Solution) -> list[tuple[str, str]]:
    """Extremes of the IMU inside the run."""
    imu = session.imu
    if imu is None or not len(solution):
        return []
    inside = (imu.t_ns >= solution.t_ns[0]) & (imu.t_ns <= solution.t_ns[-1])
    if not inside.any():
        return []
    imu = imu.take(inside)
    signals = [
        ("acceleration (IMU, gravity removed)", "m/s²", accelerations(imu, solution, session.gravity)),
        ("specific force (IMU)", "m/s²", np.linalg.norm(imu.accel, axis=1)),
        ("rotation rate (IMU)", "°/s", np.degrees(np.linalg.norm(imu.gyro, axis=1))),
    ]
    t = session.seconds(imu.t_ns)
    return [
        (f"Largest {what}", f"{number(size.max())} {unit} at {fixed(t[int(np.argmax(size))], 1)} s")
        for what, unit, size in signals
    ]


def accelerations(imu: Imu, solution: Solution, gravity: float) -> Floats:
    """Size (n,) m/s^2 of the acceleration over ground at inertial samples: ``nav_R_body (f - bias) - gravity up``."""
    bias = interpolate(imu.t_ns, solution.t_ns, solution.accel_bias)
    if len(solution) > 1:
        R = Slerp(solution.seconds, Rotation.from_matrix(solution.nav_R_body))(seconds_since(imu.t_ns, solution.t0_ns))
    else:
        R = Rotation.from_matrix(solution.nav_R_body[0])
    return np.asarray(np.linalg.norm(R.apply(imu.accel - bias) - [0.0, 0.0, gravity], axis=1))


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
