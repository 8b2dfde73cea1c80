"""Surveyed control points: computed less given position, and what the point was used for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.so3 import rotate
from smartnav_graph.core.timebase import NS
from smartnav_graph.evaluation.align import states_of_solution
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.output.report.track import fix_states
from smartnav_graph.output.summary_json import Summary, table_of
from smartnav_graph.output.text import DASH, Row, Table, count, fixed, seconds
from smartnav_graph.session.session import Session

CONTRARY = 4.0  # sigmas: 1 point in 5000 by chance, on one of three axes
USES = {"used": "in", "unused": "withheld", "rejected": "rejected"}


@dataclass(frozen=True)
class ControlRow:
    """One visit: `difference` computed less given (3,) m east, north, up; `sigma_point` that of the point, `sigma` that
    of the solution (3,) m; `use` in, withheld or rejected; `place` in the system asked for."""

    point_id: str
    t_s: float
    difference: Floats
    sigma_point: Floats
    sigma: Floats
    use: str
    place: tuple[float, ...] = ()

    @property
    def is_contrary(self) -> bool:
        """Whether it was withheld, and differs by more than `CONTRARY` sigmas of both on an axis."""
        both = np.hypot(np.nan_to_num(self.sigma_point), self.sigma)
        return self.use == "withheld" and bool((np.nan_to_num(np.abs(self.difference)) > CONTRARY * both).any())


def control_rows(session: Session, solution: Solution, summary: Summary, crs: str = "") -> list[ControlRow]:
    """The visits inside the run in time order.

    Raises
    ------
    SessionError
        The system `crs` is not known or does not hold there.
    """
    points = session.control
    if points is None or len(solution) < 2:
        return []
    points = points.take((points.t_ns >= solution.t_ns[0]) & (points.t_ns <= solution.t_ns[-1]))
    if not len(points):
        return []
    use = fix_states(session, solution)["control"][1]
    states = states_of_solution(solution).at(points.t_ns)
    assert states.rotation is not None and states.covariance is not None  # of a solution
    given, state = session.nav_position(points), table_of(table_of(summary, "states"), "control_lever_arm_correction_m")
    lever = session.lever_arms(points) + np.asarray(state.get("value", np.zeros(3)), dtype=np.float64)
    difference = states.position + rotate(states.rotation, lever) - given
    mount = session.mount("control")
    if mount.above_sea and not np.isfinite(mount.geoid_m):  # heights on a datum of their own
        difference[:, 2] = np.nan
    difference[~points.has_height, 2] = np.nan
    sigma = np.sqrt(np.clip(np.diagonal(states.covariance, axis1=1, axis2=2)[:, POS], 0.0, None))
    sigma_point = np.full((len(points), 3), np.nan) if points.sigma is None else points.sigma
    t_s = (points.t_ns - solution.t0_ns) / NS
    places = _places(given, solution, crs)
    return [
        ControlRow(str(points.point_id[i]), float(t_s[i]), difference[i], sigma_point[i], sigma[i], USES[use[i]], at)
        for i, at in enumerate(places)
    ]


def _places(nav: Floats, solution: Solution, crs: str) -> list[tuple[float, ...]]:
    if not crs or solution.origin is None:
        return [()] * len(nav)
    from smartnav_graph.core.frames import LocalFrame
    from smartnav_graph.output.export.coordinates import transformed

    _, values = transformed(LocalFrame(solution.origin).lla_from_nav(nav), crs)
    return list(zip(*(column.tolist() for column in values), strict=True))


def control_table(rows: Sequence[ControlRow]) -> Table:
    """One row a visit. The sigma of the solution contains the point itself where it is in."""
    with_place = any(row.place for row in rows)
    head = ["Point", "Use", "Time", "dE [m]", "dN [m]", "dU [m]", "σ point E, N, U [m]", "σ solution E, N, U [m]"]
    head += ["East", "North", "Height"] if with_place else []
    shown = [
        Row(
            [
                row.point_id or DASH,
                row.use,
                seconds(row.t_s),
                *map(_metres, row.difference),
                *(" / ".join(map(_metres, sigma)) for sigma in (row.sigma_point, row.sigma)),
                *(map(_metres, row.place)),
            ],
            {"point": row.point_id, "use": row.use, "t-s": row.t_s}
            | dict(zip(("de-m", "dn-m", "du-m"), map(_known, row.difference), strict=True)),
        )
        for row in rows
    ]
    return Table(head, shown, frozenset({1}))


def control_summary(rows: Sequence[ControlRow]) -> Table:
    """RMS of the points that are in and of those withheld, and the largest horizontal difference."""
    found = []
    for use in ("in", "withheld", "rejected"):
        chosen = np.array([row.difference for row in rows if row.use == use])
        if len(chosen):
            square = chosen**2
            rms = [_rms(square[:, i]) for i in range(3)]
            horizontal = square[:, :2].sum(axis=1)
            cells = [
                use.capitalize(),
                count(len(chosen)),
                *map(_metres, [*rms, _rms(horizontal), horizontal.max() ** 0.5]),
            ]
            found.append(Row(cells, {"use": use, "rms-horizontal-m": _rms(horizontal)}))
    return Table(("RMS of points", "Count", "dE [m]", "dN [m]", "dU [m]", "Horizontal [m]", "Largest [m]"), found)


def _rms(square: Floats) -> float:
    known = square[np.isfinite(square)]
    return float(np.sqrt(known.mean())) if len(known) else float("nan")


def _metres(value: float) -> str:
    return fixed(float(value), 3) if np.isfinite(value) else DASH


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
