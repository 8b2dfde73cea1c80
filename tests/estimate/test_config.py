"""Options <-> TOML: exact round trip, unknown keys refused by their path, values checked."""

from __future__ import annotations

import dataclasses
import tomllib

import pytest

from smartnav_graph.core.errors import ConfigError, SmartnavError
from smartnav_graph.estimate import config
from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.graph.keyframes import KeyframeConfig


def test_the_defaults_survive_text():
    assert config.from_dict(tomllib.loads(config.dumps(Config()))) == Config()
    assert config.from_dict({}) == Config()


def test_every_option_survives_text():
    run = RunConfig("car", ("gnss", "-control"), ("gnss:every=10",), 1.5, 99.0, "1,2,3,45", "10", 3)
    one = Config(run=run, gnss=GnssConfig("huber", 0.99, False), keyframes=KeyframeConfig(0.5, 1e-3, 10.0))
    assert config.from_dict(tomllib.loads(config.dumps(one))) == one


def test_options_that_are_not_set_are_left_out():
    assert "start_s" not in config.dumps(Config()) and "start_s = 5" in config.dumps(Config(run=RunConfig(start_s=5.0)))


def test_every_section_is_a_frozen_room():
    for section in dataclasses.fields(Config):
        room = getattr(Config(), section.name)
        field = dataclasses.fields(room)[0].name
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(room, field, 0)


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        ({"gnss": {"los": "huber"}}, ("my.toml: ", "los", "gnss", "unknown key", "expected loss, or")),
        ({"gnns": {"loss": "huber"}}, ("my.toml: ", "gnns")),
        ({"keyframes": {"max_spacing_s": "fast"}}, ("my.toml: ", "keyframes.max_spacing_s")),
        ({"gnss": {"loss": "tukey"}}, ("my.toml [gnss]: loss = 'tukey'; expected gate, gnc, huber or none",)),
        ({"gnss": {"gate_probability": 1.5}}, ("gate_probability = 1.5; expected between 0.5 and 1",)),
        ({"imu": {"integration_sigma": 0.0}}, ("my.toml [imu]",)),
        ({"control": {"lever_arm_sigma": -1.0}}, ("my.toml [control]: lever_arm_sigma = -1.0",)),
        ({"keyframes": {"max_spacing_s": 0.0}}, ("my.toml [keyframes]: max_spacing_s = 0.0", "> merge_s >= 0")),
        ({"keyframes": {"merge_s": 2.0}}, ("merge_s = 2.0",)),
        ({"keyframes": {"lead_s": -1.0}}, ("my.toml: keyframes.lead_s = -1.0",)),
        ({"initialise": {"stretch_s": 0.0}}, ("my.toml [initialise]: stretch_s = 0.0",)),
        ({"initialise": {"starts": 0}}, ("starts = 0",)),
        ({"batch": {"settle_s": -1.0}}, ("my.toml: batch.settle_s = -1.0",)),
        ({"solver": {"tolerance": 0.0}}, ("my.toml [solver]",)),
        ({"replay": {"smoother": "ekf"}}, ("--smoother: 'ekf'; expected fixed-lag or isam2",)),
        ({"replay": {"lag_s": 0.0}}, ("my.toml [replay]",)),
        ({"run": {"vehicle": "ship"}}, ("--vehicle: 'ship'; expected one of none, car, trolley, foot",)),
        ({"run": {"start_s": 9.0, "end_s": 9.0}}, ("--from, --to: 9.0 s to 9.0 s; expected --from before --to",)),
        ({"run": {"rate": "fast"}}, ("--rate: 'fast'; expected keyframes, imu or a frequency in (0, 1000] Hz",)),
        ({"run": {"rate": "0"}}, ("--rate: '0'",)),
        ({"run": {"rate": "nan"}}, ("--rate: 'nan'",)),
        ({"run": {"passes": 0}}, ("my.toml [run]: passes = 0; expected >= 1",)),
    ],
)
def test_faults_are_told_with_their_place(data, parts):
    with pytest.raises(SmartnavError) as e:
        config.from_dict(data, "my.toml")
    assert isinstance(e.value, ConfigError)
    for part in parts:
        assert part in str(e.value), str(e.value)


def test_files(tmp_path):
    path = tmp_path / "config.toml"
    with pytest.raises(ConfigError, match=r"config\.toml: cannot be read \(No such file or directory\)"):
        config.load(path)
    path.write_text("[gnss")
    with pytest.raises(ConfigError, match=r"config\.toml: is no TOML \("):
        config.load(path)
    path.write_text('[gnss]\nloss = "none"\n')
    assert config.load(path) == Config(gnss=GnssConfig(loss="none"))
