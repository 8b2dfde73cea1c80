"""What the sensors of a device read along an exact motion: inertial, magnetometer, barometer, wheel, velocity.

Every sample is the true instantaneous quantity at its own stamp, plus bias and noise, as a real sensor gives it; it is
no mean over the interval before or after. Holding sample k constant over [t_k, t_k+1] is therefore an error of first
order in the interval; the mean of neighbouring samples is right to second order.
Noise models: IEEE Std 952 (white noise and rate random walk).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.so3 import rotate_back
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, ImuNoise
from smartnav_graph.session.streams import Barometer, Imu, Magnetometer, Temperature, Velocity, WheelSpeed
from smartnav_graph.simulation.trajectory import Truth


def _at_rest(
    accel_noise: Sequence[float], gyro_noise: Sequence[float], accel_bias: float, gyro_bias: float
) -> ImuNoise:
    """Noise of published sample sigmas by axis at 100 Hz: their quadratic mean, density = sigma / sqrt(100 Hz).

    Bias walks were not published; they are those of the class.
    """
    accel, gyro = (float(np.sqrt(np.mean(np.square(sigma)) / 100.0)) for sigma in (accel_noise, gyro_noise))
    return replace(
        DEVICE_CLASSES["mems"],
        accel_noise_density=accel,
        gyro_noise_density=gyro,
        accel_bias_sigma=accel_bias,
        gyro_bias_sigma=gyro_bias,
    )


_MILLI_G = STANDARD_GRAVITY / 1000.0
# Turn-on bias sigmas: quadratic mean of the one published bias (0.396, -0.068, 0.124) and (1.62, 0.68, -4.89) e-3.
_GALAXY_S2 = _at_rest((0.0386, 0.0297, 0.0435), (2.20e-3, 2.52e-3, 3.08e-3), 0.24, 3.0e-3)

# Noise that the simulated sensors of a device really have, the same on all three axes.
PROFILES: dict[str, ImuNoise] = {
    "mems": DEVICE_CLASSES["mems"],
    "galaxy-s2": _GALAXY_S2,
    # The same phone as it warms up: its gyro was seen to drift in proportion to temperature, through zero at 40 of 33
    # to 48 deg C. 1e-4 rad/s/sqrt(s) is 3.5e-3 rad/s in 20 min; the published bias is 4.9e-3.
    "galaxy-s2-warming": replace(_GALAXY_S2, gyro_bias_walk=1e-4),
    # The same phone where its temperature is simulated beside: the bias is that of the temperature, and little more.
    "galaxy-s2-by-temperature": replace(_GALAXY_S2, gyro_bias_sigma=2e-4, gyro_bias_walk=1e-6),
    "galaxy-s5": _at_rest((4.6 * _MILLI_G, 6.1 * _MILLI_G, 0.2 * _MILLI_G), (1.7e-3, 2.8e-3, 0.9e-3), 0.2, 3.0e-3),
    "iphone-4": _at_rest((2.8 * _MILLI_G, 2.4 * _MILLI_G, 4.2 * _MILLI_G), (4.8e-3, 3.2e-3, 4.3e-3), 0.2, 5.0e-3),
}


@dataclass(frozen=True)
class Biases:
    """True biases of every sample: accel (n, 3) m/s^2, gyro (n, 3) rad/s, body axes."""

    accel: Floats
    gyro: Floats


def specific_force(truth: Truth, gravity: float) -> Floats:
    """f = nav_R_body^T (a - g) with g = (0, 0, -gravity) in ENU; (n, 3) m/s^2 in body axes.

    A device lying flat at rest reads +gravity on z.
    """
    force = truth.nav_a_body + np.array([0.0, 0.0, gravity])
    return rotate_back(truth.nav_R_body, force)


def random_walk(t_ns: Times, start_sigma: float, walk: float, rng: np.random.Generator) -> Floats:
    """Three axes of b_k+1 = b_k + walk sqrt(dt) n, b_0 = start_sigma n; (n, 3)."""
    steps = rng.standard_normal((len(t_ns), 3))
    scale = np.concatenate([[start_sigma], walk * np.sqrt(np.diff(t_ns) / NS)])
    return np.cumsum(steps * scale[:, None], axis=0)


def imu(
    truth: Truth,
    t_ns: Times,
    noise: ImuNoise | None,
    gravity: float,
    rng: np.random.Generator,
    warming: Floats | None = None,
) -> tuple[Imu, Biases]:
    """Inertial samples at the stamps `t_ns` of `truth`, and their true biases; `noise` None gives the exact ones.

    warming : bias (n, 3) rad/s of the gyro by temperature, beside the random one
    White noise has sigma = density / sqrt(dt), dt the median interval. Earth rotation is not simulated.
    """
    accel, gyro = specific_force(truth, gravity), truth.body_rate
    if noise is None:
        nothing = np.zeros_like(accel)
        return Imu(t_ns=t_ns, gyro=gyro, accel=accel), Biases(nothing, nothing)
    root_rate = 1.0 / np.sqrt(float(np.median(np.diff(t_ns))) / NS)
    biases = Biases(
        random_walk(t_ns, noise.accel_bias_sigma, noise.accel_bias_walk, rng),
        random_walk(t_ns, noise.gyro_bias_sigma, noise.gyro_bias_walk, rng),
    )
    if warming is not None:
        biases = replace(biases, gyro=biases.gyro + warming)
    accel = accel + biases.accel + noise.accel_noise_density * root_rate * rng.standard_normal(accel.shape)
    gyro = gyro + biases.gyro + noise.gyro_noise_density * root_rate * rng.standard_normal(gyro.shape)
    return Imu(t_ns=t_ns, gyro=gyro, accel=accel), biases


@dataclass(frozen=True)
class MagnetometerModel:
    """A magnetometer: `rate_hz`, white sigma a sample, sigma of the constant hard iron (uT, body axes), disturbances.

    A disturbance (start s, length s, size uT) is a horizontal field in a random direction that rises and falls as iron
    is passed.
    """

    rate_hz: float = 10.0
    sigma_ut: float = 0.5
    hard_iron_sigma_ut: float = 1.0
    disturbances: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class BarometerModel:
    """A barometer: `rate_hz`, white sigma a sample hPa, sigma of the first offset hPa, and its walk hPa/sqrt(s)."""

    rate_hz: float = 10.0
    sigma_hpa: float = 0.03
    offset_sigma_hpa: float = 1.0
    walk_hpa: float = 0.0


@dataclass(frozen=True)
class TemperatureModel:
    """A thermometer beside the inertial sensors at `rate_hz`, white sigma deg C, and what temperature does to the gyro.

    A device warms up from `start_c` towards `end_c` with the time constant `warming_s`; the bias of the gyro is in
    proportion to temperature, by `gyro_rad_s_k` (x, y, z) rad/s/K, and zero at `zero_c`.
    """

    rate_hz: float = 1.0
    sigma_c: float = 0.05
    start_c: float = 33.0
    end_c: float = 48.0
    warming_s: float = 4500.0
    zero_c: float = 40.0
    gyro_rad_s_k: tuple[float, float, float] = (2.0e-4, 0.85e-4, -6.1e-4)

    def temperature(self, t: Floats) -> Floats:
        """deg C at times t (n,) s."""
        return np.asarray(self.end_c - (self.end_c - self.start_c) * np.exp(-t / self.warming_s))

    def gyro_bias(self, t: Floats) -> Floats:
        """(n, 3) rad/s at times t (n,) s."""
        return np.outer(self.temperature(t) - self.zero_c, self.gyro_rad_s_k)


@dataclass(frozen=True)
class SpeedModel:
    """A wheel or velocity sensor: `rate_hz` and white sigma m/s (per axis)."""

    rate_hz: float = 10.0
    sigma_m_s: float = 0.05


def magnetometer(
    truth: Truth, t_ns: Times, model: MagnetometerModel, nav_field_ut: Floats, rng: np.random.Generator
) -> Magnetometer:
    """m = nav_R_body^T (B + disturbance) + hard iron + white noise, uT; the hard iron is constant, drawn first."""
    hard_iron = model.hard_iron_sigma_ut * rng.standard_normal(3)
    field = np.einsum("nji,j->ni", truth.nav_R_body, nav_field_ut) + hard_iron
    field = field + model.sigma_ut * rng.standard_normal(field.shape)
    for start, length, size in model.disturbances:
        angle = rng.uniform(0.0, 2 * np.pi)
        size_ut = size * np.sin(np.pi * np.clip((truth.t - start) / length, 0.0, 1.0)) ** 2
        iron = size_ut[:, None] * np.array([np.cos(angle), np.sin(angle), 0.0])
        field = field + rotate_back(truth.nav_R_body, iron)
    return Magnetometer(t_ns=t_ns, field_ut=field)


def thermometer(t: Floats, t_ns: Times, model: TemperatureModel, rng: np.random.Generator) -> Temperature:
    """Temperature at times t (n,) s + white noise."""
    return Temperature(t_ns=t_ns, temperature_c=model.temperature(t) + model.sigma_c * rng.standard_normal(len(t)))


def standard_pressure(height_m: Floats) -> Floats:
    """Pressure in hPa of the ICAO standard atmosphere below 11 km: 1013.25 (1 - 0.0065 h / 288.15)^5.25588."""
    return np.asarray(1013.25 * (1.0 - 0.0065 * height_m / 288.15) ** 5.25588)


def barometer(height_m: Floats, t_ns: Times, model: BarometerModel, rng: np.random.Generator) -> Barometer:
    """Standard pressure at `height_m` (n,) + an offset (the day's weather, the sensor) that walks + white noise."""
    offset = model.offset_sigma_hpa * rng.standard_normal()
    noise = model.sigma_hpa * rng.standard_normal(len(t_ns))
    steps = np.sqrt(np.diff(t_ns, prepend=t_ns[:1]) / NS) * rng.standard_normal(len(t_ns))
    return Barometer(
        t_ns=t_ns, pressure_hpa=standard_pressure(height_m) + offset + noise + model.walk_hpa * np.cumsum(steps)
    )


def wheel(speed_m_s: Floats, t_ns: Times, model: SpeedModel, rng: np.random.Generator) -> WheelSpeed:
    """Speed along the way (n,) m/s + white noise."""
    sigma = np.full(len(t_ns), model.sigma_m_s)
    return WheelSpeed(t_ns=t_ns, speed=speed_m_s + sigma * rng.standard_normal(len(t_ns)), sigma=sigma)


def velocity(truth: Truth, t_ns: Times, model: SpeedModel, rng: np.random.Generator) -> Velocity:
    """nav_R_body^T nav_v_body + white noise, m/s in body axes."""
    body = rotate_back(truth.nav_R_body, truth.nav_v_body)
    sigma = np.full(body.shape, model.sigma_m_s)
    return Velocity(t_ns=t_ns, velocity=body + sigma * rng.standard_normal(body.shape), sigma=sigma)
