"""A town of square blocks: a drive through its streets from a road and a roundabout outside, and what a camera sees.

The drive begins at the nav origin on a road that points to 85 deg, goes round a roundabout by 320 deg to the left and
bends into the street to the east. From there it turns at random at the crossings, within the town.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.simulation import motions
from smartnav_graph.simulation.scenes import CorridorGrid, Scene
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

FIRST_HEADING_DEG = 85.0
ROUNDABOUT_DEG = 320.0
_STEPS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # east, north, west, south: a turn to the left is the next one


@dataclass(frozen=True)
class TownDrive:
    """A car's way through a town of `nodes` (east, north) crossings, `spacing_m` apart; a motion, see `recording`.

    rest_s : at the start; speed_m_s : least and most of a street; corner_m_s, corner_s : of a turn of 90 deg
    stops : share of the streets with a stop of `stop_s` (least, most) in the middle
    held_deg, carried : of the phone in the car, as in `Trajectory`; slip_m_s : side and vertical speed at 15 m/s
    """

    nodes: tuple[int, int] = (8, 8)
    spacing_m: float = 150.0
    rest_s: float = 30.0
    speed_m_s: tuple[float, float] = (9.0, 14.0)
    corner_m_s: float = 5.0
    corner_s: float = 5.0
    ramp_s: float = 4.0
    stops: float = 1 / 6
    stop_s: tuple[float, float] = (5.0, 20.0)
    held_deg: tuple[float, float, float] = (3.0, 2.0, 0.0)
    carried: tuple[float, float, float] = (0.0, 1.2, 0.5)
    slip_m_s: float = 0.12

    def __call__(self, seconds: float, rng: np.random.Generator) -> Trajectory:
        """A drive of at least so many seconds."""
        legs, speed = list(self._approach), self.corner_m_s
        place, heading = np.array([0, self.nodes[1] // 2]), 0
        while sum(leg.seconds for leg in legs) < seconds:
            turn = self._turn(place, heading, rng)
            legs.append(self._crossing(turn))
            heading = (heading + turn) % 4
            legs += self._street(speed, rng)
            place = place + _STEPS[heading]
        sway = (*motions.SPRINGS, *motions.slip(rng, self.slip_m_s))
        way = Legs(legs, heading_deg=FIRST_HEADING_DEG)
        return Trajectory(way, self.held_deg, sway=sway, sway_speed=15.0, carried=self.carried)

    @property
    def _approach(self) -> Iterator[Leg]:
        """From rest, round the roundabout, and to the beginning of the first crossing."""
        bend = (FIRST_HEADING_DEG - ROUNDABOUT_DEG) % 360.0 - 90.0  # to the left, towards the east
        yield from (Leg(self.rest_s, 0.0), Leg(8.0, 11.0), Leg(12.0, 11.0), Leg(4.0, 6.0))
        yield Leg(20.0, 6.0, ROUNDABOUT_DEG)
        yield from (Leg(4.0, 8.0), Leg(4.0, 8.0, bend), Leg(10.0, 8.0), Leg(4.0, self.corner_m_s))

    @cached_property
    def entrance(self) -> Floats:
        """East and north (2,) m of the first crossing, by which the drive comes in from the west."""
        way = Trajectory(Legs(list(self._approach), heading_deg=FIRST_HEADING_DEG))
        end = way.sample([way.duration]).nav_t_body[0, :2]
        return np.asarray(end + np.array([self._arc_m, 0.0]))

    @property
    def _arc_m(self) -> float:
        """From the beginning of a turn to the middle of the crossing."""
        return motions.arc_reach(self.corner_m_s, self.corner_s)

    def _turn(self, place: Floats, heading: int, rng: np.random.Generator) -> int:
        """0 straight on, 1 left, -1 right: one at random of those that stay in the town."""
        ways = []
        for turn in (0, 1, -1):
            ahead = place + _STEPS[(heading + turn) % 4]
            if ((ahead >= 0) & (ahead < self.nodes)).all():
                ways.append(turn)
        return int(rng.choice(ways))

    def _crossing(self, turn: int) -> Leg:
        reach = 2 * self._arc_m / self.corner_m_s
        return Leg(self.corner_s, self.corner_m_s, 90.0 * turn) if turn else Leg(reach, self.corner_m_s)

    def _street(self, ends: float, rng: np.random.Generator) -> list[Leg]:
        """From a crossing to the next one, sometimes with a stop in the middle."""
        length, speed = self.spacing_m - 2 * self._arc_m, float(rng.uniform(*self.speed_m_s))
        if rng.random() >= self.stops:
            return self._drive(length, ends, speed, ends)
        rest = Leg(float(rng.uniform(*self.stop_s)), 0.0)
        slow = min(speed, 9.0)
        return [*self._drive(length / 2, ends, slow, 0.0), rest, *self._drive(length / 2, 0.0, slow, ends)]

    def _drive(self, metres: float, begin: float, speed: float, end: float) -> list[Leg]:
        even = metres - self.ramp_s * (speed + (begin + end) / 2)
        return [Leg(self.ramp_s, speed), Leg(even / speed, speed), Leg(self.ramp_s, end)]


@dataclass(frozen=True)
class Streets:
    """Facades and road of the streets of `drive`, open to the sky: a scene, see `SimulatedCamera`."""

    drive: TownDrive
    width_m: float = 18.0
    height_m: float = 12.0
    camera_m: float = 1.5
    per_m2: float = 0.6

    def __call__(self, rng: np.random.Generator) -> Scene:
        drive = self.drive
        grid = CorridorGrid(
            nodes=drive.nodes,
            spacing_m=drive.spacing_m,
            origin=(0, drive.nodes[1] // 2),
            width_m=self.width_m,
            floor_m=-self.camera_m,
            ceiling_m=self.height_m - self.camera_m,
            cupboards=0,
            per_m2=self.per_m2,
        )(rng)
        walls = np.flatnonzero(grid.normal[:, 2] > -0.5)  # all but the ceiling
        kept = np.isin(grid.face, walls)
        shift = np.append(drive.entrance, 0.0)
        return Scene(
            corner=grid.corner[walls] + shift,
            u=grid.u[walls],
            v=grid.v[walls],
            points=grid.points[kept] + shift,
            face=np.searchsorted(walls, grid.face[kept]),
            visible_m=grid.visible_m[kept],
        )
