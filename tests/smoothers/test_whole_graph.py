"""Blocks as one graph: the same system as one factor a row, losses, constants, rows that are not used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from smartnav_graph.graph.robust import huber_limit, loss_weights
from smartnav_graph.graph.states import SessionState, key
from smartnav_graph.graph.update import FactorBatch, GraphUpdate
from smartnav_graph.smoothers.whole_graph import (
    Snapshot,
    StackedFactors,
    WholeGraph,
    custom_factor,
    linear_factor,
    session_prior,
    stacks_of,
    value_of,
)

LEVER = SessionState("L", "gnss", "gnss_lever_arm_correction_m", np.array([0.1, 0.0, -0.2]), np.full(3, 0.3))


class Everything:
    """Five states of every kind in one row: r = data (3) + sums of the states' parts, two of them nonlinear."""

    letters: tuple[str, ...] = ("X", "V", "B", "C", "L")

    def linearize(self, states: Sequence[np.ndarray], data: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        pose, v, bias, c, lever = states
        R, eye = pose[:, :3, :3], np.tile(np.eye(3), (len(v), 1, 1))
        arm = np.einsum("nij,nj->ni", R, lever)
        residual = pose[:, :3, 3] + arm + v**2 + bias[:, :3] - 2.0 * bias[:, 3:] + c - data
        zero = np.zeros(len(v))
        rows = [zero, -lever[:, 2], lever[:, 1], lever[:, 2], zero, -lever[:, 0], -lever[:, 1], lever[:, 0], zero]
        skew = np.stack(rows, axis=-1).reshape(-1, 3, 3)
        by_pose = np.concatenate([-R @ skew, R], axis=2)
        by_v = 2.0 * eye * v[:, None, :]
        return residual, [by_pose, by_v, np.concatenate([eye, -2.0 * eye], axis=2), eye, R]


class Blind:
    """Two rows of letters of which the velocity never matters."""

    letters: tuple[str, ...] = ("V", "C")

    def linearize(self, states: Sequence[np.ndarray], data: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        v, c = states
        return c - data, [np.zeros((len(v), 3, 3)), np.tile(np.eye(3), (len(v), 1, 1))]


MODEL, BLIND = Everything(), Blind()


def values(rng: np.random.Generator, count: int = 4) -> gtsam.Values:
    made = gtsam.Values()
    for i in range(count):
        made.insert(key("X", i), gtsam.Pose3(gtsam.Rot3.Rodrigues(rng.normal(0, 1, 3)), rng.normal(0, 1, 3)))
        made.insert(key("V", i), rng.normal(0, 1, 3))
        made.insert(key("B", i), gtsam.imuBias.ConstantBias(rng.normal(0, 1, 3), rng.normal(0, 1, 3)))
        made.insert(key("C", i), rng.normal(0, 1, 3))
    made.insert(LEVER.key, rng.normal(0, 1, 3))
    return made


def keys(i: int) -> tuple[int, ...]:
    return (*(key(letter, i) for letter in "XVBC"), LEVER.key)


def block(rng: np.random.Generator, count: int = 4, **changes) -> FactorBatch:
    return replace(
        FactorBatch("probe", MODEL, [keys(i) for i in range(count)], rng.normal(0, 2, (count, 3)), 0, range(count)),
        **changes,
    )


def information(linear: gtsam.GaussianFactorGraph, at: gtsam.Values) -> tuple[np.ndarray, np.ndarray]:
    order = gtsam.Ordering()
    for name in sorted(linear.keys()):
        order.push_back(name)
    return linear.hessian(order)


def one_by_one(blocks: Sequence[FactorBatch], held, priors=()) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for b in blocks:
        for row in np.flatnonzero(b.used):
            graph.push_back(custom_factor(b, int(row), held))
    for prior in priors:
        graph.push_back(prior)
    return graph


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("held", [{}, {LEVER.key: np.array([0.3, -0.2, 0.5])}])
def test_a_stack_is_the_system_of_its_rows(loss, held):
    """Five states a row: linearised at once or one CustomFactor a row, gradient, information and cost are the same."""
    rng = np.random.default_rng(0)
    at, made = values(rng), block(np.random.default_rng(1), loss=loss, used=(True, True, False, True))
    if held:
        at.erase(LEVER.key)
    graph, single = WholeGraph([], [made], held), one_by_one([made], held)
    mine, theirs = information(graph.linearize(at), at), information(single.linearize(at), at)
    np.testing.assert_allclose(mine[0], theirs[0], atol=1e-10)
    np.testing.assert_allclose(mine[1], theirs[1], atol=1e-10)
    assert graph.error(at) == pytest.approx(single.error(at), rel=1e-9)
    assert graph.linearize(at).size() == 3


def test_the_derivative_of_the_cost_is_the_gradient():
    """Of the losses too: the weights belong to the cost."""
    rng = np.random.default_rng(2)
    at = values(rng)
    for loss in ("none", "huber", "cauchy"):
        graph = WholeGraph([], [block(np.random.default_rng(3), loss=loss)], {})
        gradient = graph.linearize(at).gradientAtZero()
        for letter, size in (("X", 6), ("V", 3), ("B", 6), ("L", 3)):
            name = LEVER.key if letter == "L" else key(letter, 2)
            for axis in range(size):
                ends = []
                for step in (1e-6, -1e-6):
                    delta = gtsam.VectorValues()
                    delta.insert(name, step * np.eye(size)[axis])
                    ends.append(graph.error(at.retract(delta)))
                assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(gradient.at(name)[axis], abs=1e-6), (loss, letter)


@pytest.mark.parametrize("reach", [1.0, 2.5])
@pytest.mark.parametrize("square", [0.0, 1.0, 1.345**2, 2.0, 400.0])
def test_losses_are_gtsam_s(square, reach):
    estimators = gtsam.noiseModel.mEstimator
    huber, cauchy = estimators.Huber.Create(1.345 * reach), estimators.Cauchy.Create(reach)
    for loss, estimator in (("huber", huber), ("cauchy", cauchy)):
        weight, cost = loss_weights(np.array([square]), loss, reach)
        assert weight[0] == pytest.approx(estimator.weight(np.sqrt(square)), abs=1e-12)
        assert cost[0] == pytest.approx(estimator.loss(np.sqrt(square)), abs=1e-12)
    assert loss_weights(np.array([square]), "none", reach) == (pytest.approx([1.0]), pytest.approx([0.5 * square]))


def test_the_loss_is_on_the_norm_of_a_row():
    rng = np.random.default_rng(0)
    at, made = values(rng, 1), block(np.random.default_rng(1), 1, loss="huber")
    (stack,) = stacks_of([made], {})
    residual = stack.linearize(at)[0][0]
    limit = huber_limit(3)
    expected = limit * np.linalg.norm(residual) - 0.5 * limit**2
    assert np.linalg.norm(residual) > limit and stack.cost(at) == pytest.approx(expected)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_as_many_good_rows_lie_outside_however_many_components_they_have(dim):
    norm = np.linalg.norm(np.random.default_rng(0).standard_normal((200_000, dim)), axis=1)
    assert (norm > huber_limit(dim)).mean() == pytest.approx(0.1786, abs=0.004)
    assert loss_weights(norm**2, "huber", dim=dim)[0].mean() > 0.94


def test_rows_not_used_have_residuals_and_nothing_else():
    at = values(np.random.default_rng(0))
    (full,) = stacks_of([block(np.random.default_rng(1))], {})
    (part,) = stacks_of([block(np.random.default_rng(1), used=(False, True, True, False))], {})
    np.testing.assert_array_equal(full.linearize(at)[0], part.linearize(at)[0])
    rows = full.linearize(at)[0][[1, 2]]
    assert part.cost(at) == pytest.approx(0.5 * (rows**2).sum())
    linear = gtsam.GaussianFactorGraph()
    stacks_of([block(np.random.default_rng(1), used=(False,) * 4)], {})[0].add_to(linear, at)
    assert linear.size() == 0


def test_what_nothing_depends_on_is_not_tied():
    """A row that does not feel a state does not make it look observed."""
    at = values(np.random.default_rng(0))
    rows = FactorBatch("blind", BLIND, [(key("V", i), key("C", i)) for i in range(4)], np.zeros((4, 3)), 0)
    linear = WholeGraph([], [rows], {}).linearize(at)
    assert set(linear.keys()) == {key("C", i) for i in range(4)}


def test_blocks_are_joined_by_sensor_model_and_loss():
    rng = np.random.default_rng(0)
    blocks = [block(rng), block(rng, loss="huber"), block(rng), block(rng, sensor="other"), block(rng, 0)]
    found = stacks_of(blocks, {})
    assert [(s.blocks[0].sensor, s.loss, len(s.keys)) for s in found] == [
        ("probe", "none", 8),
        ("probe", "huber", 4),
        ("other", "none", 4),
    ]
    assert [b.t_ns for b in found[0].blocks] == [0, 0] and isinstance(found[0], StackedFactors)


def test_a_graph_of_updates_has_the_prior_of_each_session_state_once():
    rng = np.random.default_rng(4)
    at, updates = values(rng), []
    for i in range(4):
        update = GraphUpdate(i, 0, 0.0)
        update.use(LEVER)
        update.blocks.append(block(rng, 4, keys=[keys(i)] * 4))
        updates.append(update)
    mine = WholeGraph.of(updates)
    single = one_by_one([b for u in updates for b in u.blocks], {}, [session_prior(LEVER)])
    np.testing.assert_allclose(
        information(mine.linearize(at), at)[0], information(single.linearize(at), at)[0], atol=1e-9
    )
    assert mine.error(at) == pytest.approx(single.error(at)) and mine.native.size() == 1


def test_a_held_state_is_a_constant_without_a_prior():
    rng = np.random.default_rng(4)
    update = GraphUpdate(0, 0, 0.0)
    update.use(LEVER)
    update.blocks.append(block(rng, 1))
    update.hold({LEVER.name: np.array([1.0, 2.0, 3.0])})
    at = values(rng, 1)
    at.erase(LEVER.key)  # nobody asks for it
    graph = WholeGraph.of([update])
    linear = graph.linearize(at)
    assert graph.native.size() == 0 and LEVER.key not in set(linear.keys())
    with_state = gtsam.Values(at)
    with_state.insert(LEVER.key, np.array([1.0, 2.0, 3.0]))
    (free,) = stacks_of(update.blocks, {})
    np.testing.assert_array_equal(graph.stacks[0].linearize(at)[0], free.linearize(with_state)[0])


def test_a_linear_factor_of_any_number_of_terms():
    """The same solution by Cholesky and QR as GTSAM's own three terms; more terms than those too."""
    rng = np.random.default_rng(5)
    names, dims = [key(letter, 0) for letter in "XVBC"], [6, 3, 6, 3]
    A, b = rng.normal(size=(30, 18)), rng.normal(size=30)
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(linear_factor(names, [*dims, 1], np.column_stack([A, b])))
    order = gtsam.Ordering()
    for name in names:
        order.push_back(name)
    expected = np.linalg.lstsq(A, b, rcond=None)[0]
    for solution in (graph.optimize(order), graph.optimize(order, gtsam.EliminateQR)):
        found = np.concatenate([solution.at(name) for name in names])
        np.testing.assert_allclose(found, expected, atol=1e-10)
        assert graph.error(solution) == pytest.approx(0.5 * ((A @ expected - b) ** 2).sum())


def names(letter, *indices):
    return np.array([key(letter, index) for index in indices], dtype=np.uint64)


def test_a_snapshot_reads_a_state_once_and_holds_constants():
    at = values(np.random.default_rng(0), 2)
    snapshot = Snapshot(at, {LEVER.key: np.array([7.0, 8.0, 9.0])})
    before = snapshot.column("X", names("X", 0, 1, 0))
    assert before.shape == (3, 4, 4) and np.array_equal(before[0], value_of(at, "X", key("X", 0)))
    at.update(key("X", 0), gtsam.Pose3())
    assert np.array_equal(snapshot.column("X", names("X", 0))[0], before[0])
    assert np.array_equal(snapshot.column("L", np.array([LEVER.key] * 2, dtype=np.uint64)), [[7.0, 8.0, 9.0]] * 2)
    assert snapshot.column("B", names("B", 1)).shape == (1, 6) and snapshot.column("V", names("V", 0)).shape == (1, 3)
