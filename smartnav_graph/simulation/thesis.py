"""The recordings of the 2012 thesis and of the 2016 study as scenarios.

thesis-static : six hours at rest while the phone warms up from 33 to 48 deg C (characterisation of its sensors).
thesis-outdoor : 37 min in a car with a phone in its holder: a start at 85 deg, a roundabout, streets of a town, fixes
at 1 Hz with tunnels and bridges, compass at 100 Hz, 1.6 images a second with sky and moving cars; see `town`.
thesis-indoor : 20 min with a trolley: three minutes of rest, ten stops of ten seconds on surveyed points (over a lever
arm), 1.25 images a second; the motion is that of trolley-20min.
paper-courtyard : ten minutes on foot, pose fixes every second; paper-courtyard-iphone4 has the noise of the other
phone. Fixes at other intervals: `smartnav intervals`. The truth is exact, as of a total station without errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from smartnav_graph.simulation import motions
from smartnav_graph.simulation.cameras import ON_PHONE, PHONE_CAMERA, Faults, SimulatedCamera
from smartnav_graph.simulation.fixes import GnssModel, PoseFixModel
from smartnav_graph.simulation.recording import Scenario
from smartnav_graph.simulation.scenes import CorridorGrid
from smartnav_graph.simulation.sensors import BarometerModel, MagnetometerModel, TemperatureModel
from smartnav_graph.simulation.town import Streets, TownDrive
from smartnav_graph.simulation.trajectory import Leg, Legs, Trajectory

# Start and length (s) without fixes: bridges take seconds, tunnels up to a minute.
OUTAGES = ((240.0, 12.0), (430.0, 30.0), (700.0, 8.0), (905.0, 60.0), (1290.0, 20.0), (1610.0, 40.0), (1930.0, 10.0))

_DRIVE = TownDrive()
TROLLEY = motions.Corridors()
CORRIDOR_CAMERA = SimulatedCamera(
    camera=PHONE_CAMERA,
    mount=ON_PHONE,
    scene=CorridorGrid(nodes=(5, 5), origin=(4, 0), spacing_m=TROLLEY.spacing_m, per_m2=30.0),
    rate_hz=1.25,
    range_m=(0.3, 40.0),
    count=(15, 60),
    pairs=(1, 2),  # those that `smartnav match` makes of such images: up to 2 s apart
    faults=Faults(outliers=(0.1, 0.3)),
)


def flat(seconds: float, rng: np.random.Generator) -> Trajectory:
    """A device that lies flat, heading north."""
    return Trajectory(Legs([Leg(seconds, 0.0)]))


_STATIC = Scenario(
    "thesis-static",
    6 * 3600.0,
    flat,
    profile="galaxy-s2-by-temperature",
    magnetometer=MagnetometerModel(rate_hz=100.0),
    temperature=TemperatureModel(),
)
_OUTDOOR = Scenario(
    "thesis-outdoor",
    2220.0,
    _DRIVE,
    "car",
    "galaxy-s2",
    gnss=GnssModel(white_m=3.0, markov_m=4.0, markov_s=60.0, outages=OUTAGES),
    magnetometer=MagnetometerModel(
        rate_hz=100.0, disturbances=tuple((start, length, 20.0) for start, length in OUTAGES)
    ),
    camera=SimulatedCamera(
        camera=PHONE_CAMERA,
        mount=ON_PHONE,
        scene=Streets(_DRIVE),
        rate_hz=1.6,
        range_m=(1.0, 80.0),
        count=(15, 60),
        pairs=(1, 2),
        faults=Faults(outliers=(0.1, 0.3), moving=(0.0, 0.2)),
    ),
)
_INDOOR = Scenario(
    "thesis-indoor",
    1200.0,
    TROLLEY,
    profile="galaxy-s2-warming",
    control=True,
    control_arm=(0.15, -0.25, -1.0),
    control_rest_s=9.0,
    magnetometer=MagnetometerModel(rate_hz=100.0),
    camera=CORRIDOR_CAMERA,
    rest_sigma_m_s=5e-4,
)
_COURTYARD = Scenario(
    "paper-courtyard",
    600.0,
    motions.walk,
    "foot",
    "galaxy-s5",
    magnetometer=MagnetometerModel(),
    barometer=BarometerModel(),
    pose_fixes=PoseFixModel(every_s=1.0, sigma_m=0.3, sigma_rad=0.035),
)

SCENARIOS = (
    _STATIC,
    _OUTDOOR,
    _INDOOR,
    _COURTYARD,
    replace(_COURTYARD, name="paper-courtyard-iphone4", profile="iphone-4"),
)
