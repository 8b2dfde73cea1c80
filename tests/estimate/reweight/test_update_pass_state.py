"""What a pass learns: the sigma of fixes that carry none, and which fixes are outliers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact import LEVER, assemble, estimate_of, record, state

from smartnav_graph.estimate.config import Config, RunConfig
from smartnav_graph.estimate.passes import solve_passes
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.reweight.imu_noise import RELAXATION
from smartnav_graph.estimate.reweight.outliers import fix_residuals
from smartnav_graph.estimate.reweight.update import LEAST_SIGMA, suspects, update_pass_state
from smartnav_graph.estimate.run import initialise
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.factors.imu import ImuConfig
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.session.calibration.model import DEVICE_CLASSES, Calibration, GnssNoise
from smartnav_graph.session.detect.scatter import Scatter
from smartnav_graph.session.streams import GnssFix
from smartnav_graph.simulation import motions

GOOD_SEED = 1  # of 174 good fixes none lies outside the gate by itself
WHITE = GnssNoise(correlated_horizontal_sigma=0.0, correlated_vertical_sigma=0.0)  # 3 m and 5 m, no wander


@pytest.fixture(scope="module")
def drive():
    """A minute of a car with exact fixes, half a second apart."""
    noise = DEVICE_CLASSES["mems"]
    made = record(
        motions.car(60.0, np.random.default_rng(5), start_speed=12.0), every_s=0.5, noise=noise, fix_sigma=1e-9, seed=1
    )
    calibration = Calibration(imu_noise=noise, gnss_noise=WHITE)
    return replace(made, session=made.session.replace(control=None, calibration=calibration))


def with_fixes(drive, sigma, told=None, seed: int = 0, off=()):
    """The drive with noisy fixes; `told` their sigma columns; `off` rows moved 30 to 120 m away."""
    rng = np.random.default_rng(seed)
    fix = drive.session.gnss
    enu = fix.enu + np.array(sigma) * rng.standard_normal(fix.enu.shape)
    for row in off:
        angle = rng.uniform(0, 2 * np.pi)
        enu[row] += rng.uniform(30, 120) * np.array([np.cos(angle), np.sin(angle), 0.0])
    told = None if told is None else np.tile(told, (len(fix), 1))
    return drive.session.replace(gnss=GnssFix(t_ns=fix.t_ns, enu=enu, sigma=told))


def learn(drive, session) -> tuple[PassState, int]:
    """What all passes have learnt, started at the truth, and their number."""
    problem = prepare(session, Config(run=RunConfig(passes=10)))
    t_ns = problem.windows[0].t1_ns
    start = state(drive.truth([t_ns]), 0, t_ns, np.zeros(6))
    prior = PriorBuilder(
        start,
        np.full(3, 0.1),
        None,
        np.full(3, 1.0),
        np.array([0.3] * 3 + [0.05] * 3),
        start.nav.velocity(),
        start.bias,
    )
    _, pass_state, passes = solve_passes(problem, problem.windows, prior, PassState())
    return pass_state, passes


# --- sigma ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("planted", [0.3, 1.2, 4.0])
def test_the_sigma_of_fixes_is_found_within_fifteen_per_cent(drive, planted):
    # about 300 residuals: 1 / sqrt(600) = 4 %
    pass_state, passes = learn(drive, with_fixes(drive, [planted, planted, planted * 5 / 3]))
    assert 3.0 * pass_state.scale("gnss") == pytest.approx(planted, rel=0.15)
    assert pass_state.rejected.get("gnss", frozenset()) == frozenset() and passes < 10


def test_a_sigma_that_came_with_the_data_is_left_alone(drive):
    pass_state, _ = learn(drive, with_fixes(drive, [1.0, 1.0, 1.0], told=[3.0, 3.0, 3.0]))
    assert pass_state.scale("gnss") == 1.0


@pytest.mark.parametrize(("true", "scale"), [(2.0, 1.0), (2.7, 1.35)])
def test_stated_sigmas_that_residuals_and_scatter_exceed_are_raised(drive, true, scale):
    pass_state, _ = learn(drive, with_fixes(drive, [true] * 3, told=[2.0] * 3))
    assert pass_state.scale("gnss_stated") == pytest.approx(scale, rel=0.1)  # two sigmas of 300 residuals


def test_exact_fixes_are_believed_no_better_than_their_clock_allows(drive):
    pass_state, _ = learn(drive, with_fixes(drive, [1e-6, 1e-6, 1e-6]))
    assert 3.0 * pass_state.scale("gnss") >= LEAST_SIGMA[0] - 1e-12


def test_outliers_do_not_swell_the_sigma(drive):
    off = frozenset({7, 30, 31, 32, 70, 95})
    pass_state, _ = learn(drive, with_fixes(drive, [1.2, 1.2, 2.0], off=off))
    assert 3.0 * pass_state.scale("gnss") == pytest.approx(1.2, rel=0.2)
    assert pass_state.rejected["gnss"] == off


# --- outliers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "off",
    # the early burst and the early outlier bend the least squares solution so far that a loss started there fails
    [{100}, {70, 90, 91, 92, 120, 150, 171}, set(range(100, 112)), {60, 172}, set(range(50, 62)), {1, 110}],
    ids=["one", "several", "a burst of six seconds", "near the end", "an early burst", "near the start"],
)
def test_planted_outliers_are_found_exactly(drive, off):
    pass_state, _ = learn(drive, with_fixes(drive, [1.0] * 3, told=[1.0] * 3, off=off, seed=GOOD_SEED))
    assert pass_state.rejected["gnss"] == frozenset(off)
    assert pass_state.phase is Phase.GATED


def test_graduated_non_convexity_finds_them_too(drive):
    off = frozenset({8, 40, 41, 42, 43, 90, 120})
    problem = prepare(with_fixes(drive, [1.0] * 3, told=[1.0] * 3, off=off, seed=GOOD_SEED), gnc())
    initial = initialise(problem)
    _, pass_state, passes = solve_passes(problem, problem.windows, initial.prior, PassState())
    assert pass_state.rejected["gnss"] == off and pass_state.phase is Phase.GATED and not pass_state.weights
    assert 6 <= passes <= 20  # the control grows fourfold a pass


def gnc() -> Config:
    return Config(gnss=GnssConfig(loss="gnc"))


def test_the_control_grows_until_every_weight_is_settled(drive):
    session = with_fixes(drive, [1.0] * 3, told=[1.0] * 3, off={40})
    builders, windows, estimate = at_truth(drive, session, loss="gnc")
    pass_state, controls = PassState(phase=Phase.ROBUST), []
    while pass_state.phase is not Phase.GATED:
        pass_state, done = update_pass_state(builders, windows, estimate, pass_state)
        assert not done
        controls.append(pass_state.gnc_mu)
        if pass_state.phase is Phase.GRADUATED:
            assert pass_state.weight("gnss", 40) < 0.5 * pass_state.weight("gnss", 41)
    assert pass_state.rejected == {"gnss": frozenset({40})} and not pass_state.weights
    assert np.allclose(np.diff(np.log(controls[:-1])), np.log(4.0))


@pytest.mark.parametrize("off", [{40}, {1, 110}], ids=["one", "near the start"])
def test_outliers_among_the_first_fixes_do_not_mislead_the_start(drive, off):
    problem = prepare(with_fixes(drive, [1.0] * 3, told=[1.0] * 3, off=off, seed=GOOD_SEED), Config())
    initial = initialise(problem)
    _, pass_state, _ = solve_passes(problem, problem.windows, initial.prior, initial.pass_state)
    assert pass_state.rejected["gnss"] == frozenset(off)


@pytest.mark.parametrize("seed", range(3))
def test_good_fixes_are_all_kept_without_a_robust_pass(drive, seed):
    pass_state, passes = learn(drive, with_fixes(drive, [1.0] * 3, told=[1.0] * 3, seed=seed))
    assert not pass_state.rejected.get("gnss") and pass_state.phase is Phase.PLAIN and passes <= 5  # the noise is found


@pytest.mark.parametrize("seed", range(3))
def test_sigmas_too_small_by_three_reject_nothing_wholesale(drive, seed):
    pass_state, _ = learn(drive, with_fixes(drive, [3.0] * 3, told=[1.0] * 3, seed=seed))
    assert len(pass_state.rejected.get("gnss", ())) <= 2  # of 130


def test_a_loss_that_is_no_gate_rejects_nothing(drive):
    session = with_fixes(drive, [1.0] * 3, told=[1.0] * 3, off={40})
    for loss in ("huber", "none"):
        problem = prepare(session, Config(gnss=GnssConfig(loss=loss), imu=ImuConfig(estimate_noise=False)))
        graph = assemble(session, drive.truth)
        learnt, done = update_pass_state(problem.builders, graph.windows, estimate_of(graph), PassState())
        assert learnt.phase is Phase.PLAIN and not learnt.rejected
        assert not done and learnt.stage == 1  # the clock joins
        assert update_pass_state(problem.builders, graph.windows, estimate_of(graph), learnt) == (learnt, True)


# --- one step at a time, at the true states ---------------------------------------------------------------------------


def at_truth(drive, session, **config):
    graph = assemble(session, drive.truth)
    builder = graph.builders["gnss"]
    builder.config = GnssConfig(**config)
    n = len(graph.windows)
    return [builder], graph.windows, estimate_of(graph, np.tile(1e-4 * np.eye(15), (n, 1, 1)))


def test_residuals_are_those_of_the_antenna(drive):
    session = with_fixes(drive, [0.0] * 3)
    shifted = session.replace(gnss=replace(session.gnss, enu=session.gnss.enu - [1.0, 2.0, 3.0]))
    (builder,), windows, estimate = at_truth(drive, shifted)
    found = fix_residuals(builder, windows, estimate, PassState(noise_scales={"gnss": 2.0, "gnss_vertical": 2.0}))
    np.testing.assert_allclose(found.residual, np.tile([1.0, 2.0, 3.0], (len(session.gnss), 1)), atol=1e-6)
    np.testing.assert_allclose(found.sigma, np.tile([6.0, 6.0, 10.0], (len(session.gnss), 1)))
    np.testing.assert_allclose(found.square, 1 / 36 + 4 / 36 + 9 / 100)
    # attitude and position known to 1e-4 rad^2 and m^2: the antenna turns about the body
    np.testing.assert_allclose(found.posterior.sum(axis=1), 1e-4 * (3 + 2 * np.dot(LEVER, LEVER)))
    assert found.rows.tolist() == list(range(len(session.gnss)))


def test_the_variance_component_uses_the_redundancy(drive):
    # where the posterior takes half of the variance, the same residuals are of noise of twice the variance
    session = with_fixes(drive, [1.5, 1.5, 2.5])
    builders, windows, estimate = at_truth(drive, session)
    half = np.zeros((len(windows), 15, 15))
    half[:, range(3, 6), range(3, 6)] = np.array([9.0, 9.0, 25.0]) / 2  # half of the default's variance
    plain, _ = update_pass_state(builders, windows, estimate, PassState())
    learnt, _ = update_pass_state(builders, windows, replace(estimate, covariance=half), PassState())
    assert plain.scale("gnss") == pytest.approx(0.5**RELAXATION, rel=0.1)
    assert learnt.scale("gnss") == pytest.approx(plain.scale("gnss") * np.sqrt(2) ** RELAXATION, rel=0.05)


def test_the_sigma_stays_within_a_factor_of_two_of_the_scatter_of_the_fixes(drive):
    """Whatever the solution: here its residuals are 300 m, and then nothing."""
    shift = np.array([300.0, -300.0, 100.0])
    session = with_fixes(drive, [1.0, 1.0, 1.0])
    far = session.replace(gnss=replace(session.gnss, enu=session.gnss.enu + shift))
    exact = session.replace(gnss=replace(session.gnss, enu=drive.session.gnss.enu))
    for moved, bound in ((far, 2.0), (exact, 0.5)):
        builders, windows, estimate = at_truth(drive, moved)
        (builder,) = builders
        builder.scatter = (Scatter(1.0, is_noise=True, rows=100), Scatter(1.0, is_noise=True, rows=100))
        state = PassState()
        for _ in range(6):
            state = replace(update_pass_state(builders, windows, estimate, state)[0], phase=Phase.PLAIN)
        np.testing.assert_allclose(builder.scaled_sigma(state)[0], bound, rtol=0.05)


def test_motion_in_the_scatter_is_an_upper_bound_only(drive):
    builders, windows, estimate = at_truth(drive, with_fixes(drive, [0.05] * 3))
    builders[0].scatter = (Scatter(0.5, is_noise=False, rows=100), None)
    state = PassState()
    for _ in range(6):
        state = update_pass_state(builders, windows, estimate, state)[0]
    assert 0.03 < builders[0].scaled_sigma(state)[0, 0] < 0.1


def test_too_few_fixes_teach_no_sigma(drive):
    session = with_fixes(drive, [30.0] * 3)
    session = session.replace(gnss=session.gnss.take(slice(0, 3)))
    builders, windows, estimate = at_truth(drive, session, loss="none", time_offset_sigma=0.0)
    assert update_pass_state(builders, windows, estimate, PassState()) == (PassState(), True)


def test_phases_follow_each_other(drive):
    session = with_fixes(drive, [1.0] * 3, told=[1.0] * 3, off={40})
    builders, windows, estimate = at_truth(drive, session)
    one, done = update_pass_state(builders, windows, estimate, PassState())
    assert (one.phase, done, dict(one.rejected)) == (Phase.ROBUST, False, {})
    two, done = update_pass_state(builders, windows, estimate, one)
    assert (two.phase, done, dict(two.rejected)) == (Phase.GATED, False, {"gnss": frozenset({40})})
    three, done = update_pass_state(builders, windows, estimate, two)
    assert (three, done) == (replace(two, stage=1), False)  # what needs the trajectory found joins
    assert update_pass_state(builders, windows, estimate, three) == (three, True)


def test_a_row_inside_the_gate_is_let_in_again(drive):
    builders, windows, estimate = at_truth(drive, with_fixes(drive, [1.0] * 3, told=[1.0] * 3))
    rejected = PassState(phase=Phase.GATED, rejected={"gnss": frozenset({5, 6})})
    learnt, done = update_pass_state(builders, windows, estimate, rejected)
    assert learnt.rejected["gnss"] == frozenset() and not done


def test_without_positions_there_is_nothing_to_learn(drive):
    graph = assemble(drive.session, drive.truth)
    inertial = graph.builders["imu"]
    inertial.config = ImuConfig(estimate_noise=False)
    assert update_pass_state([inertial], graph.windows, estimate_of(graph), PassState()) == (PassState(), True)


def test_many_rejected_fixes_that_agree_with_their_neighbours_make_the_solution_suspect(drive):
    (builder,), _, _ = at_truth(drive, with_fixes(drive, [1.0] * 3))
    n = len(builder.position)
    builder.agrees = np.ones(n, dtype=bool)
    assert suspects(builder, frozenset(range(40, 40 + n // 20))) == frozenset()  # few: outliers
    many = frozenset(range(40, 40 + n // 5))
    assert suspects(builder, many) == many
    builder.agrees[[39, 40]] = False  # a step into the run: a burst of outliers
    assert suspects(builder, many) == frozenset()
