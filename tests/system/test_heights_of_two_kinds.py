"""Heights of two streams on two datums, and fixes without heights."""

from dataclasses import replace

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph.session.streams import ControlPoint


def with_points(up):
    """A walk in a figure of eight with surveyed points, the heights of its fixes `up` m above theirs."""
    session = sn.simulate("figure-eight-60s")
    reference, gnss = session.reference, session.gnss
    rows = np.searchsorted(reference.t_ns, gnss.t_ns[[10, 25, 40, 50]])
    points = ControlPoint(
        t_ns=reference.t_ns[rows],
        enu=reference.enu[rows],
        sigma=np.full((4, 3), 0.02),
        point_id=np.array(list("abcd"), dtype=object),
    )
    position = session.nav_position(gnss) + np.array([0.0, 0.0, up])
    return session.replace(gnss=replace(gnss, lla=None, enu=position), control=points)


def test_fixes_of_another_datum_than_surveyed_points():
    good, run = sn.run(with_points(0.0)), sn.run(with_points(47.0))
    np.testing.assert_allclose(run.solution.nav_t_body, good.solution.nav_t_body, atol=0.05)
    assert run.summary["chi2_per_dof"]["gnss"] == pytest.approx(good.summary["chi2_per_dof"]["gnss"], abs=0.2)
    assert run.summary["verdict"]["level"] == "doubtful"  # the health names the datum
    (name,) = (name for name in run.summary["states"] if "height_offset" in name)
    state = run.summary["states"][name]
    assert abs(float(name.split("_")[3]) + state["value"] - 47.0) < 4.0 * state["sigma"]
    assert not any("height_offset" in name for name in good.summary["states"])


@pytest.mark.parametrize("stated", [True, False])
def test_fixes_without_heights_have_no_vertical_noise(stated):
    """Half of the fixes have no height: chi-square and the vertical sigma are those of the others."""
    session = sn.simulate("figure-eight-60s")
    gnss = session.gnss
    position = session.nav_position(gnss)
    position[::2, 2] = np.nan
    sigma = gnss.sigma if stated else None
    run = sn.run(session.replace(gnss=replace(gnss, lla=None, enu=position, sigma=sigma)))
    assert 0.75 < run.summary["chi2_per_dof"]["gnss"] < 1.4
    if not stated:
        assert run.summary["states"]["gnss_sigma_m"]["value"][2] == pytest.approx(1.5, rel=0.5)
