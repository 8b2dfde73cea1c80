"""The contract of observations at keyframes and at any instant: derivatives, and the states they are told of."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest
from exact import GRAVITY, angle_deg, kinematics, record
from numeric import assert_jacobians

from smartnav_graph.core.so3 import exp, rotate, skew
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.observation import (
    WIDTH,
    AtInstant,
    AtKeyframe,
    PartialPreintegration,
    at_keyframe,
    preintegrated,
)
from smartnav_graph.graph.interpolate import states_at
from smartnav_graph.graph.keyframes import KeyframeConfig, make_windows
from smartnav_graph.graph.states import STATES
from smartnav_graph.graph.windows import Window

NO_BIAS = gtsam.imuBias.ConstantBias()


class Probe:
    """Sees everything, each part in its own way, and a lever arm; data: weight, three numbers."""

    extra: tuple[str, ...] = ("L",)
    width = 4

    def observe(self, R, p, v, extra: Sequence[np.ndarray], data):
        """Residual (m, 9): a turned vector, a position at the end of a lever arm, a velocity in body axes."""
        (lever,) = extra
        arrow, weight = data[:, 1:4], data[:, :1, None]
        back = R.transpose(0, 2, 1)
        residual = np.concatenate([rotate(R, arrow), p + rotate(R, lever), rotate(back, v)], axis=1) * weight[:, :, 0]
        by_state = np.zeros((len(R), 9, 9))
        by_state[:, :3, :3] = -R @ skew(arrow)
        by_state[:, 3:6, :3] = -R @ skew(lever)
        by_state[:, 3:6, 3:6] = np.eye(3)
        by_state[:, 6:9, :3] = skew(rotate(back, v))
        by_state[:, 6:9, 6:9] = back
        by_lever = np.zeros((len(R), 9, 3))
        by_lever[:, 3:6] = R
        return residual, by_state * weight, [by_lever * weight]


def poses(rng: np.random.Generator, m: int) -> np.ndarray:
    found = np.tile(np.eye(4), (m, 1, 1))
    found[:, :3, :3] = exp(rng.normal(0.0, 1.0, (m, 3)))
    found[:, :3, 3] = rng.normal(0.0, 30.0, (m, 3))
    return found


def states(rng: np.random.Generator, letters: Sequence[str], m: int, bias: np.ndarray) -> list[np.ndarray]:
    made = {
        "X": poses(rng, m),
        "V": rng.normal(0.0, 5.0, (m, 3)),
        "B": bias + rng.normal(0.0, 1.0, (m, 6)) * ([0.1] * 3 + [0.01] * 3),
        "T": rng.normal(0.0, 0.05, (m, 1)),
        "L": rng.normal(0.0, 0.5, (m, 3)),
    }
    return [made[letter] for letter in letters]


@pytest.fixture(scope="module")
def window() -> Window:
    """0.97 s of an exact figure eight, in the middle of a turn."""
    recording = record()
    times = recording.session.imu.t_ns[0] + np.array([0, 15_000_000_000, 15_970_000_000])
    return make_windows(recording.session.imu, times, [], {}, KeyframeConfig())[2]


def partials(window: Window, m: int) -> list[PartialPreintegration]:
    bias = gtsam.imuBias.ConstantBias(np.array([0.2, -0.1, 0.05]), np.array([0.01, -0.02, 0.005]))
    at = np.linspace(window.t0_ns, window.t1_ns, m).astype(np.int64)
    return [preintegrated(window, int(t), bias, GRAVITY) for t in at]


def test_derivatives_at_a_keyframe():
    rng, model = np.random.default_rng(0), AtKeyframe(Probe())
    assert model.letters == ("X", "V", "L")
    assert_jacobians(model, states(rng, model.letters, 4, np.zeros(6)), rng.normal(1.0, 0.3, (4, 4)))


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize("short", [False, True])
def test_derivatives_at_an_instant(window, timed, short):
    """Pose, velocity, bias, clock offset and what the observation adds, away from where the partial was made."""
    rng, model = np.random.default_rng(1), AtInstant(Probe(), timed=timed, short=short)
    assert model.letters == ("X", "V", *("B",) * (not short), *("T",) * timed, "L")
    at = partials(window, 5)
    if short:
        at = [at_keyframe(gtsam.imuBias.ConstantBias(p.bias[:3], p.bias[3:]), p.accel, p.gyro, GRAVITY) for p in at]
    columns = np.array([partial.columns(0.01) for partial in at])
    assert columns.shape == (5, WIDTH)
    data = np.concatenate([rng.normal(1.0, 0.3, (5, 4)), columns], axis=1)
    # By the bias the derivative is that of a small change; here it is moved by 0.1 m/s^2 and 0.01 rad/s.
    assert_jacobians(model, states(rng, model.letters, 5, at[0].bias), data, rtol=1e-6 if short else 3e-4)


def told(
    model: AtInstant, recording, times, rows, partial: PartialPreintegration, offset: float | None = None
) -> np.ndarray:
    """State (9,) of the probe at an instant, from the truth at the keyframe before; no lever arm, arrow along x."""
    truth = recording.truth([times])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = truth.nav_R_body[0], truth.nav_t_body[0]
    held = {"X": pose, "V": truth.nav_v_body[0], "B": np.zeros(6), "T": np.array([offset]), "L": np.zeros(3)}
    data = np.concatenate([[1.0, 1.0, 0.0, 0.0], partial.columns()])[None]
    return model.linearize([held[letter][None] for letter in model.letters], data)[0][0]


def probe(truth) -> np.ndarray:
    """What the probe sees of true states, (m, 9)."""
    body = rotate(truth.nav_R_body.transpose(0, 2, 1), truth.nav_v_body)
    return np.concatenate([truth.nav_R_body[:, :, 0], truth.nav_t_body, body], axis=1)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5037, 1.0])
def test_an_instant_is_where_the_truth_is(window, share):
    recording = record()
    t_ns = window.t0_ns + round(share * (window.t1_ns - window.t0_ns))
    found = told(AtInstant(Probe()), recording, window.t0_ns, None, preintegrated(window, t_ns, NO_BIAS, GRAVITY))
    expected = probe(recording.truth([t_ns]))[0]
    # integration of 100 Hz samples over a second
    np.testing.assert_allclose(found, expected, atol=6e-4)


def test_preintegrated_is_the_prediction_of_the_windows(window):
    """The same integration as `prediction.states_at`, without its bend to the keyframe after. GTSAM integrates on the
    tangent space, prediction on the group: they part by the second order of one sample's turn."""
    recording = record()
    ends = np.array([window.t0_ns, window.t1_ns])
    truth = recording.truth(ends)
    for share in (0.2, 0.77):
        t_ns = window.t0_ns + round(share * (window.t1_ns - window.t0_ns))
        at_end = preintegrated(window, window.t1_ns, NO_BIAS, GRAVITY)
        R, p, v = carried(truth, at_end)
        states = kinematics(truth)
        bent = states._replace(R=np.array([states.R[0], R]), p=np.array([states.p[0], p]), v=np.array([states.v[0], v]))
        first = Window(0, window.t0_ns, window.t0_ns, "first", window.dt[:0], window.accel[:0], window.gyro[:0])
        expected = states_at([first, window], bent, GRAVITY, np.array([t_ns]))
        R, p, v = carried(truth, preintegrated(window, t_ns, NO_BIAS, GRAVITY))
        assert angle_deg(R, expected.R[0]) < 3e-3
        np.testing.assert_allclose(p, expected.p[0], atol=5e-5)  # m
        np.testing.assert_allclose(v, expected.v[0], atol=3e-4)  # m/s


