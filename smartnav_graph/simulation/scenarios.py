"""Named simulated sessions with truth: the same type a reader gives, `reference` holding the exact states.

The truth stands at 10 Hz and at every aiding epoch, on exact inertial stamps. All scenarios: 100 Hz inertial samples,
flat ENU frame at 52 N, 11 E, 100 m, gravity constant and straight down, no Earth rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from smartnav_graph import frames
from smartnav_graph.calibration.model import Calibration, GnssNoise
from smartnav_graph.errors import ConfigError
from smartnav_graph.frames import LocalFrame, Origin
from smartnav_graph.session import Device, Mount, Session
from smartnav_graph.simulation import fixes, motions, sensors
from smartnav_graph.simulation.fixes import GnssModel
from smartnav_graph.simulation.sensors import PROFILES, Biases
from smartnav_graph.simulation.trajectory import Trajectory, Truth
from smartnav_graph.streams import Reference, StaticPeriod
from smartnav_graph.timebase import NS, ns_from_seconds

ORIGIN = Origin(52.0, 11.0, 100.0)
START_NS = 1_748_772_000 * NS  # 2025-06-01 10:00 UTC
YEAR = 2025.41
RATE_HZ = 100
SLOW_ROWS = 10  # reference, magnetometer and barometer: every tenth inertial sample
CONTROL_SIGMA_M = 0.02


@dataclass(frozen=True)
class Scenario:
    """A motion of `seconds` (the first samples of it), a device and its sensors; call it with a seed."""

    name: str
    seconds: float
    motion: Callable[[float, np.random.Generator], Trajectory]
    vehicle: str = "none"
    profile: str = "mems"
    gnss: GnssModel | None = None
    control: bool = False
    phone_sensors: bool = False

    def __call__(self, seed: int = 0, *, calibrated: bool = True) -> Session:
        return _record(self, seed, calibrated)


def _record(scenario: Scenario, seed: int, calibrated: bool) -> Session:
    rng_motion, rng_imu, rng_gnss, rng_control, rng_mag, rng_baro = (
        np.random.default_rng((seed, purpose)) for purpose in range(6)
    )
    trajectory = scenario.motion(scenario.seconds, rng_motion)
    t = np.arange(round(scenario.seconds * RATE_HZ)) / RATE_HZ
    truth, t_ns = trajectory.sample(t), START_NS + ns_from_seconds(t)
    frame, profile = LocalFrame(ORIGIN), PROFILES[scenario.profile]
    imu, biases = sensors.imu(truth, t_ns, profile.noise, _gravity(), rng_imu)
    session = Session(
        device=Device(name=f"simulated {profile.name}", vehicle=scenario.vehicle),
        clock_epoch="unix",
        origin=ORIGIN,
        calibration=_calibration(scenario) if calibrated else None,
        imu=imu,
        static=_static(trajectory, t_ns),
    )
    rows = np.arange(0, len(t), SLOW_ROWS)
    if scenario.gnss is not None:
        model, every = scenario.gnss, slice(None, None, round(RATE_HZ / scenario.gnss.rate_hz))
        fix = fixes.gnss(truth.take(every), t_ns[every], model, frame, rng_gnss)
        session = session.replace(gnss=fix, sensors={"gnss": Mount(body_t=model.body_t_antenna)})
        rows = np.union1d(rows, np.searchsorted(t_ns, fix.t_ns))
    if scenario.control:
        at = _stop_rows(trajectory, t)
        names = [f"P{i}" for i in range(len(at))]
        points = fixes.control(truth.take(at), t_ns[at], names, CONTROL_SIGMA_M, frame, rng_control)
        session = session.replace(control=points)
        rows = np.union1d(rows, at)
    if scenario.phone_sensors:
        slow = slice(None, None, SLOW_ROWS)
        height = ORIGIN.height_m + truth.nav_t_body[slow, 2]
        session = session.replace(
            magnetometer=sensors.magnetometer(truth.take(slow), t_ns[slow], magnetic_field_ut(), rng_mag),
            barometer=sensors.barometer(height, t_ns[slow], rng_baro),
        )
    return session.replace(reference=reference(truth, t_ns, biases, rows))


def _gravity() -> float:
    return frames.normal_gravity(ORIGIN.lat_deg, ORIGIN.height_m)


def _calibration(scenario: Scenario) -> Calibration:
    profile, model = PROFILES[scenario.profile], scenario.gnss or GnssModel()
    gnss = GnssNoise(
        horizontal_sigma=model.white_m,
        vertical_sigma=1.5 * model.white_m,
        correlated_horizontal_sigma=model.markov_m,
        correlated_vertical_sigma=1.5 * model.markov_m,
        correlated_time=model.markov_s,
    )
    return Calibration(device=f"simulated {profile.name}", imu_noise=profile.noise, gnss_noise=gnss)


def magnetic_field_ut() -> NDArray[np.float64]:
    """World Magnetic Model at the scenarios' origin and date, (3,) uT in ENU."""
    from pygeomag import GeoMag

    field = GeoMag().calculate(glat=ORIGIN.lat_deg, glon=ORIGIN.lon_deg, alt=ORIGIN.height_m / 1000.0, time=YEAR)
    return np.array([field.y, field.x, -field.z]) / 1000.0


