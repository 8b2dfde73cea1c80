"""A standstill that is none: dropped where the solution moves in it, kept where it does not."""

import numpy as np
import pytest
from sessions import recorded, rms, truth

import smartnav_graph as sn
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import StaticPeriod


def listed(session: sn.Session, begin_s: float, end_s: float) -> sn.Session:
    """With a listed standstill, and no fix around it that could refute it."""
    begin, end = (session.t0_ns + round(s * NS) for s in (begin_s, end_s))
    kept = (session.gnss.t_ns < begin - NS) | (session.gnss.t_ns > end + NS)
    return session.replace(gnss=session.gnss.take(kept), static=StaticPeriod(t_ns=[begin], t_end_ns=[end]))


def refuted(run: sn.Run) -> list[str]:
    return [text for text in run.summary["warnings"] if "the solution moves" in text]


def test_a_false_standstill_is_dropped():
    session = recorded(seconds=60.0)
    begin = session.t0_ns + 30 * NS
    assert np.linalg.norm(truth(session, [begin])[2]) > 0.5  # m/s
    run = sn.run(listed(session, 30.0, 36.0))
    assert len(refuted(run)) == 1 and "30.0 to 36.0 s" in refuted(run)[0]
    plain = sn.run(listed(session, 30.0, 36.0).replace(static=None))
    assert rms(session, run.solution)[0] < 1.1 * rms(session, plain.solution)[0] + 0.01


@pytest.mark.parametrize("seed", range(2))
def test_true_standstills_are_kept(seed):
    run = sn.run(sn.simulate("trolley-loop", seed))
    assert run.summary["standstills"]["count"] > 2 and not refuted(run) and not run.pass_state.refuted


def test_a_true_standstill_without_fixes_is_kept():
    session = recorded(seconds=60.0)
    rests = session.static
    end = float(rests.t_end_ns[0] - session.t0_ns) / NS if rests is not None else 4.0
    assert not refuted(sn.run(listed(session, 0.0, end - 0.5)))
