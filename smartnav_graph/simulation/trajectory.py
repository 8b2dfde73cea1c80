"""Analytic motions with exact position, velocity, acceleration, attitude and body rate.

A motion is a way along the body's forward direction plus a sway::

    nav_R_way  = Rz(psi) Rx(slope)                        psi counter-clockwise from north about up
    velocity   = speed * nav_R_way e_y                    so a car's side and vertical speed are exactly zero
    nav_R_body = nav_R_way Rz(yaw) Rx(pitch) Ry(roll)     how the device is held
    nav_t_body = way + carried                            its place, in level axes (right, ahead, up)
    sway       = envelope * sum of sines, in level axes and in the held angles

The envelope is speed / reference speed, so that a device at rest does not sway. Speed, psi and slope are piecewise
quintics, twice continuously differentiable; all derivatives are closed forms. Position is the integral of velocity by
Gauss-Legendre quadrature, exact to rounding. Body axes of a phone: x right, y ahead, z up; nav is ENU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PPoly

from smartnav_graph.core.arrays import Floats, Indices, Mask, runs
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import rotate, rotate_back

Angle = tuple[int, Floats, Floats]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
_PIECE_S = 0.25  # s; six nodes integrate a turn of 1 rad/s over it to 1e-15


@dataclass(frozen=True)
class Truth:
    """Exact states at n times.

    t (n,) s; nav_R_body (n, 3, 3); nav_t_body (n, 3) m; nav_v_body (n, 3) m/s; nav_a_body (n, 3) m/s^2 (coordinate
    acceleration, without gravity); body_rate (n, 3) rad/s of the body relative to nav, in body axes.
    """

    t: Floats
    nav_R_body: Floats
    nav_t_body: Floats
    nav_v_body: Floats
    nav_a_body: Floats
    body_rate: Floats

    def __len__(self) -> int:
        return len(self.t)

    def take(self, rows: Mask | Indices | slice) -> Truth:
        """Only these rows (mask, indices or slice)."""
        return Truth(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


class Way(Protocol):
    """Speed (m/s), psi (rad) and slope (rad) with two derivatives; where it rests; where its formula changes."""

    duration: float
    breaks: Floats
    rests: tuple[tuple[float, float], ...]

    def __call__(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Value, first and second derivative, each (n, 3), columns speed, psi, slope."""


@dataclass(frozen=True)
class Leg:
    """A stretch of `seconds` at whose end the speed is `speed` m/s, the way has turned by `turn_deg` to the left and
    climbs by `slope_deg`; in between all three follow the smooth step 6 x^5 - 15 x^4 + 10 x^3."""

    seconds: float
    speed: float
    turn_deg: float = 0.0
    slope_deg: float = 0.0


def smooth_steps(breaks: Floats, values: Floats) -> PPoly:
    """Piecewise quintic through `values` (k, ...) at `breaks` (k,), with zero first and second derivative there."""
    width = np.diff(breaks).reshape(-1, *[1] * (values.ndim - 1))
    rise = np.diff(values, axis=0)
    zero = np.zeros_like(rise)
    c = [6 * rise / width**5, -15 * rise / width**4, 10 * rise / width**3, zero, zero, values[:-1]]
    return PPoly(np.stack(c), breaks)


