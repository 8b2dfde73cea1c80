"""Calibration of a device: noise and deterministic errors of its sensors, as in calibration.toml.

Noise densities follow IEEE Std 952: white noise in unit/sqrt(Hz), bias random walk in unit*sqrt(Hz) per second.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.files import read_toml
from smartnav_graph.core.tables import structured
from smartnav_graph.core.timebase import interpolate
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.pieces import Piece
from smartnav_graph.session.streams import Imu, Temperature

SCHEMA = 2  # of calibration.toml: 2 has pieces and the temperature of biases; 1 is read too

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class ImuNoise:
    """Inertial noise as the estimator assumes it; it covers vibration, quantisation and scale errors, other than data
    sheets.

    accel_noise_density m/s^2/sqrt(Hz), gyro_noise_density rad/s/sqrt(Hz), accel_bias_walk m/s^3/sqrt(Hz),
    gyro_bias_walk rad/s^2/sqrt(Hz); turn-on bias sigmas m/s^2 and rad/s.
    """

    accel_noise_density: float
    gyro_noise_density: float
    accel_bias_walk: float
    gyro_bias_walk: float
    accel_bias_sigma: float
    gyro_bias_sigma: float


# Sigma (m) of fixes below which they are of carrier phase, without correlated errors of metres.
CARRIER_PHASE_SIGMA = 0.5


@dataclass(frozen=True)
class GnssNoise:
    """Noise of position fixes, metres.

    horizontal_sigma, vertical_sigma : white part of fixes without sigma
    correlated_horizontal_sigma, correlated_vertical_sigma, correlated_time : first-order Gauss-Markov part of code
    receivers, m and s; zero sigma for a receiver without correlated errors
    velocity_horizontal_sigma, velocity_vertical_sigma : m/s, of velocities without sigma
    """

    horizontal_sigma: float = 3.0
    vertical_sigma: float = 5.0
    correlated_horizontal_sigma: float = 4.0
    correlated_vertical_sigma: float = 6.0
    correlated_time: float = 60.0
    velocity_horizontal_sigma: float = 0.3
    velocity_vertical_sigma: float = 0.5

    @property
    def is_correlated(self) -> bool:
        """Whether the fixes have a Gauss-Markov part."""
        return self.correlated_horizontal_sigma > 0 and self.correlated_vertical_sigma > 0


@dataclass(frozen=True)
class VehicleNoise:
    """Sigmas m/s of the constraints of a vehicle on wheels: speed sideways and up, error of the wheel speed."""

    lateral_sigma: float
    vertical_sigma: float
    wheel_sigma: float


# One default per vehicle on wheels. A trolley's castors slip and its load rocks, at a tenth of a car's speed.
VEHICLE_CLASSES: dict[str, VehicleNoise] = {
    "car": VehicleNoise(lateral_sigma=0.15, vertical_sigma=0.15, wheel_sigma=0.1),
    "trolley": VehicleNoise(lateral_sigma=0.1, vertical_sigma=0.05, wheel_sigma=0.05),
}


@dataclass(frozen=True)
class ControlNoise:
    """Sigma per axis of surveyed points without sigma, m: of the point, and of setting the device over it."""

    position_sigma: float = 0.05


@dataclass(frozen=True)
class VelocityNoise:
    """Sigma per axis of body velocities without sigma, m/s, as of an odometer or a flow sensor."""

    velocity_sigma: float = 0.1


@dataclass(frozen=True)
class BarometerNoise:
    """pressure_sigma : hPa, white, a sample; pressure_walk : hPa/sqrt(s), weather, draughts and the sensor itself."""

    pressure_sigma: float = 0.03
    pressure_walk: float = 0.003


@dataclass(frozen=True)
class PoseFixNoise:
    """Sigmas per axis of pose fixes without sigma, as of image recognition: position m, attitude rad."""

    position_sigma: float = 0.3
    attitude_sigma: float = 0.035


@dataclass(frozen=True)
class RangeNoise:
    """Ranges without sigma, m: white noise; bias_sigma : m, of the constant error of an anchor,
    zero for none."""

    sigma: float = 0.2
    bias_sigma: float = 0.3


@dataclass(frozen=True)
class StepNoise:
    """Prior on the step length of a pedestrian.

    factor : metres of a step over the fourth root of the swing of the specific force (m/s^2), with its sigma;
    sideways_sigma : the same across the forward axis of the device, zero on average; step_sigma : m/sqrt(s), by which
    steps that share one factor differ
    """

    factor: float = 0.45
    factor_sigma: float = 0.15
    sideways_sigma: float = 0.1
    step_sigma: float = 0.2


# One default per device class, the same for every recording.
DEVICE_CLASSES: dict[str, ImuNoise] = {
    # Consumer MEMS in phones and loggers, used in motion: about five times the white noise of a device at rest, to
    # cover vibration, scale factor and misalignment.
    "mems": ImuNoise(
        accel_noise_density=0.03,
        gyro_noise_density=3e-4,
        accel_bias_walk=3e-4,
        gyro_bias_walk=1e-5,
        accel_bias_sigma=0.3,
        gyro_bias_sigma=0.05,
    ),
}
# The motion model of positions without inertial data (`estimate.constant_velocity`): acceleration as of walkers and
# cars within a factor of three, of a device that stays level.
WHITE_ACCELERATION = ImuNoise(
    accel_noise_density=1.0,
    gyro_noise_density=1e-5,
    accel_bias_walk=1e-6,
    gyro_bias_walk=1e-9,
    accel_bias_sigma=1e-4,
    gyro_bias_sigma=1e-7,
)


@dataclass(frozen=True)
class MagnetometerNoise:
    """Errors of a magnetometer, uT: reading = nav_R_body^T (field + disturbance) + hard iron + white, before soft iron.

    sigma_ut : white noise of a sample; disturbance_ut, disturbance_s : Gauss-Markov sigma and correlation
    time (s) of what iron nearby adds to the Earth's field as the device moves
    hard_iron_ut : constant offset in body axes, hard_iron_sigma_ut : its sigma, by default that of a phone
    whose system calibrates
    soft_iron : row-major (3, 3), the corrected reading is soft_iron (reading - hard iron)
    """

    sigma_ut: float = 0.5
    disturbance_ut: float = 3.0
    disturbance_s: float = 2.0
    hard_iron_ut: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hard_iron_sigma_ut: float = 15.0
    soft_iron: tuple[float, ...] = _IDENTITY

    def __post_init__(self) -> None:
        for name in ("sigma_ut", "disturbance_s", "hard_iron_sigma_ut"):
            if not 0 < getattr(self, name) < math.inf:
                raise CalibrationError("calibration.toml", f"{name} = {getattr(self, name)}", "> 0", "give uT and s")
        if not 0 <= self.disturbance_ut < math.inf:
            raise CalibrationError("calibration.toml", f"disturbance_ut = {self.disturbance_ut}", ">= 0 uT")
        for name, count in (("hard_iron_ut", 3), ("soft_iron", 9)):
            numbers = getattr(self, name)
            if len(numbers) != count or not all(map(math.isfinite, numbers)):
                raise CalibrationError("calibration.toml", f"{name} = {list(numbers)}", f"{count} finite numbers")


# Largest difference of a matrix from the identity; more means other axes or units, not a calibration.
LARGEST_ERROR = 0.3


@dataclass(frozen=True)
class ImuErrors:
    """Deterministic errors of the inertial sensors: true = matrix (reading - bias).

    accel_matrix, gyro_matrix : row-major (3, 3), scale factors and misalignments; accel_bias m/s^2, gyro_bias rad/s :
    means of the bias states of a session
    accel_temperature, gyro_temperature : row-major (3, k), unit/K^j for j = 1 .. k: the biases at temperature T are
    bias + sum_j coefficient_j (T - temperature_c)^j; no T beyond `temperature_range_c` counts (no extrapolation)
    """

    accel_matrix: tuple[float, ...] = _IDENTITY
    gyro_matrix: tuple[float, ...] = _IDENTITY
    accel_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyro_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    accel_temperature: tuple[float, ...] = ()
    gyro_temperature: tuple[float, ...] = ()
    temperature_c: float = 25.0
    temperature_range_c: tuple[float, float] = (25.0, 25.0)

    def __post_init__(self) -> None:
        for name in ("accel_matrix", "gyro_matrix"):
            matrix = getattr(self, name)
            if len(matrix) != 9 or not all(abs(a - b) <= LARGEST_ERROR for a, b in zip(matrix, _IDENTITY, strict=True)):
                expected = f"nine numbers within {LARGEST_ERROR} of the identity, row by row"
                raise CalibrationError(
                    "calibration.toml", f"{name} = {list(matrix)}", expected, "turn axes in a reader"
                )
        by_temperature = (*self.accel_temperature, *self.gyro_temperature)
        numbers = (*self.accel_bias, *self.gyro_bias, *by_temperature, self.temperature_c, *self.temperature_range_c)
        if not all(map(math.isfinite, numbers)):
            found = f"biases, coefficients or temperatures {list(numbers)}"
            raise CalibrationError("calibration.toml", found, "finite numbers", "give m/s^2 and rad/s")
        lengths = len(self.accel_temperature), len(self.gyro_temperature)
        if any(length % 3 for length in lengths) or self.temperature_range_c[0] > self.temperature_range_c[1]:
            expected = "as many coefficients for each axis, and a range of temperature from low to high"
            found = f"accel_temperature, gyro_temperature of {lengths} numbers, {self.temperature_range_c} deg C"
            raise CalibrationError("calibration.toml", found, expected, "see [imu_errors]")

    def corrected(self, imu: Imu, temperature: Temperature | None = None) -> Imu:
        """True rate and force, matrix (reading - bias); the same object where there is nothing to do.

        temperature : of the sensors, for the biases that depend on it; without it they are those at `temperature_c`
        """
        if self == ImuErrors():
            return imu
        accel, gyro = (np.reshape(matrix, (3, 3)).T for matrix in (self.accel_matrix, self.gyro_matrix))
        accel_bias, gyro_bias = np.array(self.accel_bias), np.array(self.gyro_bias)
        if temperature is not None and len(temperature):
            at_c = interpolate(imu.t_ns, temperature.t_ns, temperature.temperature_c)
            accel_bias = accel_bias + self._by_temperature(self.accel_temperature, at_c)
            gyro_bias = gyro_bias + self._by_temperature(self.gyro_temperature, at_c)
        return dataclasses.replace(imu, accel=(imu.accel - accel_bias) @ accel, gyro=(imu.gyro - gyro_bias) @ gyro)

    def _by_temperature(self, coefficients: tuple[float, ...], at_c: Floats) -> Floats:
        """What temperatures (n,) deg C add to a bias: (n, 3)."""
        beside = np.clip(at_c, *self.temperature_range_c) - self.temperature_c
        by_axis = np.reshape(coefficients, (3, -1))
        return np.asarray(beside[:, None] ** np.arange(1, by_axis.shape[1] + 1) @ by_axis.T)


@dataclass(frozen=True)
class Calibration:
    """Device calibration as in calibration.toml; `cameras` by the name that images carry; `pieces` by the kind of
    calibration that found them."""

    device: str = "unknown"
    device_class: str = "mems"
    imu_noise: ImuNoise = field(default_factory=lambda: DEVICE_CLASSES["mems"])
    gnss_noise: GnssNoise = field(default_factory=GnssNoise)
    control_noise: ControlNoise = field(default_factory=ControlNoise)
    pose_fix_noise: PoseFixNoise = field(default_factory=PoseFixNoise)
    velocity_noise: VelocityNoise = field(default_factory=VelocityNoise)
    barometer_noise: BarometerNoise = field(default_factory=BarometerNoise)
    step_noise: StepNoise = field(default_factory=StepNoise)
    range_noise: RangeNoise = field(default_factory=RangeNoise)
    magnetometer_noise: MagnetometerNoise = field(default_factory=MagnetometerNoise)
    imu_errors: ImuErrors = field(default_factory=ImuErrors)
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    pieces: Mapping[str, Piece] = field(default_factory=dict)

    def __post_init__(self) -> None:
        noises = (getattr(self, f.name) for f in dataclasses.fields(self) if f.name.endswith("_noise"))
        for part in noises:
            if hasattr(part, "__post_init__"):
                continue  # it checks itself
            for f in dataclasses.fields(part):
                value = getattr(part, f.name)
                may_be_zero = f.name.endswith("_sigma") and f.name.startswith(("correlated_", "bias_"))
                if not (math.isfinite(value) and (value > 0 or (may_be_zero and value == 0))):
                    raise CalibrationError(
                        "calibration.toml", f"{f.name} = {value}", "a finite number > 0", "give SI units"
                    )


def calibration_from_dict(data: dict[str, Any], where: str | Path = "calibration.toml") -> Calibration:
    """Calibration of a parsed TOML table; missing tables take the class default, unknown keys are refused.

    Raises
    ------
    CalibrationError
        An unknown key or a value that breaks a rule; it names key, value and rule.
    """
    filled = dict(data)
    if (schema := filled.pop("schema", SCHEMA)) not in (1, SCHEMA) or type(schema) is not int:
        raise CalibrationError(where, f"schema = {data['schema']}", f"1 or {SCHEMA}", "calibrate with this version")
    name, noise = filled.get("device_class", "mems"), filled.get("imu_noise", {})
    if not isinstance(name, str) or name not in DEVICE_CLASSES:
        raise CalibrationError(where, f"device_class = {name!r}", f"one of {', '.join(DEVICE_CLASSES)}")
    if isinstance(noise, Mapping):
        filled["imu_noise"] = dataclasses.asdict(DEVICE_CLASSES[name]) | dict(noise)
    return structured(Calibration, filled, CalibrationError, where)


def load_calibration(path: str | Path) -> Calibration:
    """Read calibration.toml.

    Raises
    ------
    CalibrationError
        Missing or unreadable file, unknown key, or a value that is not > 0.
    """
    return calibration_from_dict(read_toml(Path(path), CalibrationError, "a calibration.toml"), path)


def calibration_toml(calibration: Calibration) -> str:
    """The text of calibration.toml; `calibration_from_dict` of it gives the same calibration."""
    return tomli_w.dumps({"schema": SCHEMA} | dataclasses.asdict(calibration))
