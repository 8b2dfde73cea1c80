"""The start does not depend on how the device is mounted, nor on when and of which kind the first position is."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from sessions import positions, recorded

import smartnav_graph as sn
from smartnav_graph.core import frames
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import PoseFix, Ranges

AXES = [sign + axis for sign in "+-" for axis in "xyz"]
MOUNTED = [pair for pair in itertools.product(AXES, AXES) if pair[0][1] != pair[1][1]]


@cache
def walk() -> Session:
    return recorded(seconds=50.0).replace(magnetometer=None, static=None)


def mounted(forward: str, up: str) -> Session:
    """The same ride with the device mounted another way."""
    turn = frames.body_R_vehicle(forward, up) @ frames.body_R_vehicle("+y", "+z").T
    imu = walk().imu
    turned = replace(imu, gyro=imu.gyro @ turn.T, accel=imu.accel @ turn.T)
    return walk().replace(imu=turned, device=replace(walk().device, forward=forward, up=up))


def error_m(run: sn.Run) -> float:
    solution = run.solution
    later = solution.seconds > 15.0
    off = solution.nav_t_body[later] - positions(walk(), solution.t_ns[later])
    return float(np.sqrt((off**2).sum(axis=1).mean()))


@pytest.mark.parametrize(("forward", "up"), MOUNTED)
def test_any_forward_and_up_axis(forward, up):
    run, plain = sn.run(mounted(forward, up)), sn.run(walk())
    np.testing.assert_allclose(run.solution.nav_t_body, plain.solution.nav_t_body, atol=0.01)  # m
    found, expected = (one.solution.heading_pitch_roll_deg for one in (run, plain))
    np.testing.assert_allclose((found - expected + 180.0) % 360.0 - 180.0, 0.0, atol=0.1)  # deg
    assert run.summary["initialisation"]["heading_deg"] == pytest.approx(
        plain.summary["initialisation"]["heading_deg"], abs=0.1
    )


@pytest.mark.parametrize(("forward", "up"), [("-z", "-x"), ("+z", "-y"), ("-x", "+y")])
@pytest.mark.parametrize("causal", [False, True])
def test_any_axes_with_a_given_start(forward, up, causal):
    run = sn.run(mounted(forward, up), initial="0,0,0,0,20,30", causal=causal)
    assert error_m(run) < 1.0  # m, fixes of 1 m


def _late(seconds: float) -> Session:
    gnss = walk().gnss
    return walk().replace(gnss=gnss.take(gnss.t_ns >= walk().t0_ns + round(seconds * NS)))


def _poses_without_attitude() -> Session:
    gnss = walk().gnss.take(np.arange(len(walk().gnss)) % 3 == 1)
    return walk().replace(gnss=None, pose_fixes=PoseFix(t_ns=gnss.t_ns, lla=gnss.lla, sigma=gnss.sigma))


def _ranges(start_s: float) -> Session:
    seconds, rng = np.arange(start_s, 48.0, 0.25), np.random.default_rng(0)
    t_ns, which = walk().t0_ns + (seconds * NS).astype(np.int64), np.arange(len(seconds)) % 4
    anchor = np.array([[40.0, 40.0, 10.0], [-40.0, 40.0, 8.0], [-40.0, -40.0, 12.0], [40.0, -40.0, 3.0]])[which]
    range_m = np.linalg.norm(positions(walk(), t_ns) - anchor, axis=1) + rng.normal(0.0, 0.2, len(t_ns))
    names = np.array([f"A{i}" for i in which], dtype=object)
    lla = walk().frame.lla_from_nav(anchor)
    found = Ranges(t_ns=t_ns, lla=lla, anchor_id=names, range_m=range_m, sigma=np.full(len(t_ns), 0.2))
    return walk().replace(gnss=None, ranges=found)


FIRST: dict[str, Callable[[], Session]] = {
    "a fix after some seconds": lambda: _late(4.3),
    "a fix after half a minute": lambda: _late(31.4),
    "pose fixes without attitude": _poses_without_attitude,
    "ranges": lambda: _ranges(0.0),
    "ranges after some seconds": lambda: _ranges(5.3),
}


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("kind", FIRST)
def test_any_first_position(kind, causal):
    assert error_m(sn.run(FIRST[kind](), causal=causal)) < 1.5  # m, fixes of 1 m
