"""The named motions: static, walk, car, trolley, figure eight; each a Trajectory of at least the asked duration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from smartnav_graph.simulation.trajectory import Eight, Leg, Legs, Sway, Trajectory

# A hand-held phone at 1.35 m/s, 1.9 steps per second: up and down with the step, sideways and roll with the stride.
_STEPS = (
    Sway(hertz=1.9, shift=(0.0, 0.008, 0.018), tilt=(0.0, 0.03, 0.0)),
    Sway(hertz=0.95, shift=(0.015, 0.0, 0.0), tilt=(0.03, 0.0, 0.04), phase=0.7),
)
# A car body on its springs at 15 m/s.
SPRINGS = (
    Sway(hertz=1.3, shift=(0.0, 0.0, 0.004), tilt=(0.0, 0.003, 0.0)),
    Sway(hertz=1.7, tilt=(0.0, 0.0, 0.003), phase=1.1),
    Sway(hertz=11.0, shift=(0.0, 0.0, 5e-5), phase=0.4),
)


def static(duration: float) -> Trajectory:
    """A device at rest, tilted by 5 deg in pitch and -3 deg in roll, heading 40 deg."""
    return Trajectory(Legs([Leg(duration, 0.0)], heading_deg=40.0), held_deg=(0.0, 5.0, -3.0))


def walk(
    duration: float, rng: np.random.Generator, *, paces: tuple[float, float] = (1.2, 1.5), often: float = 1 / 6
) -> Trajectory:
    """A pedestrian, phone in front and pitched up 35 deg: 5 s rest, straights of 8 to 20 s at `paces` m/s, turns of
    60 to 120 deg, and a rest of 4 to 8 s after a turn as `often` as that."""
    legs = [Leg(5.0, 0.0), Leg(1.5, 1.3)]
    while sum(leg.seconds for leg in legs) < duration:
        pace = float(rng.uniform(*paces))
        legs += [
            Leg(float(rng.uniform(8, 20)), pace),
            Leg(2.5, pace, float(rng.choice([-1, 1]) * rng.uniform(60, 120))),
        ]
        if rng.random() < often:
            legs += [Leg(1.5, 0.0), Leg(float(rng.uniform(4, 8)), 0.0), Leg(1.5, pace)]
    heading = float(rng.uniform(0, 360))
    return Trajectory(Legs(legs, heading_deg=heading), held_deg=(0.0, 35.0, 4.0), sway=_STEPS, sway_speed=1.35)


def car(duration: float, rng: np.random.Generator, *, start_speed: float = 0.0) -> Trajectory:
    """A car in town, body axes aligned with it: straights at 9 to 18 m/s with slopes up to 3 deg, turns of 60 to 110
    deg at 5 to 8 m/s, stops of 5 to 15 s at every fourth turn on average. It rests for 10 s first unless it starts
    at `start_speed` m/s."""
    legs = [Leg(10.0, 0.0)] if start_speed == 0.0 else []
    while sum(leg.seconds for leg in legs) < duration:
        fast, slow = float(rng.uniform(9, 18)), float(rng.uniform(5, 8))
        bend, turn = float(rng.uniform(-15, 15)), float(rng.choice([-1, 1]) * rng.uniform(60, 110))
        slope = float(rng.uniform(-3, 3))
        legs += [Leg(7.0, fast), Leg(float(rng.uniform(8, 25)), fast, bend, slope), Leg(6.0, slow)]
        if rng.random() < 1 / 4:
            legs += [Leg(4.0, 0.0), Leg(float(rng.uniform(5, 15)), 0.0), Leg(4.0, slow)]
        legs.append(Leg(6.0, slow, turn))
    way = Legs(legs, speed=start_speed, heading_deg=float(rng.uniform(0, 360)))
    return Trajectory(way, sway=SPRINGS, sway_speed=15.0)


def slip(rng: np.random.Generator, sigma: float, axes: tuple[int, ...] = (0, 2)) -> tuple[Sway, ...]:
    """Violation of the constraints of a vehicle: side and vertical speeds of `sigma` m/s (root mean square at the sway
    speed).

    Three slow sines per direction with different phases: samples a second apart are nearly independent.
    """
    waves = []
    for axis in axes:
        for hertz in (0.31, 0.37, 0.43):
            shift = [0.0, 0.0, 0.0]
            shift[axis] = sigma * np.sqrt(2.0 / 3.0) / (2 * np.pi * hertz)
            waves.append(Sway(hertz, (shift[0], shift[1], shift[2]), phase=float(rng.uniform(0.0, 2 * np.pi))))
    return tuple(waves)


def trolley(rounds: int, *, rest: float = 60.0, stop: float = 10.0) -> Trajectory:
    """A trolley pushed round a rectangle of corridors that closes on itself, at 1 m/s.

    It rests for `rest` s, then stops for `stop` s in the middle of every side; one round takes four stops.
    """
    legs = [Leg(rest, 0.0)]
    for side in (30.0, 15.0) * 2 * rounds:
        half = [Leg(2.0, 1.0), Leg(side / 2, 1.0)]
        legs += [*half, Leg(4.0, 1.0, 90.0), Leg(side / 2, 1.0), Leg(2.0, 0.0), Leg(stop, 0.0)]
    sway = (Sway(hertz=6.0, shift=(0.0, 0.0, 2e-4), tilt=(0.0, 0.001, 0.0)),)
    return Trajectory(Legs(legs, heading_deg=25.0), sway=sway)


def arc_reach(speed: float, seconds: float) -> float:
    """How far (m) a turn of 90 deg goes along the old direction, and as far along the new one: the integral of the
    cosine."""
    share = np.linspace(0.0, 1.0, 2001)
    angle = np.pi / 2 * share**3 * (6.0 * share**2 - 15.0 * share + 10.0)
    return float(np.trapezoid(np.cos(angle), share)) * speed * seconds


# A trolley pushed over a floor: castors and joints, the rocking load, the steering hand, the steps of the person.
_CASTORS = (
    Sway(hertz=6.0, shift=(0.0, 0.0, 2e-4), tilt=(0.0, 1e-3, 0.0)),
    Sway(hertz=1.1, tilt=(0.0, 0.002, 0.003), phase=0.4),
    Sway(hertz=0.23, tilt=(0.02, 0.0, 0.0), phase=1.3),
    Sway(hertz=1.8, shift=(0.0, 0.008, 0.0), phase=2.1),
)


def creep(rng: np.random.Generator, speed: float, rate: float) -> tuple[Sway, ...]:
    """Slow motion of a device at rest over minutes: `speed` m/s per axis and `rate` rad/s in yaw, root mean squares."""
    waves = []
    for hertz in (1 / 90, 1 / 160, 1 / 310):
        size = np.sqrt(2.0 / 3.0) / (2 * np.pi * hertz) * rng.choice([-1.0, 1.0], 4)
        right, ahead, up = (float(speed * value) for value in size[:3])
        waves.append(Sway(hertz, (right, ahead, up), (float(rate * size[3]), 0.0, 0.0)))
    return tuple(waves)


@dataclass(frozen=True)
class Corridors:
    """A trolley pushed along the corridors of a grid, from a long rest.

    It starts at the origin facing north: the mean of the initial state after a standstill without other measurements.
    Each word of `turns` is the way to the next stop of `stop_s`: a letter per crossing, with a turn of 90 deg to the
    left (L) or right (R) within `turn_s`. The first of `arc_every` crossings is taken in an arc, at `corner_m_s` (zero:
    none is); at the others it halts, is turned on the spot and halts again, each time for `halt_s`. Speeds change
    within `ramp_s`.
    A trolley held by a person is not exactly at rest: `fidget_m_s` and the slow `creep_m_s`, `creep_rad_s` are the
    remaining speeds per axis, root mean square.
    """

    turns: tuple[str, ...] = (
        *("LLRRRL", "LRLLRL", "LLRRRR", "RRLRLL", "LRRRRL"),
        *("RLRRLR", "RLRRLR", "RLRRRL", "RLLLLR", "RRLLRL"),
    )
    spacing_m: float = 8.016  # so that all takes 20 min
    rest_s: float = 180.0
    stop_s: float = 10.0
    ramp_s: float = 2.0
    turn_s: float = 3.9
    halt_s: float = 0.8
    speed_m_s: float = 1.0
    corner_m_s: float = 0.6
    arc_every: int = 3
    fidget_m_s: float = 4e-4
    creep_m_s: float = 1.5e-4
    creep_rad_s: float = 3.5e-5
    sway: tuple[Sway, ...] = _CASTORS

    def __call__(self, seconds: float, rng: np.random.Generator) -> Trajectory:
        """The motion; its duration is given by the turns, not by `seconds`."""
        legs = [Leg(self.rest_s, 0.0)]
        for word in self.turns:
            legs += [*self._way(word), Leg(self.stop_s, 0.0)]
        fidget = slip(rng, self.fidget_m_s, axes=(0, 1, 2)) + creep(rng, self.creep_m_s, self.creep_rad_s)
        return Trajectory(Legs(legs), sway=self.sway, sway_speed=self.speed_m_s, fidget=fidget)

    def _way(self, word: str) -> Iterator[Leg]:
        """To the next stop: a corridor to each crossing, and one more."""
        halt, speed, done = Leg(self.halt_s, 0.0), 0.0, 0.0
        for count, letter in enumerate(word):
            turn_deg = 90.0 if letter == "L" else -90.0
            if self.arc_every and count % self.arc_every == 0:
                yield from self._drive(self.spacing_m - done - self._arc_m, speed, self.corner_m_s)
                yield Leg(self.turn_s, self.corner_m_s, turn_deg)
                speed, done = self.corner_m_s, self._arc_m
            else:
                yield from self._drive(self.spacing_m - done, speed, 0.0)
                yield from (halt, Leg(self.turn_s, 0.0, turn_deg), halt)
                speed, done = 0.0, 0.0
        yield from self._drive(self.spacing_m - done, speed, 0.0)

    @property
    def _arc_m(self) -> float:
        """How far along the corridor, and then along the next one, an arc goes."""
        return arc_reach(self.corner_m_s, self.turn_s)

    def _drive(self, metres: float, begin: float, end: float) -> list[Leg]:
        v, ramps = self.speed_m_s, self.ramp_s * (self.speed_m_s + (begin + end) / 2)
        return [Leg(self.ramp_s, v), Leg((metres - ramps) / v, v), Leg(self.ramp_s, end)]


def in_a_room(duration: float, rng: np.random.Generator) -> Trajectory:
    """A phone in the hand, carried round a loop of 2.9 m by 2.9 m at 0.5 m/s after 3 s of rest, raised and lowered by
    15 cm and turned about all axes; it starts at the origin facing north."""
    legs = [Leg(3.0, 0.0), Leg(2.0, 0.5)]
    while sum(leg.seconds for leg in legs) < duration:
        legs.append(Leg(5.0, 0.5, 90.0))
    sway = (
        Sway(hertz=0.31, shift=(0.03, 0.0, 0.15), tilt=(0.06, 0.10, 0.08)),
        Sway(hertz=0.83, shift=(0.02, 0.01, 0.03), tilt=(0.02, 0.03, 0.04), phase=0.5),
        Sway(hertz=2.1, shift=(0.003, 0.003, 0.006), tilt=(0.004, 0.004, 0.006), phase=1.9),
    )
    return Trajectory(Legs(legs), held_deg=(0.0, 5.0, 2.0), sway=sway, sway_speed=0.5)


def figure_eight(duration: float, *, rest: float = 5.0) -> Trajectory:
    """A phone carried round a figure eight of 20 s at 1.5 m/s after 5 s of rest, tilting gently."""
    way = Eight(duration, rest=rest, ramp=5.0, period=20.0, speed=1.5)
    sway = (Sway(hertz=0.4, tilt=(0.1, 0.2, 0.25)), Sway(hertz=0.9, shift=(0.01, 0.01, 0.03), phase=0.5))
    return Trajectory(way, held_deg=(0.0, 10.0, 0.0), sway=sway, sway_speed=1.5)