def _within(trajectory: Trajectory, end: float) -> list[tuple[float, float]]:
    return [(start, min(stop, end)) for start, stop in trajectory.rests if start < end]


def _static(trajectory: Trajectory, t_ns: NDArray[np.int64]) -> StaticPeriod | None:
    """The standstills, from the first to the last inertial sample taken at rest."""
    rests = _within(trajectory, float(t_ns[-1] - t_ns[0]) / NS)
    if not rests:
        return None
    start, end = (t_ns[0] + ns_from_seconds([rest[i] for rest in rests]) for i in range(2))
    first, last = np.searchsorted(t_ns, start), np.searchsorted(t_ns, end, side="right") - 1
    source = np.full(len(rests), "simulation", dtype=object)
    return StaticPeriod(t_ns=t_ns[first], t_end_ns=t_ns[last], sigma_v=np.full(len(rests), 0.01), source=source)


def _stop_rows(trajectory: Trajectory, t: NDArray[np.float64]) -> NDArray[np.intp]:
    """The inertial sample in the middle of every standstill."""
    return np.searchsorted(t, [(start + end) / 2 for start, end in _within(trajectory, float(t[-1]))])


def reference(truth: Truth, t_ns: NDArray[np.int64], biases: Biases, rows: NDArray[np.intp]) -> Reference:
    """The exact states at these rows."""
    return Reference(
        t_ns=t_ns[rows],
        enu=truth.nav_t_body[rows],
        quat=Rotation.from_matrix(truth.nav_R_body[rows]).as_quat(canonical=True)[:, [3, 0, 1, 2]],
        velocity=truth.nav_v_body[rows],
        accel_bias=biases.accel[rows],
        gyro_bias=biases.gyro[rows],
    )


def _static_motion(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.static(seconds)


def _moving_car(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.car(seconds, rng, start_speed=12.0)


def _trolley(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.trolley(2)


def _eight(seconds: float, rng: np.random.Generator) -> Trajectory:
    return motions.figure_eight(seconds)


_PHONE_GNSS = GnssModel(white_m=3.0, markov_m=4.0, markov_s=60.0)
_CAR_GNSS = GnssModel(white_m=3.0, body_t_antenna=(0.1, -0.6, 0.9))

SCENARIOS: dict[str, Scenario] = {
    s.name: s
    for s in (
        Scenario("walk-60s", 60.0, motions.walk, "foot", "galaxy-s2", gnss=GnssModel(), phone_sensors=True),
        Scenario("walk-10min", 600.0, motions.walk, "foot", "galaxy-s2", gnss=GnssModel(), phone_sensors=True),
        Scenario("car-10min", 600.0, motions.car, "car", gnss=_CAR_GNSS),
        Scenario("car-37min", 2220.0, motions.car, "car", gnss=_CAR_GNSS),
        Scenario("car-2h", 7200.0, motions.car, "car", gnss=_CAR_GNSS),
        Scenario("trolley-loop", 384.0, _trolley, "trolley", "galaxy-s2", control=True),
        Scenario("static-60s", 60.0, _static_motion, "none", "galaxy-s2", gnss=GnssModel(), phone_sensors=True),
        Scenario("figure-eight-60s", 60.0, _eight, gnss=GnssModel(white_m=1.0)),
        Scenario("phone-car-5min", 300.0, _moving_car, "car", "galaxy-s2", gnss=_PHONE_GNSS),
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
    if name not in SCENARIOS:
        raise ConfigError("simulate", f"scenario {name!r}", f"one of {', '.join(SCENARIOS)}")
    return SCENARIOS[name](seed, calibrated=calibrated)
