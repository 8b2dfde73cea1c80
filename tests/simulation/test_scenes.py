"""Rooms: points on faces, and walls that hide."""

from __future__ import annotations

import numpy as np
import pytest

from smartnav_graph.core.errors import ConfigError
from smartnav_graph.simulation import scenes
from smartnav_graph.simulation.scenes import Box, CorridorGrid, FurnishedRoom

ROOM = Box((0.0, 0.0, 0.0), (8.0, 6.0, 3.0), inward=True)


def made(*boxes: Box, per_m2: float = 10.0) -> scenes.Scene:
    return scenes.make_scene(boxes, per_m2, np.random.default_rng(1))


def test_points_lie_evenly_on_their_faces():
    scene = made(ROOM)
    area = 2 * (8 * 6 + 8 * 3 + 6 * 3)
    assert len(scene.points) == pytest.approx(10 * area, abs=4 * np.sqrt(10 * area))
    on = (np.abs(scene.points) < 1e-12) | (np.abs(scene.points - [8.0, 6.0, 3.0]) < 1e-12)
    assert on.any(axis=1).all()
    offset = np.einsum("ni,ni->n", scene.points - scene.corner[scene.face], scene.normal[scene.face])
    np.testing.assert_allclose(offset, 0.0, atol=1e-12)


def test_inside_an_empty_room_everything_is_seen():
    scene = made(ROOM)
    everything = np.arange(len(scene.points))
    np.testing.assert_array_equal(scene.seen_from(np.array([4.0, 3.0, 1.0]), everything), everything)


def test_a_pillar_throws_its_shadow():
    """A camera 2 m before a pillar 1 m wide: its shadow on the wall, 6 m away from the camera, is 3 m wide."""
    scene = made(ROOM, Box((2.0, 2.5, 0.0), (2.5, 3.5, 3.0)))
    seen = scene.seen_from(np.array([0.0, 3.0, 1.5]), np.arange(len(scene.points)))
    wall = scene.points[scene.points[:, 0] == 8.0]
    shown = scene.points[seen]
    shown = shown[shown[:, 0] == 8.0]
    half = 0.5 * 8.0 / 2.0
    assert len(shown) == (np.abs(wall[:, 1] - 3.0) > half).sum() > 0
    assert np.abs(shown[:, 1] - 3.0).min() > half
    pillar = scene.face >= 6
    assert (scene.points[seen][pillar[seen], 0] == 2.0).all()  # its front, neither sides nor back


def test_nobody_sees_the_corridor_behind_a_block():
    scene = CorridorGrid(nodes=(2, 2), spacing_m=20.0, cupboards=0)(np.random.default_rng(0))
    seen = scene.points[scene.seen_from(np.array([10.0, 0.0, 0.0]), np.arange(len(scene.points)))]
    # past the block's corner 8.5 m along and 1.5 m aside to the outer wall 11.5 m along
    assert seen[:, 1].max() == pytest.approx(1.5 * 11.5 / 8.5, abs=0.1)
    assert not ((seen[:, 1] > 1.5 + 1e-9) & (np.abs(seen[:, 0] - 10.0) < 8.0)).any()


def test_no_point_lies_under_a_block_or_behind_a_cupboard():
    scene = CorridorGrid(nodes=(2, 3), spacing_m=10.0)(np.random.default_rng(0))
    flat = np.abs(scene.points[:, 2] + 1.0) < 1e-12
    under = flat & (scene.points[:, 0] > 1.5) & (scene.points[:, 0] < 8.5) & (scene.points[:, 1] % 10 > 1.5)
    assert not (under & (scene.points[:, 1] % 10 < 8.5)).any()


def test_furniture_leaves_the_middle_free():
    scene = FurnishedRoom((8.0, 6.0, 3.0))(np.random.default_rng(2))
    inside = (
        (np.abs(scene.points[:, 0]) < 3.3) & (np.abs(scene.points[:, 1]) < 2.3) & (np.abs(scene.points[:, 2]) < 1.49)
    )
    assert not inside.any()
    assert len(scene.corner) == 36


def test_a_flat_box_is_refused():
    with pytest.raises(ConfigError, match="expected every side longer than zero"):
        Box((0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
