"""Keys, steps, memory and the elimination order."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest

from smartnav_graph.graph import (
    KEYFRAME_LETTERS,
    LAST_STAGE,
    SENSORS,
    STATES,
    Block,
    Memory,
    SessionState,
    State,
    Step,
    Tag,
    Window,
    build_step,
    key,
)
from smartnav_graph.timebase import NS


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

        def add(self, step, window, previous, memory):
            seen.append((self.name, window.index, previous, memory))
            step.add(Tag(self.name, window.t1_ns), None)

    memory, previous = Memory(), State(2, 0, None, None)
    step = build_step(window(), previous, [Spy("imu"), Spy("vehicle", LAST_STAGE), Spy("gnss")], memory, 5 * NS)
    assert seen == [("imu", 3, previous, memory), ("gnss", 3, previous, memory)]
    assert [tag.sensor for tag, _ in step.factors] == ["imu", "gnss"]
    assert (step.index, step.t_ns, step.t_s) == (3, 7_500_000_000, 2.5)


def test_a_builder_of_the_last_stage_waits_for_it():
    class Late:
        name, stage = "vehicle", LAST_STAGE

        def add(self, step, window, previous, memory):
            step.use(CLOCK)

    for memory, there in ((Memory(), False), (Memory(stage=LAST_STAGE), True)):
        assert bool(build_step(window(), None, [Late()], memory, 0).session) == there


CLOCK = SessionState("T", "gnss", "gnss_time_offset_s", np.zeros(1), np.array([0.2]))


def test_a_session_state_has_one_key_and_may_be_held():
    step = Step(4, NS, 1.0)
    assert step.use(CLOCK) == step.use(CLOCK) == CLOCK.key == key("T", SENSORS.index("gnss"))
    step.hold({"something_else": np.ones(1)})
    assert list(step.session) == [CLOCK.key] and not step.held
    step.hold({"gnss_time_offset_s": np.array([0.06])})
    assert not step.session and step.constants == {CLOCK.key: CLOCK}
    np.testing.assert_array_equal(step.held[CLOCK.key], [0.06])


def test_a_block_says_of_every_row_where_it_is_from_and_whether_it_counts():
    block = Block("gnss", None, [(1,), (2,)], np.zeros((2, 3)), NS)
    assert (block.rows, block.used, block.loss) == ((-1, -1), (True, True), "none")


def test_the_values_of_a_step_are_its_own_states():
    step = Step(4, NS, 1.0, predicted=gtsam.NavState(gtsam.Rot3.Rz(0.3), np.ones(3), 2 * np.ones(3)))
    step.bias = gtsam.imuBias.ConstantBias(np.full(3, 0.1), np.full(3, 0.2))
    step.chain[key("C", 4)] = np.full(3, 5.0)
    values = step.values()
    assert set(values.keys()) == {key(letter, 4) for letter in "XVBC"}
    np.testing.assert_array_equal(values.atVector(key("V", 4)), 2.0)
    np.testing.assert_array_equal(values.atVector(key("C", 4)), 5.0)
    np.testing.assert_array_equal(values.atConstantBias(key("B", 4)).vector(), [0.1] * 3 + [0.2] * 3)


def test_length_of_a_window():
    assert window().length_s == pytest.approx(1.0)


def test_memory_knows_nothing_at_first_and_cannot_be_written():
    memory = Memory(noise_scales={"gyro": 2.0}, rejected={"gnss": frozenset({3})})
    assert (memory.scale("gyro"), memory.scale("accel")) == (2.0, 1.0)
    assert memory.is_rejected("gnss", 3) and not memory.is_rejected("gnss", 4) and not memory.is_rejected("control", 3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        memory.phase = "robust"
