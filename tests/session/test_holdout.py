"""Rows kept back on purpose: which, how many, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from exact import record

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.session.holdout import EXPECTED, Withhold, split
from smartnav_graph.session.streams import GnssFix


@pytest.fixture(scope="module")
def session():
    """101 fixes, one a second, from time zero on."""
    whole = record().session
    t = whole.t0_ns + ns_from_seconds(np.arange(101.0))
    return whole.replace(gnss=GnssFix(t_ns=t, enu=np.arange(303.0).reshape(101, 3), extra={"row": np.arange(101)}))


def test_every_tenth_is_kept_from_the_first_on(session):
    kept, held = split(session, ["gnss:every=10"])
    assert kept.gnss.extra["row"].tolist() == list(range(0, 101, 10))
    assert len(held["gnss"]) == 90
    both = np.sort(np.r_[kept.gnss.extra["row"], held["gnss"].extra["row"]])
    np.testing.assert_array_equal(both, np.arange(101))  # none lost, none twice
    np.testing.assert_array_equal(held["gnss"].enu, session.gnss.enu[held["gnss"].extra["row"]])


def test_an_outage_is_closed_at_its_start_and_open_at_its_end(session):
    _, held = split(session, ["gnss:outage=10-13"])
    assert held["gnss"].extra["row"].tolist() == [10, 11, 12]


def test_seconds_count_from_the_first_inertial_sample(session):
    late = session.replace(imu=session.imu.take(session.imu.t_ns >= session.t0_ns + 2 * NS))
    _, held = split(late, ["gnss:outage=10-13"])
    assert held["gnss"].extra["row"].tolist() == [12, 13, 14]


def test_specifications_add_up(session):
    kept, held = split(session, ["gnss:outage=10-12", "gnss:outage=20.5-22.5", "control:every=2"])
    assert held["gnss"].extra["row"].tolist() == [10, 11, 21, 22]
    assert len(kept.control) + len(held["control"]) == len(session.control)
    assert kept.control.point_id.tolist() == session.control.point_id[::2].tolist()


def test_nothing_asked_nothing_held(session):
    kept, held = split(session, [])
    assert held == {} and len(kept.gnss) == 101
    assert split(session, ["gnss:every=1"])[1] == {}


def test_the_given_session_is_left_as_it_was(session):
    split(session, ["gnss:every=2"])
    assert len(session.gnss) == 101


def test_parse():
    assert Withhold.parse("gnss:every=10") == Withhold("gnss", every=10)
    assert Withhold.parse("control:outage=1.5-3") == Withhold("control", outage=(1.5, 3.0))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "gnss",
        "gnss:",
        "gnss:every",
        "gnss:every=0",
        "gnss:every=-2",
        "gnss:every=1.5",
        "gnss:outage=5",
        "gnss:x=1",
        "gnss:outage=5-5",
        "gnss:outage=9-5",
        "gnss:outage=a-b",
        "gnss:outage=1-2-3",
    ],
)
def test_what_cannot_be_read_is_refused_with_an_example(text):
    with pytest.raises(ConfigError) as e:
        Withhold.parse(text)
    assert str(e.value) == f"--withhold: {text!r}; expected {EXPECTED}"
    assert "gnss:every=10" in EXPECTED and "gnss:outage=100-130" in EXPECTED


@pytest.mark.parametrize("name", ["imu", "lidar", "magnetometer"])
def test_only_streams_of_positions_can_be_withheld(name, session):
    with pytest.raises(ConfigError, match=f"no stream of positions '{name}'; expected one of gnss, control"):
        split(session, [f"{name}:every=2"])
    with pytest.raises(ConfigError, match="expected one of none here"):
        split(session.replace(gnss=None, control=None), ["gnss:every=2"])
