"""Twenty minutes with a trolley: image pairs make position and heading better, and say how sure they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.factors.coplanarity import CoplanarityConfig
from smartnav_graph.simulation.scenarios import SCENARIOS

TROLLEY = SCENARIOS["trolley-20min"]


def errors(run: sn.Run) -> tuple[float, float]:
    """RMS of position (m) and heading (deg) at the truth's epochs that the run has."""
    truth, found = run.session.reference, run.solution
    rows, at = (np.isin(one.t_ns, other.t_ns) for one, other in ((found, truth), (truth, found)))
    off = found.nav_t_body[rows] - truth.enu[at]
    true_R = Rotation.from_quat(truth.quat[at], scalar_first=True).as_matrix()
    turned = Rotation.from_matrix(found.nav_R_body[rows] @ true_R.transpose(0, 2, 1)).as_rotvec()[:, 2]
    return float(np.sqrt((off**2).sum(axis=1).mean())), float(np.degrees(np.sqrt((turned**2).mean())))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_better_by_two_and_never_worse_for_a_camera_that_is_not_known(seed):
    session = TROLLEY(seed)
    without = errors(sn.run(session, sn.Config(coplanarity=CoplanarityConfig(enabled=False)), rate="imu"))
    metres, degrees = errors(sn.run(session, rate="imu"))
    assert metres < without[0] / 2 and degrees < without[1] / 2
    wrong = replace(TROLLEY, camera=replace(TROLLEY.camera, boresight_deg=(0.0, 0.5, 0.0), clock_s=0.02))
    run = sn.run(wrong(seed), rate="imu")
    found = errors(run)
    assert found[0] < without[0] and found[1] < without[1]
    states = run.summary["states"]
    assert np.degrees(states["camera_boresight_rad"]["value"][1]) == pytest.approx(0.5, rel=0.1)
    assert states["images_time_offset_s"]["value"] == pytest.approx(0.02, rel=0.1)
