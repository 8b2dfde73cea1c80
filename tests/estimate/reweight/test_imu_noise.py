"""Inertial noise found from kept data: the statistics are unbiased, and planted noise is found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from exact import Recording, eight, record, state
from scipy.stats import chi2

import smartnav_graph as sn
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.passes import solve_passes
from smartnav_graph.estimate.problem import Problem, prepare
from smartnav_graph.estimate.reweight.imu_noise import (
    LEAST_REDUNDANCY,
    MOST,
    NOISE_NAMES,
    WIDEST,
    Component,
    components,
    worse_than_class,
)
from smartnav_graph.evaluation.metrics import nees
from smartnav_graph.factors.imu import CALIBRATED_WEIGHT, CLASS_WEIGHT, ImuBuilder, ImuConfig
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, Calibration, GnssNoise, ImuNoise
from smartnav_graph.smoothers.estimate import Estimate

CLASS = DEVICE_CLASSES["mems"]
WHITE = GnssNoise(correlated_horizontal_sigma=0.0, correlated_vertical_sigma=0.0)  # a receiver that does not wander
OFF = Config(imu=ImuConfig(estimate_noise=False))


# An accelerometer so quiet beside its gyroscope that the white noise of both shows within two seconds.
KNOWN = replace(CLASS, accel_noise_density=0.01, gyro_noise_density=1e-3)


def device(factor: float) -> ImuNoise:
    """The known device with all its noise scaled."""
    return replace(KNOWN, **{name: factor * getattr(KNOWN, name) for name in NOISE_NAMES.values()})


def recorded(factor: float = 1.0, seed: int = 0, fix_sigma: float = 0.002, seconds: float = 90.0) -> Recording:
    """A figure eight with fixes of 2 mm each second; the calibration tells `KNOWN`, whatever the noise."""
    made = record(eight(seconds), noise=device(factor), fix_sigma=fix_sigma, hertz=50.0, seed=seed)
    calibration = Calibration(imu_noise=KNOWN, gnss_noise=WHITE)
    return replace(made, session=made.session.replace(control=None, calibration=calibration))


@dataclass(frozen=True)
class Solved:
    """A recording solved from its true first state."""

    recording: Recording
    problem: Problem
    builder: ImuBuilder
    estimate: Estimate
    pass_state: PassState

    def components(self, windows: Sequence[Window] | None = None) -> Mapping[str, Component]:
        return components(self.builder, windows or self.problem.windows, self.estimate, self.pass_state)


def solved(recording: Recording, config: Config = OFF, weight: float = CLASS_WEIGHT) -> Solved:
    """`weight` is what the known noise counts for."""
    problem = prepare(recording.session, config)
    builder = next(b for b in problem.builders if isinstance(b, ImuBuilder))
    builder.weight = weight
    t_ns = problem.windows[0].t1_ns
    start = state(recording.truth([t_ns]), 0, t_ns, recording.bias([t_ns])[0])
    sigma_bias = np.array([KNOWN.accel_bias_sigma] * 3 + [KNOWN.gyro_bias_sigma] * 3)
    none = gtsam.imuBias.ConstantBias()
    prior = PriorBuilder(start, np.full(3, 0.1), None, np.full(3, 1.0), sigma_bias, start.nav.velocity(), none)
    estimate, pass_state, _ = solve_passes(problem, problem.windows, prior, PassState())
    return Solved(recording, problem, builder, estimate, pass_state)


# --- one component ----------------------------------------------------------------------------------------------------


def test_noise_that_explains_its_residuals_stays():
    assert Component(200.0, 200.0).scale(1.0, CLASS_WEIGHT) == pytest.approx(1.0)


def test_the_iteration_settles_where_the_residuals_are_explained():
    # residuals of three times the noise, which the solution does not follow: q = 9 R / s^2
    scale = 1.0
    for _ in range(12):
        scale = Component(9.0 * 200.0 / scale**2, 200.0).scale(scale, CLASS_WEIGHT)
    assert scale == pytest.approx(np.sqrt((9.0 * 200.0 + CLASS_WEIGHT) / (200.0 + CLASS_WEIGHT)), rel=0.03)


def test_few_residuals_move_little_and_a_calibrated_device_less():
    few = Component(4 * 5.0, 5.0)
    assert 1.0 < few.scale(1.0, CALIBRATED_WEIGHT) < 1.2 < few.scale(1.0, CLASS_WEIGHT)


def test_one_pass_moves_a_sigma_by_a_bounded_step_and_no_device_is_off_without_limit():
    assert Component(1e9, 100.0).scale(1.0, CLASS_WEIGHT) == MOST
    assert Component(1e9, 100.0).scale(9.0, CLASS_WEIGHT) == WIDEST
    assert Component(0.0, 1e9).scale(0.11, CLASS_WEIGHT) == 1.0 / WIDEST


def test_fixes_that_contradict_their_own_sigma_take_the_blame():
    bent = Component(400.0, 100.0)
    assert bent.scale(1.0, CLASS_WEIGHT, level=9.0) == pytest.approx(1.0)
    assert bent.scale(1.0, CLASS_WEIGHT, level=1.9) == bent.scale(1.0, CLASS_WEIGHT) > 1.5
    quiet = Component(25.0, 100.0)
    assert quiet.scale(1.0, CLASS_WEIGHT, level=9.0) == quiet.scale(1.0, CLASS_WEIGHT) < 0.7


def test_few_residuals_count_where_they_are_far_off():
    assert (
        not Component(3.0, 1.6).is_known
        and Component(670.0, 1.6).is_known
        and Component(4.0, LEAST_REDUNDANCY).is_known
    )


def test_noise_is_worse_than_its_class_only_beyond_what_the_samples_show():
    quiet, shaken = (ImuBuilder(KNOWN, 9.81, sampling_noise=(k * KNOWN.accel_noise_density, 0.0)) for k in (0.1, 2.0))
    found = PassState(noise_scales={"accel": 4.0})
    assert worse_than_class(quiet, found) and not worse_than_class(shaken, found)
    assert not worse_than_class(quiet, PassState(noise_scales={"accel": 1.5, "gyro_walk": 9.0}))


def test_noise_at_its_bound_is_worse_than_its_class_where_it_does_not_explain_the_fixes():
    shaken = ImuBuilder(KNOWN, 9.81, sampling_noise=(2.5 * KNOWN.accel_noise_density, 0.0))
    largest = PassState(noise_scales={"accel": 12.5})  # five times what the samples show
    assert worse_than_class(shaken, largest, fixes_square=9.0) == {"accel": 12.5}
    assert not worse_than_class(shaken, largest, fixes_square=2.0)
    assert not worse_than_class(shaken, PassState(noise_scales={"accel": 11.0}), fixes_square=9.0)


# --- the statistics ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def honest() -> list[Solved]:
    """Recordings with exactly the noise assumed."""
    return [solved(recorded(seed=seed)) for seed in range(3)]


def test_squares_have_their_redundancy_as_expectation(honest):
    """Sums over the recordings inside 99.9 % of chi-square of that redundancy."""
    for group in ("accel", "gyro"):
        found = [one.components()[group] for one in honest]
        square, redundancy = (sum(getattr(one, part) for one in found) for part in ("square", "redundancy"))
        assert redundancy > 100.0
        low, high = chi2(redundancy).ppf([5e-4, 1 - 5e-4])
        assert low < square < high, (group, square, redundancy)


def test_groups_share_less_than_the_equations_leave(honest):
    problem = honest[0].problem
    most = 3 * len(problem.session.gnss)  # every window brings as many equations as unknowns
    assert 0.0 < sum(one.redundancy for one in honest[0].components().values()) < most


def test_windows_across_gaps_and_at_rest_say_nothing_of_the_noise_in_motion(honest):
    windows = honest[0].problem.windows
    whole = honest[0].components()["accel"].redundancy
    for kind in ("gap", "static"):
        part = honest[0].components([replace(w, kind=kind) if w.index % 2 else w for w in windows])
        assert 0.3 * whole < part["accel"].redundancy < 0.7 * whole
    none = honest[0].components([replace(w, kind="gap") for w in windows])
    assert set(none) == {"accel_walk", "gyro_walk"}


# --- planted noise ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[3.0, 1 / 3], ids=["three times", "a third"])
def planted(request) -> tuple[float, list[Solved]]:
    """Recordings with another noise than the one known, solved with noise that finds itself."""
    return request.param, [solved(recorded(request.param, seed), Config()) for seed in range(3)]


def test_noise_far_from_that_of_the_class_is_found(planted):
    factor, found = planted
    for one in found:
        assert one.pass_state.scale("accel") == pytest.approx(factor, rel=0.3)
        assert one.pass_state.scale("gyro") == pytest.approx(
            factor, rel=0.4
        )  # 30 degrees of freedom, pulled by the class


def position_nees(found: Sequence[Solved]) -> float:
    """Average over recordings and keyframes, 1 where the covariance is honest."""
    values = []
    for one in found:
        rows = np.arange(8, len(one.estimate.t_ns) - 4, 8)
        error = one.recording.truth(one.estimate.t_ns[rows]).nav_t_body - one.estimate.states()[1][rows]
        values.append(nees(error, one.estimate.covariance[rows][:, 3:6, 3:6]).mean() / 3)
    return float(np.mean(values))


def test_the_covariance_is_honest_where_the_noise_was_found(planted):
    # 3 recordings of about 11 independent places each: 100 degrees of freedom, 99.8 % within 0.6 to 1.5
    assert 0.6 < position_nees(planted[1]) < 1.5


def test_and_not_where_it_was_not():
    assert position_nees([solved(recorded(3.0, seed)) for seed in range(2)]) > 2.0


def test_calibrated_noise_stays_where_it_was_measured():
    found = solved(recorded(), Config(), CALIBRATED_WEIGHT)
    for group in NOISE_NAMES:
        assert found.pass_state.scale(group) == pytest.approx(1.0, rel=0.15)


def test_fixes_three_times_worse_than_they_say_do_not_swell_the_noise():
    made = recorded(fix_sigma=0.3)
    bold = replace(made.session.gnss, sigma=made.session.gnss.sigma / 3)
    found = solved(replace(made, session=made.session.replace(gnss=bold)), Config())
    assert found.pass_state.scale("accel") < 1.3 and found.pass_state.scale("gyro") < 1.3


# --- what is told -----------------------------------------------------------------------------------------------------


def test_the_summary_tells_the_noise_found_and_what_stayed():
    made = recorded(3.0, fix_sigma=0.02, seconds=40.0)
    states = sn.run(made.session).summary["states"]
    assert states["accel_noise_density"]["value"] > 1.1 * KNOWN.accel_noise_density  # calibrated: held softly
    assert not states["accel_noise_density"]["held"]
    assert states["accel_bias_walk"] == {"value": KNOWN.accel_bias_walk, "sigma": None, "held": True}
    assert not set(NOISE_NAMES.values()) & set(sn.run(made.session, OFF).summary["states"])


def test_a_class_counts_less_than_a_calibration():
    session = recorded(seconds=20.0).session
    for calibration, weight in ((session.calibration, CALIBRATED_WEIGHT), (None, CLASS_WEIGHT)):
        problem = prepare(session.replace(calibration=calibration), Config())
        assert next(b for b in problem.builders if isinstance(b, ImuBuilder)).weight == weight


# --- kept windows -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scales", [{"accel": 3.0}, {"gyro": 0.4}, {"accel": 0.2, "gyro": 5.0}])
def test_a_window_kept_from_an_earlier_pass_takes_the_noise_of_this_one(scales):
    problem = prepare(recorded(seconds=30.0).session, OFF)
    window, bias, pass_state = problem.windows[20], gtsam.imuBias.ConstantBias(), PassState(noise_scales=scales)
    first, second = (ImuBuilder(CLASS, 9.81) for _ in range(2))
    kept = first.preintegrate(window, bias, PassState())
    assert first.preintegrate(window, bias, pass_state) is kept
    fresh = second.preintegrate(window, bias, pass_state).preintMeasCov()
    covariance = first._factor(window, kept, pass_state).noiseModel().covariance()
    sigma = np.sqrt(np.diag(fresh))
    np.testing.assert_allclose(covariance / np.outer(sigma, sigma), fresh / np.outer(sigma, sigma), atol=1e-9)


def test_a_window_is_preintegrated_anew_where_its_bias_has_moved():
    window = prepare(recorded(seconds=30.0).session, OFF).windows[20]
    builder, bias = ImuBuilder(CLASS, 9.81), gtsam.imuBias.ConstantBias()
    kept = builder.preintegrate(window, bias, PassState())
    near, far = (gtsam.imuBias.ConstantBias(np.zeros(3), np.array([0.0, 0.0, step])) for step in (5e-5, 5e-3))
    assert builder.preintegrate(window, near, PassState()) is kept
    assert builder.preintegrate(window, far, PassState()) is not kept
