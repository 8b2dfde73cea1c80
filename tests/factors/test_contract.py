"""What every builder owes: zero at the truth, true derivatives and sigmas, causality, only finite numbers.

Here the native factors; `test_contract_rows` has the kinds that GTSAM lacks. A new sensor adds its row to one of the
tables, or these tests fail.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from exact import GRAVITY, LEVER, Graph, Recording, assemble, assert_derivative, record
from scipy.stats import chi2
from test_contract_rows import CASES

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors import FACTORS
from smartnav_graph.factors.prior import PriorBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import GraphUpdate
from smartnav_graph.session.calibration.model import DEVICE_CLASSES
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.simulation.trajectory import Truth

# Largest |component| of the residual at the truth, and sensors (tags) the builder speaks for.
#   imu: rad, m, m/s after 1 s (second order integration of 100 Hz samples); positions: rounding.
AT_TRUTH = {
    "imu": np.array([3e-4] * 3 + [3e-4] * 3 + [6e-4] * 3),
    "gnss": np.full(3, 1e-9),
    "control": np.full(3, 1e-9),
}
TAGS = {"imu": ("imu", "imu_bias"), "gnss": ("gnss",), "control": ("control",)}
# A standstill measures nothing: no unit, no noise, no clock; see test_standstill_factor. Image pairs and
# tracks tie several states: see test_coplanar_rows, test_coplanarity, test_smart and test_smart_tracks.
ELSEWHERE = {"static", "image_pairs", "smart"}
SHIFT_NS = NS // 10

Wrong = Callable[[Session], Session]


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record()


@pytest.fixture(scope="module")
def graph(recording) -> Graph:
    return assemble(recording.session, recording.truth)


def residuals(graph: Graph, *sensors: str) -> np.ndarray:
    """Unwhitened residuals, one row a factor."""
    return np.array([factor.unwhitenedError(graph.values) for _, factor in graph.factors(*sensors)])


def test_every_builder_stands_in_the_tables():
    assert set(AT_TRUTH) == set(TAGS) == {m.sensor for m in MUTATIONS}
    assert set(FACTORS) - {"prior"} == set(AT_TRUTH) | set(CASES) | ELSEWHERE


@pytest.mark.parametrize("sensor", AT_TRUTH)
def test_the_residual_at_the_simulated_truth_is_zero(sensor, graph):
    found = np.abs(residuals(graph, sensor)).max(axis=0)
    assert (found <= AT_TRUTH[sensor]).all(), found


@pytest.mark.parametrize("sensor", AT_TRUTH)
def test_what_is_left_at_the_truth_is_small_beside_its_sigma(sensor, graph):
    white = np.array([factor.whitenedError(graph.values) for _, factor in graph.factors(sensor)])
    assert np.sqrt((white**2).mean()) < 0.1


@pytest.mark.parametrize("sensor", AT_TRUTH)
def test_one_factor_a_measurement_tagged_with_its_row(sensor, graph, recording):
    tags = [tag for tag, _ in graph.factors(sensor)]
    if sensor == "imu":
        assert [tag.t_ns for tag in tags] == [w.t1_ns for w in graph.windows[1:]]
    else:
        stream = getattr(recording.session, sensor)
        assert [tag.row for tag in tags] == list(range(len(stream)))
        assert [tag.t_ns for tag in tags] == stream.t_ns.tolist()


# --- a wrong sign, unit, frame, lever arm or clock is seen ------------------------------------------------------------


@dataclass(frozen=True)
class Mutation:
    """A mistake, and the residual (rms over the factors, largest of attitude rad, position m, velocity m/s) it must
    exceed by physics."""

    sensor: str
    name: str
    wrong: Wrong
    floor: float


def _imu(**changes: Callable[[np.ndarray], np.ndarray]) -> Wrong:
    def wrong(session: Session) -> Session:
        imu = session.require_imu()
        return session.replace(imu=replace(imu, **{name: f(getattr(imu, name)) for name, f in changes.items()}))

    return wrong


def _moved(sensor: str, change: Callable[[np.ndarray], np.ndarray]) -> Wrong:
    def wrong(session: Session) -> Session:
        stream = getattr(session, sensor)
        return session.replace(**{sensor: replace(stream, enu=change(stream.enu))})

    return wrong


def _lever(sensor: str, lever: tuple[float, float, float]) -> Wrong:
    return lambda session: session.replace(sensors={**session.sensors, sensor: Mount(body_t=lever)})


def _late(sensor: str) -> Wrong:
    def wrong(session: Session) -> Session:
        stream = getattr(session, sensor)
        stream = replace(stream, t_ns=stream.t_ns + SHIFT_NS)
        inside = stream.t_ns <= session.require_imu().t_ns[-1] if sensor != "imu" else slice(None)
        return session.replace(**{sensor: stream.take(inside)})

    return wrong


def _swap(rows: np.ndarray) -> np.ndarray:
    return rows[:, [1, 0, 2]]


def _position_mutations(sensor: str) -> list[Mutation]:
    x, y, z = LEVER
    return [
        # twice the lever arm of 1.09 m; a part of it; 1.5 m/s for a tenth of a second; a figure eight 10 m wide
        Mutation(sensor, "lever arm sign", _lever(sensor, (-x, -y, -z)), 2.0),
        Mutation(sensor, "lever arm forgotten", _lever(sensor, (0.0, 0.0, 0.0)), 1.0),
        Mutation(sensor, "lever arm axes swapped", _lever(sensor, (y, x, z)), 0.9),
        Mutation(sensor, "nav axes swapped", _moved(sensor, _swap), 1.5),
        Mutation(sensor, "height sign", _moved(sensor, lambda enu: enu * [1, 1, -1]), 1.0),
        Mutation(sensor, "clock late by 0.1 s", _late(sensor), 0.1),
        Mutation(sensor, "feet", _moved(sensor, lambda enu: enu / 0.3048), 3.0),
    ]


MUTATIONS = [
    # after a window of 1 s: gravity twice over is 2 g m/s, no gravity 1 g
    Mutation("imu", "gravity sign", lambda s: s.replace(gravity_m_s2=-GRAVITY), 10.0),
    Mutation("imu", "force sign", _imu(accel=np.negative), 10.0),
    Mutation("imu", "force in g", _imu(accel=lambda a: a / 9.80665), 5.0),
    Mutation("imu", "rate in deg/s", _imu(gyro=np.degrees), 1.0),
    Mutation("imu", "rate sign", _imu(gyro=np.negative), 0.5),
    Mutation("imu", "body axes swapped", _imu(gyro=_swap, accel=_swap), 0.5),
    Mutation("imu", "body axes of the rate swapped", _imu(gyro=lambda w: w[:, [0, 2, 1]]), 0.3),
    Mutation("imu", "nav axes north-east-down", lambda s: s, 5.0),
    Mutation("imu", "clock late by 0.1 s", _late("imu"), 0.05),
    *_position_mutations("gnss"),
    *_position_mutations("control"),
]


def in_ned(truth: Truth) -> Truth:
    """The truth in north-east-down axes."""
    nav = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    return replace(
        truth, nav_R_body=nav @ truth.nav_R_body, nav_t_body=truth.nav_t_body @ nav, nav_v_body=truth.nav_v_body @ nav
    )


def size(rows: np.ndarray) -> float:
    """Largest root mean square over the groups of three components."""
    groups = rows.reshape(len(rows), -1, 3)
    return float(np.sqrt((groups**2).sum(axis=2).mean(axis=0)).max())


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda m: f"{m.sensor}: {m.name}")
def test_a_mistake_shows_in_the_residual(mutation, recording, graph):
    at_truth = size(residuals(graph, mutation.sensor))
    session = mutation.wrong(recording.session)
    truth = (lambda t: in_ned(recording.truth(t))) if "north-east-down" in mutation.name else recording.truth
    span = (int(recording.session.imu.t_ns[0] + SHIFT_NS), int(recording.session.imu.t_ns[-1]))
    found = size(residuals(assemble(session, truth, span=span), mutation.sensor))
    assert at_truth < 1e-3 < mutation.floor < found, (at_truth, found)


# --- derivatives ------------------------------------------------------------------------------------------------------


def disturbed(graph: Graph, index: int) -> gtsam.Values:
    """States up to keyframe `index`, each off by 0.02 of its unit: derivatives must hold away from the truth too."""
    rng = np.random.default_rng(3)
    delta = gtsam.VectorValues()
    for k in (index - 1, index):
        for letter, n in (("X", 6), ("V", 3), ("B", 6)):
            delta.insert(key(letter, k), 0.02 * rng.standard_normal(n))
    return graph.values.retract(delta)


@pytest.mark.parametrize("sensor", [tag for tags in TAGS.values() for tag in tags])
def test_the_analytic_derivative_is_the_numerical_one(sensor, graph, recording):
    tag, factor = graph.factors(sensor)[len(graph.factors(sensor)) // 2]
    index = next(w.index for w in graph.windows if w.t1_ns == tag.t_ns)
    assert_derivative(factor, disturbed(graph, index))


def test_the_derivative_of_a_position_without_lever_arm(graph, recording):
    bare = assemble(recording.session.replace(sensors={}), recording.truth)
    (tag, factor) = bare.factors("gnss")[12]
    assert isinstance(factor, gtsam.GPSFactor)
    assert_derivative(factor, disturbed(bare, next(w.index for w in bare.windows if w.t1_ns == tag.t_ns)))


@pytest.mark.parametrize("sigma_pos", [None, np.array([1.0, 2.0, 3.0])])
def test_the_derivatives_of_the_prior_at_its_mean(graph, sigma_pos):
    # GTSAM's priors take the identity for the derivative of the logarithm: right at the mean, where it is needed.
    values = graph.values
    pose, velocity, bias = values.atPose3(key("X", 0)), values.atVector(key("V", 0)), values.atConstantBias(key("B", 0))
    start = State(0, 0, gtsam.NavState(pose, velocity), bias)
    prior = PriorBuilder(
        start, np.array([0.1, 0.2, 0.3]), sigma_pos, np.full(3, 0.5), np.full(6, 0.1), np.array([1.0, 2.0, 3.0]), bias
    )
    update = GraphUpdate(0, 0, 0.0)
    prior.add(update, graph.windows[0], None, PassState())
    assert len(update.factors) == 3
    for _, factor in update.factors:
        assert_derivative(factor, values)


# --- sigmas -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tag", [tag for tags in TAGS.values() for tag in tags])
def test_whitened_residuals_of_simulated_noise_have_unit_variance(tag):
    noise = DEVICE_CLASSES["mems"]
    square, count = 0.0, 0
    for seed in range(4):
        noisy = record(noise=noise, fix_sigma=0.7, seed=seed)
        graph = assemble(noisy.session, noisy.truth, bias=noisy.bias)
        white = np.array([factor.whitenedError(graph.values) for _, factor in graph.factors(tag)])
        square, count = square + float((white**2).sum()), count + white.size
    # two-sided, 1e-4 in each tail
    low, high = chi2(count).ppf([1e-4, 1 - 1e-4])
    assert low < square < high, (low / count, square / count, high / count)


@pytest.mark.parametrize("wrong", [0.7, 1.4])
@pytest.mark.parametrize(("tag", "group"), [("imu", "gyro"), ("imu_bias", "gyro_walk")])
def test_that_bound_sees_a_noise_wrong_by_forty_per_cent(tag, group, wrong):
    noisy = record(noise=DEVICE_CLASSES["mems"], seed=0)
    pass_state = PassState(noise_scales={group: wrong, group.replace("gyro", "accel"): wrong})
    graph = assemble(noisy.session, noisy.truth, bias=noisy.bias, pass_state=pass_state)
    white = np.array([factor.whitenedError(graph.values) for _, factor in graph.factors(tag)])
    low, high = chi2(4 * white.size).ppf([1e-4, 1 - 1e-4]) / (4 * white.size)
    assert not low < (white**2).mean() < high


# --- causality and broken numbers -------------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", AT_TRUTH)
def test_removing_what_comes_later_leaves_earlier_steps_unchanged(sensor, recording):
    session, imu = recording.session, recording.session.imu
    cut = int(imu.t_ns[1700])
    shorter = session.replace(
        imu=imu.take(imu.t_ns <= cut),
        gnss=session.gnss.take(session.gnss.t_ns <= cut),
        control=session.control.take(session.control.t_ns <= cut),
    )
    full, part = (assemble(s, recording.truth) for s in (session, shorter))
    known = max(w.t1_ns for w in part.windows if w.rows)  # later windows end where the recording does
    values = [disturbed(graph, 5) for graph in (full, part)]
    pairs = [[(tag, f) for tag, f in graph.factors(*TAGS[sensor]) if tag.t_ns <= known] for graph in (full, part)]
    assert len(pairs[0]) == len(pairs[1]) > 2
    for (tag, factor), (other_tag, other) in zip(*pairs, strict=True):
        assert tag == other_tag
        np.testing.assert_array_equal(factor.whitenedError(values[0]), other.whitenedError(values[1]))


@pytest.mark.parametrize("sensor", AT_TRUTH)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_measurement_that_is_no_number_is_refused_by_name(sensor, value, recording):
    stream = getattr(recording.session, sensor)
    field = "accel" if sensor == "imu" else "enu"
    rows = np.array(getattr(stream, field))
    rows[4, 1] = value
    with pytest.raises(SessionError, match=rf"^{sensor}: \w+ is {value} at row 4 .*; expected finite numbers") as error:
        replace(stream, **{field: rows})
    assert error.value.stream == sensor and error.value.row == 4
