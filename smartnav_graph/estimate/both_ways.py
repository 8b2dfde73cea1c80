"""Forward and backward: the filter run on a session and on the session with time reversed.

Reversed, the stamps run from the last to the first: places, attitudes and specific forces are the same, angular rates
and velocities change their sign.
Forward is the other way, so that what drives or walks forward does so in both. The two causal solutions share the
measurements near an epoch only: their difference shows what each of them is worth, and contains errors that a smoothed
solution hides (Shin, El-Sheimy 2002, Optimizing smoothing computation for near real-time GPS measurement gap filling).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.replay import replay
from smartnav_graph.factors.pose_fix import undo_latency
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream

IMAGES = ("images", "tracks", "matches")
# Columns that change their sign.
OPPOSITE = (
    *(f"gyro_{axis}_rad_s" for axis in "xyz"),
    *("ve_m_s", "vn_m_s", "vu_m_s"),
    *(f"v_{axis}_m_s" for axis in "xyz"),
)
_OTHER = {"+": "-", "-": "+"}


@dataclass(frozen=True)
class BothWays:
    """Forward less backward position `difference` (n, 3) m east, north, up at t_ns (n,), and its `sigma` (n, 3) m as
    both solutions give it, taken as independent."""

    t_ns: Times
    difference: Floats
    sigma: Floats


def reversed_session(session: Session) -> Session:
    """The session with time reversed; without images, reference and times of arrival."""
    imu = session.require_imu()
    sum_ns = int(imu.t_ns[0]) + int(imu.t_ns[-1])
    left_out = dict.fromkeys((*IMAGES, "reference"))
    streams = {name: _reversed(s, sum_ns) for name, s in session.streams().items() if name not in left_out}
    device = replace(session.device, forward=_OTHER[session.device.forward[0]] + session.device.forward[1])
    return session.replace(**(streams | left_out), device=device, calibration=_reversed_bias(session.calibration))


def _reversed_bias(calibration: Calibration | None) -> Calibration | None:
    """Of a gyro with the other sign."""
    if calibration is None:
        return None
    errors = calibration.imu_errors
    x, y, z = errors.gyro_bias
    by_temperature = tuple(-value for value in errors.gyro_temperature)
    errors = replace(errors, gyro_bias=(-x, -y, -z), gyro_temperature=by_temperature)
    return replace(calibration, imu_errors=errors)


def _reversed(stream: Stream, sum_ns: int) -> Stream:
    table = {name: column[::-1] for name, column in stream.columns().items() if name != "arrival_ns"}
    table |= {name: np.negative(table[name]) for name in OPPOSITE if name in table}
    t_ns = sum_ns - table["t_ns"]
    if "t_end_ns" in table:
        table["t_end_ns"], t_ns = t_ns, sum_ns - table["t_end_ns"]
    return type(stream).from_columns(table | {"t_ns": t_ns})


def both_ways(session: Session, config: Config, progress: Progress = silent) -> BothWays:
    """Two causal runs with all measurements, without images.

    Raises
    ------
    SessionError, SolverError
        As `replay`; a way that cannot be begun is one of them.
    """
    imu = session.require_imu()
    first, last = int(imu.t_ns[0]), int(imu.t_ns[-1])
    length_s = (last - first) / NS
    session, latest = undo_latency(session, config.pose_fixes), replace(config.pose_fixes, latency_s=0.0)
    changes: dict[str, Any] = {"replay": replace(config.replay, polish=False), "pose_fixes": latest}
    plain = dataclasses.replace(config, **changes, run=replace(config.run, withhold=()))
    start, end = plain.run.start_s, plain.run.end_s
    swapped = replace(
        plain.run,
        initial="",
        start_s=None if end is None else max(length_s - end, 0.0),
        end_s=None if start is None else length_s - start,
    )
    backward = replace(plain, run=swapped)
    ahead = _causal(session.replace(**dict.fromkeys(IMAGES)), plain, progress)
    back = _causal(reversed_session(session), backward, progress)
    t_ns = first + last - back.t_ns[::-1]
    rows = (ahead.t_ns >= t_ns[0]) & (ahead.t_ns <= t_ns[-1])
    at = ahead.t_ns[rows]
    position, sigma = (interpolate(at, t_ns, values[::-1]) for values in (back.nav_t_body, back.sigmas[:, POS]))
    return BothWays(at, ahead.nav_t_body[rows] - position, np.hypot(ahead.sigmas[rows][:, POS], sigma))


def _causal(session: Session, config: Config, progress: Progress) -> Solution:
    found = replay(session, config, progress=progress).causal
    assert found is not None  # of a replay
    return found
