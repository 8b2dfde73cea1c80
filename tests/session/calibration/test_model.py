"""calibration.toml <-> Calibration: exact round trip, class defaults, named faults."""

from __future__ import annotations

import dataclasses
import tomllib

import pytest

from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.session.calibration import model
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, Calibration, GnssNoise, ImuNoise, MagnetometerNoise


def test_text_and_back_is_the_same_calibration():
    noise = dataclasses.replace(DEVICE_CLASSES["mems"], gyro_bias_walk=1.2345678901234567e-7)
    one = Calibration('Phone "7"', "mems", noise, GnssNoise(1.5, 2.25))
    assert model.calibration_from_dict(tomllib.loads(model.calibration_toml(one))) == one
    assert model.calibration_from_dict({}) == Calibration()


def test_what_is_left_out_is_the_default_of_the_class():
    found = model.calibration_from_dict(
        {"imu_noise": {"accel_noise_density": 0.1}, "gnss_noise": {"vertical_sigma": 9.0}}
    )
    assert found.imu_noise == dataclasses.replace(DEVICE_CLASSES["mems"], accel_noise_density=0.1)
    assert found.gnss_noise == GnssNoise(vertical_sigma=9.0)


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        (
            {"imu_noise": {"acel_noise_density": 0.1}},
            ("acel_noise_density", "expected accel_noise_density, or"),
        ),
        ({"colour": 1}, ("colour",)),
        ({"device_class": "laser"}, ("device_class = 'laser'; expected one of mems",)),
        ({"imu_noise": {"gyro_noise_density": "low"}}, ("gyro_noise_density",)),
        (
            {"imu_noise": {"gyro_noise_density": 0.0}},
            ("gyro_noise_density = 0.0; expected a finite number > 0; give SI",),
        ),
        ({"imu_noise": {"accel_bias_sigma": -1.0}}, ("accel_bias_sigma = -1.0",)),
        ({"gnss_noise": {"horizontal_sigma": float("nan")}}, ("horizontal_sigma = nan",)),
        ({"gnss_noise": {"vertical_sigma": float("inf")}}, ("vertical_sigma = inf",)),
    ],
)
def test_faults_name_file_key_and_value(data, parts):
    with pytest.raises(CalibrationError) as e:
        model.calibration_from_dict(data, "phone/calibration.toml")
    for part in parts:
        assert part in str(e.value)


@pytest.mark.parametrize("part", [f.name for f in dataclasses.fields(Calibration) if f.name.endswith("_noise")])
def test_every_noise_refuses_a_negative_number(part):
    for f in dataclasses.fields(getattr(Calibration(), part)):
        if isinstance(getattr(getattr(Calibration(), part), f.name), float):
            with pytest.raises(CalibrationError, match=f.name):
                model.calibration_from_dict({part: {f.name: -1.0}})


def test_files(tmp_path):
    path = tmp_path / "calibration.toml"
    with pytest.raises(CalibrationError, match=r"calibration.toml: cannot be read \(No such file or directory\)"):
        model.load_calibration(path)
    path.write_text("device = ")
    with pytest.raises(CalibrationError, match=r"is no TOML \("):
        model.load_calibration(path)
    path.write_bytes(b"\xff")
    with pytest.raises(CalibrationError, match=r"is no TOML \("):
        model.load_calibration(path)
    path.write_text(model.calibration_toml(Calibration(device="phone")))
    assert model.load_calibration(path) == Calibration(device="phone")
    path.write_text("[imu_noise]\ngyro_noise_density = -1.0")
    with pytest.raises(CalibrationError, match=r"gyro_noise_density = -1\.0"):
        model.load_calibration(path)


def test_every_default_is_a_physical_mems():
    for noise in DEVICE_CLASSES.values():
        assert isinstance(noise, ImuNoise)
        assert 1e-3 < noise.accel_noise_density < 0.1 and 1e-5 < noise.gyro_noise_density < 1e-2
        assert noise.accel_bias_sigma < 1.0 and noise.gyro_bias_sigma < 0.1


def test_the_irons_of_a_magnetometer_survive_the_text():
    soft = (1.1, 0.02, 0.0, 0.02, 0.9, 0.01, 0.0, 0.01, 1.05)
    noise = MagnetometerNoise(hard_iron_ut=(12.0, -30.5, 7.0), hard_iron_sigma_ut=0.8, soft_iron=soft)
    calibration = Calibration(magnetometer_noise=noise)
    assert model.calibration_from_dict(tomllib.loads(model.calibration_toml(calibration))) == calibration


def test_a_soft_iron_of_eight_numbers_is_refused_with_the_file():
    with pytest.raises(CalibrationError, match=r"^phone.toml .*soft_iron.*expected"):
        model.calibration_from_dict({"magnetometer_noise": {"soft_iron": [1.0] * 8}}, "phone.toml")
