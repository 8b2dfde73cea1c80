"""Steps: counted on motions of known cadence, separated from other motion, causal but for the look-ahead."""

import numpy as np
import pytest

from smartnav_graph import readers, simulation
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.session.detect.steps import LOOKAHEAD_S, Steps, find_steps
from smartnav_graph.session.streams import Imu
from smartnav_graph.simulation import motions, scenarios

START_NS = 1_748_772_000 * NS


def bobbing(hertz: float, amplitude: float, seconds: float = 60.0, rate: float = 100.0, seed: int | None = 0) -> Imu:
    """A phone lying flat in a hand that swings by `amplitude` m/s^2 up and down; gravity reads 2 % too much."""
    t = np.arange(round(seconds * rate)) / rate
    accel = np.zeros((len(t), 3))
    accel[:, 2] = 10.0 + amplitude * np.sin(2 * np.pi * hertz * t)
    if seed is not None:
        accel += np.random.default_rng(seed).normal(0.0, 0.1, accel.shape)
    return Imu(t_ns=START_NS + ns_from_seconds(t), gyro=np.zeros_like(accel), accel=accel)


@pytest.mark.parametrize("rate", [50.0, 100.0, 198.6])
@pytest.mark.parametrize("hertz", [1.4, 1.9, 2.4])
def test_one_step_a_swing_at_any_rate_of_the_sensor(hertz, rate):
    steps = find_steps(bobbing(hertz, 2.5, rate=rate))
    assert len(steps) == pytest.approx(60.0 * hertz, abs=1.5)
    assert np.median(np.diff(steps.end_ns)) / NS == pytest.approx(1 / hertz, abs=0.011)


def test_the_length_is_weinbergs():
    one, other = (find_steps(bobbing(1.9, amplitude, seed=None)) for amplitude in (1.0, 3.0))
    # three times the swing, 3^(1/4) the length; the filter takes a sixth of a swing at 1.9 Hz
    assert np.median(other.length) / np.median(one.length) == pytest.approx(3**0.25, rel=0.01)
    assert np.median(one.swing) == pytest.approx(2.0 * 5 / 6, rel=0.05)


def test_a_hand_that_stands_makes_no_steps():
    assert len(find_steps(bobbing(1.9, 0.1))) == 0
    assert find_steps(bobbing(1.9, 0.1)).travelled(np.array([0, 1])).tolist() == [0.0, 0.0]


def test_travelled_grows_evenly_over_each_step_and_stands_between():
    second = np.array([1, 2, 5], dtype=np.int64) * NS
    steps = Steps(second - NS // 2, second, np.array([1.0, 16.0, 81.0]))  # lengths 1, 2, 3
    at = (np.array([0.0, 0.75, 1.0, 1.25, 1.75, 2.0, 4.0, 4.75, 6.0]) * NS).astype(np.int64)
    np.testing.assert_allclose(steps.travelled(at), [0, 0.5, 1, 1, 2, 3, 3, 4.5, 6], atol=1e-12)


def test_nothing_known_at_t_rests_on_data_after_the_look_ahead():
    assert LOOKAHEAD_S <= 1.0
    imu = simulation_walk(seconds=40.0)
    whole = find_steps(imu)
    for seconds in np.arange(8.0, 30.0, 0.37):
        cut = imu.take(imu.t_ns <= imu.t_ns[0] + ns_from_seconds(seconds + LOOKAHEAD_S))
        at = imu.t_ns[0] + ns_from_seconds(np.arange(0.0, seconds, 0.05))
        np.testing.assert_array_equal(find_steps(cut).travelled(at), whole.travelled(at))


def simulation_walk(seconds: float = 60.0, seed: int = 0) -> Imu:
    scenario = scenarios.Scenario("walk", seconds, motions.walk, "foot", "galaxy-s2")
    return scenario(seed).require_imu()


def test_a_simulated_walk_steps_at_its_cadence_and_rests_where_it_rests():
    steps = find_steps(simulation_walk())
    assert (steps.end_ns - START_NS).min() > 5.0 * NS  # it stands for 5 s
    assert 1 / np.median(np.diff(steps.end_ns) / NS) == pytest.approx(1.9, abs=0.04)


def regular_share(imu: Imu) -> float:
    """Share of a recording spent walking."""
    seconds = find_steps(imu).regular_seconds
    return float(seconds[-1] / (imu.t_ns[-1] - imu.t_ns[0]) * NS) if len(seconds) else 0.0


@pytest.mark.parametrize(("scenario", "least", "most"), [("walk-60s", 0.7, 1.0), ("phone-car-5min", 0.0, 0.02)])
def test_a_walk_is_reported_from_a_ride(scenario, least, most):
    session = simulation.scenarios.simulate(scenario)
    share = regular_share(session.imu)
    assert least <= share <= most


def test_no_walk_in_nothing():
    nothing = Steps(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    assert not len(nothing.regular_seconds)
    assert regular_share(bobbing(1.9, 2.0, seconds=1.2)) == 0.0


def test_the_public_recordings(dataset, kitti):
    walks = [readers.read(file).imu for file in sorted(dataset("indoor_waypoints_ms").glob("site1/*/*.txt"))]
    assert [len(find_steps(imu)) for imu in walks] == pytest.approx([122, 139], abs=5)
    assert min(regular_share(imu) for imu in walks) > 0.7
    assert regular_share(kitti.imu) < 0.1 and regular_share(readers.read(dataset("car_comma2k19")).imu) < 0.1