def carried(truth, partial: PartialPreintegration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State at the end of a partial preintegration from the first row of the truth."""
    R, dt, fall = truth.nav_R_body[0], partial.dt, np.array([0.0, 0.0, -GRAVITY])
    p = truth.nav_t_body[0] + truth.nav_v_body[0] * dt + 0.5 * fall * dt**2 + R @ partial.dp
    return R @ partial.dR, p, truth.nav_v_body[0] + fall * dt + R @ partial.dv


def test_the_bias_is_corrected_to_first_order(window):
    """Deltas at another bias, and those of the first one corrected, differ by the second order alone."""
    model, recording = AtInstant(Probe()), record()
    bias = np.array([0.05, -0.03, 0.04, 0.003, -0.002, 0.004])
    moved = gtsam.imuBias.ConstantBias(bias[:3], bias[3:])
    one, other = (preintegrated(window, window.t1_ns, b, GRAVITY) for b in (NO_BIAS, moved))
    truth = recording.truth([window.t0_ns])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = truth.nav_R_body[0], truth.nav_t_body[0]
    held = {"X": pose, "V": truth.nav_v_body[0], "B": bias, "L": np.zeros(3)}
    state = [held[letter][None] for letter in model.letters]
    seen = [
        model.linearize(state, np.concatenate([[1.0, 1.0, 0.0, 0.0], p.columns()])[None])[0][0] for p in (one, other)
    ]
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-4)
    assert np.abs(one.dp - other.dp).max() > 0.01  # m: there is something to correct


@pytest.mark.parametrize("offset", [-0.1, -0.02, 0.06, 0.1])
def test_a_clock_offset_speaks_of_another_time(window, offset):
    """A row stamped t speaks of t + offset: at walking speed within 2 mm for a tenth of a second."""
    recording, model = record(), AtInstant(Probe(), timed=True)
    t_ns = window.t0_ns + (window.t1_ns - window.t0_ns) // 2
    found = told(model, recording, window.t0_ns, None, preintegrated(window, t_ns, NO_BIAS, GRAVITY), offset)
    expected = probe(recording.truth([t_ns + round(offset * NS)]))[0]
    np.testing.assert_allclose(found[3:6], expected[3:6], atol=2e-3)
    np.testing.assert_allclose(found[6:9], expected[6:9], atol=0.03)  # m/s: the swing of a step is left out
    assert np.abs(found[3:6] - probe(recording.truth([t_ns]))[0, 3:6]).max() > abs(offset) * 0.3


def test_a_nominal_offset_is_part_of_the_instant(window):
    """The instant made at t + 0.05 s, told so, and an offset of 0.05 s: nothing is left to bend."""
    recording, model = record(), AtInstant(Probe(), timed=True)
    t_ns = window.t0_ns + (window.t1_ns - window.t0_ns) // 2
    partial = preintegrated(window, t_ns + NS // 20, NO_BIAS, GRAVITY)
    truth = recording.truth([window.t0_ns])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = truth.nav_R_body[0], truth.nav_t_body[0]
    held = {"X": pose, "V": truth.nav_v_body[0], "B": np.zeros(6), "T": np.array([0.05]), "L": np.zeros(3)}
    data = np.concatenate([[1.0, 1.0, 0.0, 0.0], partial.columns(0.05)])[None]
    found = model.linearize([held[letter][None] for letter in model.letters], data)[0][0]
    np.testing.assert_allclose(found, probe(recording.truth([t_ns + NS // 20]))[0], atol=6e-4)


def test_nothing_passes_at_the_keyframe_itself(window):
    partial = preintegrated(window, window.t0_ns, NO_BIAS, GRAVITY)
    assert partial.dt == 0.0 and not partial.by_bias.any() and np.array_equal(partial.dR, np.eye(3))
    at = at_keyframe(NO_BIAS, window.accel[0], window.gyro[0], GRAVITY)
    np.testing.assert_array_equal(partial.columns(), at.columns())


@pytest.mark.parametrize("beyond_ns", [-1, 1])
def test_an_instant_outside_its_window_is_refused(window, beyond_ns):
    t_ns = window.t0_ns + beyond_ns if beyond_ns < 0 else window.t1_ns + beyond_ns
    with pytest.raises(ValueError, match="lies outside the window"):
        preintegrated(window, t_ns, NO_BIAS, GRAVITY)


def test_every_letter_of_an_observation_is_a_state():
    assert set(AtInstant(Probe(), timed=True).letters) <= set(STATES)
