"""A replay as it went, with what differs from run to run in a file of its own."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
from recordings import EVALUATION, N, Recording, make_session, make_solution, replayed, updates, write

from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.output.rerun_log import replays, viewer, write_latency


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return write(tmp_path_factory.mktemp("replay") / "run.rrd", causal=causal(), diagnostics=replayed())


def causal():
    solution = make_solution()
    return make_solution(nav_t_body=solution.nav_t_body + 1.0)


def test_each_update_has_its_window(found):
    rows = found.rows("/world/causal/window", "LineStrips3D:strips")
    assert len(rows) == N
    expected = updates()
    for k in (0, 1, 7, N - 1):
        window = expected.past[expected.edge[k] : expected.edge[k + 1]]
        np.testing.assert_array_equal(np.array(rows[k][0]), window.astype(np.float32))
    stamps = found.index("/world/causal/window", "LineStrips3D:strips", "keyframe")
    np.testing.assert_array_equal(stamps, np.arange(N))


def test_causal_estimate_of_the_moment_with_its_ellipsoid(found):
    now = found.values("/world/causal/now", "Points3D:positions")[:, 0]
    np.testing.assert_array_equal(now, causal().nav_t_body.astype(np.float32))
    centres = found.values("/world/causal/covariance", "Ellipsoids3D:centers")[:, 0]
    np.testing.assert_array_equal(centres, now)


def test_updates_have_effort_change_and_rejections(found):
    effort = found.values("/update/effort", "Scalars:scalars")
    np.testing.assert_array_equal(effort, np.column_stack([np.arange(N), 2 * np.arange(N)]))
    np.testing.assert_array_equal(found.values("/update/change", "Scalars:scalars")[:, 0], updates().corrected)
    assert found.index("/update/rejected", "Scalars:scalars", "keyframe").tolist() == [0, 10, 20, 30]
    assert {
        "Updates: states (latency ms in latency.rrd)",
        "Change of earlier states m",
        "Rejected measurements by update",
    } <= set(found.view_names())


def test_a_long_window_is_thinned_to_its_ends():
    kept = replays._some(100, 1100)
    assert len(kept) == replays.MOST_POINTS and kept[0] == 100 and kept[-1] == 1099
    assert replays._some(3, 6).tolist() == [3, 4, 5]


def test_latency_stands_in_a_recording_beside_that_the_viewer_joins(tmp_path):
    """Two replays of the same session differ in nothing but their wall times: run.rrd compares equal."""
    slow = replayed(latency_ms=np.full(N, 50.0))
    one = write(tmp_path / "one.rrd", causal=causal(), diagnostics=replayed())
    other = write(tmp_path / "other.rrd", causal=causal(), diagnostics=slow)
    assert one.identity == other.identity
    binary = str(viewer.executable())
    command = [binary, "rrd", "compare", str(tmp_path / "one.rrd"), str(tmp_path / "other.rrd")]
    compared = subprocess.run(command, capture_output=True, text=True)
    assert compared.returncode == 0, compared.stderr
    assert "/update/latency" not in one.paths
    write_latency(tmp_path / "latency.rrd", session=make_session(), diagnostics=slow, identity=one.identity)
    beside = Recording(tmp_path / "latency.rrd")
    assert (beside.identity, beside.application) == (one.identity, one.application)
    np.testing.assert_array_equal(beside.values("/update/latency", "Scalars:scalars"), np.full((N, 1), 50.0))
    names = {name for chunk in beside.chunks if not chunk.is_static for name in chunk.timeline_names}
    assert names == {"elapsed", "utc", "keyframe"}


@pytest.mark.parametrize("name", sorted(set(Updates.__dataclass_fields__) - {"latency_ms", "t_ns", "edge", "states"}))
def test_identity_follows_all_else_of_the_updates(tmp_path, found, name):
    changed = getattr(updates(), name).copy()
    changed[5] += 1
    other = write(tmp_path / "run.rrd", causal=causal(), diagnostics=replayed(**{name: changed}), evaluation=EVALUATION)
    assert other.identity != found.identity
