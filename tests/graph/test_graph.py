"""Keys, steps, memory and the elimination order."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from smartnav_graph.core.timebase import NS
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState
from smartnav_graph.graph.states import KEYFRAME_LETTERS, STATES, SessionState, State, key, session_key
from smartnav_graph.graph.update import FactorBatch, FactorId, GraphUpdate, build_update
from smartnav_graph.graph.windows import Window


def window(index: int = 3, t_s: float = 7.5) -> Window:
    return Window(index, round((t_s - 1) * NS), round(t_s * NS), "normal", *np.zeros((1, 1)), *np.zeros((2, 1, 3)))


def test_every_state_has_its_own_letter_and_the_keyframe_has_three():
    assert KEYFRAME_LETTERS == ("X", "V", "B")
    assert {STATES[letter].dim for letter in "XB"} == {6} and STATES["V"].dim == 3
    assert {kind.scope for kind in STATES.values()} <= {"keyframe", "chain", "session"}
    keys = {key(letter, index) for letter in STATES for index in (0, 1, 10_000)}
    assert len(keys) == 3 * len(STATES)
    assert chr(gtsam.symbolChr(key("V", 12))) == "V" and gtsam.symbolIndex(key("V", 12)) == 12


def test_a_step_asks_every_builder_in_turn():
    seen = []

    class Spy:
        def __init__(self, name, stage=0):
            self.name, self.stage = name, stage

        def add(self, update, window, previous, pass_state):
            seen.append((self.name, window.index, previous, pass_state))
            update.add(FactorId(self.name, window.t1_ns), None)

    pass_state, previous = PassState(), State(2, 0, None, None)
    update = build_update(window(), previous, [Spy("imu"), Spy("vehicle", LAST_STAGE), Spy("gnss")], pass_state, 5 * NS)
    assert seen == [("imu", 3, previous, pass_state), ("gnss", 3, previous, pass_state)]
    assert [tag.sensor for tag, _ in update.factors] == ["imu", "gnss"]
    assert (update.index, update.t_ns, update.t_s) == (3, 7_500_000_000, 2.5)


def test_a_builder_of_the_last_stage_waits_for_it():
    class Late:
        name, stage = "vehicle", LAST_STAGE

        def add(self, step, window, previous, pass_state):
            step.use(CLOCK)

    for pass_state, there in ((PassState(), False), (PassState(stage=LAST_STAGE), True)):
        assert bool(build_update(window(), None, [Late()], pass_state, 0).session) == there


CLOCK = SessionState("T", "gnss", "gnss_time_offset_s", np.zeros(1), np.array([0.2]))


def test_a_session_state_has_one_key_and_may_be_held():
    update = GraphUpdate(4, NS, 1.0)
    assert update.use(CLOCK) == update.use(CLOCK) == CLOCK.key == session_key("T", "gnss")
    update.hold({"something_else": np.ones(1)})
    assert list(update.session) == [CLOCK.key] and not update.held
    update.hold({"gnss_time_offset_s": np.array([0.06])})
    assert not update.session and update.constants == {CLOCK.key: CLOCK}
    np.testing.assert_array_equal(update.held[CLOCK.key], [0.06])


def test_a_block_says_of_every_row_where_it_is_from_and_whether_it_counts():
    block = FactorBatch("gnss", None, [(1,), (2,)], np.zeros((2, 3)), NS)
    assert (block.rows, block.used, block.loss) == ((-1, -1), (True, True), "none")


def test_the_values_of_a_step_are_its_own_states():
    update = GraphUpdate(4, NS, 1.0, predicted=gtsam.NavState(gtsam.Rot3.Rz(0.3), np.ones(3), 2 * np.ones(3)))
    update.bias = gtsam.imuBias.ConstantBias(np.full(3, 0.1), np.full(3, 0.2))
    update.chain[key("C", 4)] = np.full(3, 5.0)
    values = update.values()
    assert set(values.keys()) == {key(letter, 4) for letter in "XVBC"}
    np.testing.assert_array_equal(values.atVector(key("V", 4)), 2.0)
    np.testing.assert_array_equal(values.atVector(key("C", 4)), 5.0)
    np.testing.assert_array_equal(values.atConstantBias(key("B", 4)).vector(), [0.1] * 3 + [0.2] * 3)


def test_length_of_a_window():
    assert window().length_s == pytest.approx(1.0)


def test_memory_knows_nothing_at_first_and_cannot_be_written():
    pass_state = PassState(noise_scales={"gyro": 2.0}, rejected={"gnss": frozenset({3})})
    assert (pass_state.scale("gyro"), pass_state.scale("accel")) == (2.0, 1.0)
    assert (
        pass_state.is_rejected("gnss", 3)
        and not pass_state.is_rejected("gnss", 4)
        and not pass_state.is_rejected("control", 3)
    )
    with pytest.raises(dataclasses.FrozenInstanceError):
        pass_state.stage = 1
