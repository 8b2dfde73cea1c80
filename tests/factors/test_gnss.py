"""Position fixes: value, sigma, loss and gate."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from exact import LEVER, assemble, record
from numeric import assert_observation, random_rotations
from scipy.stats import chi2

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.gnss import GnssConfig, PositionBuilder, PositionFix, fix_sigmas, noise_model
from smartnav_graph.graph.pass_state import PassState, Phase
from smartnav_graph.graph.states import key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import Calibration, GnssNoise
from smartnav_graph.session.streams import GnssFix


def builder(
    position=((10.0, 20.0, 30.0),), sigma=((1.0, 2.0, 3.0),), own: bool = True, lever=(0.0, 0.0, 0.0), **config
) -> PositionBuilder:
    position = np.array(position)
    return PositionBuilder(
        "gnss", position, np.array(sigma), np.full(len(position), own), np.array(lever), GnssConfig(**config)
    )


def window(*rows: int) -> Window:
    empty = np.zeros((0, 3))
    return Window(7, NS, NS, "normal", np.zeros(0), empty, empty, {"gnss": np.array(rows)})


def added(
    fixes: PositionBuilder, pass_state: PassState | None = None, update: GraphUpdate | None = None, rows=(0,)
) -> GraphUpdate:
    update = update or GraphUpdate(7, NS, 1.0)
    fixes.add(update, window(*rows), None, pass_state or PassState())
    return update


def at(x: float, y: float, z: float, yaw_deg: float = 0.0) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(key("X", 7), gtsam.Pose3(gtsam.Rot3.Rz(np.radians(yaw_deg)), np.array([x, y, z])))
    return values


def test_residual_is_state_minus_fix_over_sigma():
    ((tag, factor),) = added(builder()).factors
    np.testing.assert_allclose(factor.unwhitenedError(at(11, 22, 33)), [1, 2, 3])
    np.testing.assert_allclose(factor.whitenedError(at(11, 22, 33)), [1, 1, 1])
    assert (tag.sensor, tag.t_ns, tag.row) == ("gnss", NS, 0)


def test_the_lever_arm_turns_with_the_body():
    # heading west (yaw 90 deg): an antenna 2 m to the right of a phone is 2 m north of it
    ((_, factor),) = added(builder(position=[[0.0, 2.0, 0.5]], lever=(2.0, 0.0, 0.5))).factors
    np.testing.assert_allclose(factor.unwhitenedError(at(0, 0, 0, yaw_deg=90.0)), 0.0, atol=1e-12)
    np.testing.assert_allclose(factor.unwhitenedError(at(0, 0, 0, yaw_deg=-90.0)), [0, -4, 0], atol=1e-12)


def test_geodetic_fixes_arrive_in_local_metres():
    origin = Origin(52.0, 11.0, 100.0)
    enu = np.array([[100.0, -50.0, 3.0], [0.0, 0.0, 0.0]])
    session = record().session.replace(
        origin=origin, gnss=GnssFix(t_ns=[0, 1], lla=LocalFrame(origin).lla_from_nav(enu)), control=None
    )
    context = FactorContext(session, Calibration(), (), "none", Config())
    made = PositionBuilder.of(context, "gnss", session.gnss, GnssNoise(), GnssConfig())
    np.testing.assert_allclose(made.position, enu, atol=1e-6)
    np.testing.assert_array_equal(made.lever, np.tile(LEVER, (len(made.lever), 1)))
    assert not made.own_sigma.any()


def test_sigmas_are_the_rows_own_where_known_and_the_default_elsewhere():
    sigma = np.array([[1.0, 2.0, 3.0], [np.nan, np.nan, np.nan], [0.5, np.nan, 0.7]])
    fix = GnssFix(t_ns=[0, 1, 2], enu=np.zeros((3, 3)), sigma=sigma)
    expected = [[1, 2, 3], [4, 4, 6], [0.5, 4, 0.7]]
    np.testing.assert_array_equal(fix_sigmas(fix, GnssNoise(4.0, 6.0)), expected)
    bare = GnssFix(t_ns=[0, 1], enu=np.zeros((2, 3)))
    np.testing.assert_array_equal(fix_sigmas(bare, GnssNoise(4.0, 6.0)), [[4, 4, 6]] * 2)


def test_a_noise_scale_leaves_sigmas_that_came_with_the_data_alone():
    pass_state = PassState(noise_scales={"gnss": 5.0, "gnss_vertical": 4.0})
    for own, expected in ((True, [1, 2, 3]), (False, [5, 10, 12])):
        ((_, factor),) = added(builder(own=own), pass_state).factors
        np.testing.assert_allclose(factor.noiseModel().sigmas(), expected)
        np.testing.assert_allclose(builder(own=own).scaled_sigma(pass_state), [expected])


def test_rejected_rows_get_no_factor_and_several_rows_share_a_keyframe():
    fixes = builder(position=np.zeros((3, 3)), sigma=np.ones((3, 3)))
    step = added(fixes, PassState(rejected={"gnss": frozenset({1}), "control": frozenset({0})}), rows=(0, 1, 2))
    assert [tag.row for tag, _ in step.factors] == [0, 2]


def test_a_keyframe_without_fix_gets_nothing():
    assert added(builder(), rows=()).factors == []


@pytest.mark.parametrize(
    ("loss", "weighted"),
    # whitened distance 5: L2 25 / 2; Huber 2.216 (5 - 2.216 / 2) of three components; Cauchy log(1 + 25) / 2
    [("none", 12.5), ("huber", 2.2155014 * (5 - 2.2155014 / 2)), ("cauchy", 0.5 * np.log(26.0))],
)
def test_a_loss_acts_on_the_whole_fix(loss, weighted):
    factor = gtsam.GPSFactor(key("X", 7), np.zeros(3), noise_model(np.array([1.0, 1.0, 1.0]), loss))
    assert factor.error(at(3, 4, 0)) == pytest.approx(weighted, rel=1e-5)


@pytest.mark.parametrize(
    ("loss", "phase", "robust"),
    [
        ("gate", Phase.PLAIN, False),
        ("gate", Phase.ROBUST, True),
        ("gate", Phase.GATED, False),
        ("huber", Phase.PLAIN, True),
    ],
)
def test_the_loss_follows_the_phase(loss, phase, robust):
    ((_, factor),) = added(builder(loss=loss), PassState(phase=phase)).factors
    assert isinstance(factor.noiseModel(), gtsam.noiseModel.Robust) == robust


@pytest.mark.parametrize(
    ("off_m", "robust"),
    # variance 3 + sigma^2 1 = 4 m^2 an axis; gate 9 * 16.27 = 146.4 -> 24.2 m
    [(20.0, False), (24.0, False), (24.5, True), (200.0, True)],
)
def test_replay_doubts_a_fix_that_contradicts_the_prediction(off_m, robust):
    update = GraphUpdate(7, NS, 1.0, predicted=gtsam.NavState(), variance=np.full(3, 3.0))
    fixes = builder(position=[[off_m, 0.0, 0.0]], sigma=[[1.0, 1.0, 1.0]])
    ((_, factor),) = added(fixes, PassState(phase=Phase.CAUSAL), update).factors
    assert isinstance(factor.noiseModel(), gtsam.noiseModel.Robust) == robust


def test_replay_takes_a_fix_at_its_word_where_nothing_is_foretold():
    ((_, factor),) = added(builder(position=[[1e6, 0, 0]]), PassState(phase=Phase.CAUSAL)).factors
    assert not isinstance(factor.noiseModel(), gtsam.noiseModel.Robust)


def test_the_lever_arm_is_part_of_what_is_foretold():
    rotate = gtsam.NavState(gtsam.Rot3.Rz(np.pi / 2), np.zeros(3), np.zeros(3))
    fixes = builder(position=[[0.0, 40.0, 0.0]], sigma=[[1.0, 1.0, 1.0]], lever=(40.0, 0.0, 0.0))
    update = GraphUpdate(7, NS, 1.0, predicted=rotate, variance=np.full(3, 3.0))
    ((_, factor),) = added(fixes, PassState(phase=Phase.CAUSAL), update).factors
    assert not isinstance(factor.noiseModel(), gtsam.noiseModel.Robust)


def test_the_gate_is_the_chi_square_quantile_widened_by_level_and_for_estimated_sigmas():
    limit = chi2(3).ppf(0.999)
    assert limit == pytest.approx(16.266, abs=1e-3)  # table value
    square = limit * np.array([0.99, 1.01, 3.99, 4.01])
    rows = np.zeros(4, dtype=int)
    assert builder().gate(square, 0.2, rows).tolist() == [False, True, True, True]
    assert builder(own=False).gate(square, 1.0, rows).tolist() == [False, False, False, True]
    assert builder().gate(square, 4.0, rows).tolist() == [False, False, False, True]


def test_a_good_share_of_good_fixes_stays_inside_the_gate():
    rng = np.random.default_rng(0)
    square = (rng.standard_normal((100_000, 3)) ** 2).sum(axis=1)
    outside = builder().gate(square, 1.0, np.zeros(len(square), dtype=int)).mean()
    assert outside == pytest.approx(1e-3, abs=4e-4)  # 4 sigma of the count


@pytest.mark.parametrize(
    ("wrong", "text"),
    [({"loss": "tukey"}, "gate, gnc, huber or none"), ({"gate_probability": 1.0}, "between 0.5 and 1")],
)
def test_config_names_what_is_wrong(wrong, text):
    with pytest.raises(ConfigError, match=rf"config \[gnss\]: .*; expected {text}"):
        GnssConfig(**wrong)


def test_without_fixes_there_is_no_builder():
    recording = record()
    graph = assemble(recording.session.replace(gnss=None), recording.truth)
    assert "gnss" not in graph.builders and graph.factors("control") and not graph.factors("gnss")


def test_the_builder_keeps_the_sessions_rows():
    recording = record()
    fixes = replace(recording.session.gnss)
    assert assemble(recording.session, recording.truth).builders["gnss"].position.shape == (len(fixes), 3)


@pytest.mark.parametrize("extra", [(), ("O",), ("C", "L", "O")])
def test_derivatives_of_a_fix_by_its_states(extra):
    rng = np.random.default_rng(0)
    states = [rng.normal(0.0, 2.0, (4, 1 if letter == "O" else 3)) for letter in extra]
    data = np.concatenate([rng.normal(0.0, 5.0, (4, 6)), rng.uniform(0.5, 3.0, (4, 3))], axis=1)
    p, v = rng.normal(0.0, 5.0, (2, 4, 3))
    assert_observation(PositionFix(extra), random_rotations(rng, 4), p, v, states, data)


def test_rows_of_another_datum_have_one_state():
    fixes = builder(np.zeros((3, 3)), np.ones((3, 3)))
    fixes.height_offset = np.array([0.0, 47.0, 47.0])
    update = added(fixes, rows=(0, 1, 2))
    (state,) = update.session.values()
    assert state.name == "gnss_height_offset_+47.0_m" and state.sigma.tolist() == [47.0]
    assert len(update.factors) == 1 and len(update.blocks) == 2