class Legs:
    """A way made of legs, started at `speed` m/s and `heading_deg` (clockwise from north)."""

    def __init__(self, legs: Sequence[Leg], *, speed: float = 0.0, heading_deg: float = 0.0) -> None:
        self.breaks = np.concatenate([[0.0], np.cumsum([leg.seconds for leg in legs])])
        self.duration = float(self.breaks[-1])
        speeds = np.array([speed, *(leg.speed for leg in legs)])
        psi = np.radians(-heading_deg + np.concatenate([[0.0], np.cumsum([leg.turn_deg for leg in legs])]))
        slope = np.radians([0.0, *(leg.slope_deg for leg in legs)])
        step = smooth_steps(self.breaks, np.stack([speeds, psi, slope], axis=-1))
        self._orders = (step, step.derivative(), step.derivative(2))
        still = (speeds[:-1] == 0) & (speeds[1:] == 0) & (np.diff(psi) == 0) & (np.diff(slope) == 0)
        self.rests = tuple((float(self.breaks[i]), float(self.breaks[j])) for i, j in runs(still))

    def __call__(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        value, first, second = (order(t) for order in self._orders)
        return value, first, second


class Eight:
    """A flat figure eight: psi = A sin(phase), speed = size * phase rate, with J0(A) = 0 so that it closes.

    The device rests for `rest` s, comes to speed within `ramp` s and then needs `period` s a round; `speed` in m/s.
    """

    CLOSING = 2.404825557695773  # rad, first zero of the Bessel function J0

    def __init__(self, duration: float, *, rest: float, ramp: float, period: float, speed: float) -> None:
        self.duration, self._size = float(duration), speed * period / (2 * np.pi)
        self.rests: tuple[tuple[float, float], ...] = ((0.0, rest),)
        self.breaks = np.array([0.0, rest, rest + ramp, duration])
        rate = 2 * np.pi / period
        step = smooth_steps(self.breaks, np.array([0.0, 0.0, rate, rate]))
        self._orders = (step.antiderivative(), step, step.derivative(), step.derivative(2))

    def __call__(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        p, p1, p2, p3 = (order(t) for order in self._orders)
        flat, a, sin, cos = np.zeros_like(p), self.CLOSING, np.sin(p), np.cos(p)
        psi, psi1, psi2 = a * sin, a * cos * p1, a * (cos * p2 - sin * p1**2)
        speed = [self._size * order for order in (p1, p2, p3)]
        value, first, second = (np.stack([s, y, flat], axis=-1) for s, y in zip(speed, (psi, psi1, psi2), strict=True))
        return value, first, second


@dataclass(frozen=True)
class Sway:
    """One sine: `shift` m to the right, ahead and up, `tilt` rad in the held yaw, pitch and roll."""

    hertz: float
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    phase: float = 0.0


@dataclass(frozen=True)
class Trajectory:
    """A way, how the device is held on it (yaw, pitch, roll in degrees), how it sways at `sway_speed` m/s, and where it
    is `carried` (m to the right, ahead, up of the point that follows the way). `fidget` is a sway at rest too."""

    way: Way
    held_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sway: tuple[Sway, ...] = ()
    sway_speed: float = 1.0
    fidget: tuple[Sway, ...] = ()
    carried: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def duration(self) -> float:
        """Seconds."""
        return self.way.duration

    @property
    def rests(self) -> tuple[tuple[float, float], ...]:
        """Standstills: start and end in seconds."""
        return self.way.rests

    def speed(self, t: ArrayLike) -> Floats:
        """Speed (n,) m/s along the way: what a wheel counts."""
        return np.asarray(self.way(np.asarray(t, dtype=np.float64).reshape(-1))[0][:, 0])

    def sample(self, t: ArrayLike) -> Truth:
        """Exact states at the times `t` (n,) s.

        Raises
        ------
        ConfigError
            A time outside [0, duration].
        """
        at = np.asarray(t, dtype=np.float64).reshape(-1)
        if len(at) and not (at.min() >= 0.0 and at.max() <= self.duration):
            raise ConfigError("trajectory", f"time {at.min()} .. {at.max()} s", f"within 0 .. {self.duration} s")
        value, first, second = self.way(at)
        shift, tilt = self._swayed(at, value[:, 0], first[:, 0], second[:, 0])
        rotation, rate = chain(
            [
                (2, value[:, 1], first[:, 1]),
                (0, value[:, 2], first[:, 2]),
                *((axis, tilt[0][:, i], tilt[1][:, i]) for i, axis in enumerate((2, 0, 1))),
            ]
        )
        ahead, ahead_rate = _ahead(value, first)
        sway = _turned(value[:, 1], first[:, 1], second[:, 1], shift)
        return Truth(
            t=at,
            nav_R_body=rotation,
            nav_t_body=self._travelled(at) + sway[0],
            nav_v_body=value[:, :1] * ahead + sway[1],
            nav_a_body=first[:, :1] * ahead + value[:, :1] * ahead_rate + sway[2],
            body_rate=rate,
        )

    def _swayed(self, t: Floats, speed: Floats, speed1: Floats, speed2: Floats) -> tuple[list[Floats], list[Floats]]:
        """Shift and tilt, each as value, first and second derivative (n, 3)."""
        moving = tuple(order / self.sway_speed for order in (speed, speed1, speed2))
        always = (np.ones_like(t), np.zeros_like(t), np.zeros_like(t))
        shift = [np.zeros((len(t), 3)) + np.asarray(order) for order in (self.carried, 0.0, 0.0)]
        tilt = [np.zeros((len(t), 3)) + np.radians(self.held_deg), *(np.zeros((len(t), 3)) for _ in range(2))]
        for wave, (e, e1, e2) in [(w, moving) for w in self.sway] + [(w, always) for w in self.fidget]:
            w = 2 * np.pi * wave.hertz
            s, c = np.sin(w * t + wave.phase), np.cos(w * t + wave.phase)
            orders = (e * s, e1 * s + e * w * c, e2 * s + 2 * e1 * w * c - e * w**2 * s)
            for k, order in enumerate(orders):
                shift[k] += order[:, None] * np.asarray(wave.shift)
                tilt[k] += order[:, None] * np.asarray(wave.tilt)
        return shift, tilt

    @cached_property
    def _stations(self) -> tuple[Floats, Floats]:
        """Knots (k,) no wider than a piece, and the distance vectors (k, 3) travelled up to them."""
        parts = [
            np.linspace(a, b, int(np.ceil((b - a) / _PIECE_S)) + 1)[1:]
            for a, b in zip(self.way.breaks[:-1], self.way.breaks[1:], strict=True)
        ]
        knots = np.concatenate([self.way.breaks[:1], *parts])
        steps = self._between(knots[:-1], knots[1:])
        return knots, np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def _travelled(self, t: Floats) -> Floats:
        knots, travelled = self._stations
        i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(knots) - 1)
        return np.asarray(travelled[i] + self._between(knots[i], t))

    def _between(self, a: Floats, b: Floats) -> Floats:
        """Integral of the way's velocity from `a` (n,) to `b` (n,), within one piece each."""
        middle, half = (a + b) / 2, (b - a) / 2
        total = np.zeros((len(a), 3))
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            value, first, _ = self.way(middle + half * node)
            total += weight * value[:, :1] * _ahead(value, first)[0]
        return np.asarray(half[:, None] * total)


def chain(angles: Sequence[Angle]) -> tuple[Floats, Floats]:
    """Rotation (n, 3, 3), the product of turns about axis i by an angle (n,), and its body rate (n, 3).

    With R' = R Ri(a): omega' = Ri(a)^T omega + a_dot e_i.
    """
    n = len(angles[0][1])
    rotation, rate = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    for axis, angle, angle_rate in angles:
        turn = _axis_turn(axis, angle)
        rotation = rotation @ turn
        rate = rotate_back(turn, rate)
        rate[:, axis] += angle_rate
    return np.asarray(rotation), rate


def _axis_turn(axis: int, angle: Floats) -> Floats:
    turn = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[:, axis, axis] = 1.0
    turn[:, i, i] = turn[:, j, j] = np.cos(angle)
    turn[:, j, i] = np.sin(angle)
    turn[:, i, j] = -turn[:, j, i]
    return turn


def _ahead(value: Floats, first: Floats) -> tuple[Floats, Floats]:
    """Unit vector (n, 3) along the way and its derivative."""
    (sp, sg), (cp, cg) = np.sin(value[:, 1:]).T, np.cos(value[:, 1:]).T
    ahead = np.stack([-sp * cg, cp * cg, sg], axis=-1)
    by_psi = np.stack([-cp * cg, -sp * cg, np.zeros_like(sp)], axis=-1)
    by_slope = np.stack([sp * sg, -cp * sg, cg], axis=-1)
    return ahead, first[:, 1:2] * by_psi + first[:, 2:3] * by_slope


def _turned(psi: Floats, psi1: Floats, psi2: Floats, q: list[Floats]) -> tuple[Floats, Floats, Floats]:
    """A vector q (value and two derivatives) in level axes turned by psi, seen from nav, with its two derivatives."""
    rotation = _axis_turn(2, psi)
    w, w1 = (np.stack([0 * r, 0 * r, r], axis=-1) for r in (psi1, psi2))
    first = q[1] + np.cross(w, q[0])
    second = q[2] + 2 * np.cross(w, q[1]) + np.cross(w1, q[0]) + np.cross(w, np.cross(w, q[0]))
    return rotate(rotation, q[0]), rotate(rotation, first), rotate(rotation, second)
