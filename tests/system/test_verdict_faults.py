"""The verdict on faults planted in good recordings: it is not good, or the result is as good as without the fault.

The fast ones are on a minute of walking and two minutes of a car; all of them, on longer recordings, are slow.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from planted_faults import DATASETS, FAULTS, OTHERS, Outcome, Truth, outcome, recording

ALL = {**FAULTS, **OTHERS}
# One of each detector, and each in a second or so.
FAST = {
    "walk-60s": (
        *("clock +5 s", "clock +3600 s", "accelerometer sign", "gyro in deg/s", "accelerometer in g"),
        *("up axis +x", "multipath of 40 m for 30 s", "scale 5 %", "stale fixes", "filtered fixes", "sigma / 100"),
        *("pressure in Pa", "false standstill", "heights 47 m up"),
        *(
            "every second fix 150 m away",
            "half of the fixes 150 m away",
            "two receivers 25 m apart",
            "two height datums",
        ),
    ),
    "trolley-loop": ("scale 5 %", "lever arm 3 m", "gyro bias 0.2 rad/s"),
}
LONG = ("kitti", "car-10min", "walk-10min", "trolley-loop", "camera-fixes")


@cache
def clean(name: str, seed: int) -> tuple[Truth, Outcome]:
    session = recording(name, seed)
    truth = Truth.of(session)
    return truth, outcome(session, truth)


def assert_right(name: str, seed: int, fault: str) -> None:
    spoiled = ALL[fault](recording(name, seed), np.random.default_rng(seed))
    if spoiled is None:
        pytest.skip(f"{name} has nothing for it")
    truth, without = clean(name, seed)
    found = outcome(spoiled, truth)
    assert found.is_right(without), found


@pytest.mark.parametrize(("name", "fault"), [(name, fault) for name, faults in FAST.items() for fault in faults])
def test_faults_are_not_good(name, fault):
    assert_right(name, 0, fault)


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
@pytest.mark.parametrize("fault", ALL)
def test_every_fault_is_not_good(name, fault):
    assert_right(name, 1, fault)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trolley-images", "euroc"])
@pytest.mark.parametrize("fault", [fault for fault in ALL if fault.startswith(("focal", "camera"))])
def test_camera_faults_are_not_good(name, fault):
    if name == "euroc" and not (DATASETS / "euroc_v101").exists():
        pytest.skip("the truth of euroc_v101 is not in SMARTNAV_DATASETS")
    assert_right(name, 0, fault)


@pytest.mark.parametrize("name", FAST)
def test_the_same_recordings_are_good(name):
    assert clean(name, 0)[1].level == "good"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", LONG)
def test_long_recordings_are_good(name, seed):
    assert clean(name, seed)[1].level == "good", clean(name, seed)[1]
