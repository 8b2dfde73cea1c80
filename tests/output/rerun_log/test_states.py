"""States of the session: clock offsets over time, all of them in a table."""

from __future__ import annotations

import numpy as np
from recordings import T0, make_solution, replayed, updates, write

from smartnav_graph.output.rerun_log import states

FOUND = {
    "gnss_time_offset_s": {"value": 0.06, "sigma": 0.002, "held": False},
    "gnss_lever_arm_correction_m": {"value": [0.1, 0.2, 0.3], "sigma": [0.01] * 3, "observed": [True, True, False]},
    "accel_noise_density": {"value": 0.003, "sigma": None, "held": True},
}


def test_clock_offset_is_drawn_over_the_whole_session_with_its_bands(tmp_path):
    found = write(tmp_path / "run.rrd", summary={"states": FOUND})
    np.testing.assert_array_equal(found.values("/clock/gnss", "Measurements:values"), [[0.06]] * 2)
    np.testing.assert_allclose(found.values("/clock/gnss", "Measurements:variances"), [[0.002**2]] * 2)
    wide = found.values("/clock/gnss/three_sigma", "Measurements:variances")
    np.testing.assert_allclose(wide, [[0.006**2]] * 2)
    ends = found.index("/clock/gnss", "Measurements:values", "elapsed")
    assert ends[0] == 0 and ends[1] >= make_solution().t_ns[-1] - T0
    assert [name for name in found.view_names() if name.startswith("Clock offset of gnss s")]


def test_in_a_replay_it_is_drawn_as_each_update_has_it(tmp_path):
    found = write(tmp_path / "run.rrd", summary={"states": FOUND}, causal=make_solution(), diagnostics=replayed())
    followed = updates().states["gnss_time_offset_s"]
    np.testing.assert_array_equal(found.values("/clock/gnss", "Measurements:values")[:, 0], followed[:, 0])
    np.testing.assert_allclose(found.values("/clock/gnss", "Measurements:variances")[:, 0], followed[:, 1] ** 2)
    np.testing.assert_array_equal(found.values("/clock/gnss/final", "Measurements:values"), [[0.06]] * 2)


def test_every_state_is_in_the_table(tmp_path):
    found = write(tmp_path / "run.rrd", summary={"states": FOUND})
    text = found.rows("/states", "TextDocument:text", static=True)[0][0]
    assert "| GNSS time offset [s] | 0.0600 | 0.00200 | estimated |" in text
    (unseen,) = [
        line for line in text.splitlines() if line.endswith("| 0.300 | 0.0100 | not observable (prior only) |")
    ]
    assert unseen.startswith("| GNSS lever arm") and "[m]" in unseen
    assert "| Accelerometer noise density [m/s²/√Hz] | 0.00300 | – | fixed |" in text
    assert "States of the session" in found.view_names()


def test_only_clocks_are_drawn():
    assert states.clocks(FOUND) == ["gnss_time_offset_s"]
