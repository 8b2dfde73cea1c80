"""iSAM2 and the fixed lag: what they know, what they forget, how they fail."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from exact import record

from smartnav_graph.core.errors import ConfigError, SolverError
from smartnav_graph.estimate.config import Config
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import KEYFRAME_LETTERS, key
from smartnav_graph.graph.update import FactorId, build_update
from smartnav_graph.simulation import motions
from smartnav_graph.smoothers import incremental
from smartnav_graph.smoothers.batch import Batch
from smartnav_graph.smoothers.incremental import ReplayConfig


@pytest.fixture(scope="module")
def problem():
    return prepare(record(motions.figure_eight(60.0), seed=2, fix_sigma=0.2).session, Config())


@pytest.fixture(scope="module")
def prior(problem):
    return initialise(problem, 30.0).prior.with_position()


def fill(problem, prior, smoother, watch=lambda smoother: None):
    for window in problem.windows:
        latest = smoother.latest()
        smoother.update(build_update(window, latest, [prior, *problem.builders], PassState(), problem.session.t0_ns))
        watch(smoother)
    return smoother


@pytest.mark.parametrize("kind", ["isam2", "fixed-lag"])
def test_the_last_state_is_that_of_batch(problem, prior, kind):
    """Everything is known at the end: the newest state is the smoothed one, up to what a lag froze."""
    smoother = fill(problem, prior, incremental(ReplayConfig(kind), problem.session.t0_ns))
    batch = fill(problem, prior, Batch(t0_ns=problem.session.t0_ns)).estimate()
    known = smoother.latest()
    assert known.nav.position() == pytest.approx(batch.states()[1][-1], abs=0.02)  # m; a tenth of a fix
    sigma, full = (np.sqrt(np.diag(c)) for c in (known.covariance, batch.covariance[-1]))
    assert sigma[:9] == pytest.approx(full[:9], rel=0.05)
    if kind == "isam2":
        assert not known.covariance[:6, 6:].any()  # blocks only
    else:
        scaled = known.covariance - batch.covariance[-1]
        assert np.abs(scaled / np.outer(full, full)).max() < 0.05


def test_a_fixed_lag_keeps_its_lag_and_no_more(problem, prior):
    sizes = []

    def watch(smoother) -> None:
        sizes.append(smoother._live.size())

    smoother = fill(problem, prior, incremental(ReplayConfig("fixed-lag", lag_s=10.0), problem.session.t0_ns), watch)
    spacing = np.diff([update.t_s for update in smoother.updates]).min()
    most = (10.0 / spacing + 2) * len(KEYFRAME_LETTERS)
    assert max(sizes) <= most and len(smoother._inside) <= 10.0 / spacing + 2
    middle, last = sizes[len(sizes) // 2], sizes[-1]
    assert abs(last - middle) <= 4 * len(KEYFRAME_LETTERS)  # flat, while 60 s went by
    everything = fill(problem, prior, incremental(ReplayConfig("isam2"), problem.session.t0_ns))
    assert everything._engine.calculateEstimate().size() == len(problem.windows) * len(KEYFRAME_LETTERS)


def test_states_that_left_the_lag_keep_their_last_estimate(problem, prior):
    kept = {}

    def watch(smoother) -> None:
        for update in smoother._inside:
            kept[update.index] = smoother._live.atPose3(key("X", update.index)).translation()

    smoother = fill(problem, prior, incremental(ReplayConfig("fixed-lag", lag_s=5.0), problem.session.t0_ns), watch)
    estimate = smoother.estimate()
    assert len(estimate.indices) == len(problem.windows)
    assert estimate.states()[1] == pytest.approx(np.array([kept[i] for i in estimate.indices]), abs=1e-9)


def test_the_estimate_of_the_first_keyframes(problem, prior):
    smoother = fill(problem, prior, incremental(ReplayConfig("isam2"), problem.session.t0_ns))
    assert len(smoother.estimate(7).indices) == 7
    assert np.isfinite(smoother.estimate(7).covariance).all()


@pytest.mark.parametrize("kind", ["isam2", "fixed-lag"])
def test_a_state_without_factors_is_told(problem, prior, kind):
    """No prior and no fix: nothing holds the first state."""
    smoother = incremental(ReplayConfig(kind), problem.session.t0_ns)
    update = build_update(problem.windows[0], None, [prior, *problem.builders], PassState(), problem.session.t0_ns)
    name = key("X", 0)
    update.factors = [
        (FactorId("imu", update.t_ns), gtsam.GPSFactor(name, np.zeros(3), gtsam.noiseModel.Unit.Create(3)))
    ]
    with pytest.raises(SolverError, match=r"t = 0\.00 s: .* not determined there \(keyframe 0, touched by imu\)"):
        smoother.update(update)


def test_nothing_processed_is_an_error():
    with pytest.raises(SolverError, match="no keyframe was processed"):
        incremental(ReplayConfig(), 0).estimate()


@pytest.mark.parametrize("options", [{"smoother": "kalman"}, {"lag_s": 0.0}, {"relinearize": -1.0}])
def test_options(options):
    with pytest.raises(ConfigError):
        ReplayConfig(**options)
