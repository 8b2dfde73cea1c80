"""The factor graph around a keyframe."""

from __future__ import annotations

import numpy as np
from recordings import make_solution, write

from smartnav_graph.estimate.result.diagnostics import Diagnostics, FactorGraphLayout
from smartnav_graph.output.rerun_log import factor_graph

# prior on the first keyframe, two inertial factors, a fix at each keyframe whose clock is a state
FACTORS = [
    ("prior", [("X", 0)]),
    ("gnss", [("X", 0), ("T", 1)]),
    ("imu", [("X", 0), ("V", 0), ("B", 0), ("X", 1), ("V", 1)]),
    ("gnss", [("X", 1), ("T", 1)]),
    ("imu", [("X", 1), ("V", 1), ("B", 1), ("X", 2), ("V", 2)]),
    ("gnss", [("X", 2), ("T", 1)]),
]


def wired():
    return FactorGraphLayout(
        sensor=np.array([sensor for sensor, _ in FACTORS]),
        factor=np.repeat(np.arange(len(FACTORS)), [len(states) for _, states in FACTORS]),
        letter=np.array([letter for _, states in FACTORS for letter, _ in states]),
        index=np.array([index for _, states in FACTORS for _, index in states]),
    )


def edges_by_name(picture):
    label = dict(zip(picture.ids, picture.labels, strict=True))
    return sorted((label[a], label[b]) for a, b in picture.edges)


def test_every_factor_is_joined_with_the_states_it_touches():
    picture = factor_graph.picture_of(FACTORS, first=0)
    assert len(picture.edges) == sum(len(states) for _, states in FACTORS)
    assert ("prior", "pose 0") in edges_by_name(picture)
    assert edges_by_name(picture).count(("gnss", "time offset")) == 3
    assert {("imu", "imu bias 1"), ("imu", "velocity 2")} <= set(edges_by_name(picture))


def test_earlier_keyframes_are_one_node():
    picture = factor_graph.picture_of(FACTORS[3:], first=2)
    assert "pose 1" not in picture.labels and "pose 2" in picture.labels
    assert edges_by_name(picture).count(("imu", "earlier")) == 1  # three states, one edge
    assert picture.labels.count("earlier") == 1


def test_no_node_lies_on_another():
    picture = factor_graph.picture_of([*FACTORS, ("image_pairs", [("X", 0), ("X", 1)])], first=0)
    assert len(set(picture.places)) == len(picture.places)
    assert len(set(picture.ids)) == len(picture.ids)
    assert {end for edge in picture.edges for end in edge} <= set(picture.ids)


def test_each_moment_shows_the_last_keyframes(tmp_path, monkeypatch):
    monkeypatch.setattr(factor_graph, "DEPTH", 2)
    t = make_solution().t_ns[:3]
    found = write(tmp_path / "run.rrd", diagnostics=Diagnostics(t, wired()))
    labels = found.rows("/graph", "GraphNodes:labels")
    assert [("pose 0" in row, "pose 2" in row) for row in labels] == [(True, False), (True, False), (False, True)]
    assert found.index("/graph", "GraphNodes:node_ids", "keyframe").tolist() == [0, 1, 2]
    assert [len(row) for row in found.rows("/graph", "GraphEdges:edges")] == [3, 10, 12]
    assert "Factor graph" in found.view_names()


def test_places_do_not_depend_on_the_order_of_a_set():
    """States with the same index: the camera's clock and its attitude."""
    factors = [("image_pairs", [("X", 0), ("T", 10), ("A", 10), ("L", 10)])]
    labels = [label for label in factor_graph.picture_of(factors, first=0).labels if label != "image_pairs"]
    assert labels == ["pose 0", "mount rotation", "lever arm", "time offset"]
