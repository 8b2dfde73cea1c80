"""Which body axis of a recording points up and forward: up by gravity, forward by speed and turns of the fixes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.frames import LocalFrame, axis_vector
from smartnav_graph.core.timebase import NS, interpolate, ns_from_seconds, seconds_since
from smartnav_graph.readers.fixes import LoggedFixes, first_fix
from smartnav_graph.readers.samples import Samples

COHERENCE = 0.5  # of horizontal force and the acceleration of the fixes, below which forward is not known
LEAST_SPEED = 2.0  # m/s: slower, a hand moves the device more than its carrier does
LEAST_TURN = 2.0  # rad of course, in all, that shows the sign of a turn
_STEP_S = 1.0


@dataclass(frozen=True)
class BodyAxes:
    """Forward and up of a device as signed body axes, and whether each was found in the data."""

    forward: str = "+y"
    up: str = "+z"
    forward_found: bool = False
    up_found: bool = False


def find_body_axes(imu: Table, fixes: Table | None = None) -> BodyAxes:
    """Up is the axis nearest to the median specific force; forward the one that speeds up, and turns, with the fixes.

    Over each second the horizontal specific force, in the plane across up, is f = exp(i theta) (dv/dt + i v omega):
    longitudinal and centripetal acceleration of a vehicle with speed v and turn rate omega about up. theta of the
    least squares is the direction of travel; it counts where the coherence of both sides is at least `COHERENCE`.

    Parameters
    ----------
    imu, fixes : columns of the streams ``imu`` and ``gnss`` (latitude and longitude)
    """
    accel = np.stack([np.asarray(imu[f"accel_{axis}_m_s2"], dtype=np.float64) for axis in "xyz"], axis=-1)
    gyro = np.stack([np.asarray(imu[f"gyro_{axis}_rad_s"], dtype=np.float64) for axis in "xyz"], axis=-1)
    t_ns = np.asarray(imu["t_ns"], dtype=np.int64)
    force = np.median(accel, axis=0)
    if not np.linalg.norm(force) > 0.0:
        return BodyAxes()
    up = _nearest_axis(force)
    known = _forward(t_ns, gyro, accel, force, fixes) if fixes is not None else None
    default = "+y" if up[1] == "z" else "-z"  # the back camera of a phone held upright looks ahead
    forward = default if known is None else _nearest_axis(known, but=up[1])
    return BodyAxes(forward, up, known is not None, True)


def _nearest_axis(direction: Floats, but: str = "") -> str:
    size = np.where([name == but for name in "xyz"], 0.0, np.abs(direction))
    axis = int(np.argmax(size))
    return f"{'+' if direction[axis] > 0 else '-'}{'xyz'[axis]}"


def _forward(t_ns: Times, gyro: Floats, accel: Floats, force: Floats, fixes: Table) -> Floats | None:
    """Direction of travel (3,) in body axes; None where the fixes do not show it."""
    at = np.asarray(fixes["t_ns"], dtype=np.int64)
    begin, end = max(at[0], t_ns[0]), min(at[-1], t_ns[-1])
    if len(at) < 10 or end - begin < 20 * NS:
        return None
    grid = begin + ns_from_seconds(np.arange(0.0, (end - begin) / NS, _STEP_S))
    speed = interpolate(grid, at, _speeds(at, fixes))
    up = force / np.linalg.norm(force)
    first = axis_vector("+x" if abs(up[0]) < 0.7 else "+y")
    first = first - up * (first @ up)
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    mean = _means(t_ns, np.concatenate([accel, gyro], axis=1), grid)
    f, turn = (mean[:, :3] @ first) + 1j * (mean[:, :3] @ second), mean[:, 3:] @ up
    model = np.diff(speed) / _STEP_S + 1j * turn * (speed[1:] + speed[:-1]) / 2
    moving = (np.minimum(speed[1:], speed[:-1]) > LEAST_SPEED) & np.isfinite(f) & np.isfinite(model)
    if moving.sum() < 20:
        return None
    f, model = f[moving] - np.median(f[moving].real) - 1j * np.median(f[moving].imag), model[moving]
    product = np.vdot(model, f)  # conjugates the first
    size = np.sqrt(np.vdot(model, model).real * np.vdot(f, f).real)
    if not size > 0.0 or abs(product) < COHERENCE * size:
        return None
    return np.asarray((product.real * first + product.imag * second) / abs(product))


def _speeds(at: Times, fixes: Table) -> Floats:
    """Speed (n,) m/s of fixes: their own where they have one, else that of the chords."""
    position = np.stack([np.asarray(fixes[name], dtype=np.float64) for name in ("lat_deg", "lon_deg")], axis=-1)
    enu = LocalFrame(first_fix(fixes)).nav_from_lla(np.column_stack([position, np.zeros(len(at))]))
    seconds = seconds_since(at, int(at[0]))
    chord: Floats = np.hypot(*np.gradient(enu[:, :2], seconds, axis=0).T)
    if "ve_m_s" not in fixes:
        return chord
    own = np.hypot(*(np.asarray(fixes[name], dtype=np.float64) for name in ("ve_m_s", "vn_m_s")))
    return np.where(np.isfinite(own), own, chord)


def _means(t_ns: Times, values: Floats, grid: Times) -> Floats:
    """Means (m - 1, k) of the rows between successive stamps of a grid (m,); NaN where there are none."""
    edge = np.searchsorted(t_ns, grid)
    count = np.diff(edge)
    there = count > 0
    found = np.full((len(count), values.shape[1]), np.nan)
    if there.any():  # rows between two stamps that have some end where the next ones begin
        found[there] = np.add.reduceat(values[: edge[-1]], edge[:-1][there], axis=0) / count[there, None]
    return found


def sign_by_turn(force: Samples, gyro: Samples, fixes: LoggedFixes) -> float:
    """1 where the force (n, 3) points up, -1 where it points down, by the turns about it; zero where they say nothing.

    Between fixes the course turns by as much as the gyroscope shows about up; about down it is the opposite.
    """
    if fixes.course is None or fixes.speed is None:
        return 0.0
    size = np.linalg.norm(np.median(force.values, axis=0))
    moving = np.isfinite(fixes.course) & (fixes.course >= 0.0) & (np.nan_to_num(fixes.speed) > LEAST_SPEED)
    moving &= (fixes.t_ns > gyro.t_ns[0]) & (fixes.t_ns < gyro.t_ns[-1])
    if not size > 0.0 or moving.sum() < 10:
        return 0.0
    rate = gyro.values @ (np.median(force.values, axis=0) / size)
    step = np.diff(seconds_since(gyro.t_ns, int(gyro.t_ns[0])))
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])
    at = fixes.t_ns[moving]
    near = np.diff(at) < 3 * NS
    by_gyro = np.diff(interpolate(at, gyro.t_ns, turned))[near]
    by_course = -np.diff(np.unwrap(np.radians(fixes.course[moving])))[near]
    product, squares = float(by_gyro @ by_course), float(np.sqrt((by_gyro @ by_gyro) * (by_course @ by_course)))
    clear = np.abs(by_course).sum() > LEAST_TURN and abs(product) > COHERENCE * squares
    return float(np.sign(product)) if clear else 0.0
