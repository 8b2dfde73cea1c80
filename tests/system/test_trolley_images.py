"""Twenty minutes with a trolley: image pairs make position and heading better, and say how sure they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sessions import rms

import smartnav_graph as sn
from smartnav_graph.factors.coplanarity import CoplanarityConfig
from smartnav_graph.simulation.scenarios import SCENARIOS

TROLLEY = SCENARIOS["trolley-20min"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_better_by_two_and_never_worse_for_a_camera_that_is_not_known(seed):
    session = TROLLEY(seed)
    blind = sn.Config(image_pairs=CoplanarityConfig(enabled=False))
    without = rms(session, sn.run(session, blind, rate="imu").solution)
    metres, degrees = rms(session, sn.run(session, rate="imu").solution)
    assert metres < without[0] / 2 and degrees < without[1] / 2
    wrong = replace(TROLLEY, camera=replace(TROLLEY.camera, boresight_deg=(0.0, 0.5, 0.0), clock_s=0.02))
    run = sn.run(wrong(seed), rate="imu")
    found = rms(run.session, run.solution)
    assert found[0] < without[0] and found[1] < without[1]
    states = run.summary["states"]
    assert np.degrees(states["camera_boresight_rad"]["value"][1]) == pytest.approx(0.5, rel=0.1)
    assert states["images_time_offset_s"]["value"] == pytest.approx(0.02, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_turns_on_the_spot_between_long_corridors(seed):
    """Neighbours only, half of them without a baseline: images help less, and never harm."""
    session = SCENARIOS["trolley-20min-plain"](seed)
    blind = sn.Config(image_pairs=CoplanarityConfig(enabled=False))
    without = rms(session, sn.run(session, blind, rate="imu").solution)
    metres, degrees = rms(session, sn.run(session, rate="imu").solution)
    assert metres < without[0] and degrees < without[1]
