"""The named scenarios, each a `Scenario` that a seed turns into a session with its truth; see `recording`.

With a camera: room-30s (tracks), rendered-room-10s (pictures) and trolley-20min (matches of images up to 2 s apart, as
`smartnav match` pairs them; its constants are frozen). These start at rest at the origin facing north and have no
position measurements. That is also the initial state of a run without fixes, in batch and replay, so that errors are
those of the whole way. The trolley rests for three minutes and stops ten times for ten seconds; at two corners of three
it halts for 0.8 s before and after it is turned, too briefly to be detected, so that the listed halts fix its velocity
and not its heading; round the third it is pushed in an arc. trolley-20min-plain has turns on the spot alone, at longer
corridors, and matches of neighbours only. Without standstills: ``--standstill.zupt False
--standstill.zaru False``. A wrong boresight or camera clock, unknown to the session: ``replace(scenario,
camera=replace(scenario.camera, boresight_deg=(0.0, 0.5, 0.0), clock_s=0.02))``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypedDict

import numpy as np

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.session.session import Session
from smartnav_graph.simulation import motions, thesis
from smartnav_graph.simulation.cameras import ON_PHONE, PHONE_CAMERA, Faults, PictureModel, SimulatedCamera
from smartnav_graph.simulation.fixes import GnssModel, PoseFixModel, RangeModel
from smartnav_graph.simulation.recording import Scenario
from smartnav_graph.simulation.scenes import CorridorGrid, FurnishedRoom
from smartnav_graph.simulation.sensors import BarometerModel, MagnetometerModel, SpeedModel
from smartnav_graph.simulation.trajectory import Trajectory

SLIP_M_S = 0.12  # side and vertical speed of the phone's car at 15 m/s: 0.15 when it is fastest


def _static_motion(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.static(seconds)


def _moving_car(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.car(seconds, rng, start_speed=12.0)


def _trolley(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.trolley(2)


def _eight(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.figure_eight(seconds)


def _car_with_phone(seconds: float, rng: np.random.Generator) -> Trajectory:
    """A phone in a holder, turned by 3 deg in yaw and 2 deg in pitch, 1.2 m ahead of the rear axle, 0.5 m above it."""
    car = motions.car(seconds, rng)
    sway = (*car.sway, *motions.slip(rng, SLIP_M_S))
    return replace(car, held_deg=(3.0, 2.0, 0.0), carried=(0.0, 1.2, 0.5), sway=sway)


def _steady_walk(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.walk(seconds, rng, paces=(1.35, 1.35), often=1 / 3)


class _Sensors(TypedDict):
    magnetometer: MagnetometerModel
    barometer: BarometerModel


_PHONE_GNSS = GnssModel(white_m=3.0, markov_m=4.0, markov_s=60.0)
_CAR_GNSS = GnssModel(white_m=3.0, body_t_antenna=(0.1, -0.6, 0.9))
_PHONE_SENSORS: _Sensors = {"magnetometer": MagnetometerModel(), "barometer": BarometerModel()}
# Every sensor of a phone, with realistic noise: uncalibrated hard iron, pressure with a random walk, delayed fixes.
_ALL_SENSORS: _Sensors = {
    "magnetometer": MagnetometerModel(hard_iron_sigma_ut=15.0),
    "barometer": BarometerModel(walk_hpa=0.003),
}

_ROOM = SimulatedCamera(
    camera=replace(PHONE_CAMERA, noise_px=0.5),
    mount=ON_PHONE,
    scene=FurnishedRoom(size_m=(8.0, 6.0, 3.0), centre_m=(-1.5, 0.4, 0.2)),
    rate_hz=10.0,
    count=(20, 60),
    tracked=True,
    faults=Faults(lost=0.01),
)
_RENDERED = replace(_ROOM, tracked=False, pictures=PictureModel())
_PLAIN = motions.Corridors(
    turns=("LRL", "RRL", "LLL", "RRL", "LLL", "RRR", "RLL", "LLR", "LRR", "LRR"),
    spacing_m=16.8,
    turn_s=4.0,
    arc_every=0,
    fidget_m_s=5e-4,
    creep_m_s=0.0,
    creep_rad_s=0.0,
)
_PLAIN_CAMERA = replace(
    thesis.CORRIDOR_CAMERA,
    scene=CorridorGrid(nodes=(4, 6), origin=(3, 0), spacing_m=_PLAIN.spacing_m, per_m2=20.0),
    range_m=(0.3, 15.0),
    pairs=(1,),
)
SCENARIOS: dict[str, Scenario] = {
    s.name: s
    for s in (
        Scenario("walk-60s", 60.0, motions.walk, "foot", "galaxy-s2", gnss=GnssModel(), **_PHONE_SENSORS),
        Scenario("walk-10min", 600.0, motions.walk, "foot", "galaxy-s2", gnss=GnssModel(), **_PHONE_SENSORS),
        Scenario("car-10min", 600.0, motions.car, "car", gnss=_CAR_GNSS),
        Scenario("car-37min", 2220.0, motions.car, "car", gnss=_CAR_GNSS),
        Scenario("car-2h", 7200.0, motions.car, "car", gnss=_CAR_GNSS),
        Scenario("trolley-loop", 384.0, _trolley, "trolley", "galaxy-s2", control=True),
        Scenario("static-60s", 60.0, _static_motion, "none", "galaxy-s2", gnss=GnssModel(), **_PHONE_SENSORS),
        Scenario("figure-eight-60s", 60.0, _eight, gnss=GnssModel(white_m=1.0)),
        Scenario("phone-car-5min", 300.0, _moving_car, "car", "galaxy-s2", gnss=_PHONE_GNSS),
        Scenario(
            "car-all-2min",
            120.0,
            _car_with_phone,
            "car",
            gnss=GnssModel(white_m=1.0, body_t_antenna=(0.1, -0.6, 0.9), velocity_m_s=0.1, offset_s=0.06),
            wheel=SpeedModel(rate_hz=10.0, sigma_m_s=0.1),
            pose_fixes=PoseFixModel(every_s=5.0, sigma_m=0.5, sigma_rad=0.05, latency_s=0.4),
            control=True,
            **_ALL_SENSORS,
        ),
        Scenario(
            "walk-all-2min",
            120.0,
            _steady_walk,
            "foot",
            "galaxy-s2",
            gnss=GnssModel(white_m=2.0, velocity_m_s=0.3),
            pose_fixes=PoseFixModel(every_s=10.0, sigma_m=0.5, sigma_rad=0.05, latency_s=1.0),
            control=True,
            **_ALL_SENSORS,
        ),
        Scenario("ranges-60s", 60.0, _eight, ranges=RangeModel(detours=0.03)),
        Scenario("rendered-room-10s", 10.0, motions.in_a_room, profile="galaxy-s2", camera=_RENDERED),
        Scenario("room-30s", 30.0, motions.in_a_room, profile="galaxy-s2", camera=_ROOM),
        Scenario(
            "trolley-20min",
            1200.0,
            thesis.TROLLEY,
            profile="galaxy-s2-warming",
            camera=thesis.CORRIDOR_CAMERA,
            rest_sigma_m_s=5e-4,
        ),
        Scenario(
            "trolley-20min-plain",
            1200.0,
            _PLAIN,
            profile="galaxy-s2-warming",
            camera=_PLAIN_CAMERA,
            rest_sigma_m_s=5e-4,
        ),
        *thesis.SCENARIOS,
    )
}


def simulate(name: str, seed: int = 0, *, calibrated: bool = True) -> Session:
    """A named scenario with its truth in `reference`; the same name and seed give the same session.

    Parameters
    ----------
    name : one of `SCENARIOS`
    seed : of every random draw: motion, biases, noise
    calibrated : put the noise that was really simulated into the session's calibration

    Raises
    ------
    ConfigError
        Unknown name.
    """
    return find_scenario(name)(seed, calibrated=calibrated)


def find_scenario(name: str) -> Scenario:
    """The scenario of this name.

    Raises
    ------
    ConfigError
        Unknown name.
    """
    if name not in SCENARIOS:
        raise ConfigError("simulate", f"scenario {name!r}", f"one of {', '.join(SCENARIOS)}")
    return SCENARIOS[name]
