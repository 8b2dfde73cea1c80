"""Rooms and corridors made of rectangles, the points scattered on them, and what a camera can see of both.

A face is a rectangle corner + a u + b v, 0 <= a, b <= 1, seen from the side its normal u x v points to. Faces hide what
lies behind them. All positions are nav metres (ENU).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Mask
from smartnav_graph.core.errors import ConfigError

# Share of the way to a point within which another face hides it; the point itself lies on a face.
_BEFORE = 1.0 - 1e-6
# Metres before a face that must be free, or its points are not visible.
_CLEAR_M = 1e-6
# Every point is seen from `_NEAR_M`; from twice as far, half of them.
_NEAR_M, _FAR_M = 4.0, 100.0


@dataclass(frozen=True)
class Box:
    """An upright cuboid from corner `low` to corner `high` (east, north, up m); `inward`: seen from inside (a room)."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    inward: bool = False

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ConfigError("scene", f"box from {self.low} to {self.high}", "every side longer than zero")


@dataclass(frozen=True)
class Scene:
    """Faces with `corner`, `u`, `v` (f, 3) m; `points` (n, 3) m on the faces numbered `face` (n,), which are visible up
    to a distance of `visible_m` (n,) m."""

    corner: Floats
    u: Floats
    v: Floats
    points: Floats
    face: Indices
    visible_m: Floats

    @cached_property
    def normal(self) -> Floats:
        """Unit normals (f, 3) of the faces, towards the visible side."""
        normal = np.cross(self.u, self.v)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))

    def near(self, centre: Floats, range_m: float) -> Indices:
        """Points within `range_m`, and within their visible_m, of a place (3,), in their order."""
        rows = np.flatnonzero(np.abs(self._east - centre[0]) < range_m)
        away = self.points[rows] - centre
        return np.asarray(rows[np.einsum("ni,ni->n", away, away) < np.minimum(self.visible_m[rows], range_m) ** 2])

    @cached_property
    def _east(self) -> Floats:
        return np.ascontiguousarray(self.points[:, 0])

    def seen_from(self, centre: Floats, rows: Indices) -> Indices:
        """Those of the points `rows` that no face hides from a camera at `centre` (3,), and that face it."""
        ahead = np.einsum("ni,ni->n", centre - self.points[rows], self.normal[self.face[rows]]) > 0.0
        return self._unhidden(centre, rows[ahead])

    def _unhidden(self, centre: Floats, rows: Indices) -> Indices:
        """Those without another face in between; a closed box hides by one of its visible faces."""
        height = np.einsum("fi,fi->f", centre - self.corner, self.normal)
        middle, size = self.corner + (self.u + self.v) / 2, np.linalg.norm(self.u + self.v, axis=1) / 2
        away = np.linalg.norm(middle - centre, axis=1) - size
        way = self.points[rows] - centre
        for f in np.argsort(away, kind="stable"):
            if height[f] <= 0.0:
                continue
            down = -way @ self.normal[f]
            share = height[f] / np.where(down > 0.0, down, np.inf)
            at = share[:, None] * way + (centre - self.corner[f])
            a, b = (at @ (edge / (edge @ edge)) for edge in (self.u[f], self.v[f]))
            hidden = (share < _BEFORE) & (down > 0.0) & (a >= 0.0) & (a <= 1.0) & (b >= 0.0) & (b <= 1.0)
            rows, way = rows[~hidden], way[~hidden]
        return rows


def make_scene(boxes: Sequence[Box], per_m2: float, rng: np.random.Generator) -> Scene:
    """The faces of the boxes, with `per_m2` points per square metre scattered evenly where nothing covers them."""
    faces = np.concatenate([_faces(box) for box in boxes])
    corner, u, v = faces[:, 0], faces[:, 1], faces[:, 2]
    area = np.linalg.norm(np.cross(u, v), axis=1)
    face = np.repeat(np.arange(len(area)), rng.poisson(per_m2 * area))
    a, b = rng.random((2, len(face), 1))
    visible_m = _NEAR_M / np.maximum(rng.random(len(face)), _NEAR_M / _FAR_M)
    scene = Scene(corner, u, v, corner[face] + a * u[face] + b * v[face], face, visible_m)
    free = _free(scene.points + _CLEAR_M * scene.normal[face], boxes)
    return Scene(corner, u, v, scene.points[free], face[free], visible_m[free])


def _free(points: Floats, boxes: Sequence[Box]) -> Mask:
    """Mask of the places (n, 3) inside a room and outside of every solid box."""
    room, solid = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    for box in boxes:
        within = ((points >= box.low) & (points <= box.high)).all(axis=1)
        if box.inward:
            room |= within
        else:
            solid |= within
    return room & ~solid


def _faces(box: Box) -> Floats:
    """Corner, u and v (6, 3, 3) of the faces of a box."""
    low, high = np.array(box.low), np.array(box.high)
    edges = np.diag(high - low)
    faces = []
    for axis in range(3):
        u, v = edges[(axis + 1) % 3], edges[(axis + 2) % 3]
        for corner, outward in ((low, -1.0), (low + edges[axis], 1.0)):
            faces.append((corner, u, v) if (outward > 0) != box.inward else (corner, v, u))
    return np.array(faces)


@dataclass(frozen=True)
class FurnishedRoom:
    """A room of `size_m` (east, north, up) about `centre_m`, with five pieces of furniture along its walls and `per_m2`
    points per square metre."""

    size_m: tuple[float, float, float] = (8.0, 6.0, 3.0)
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    per_m2: float = 6.0

    def __call__(self, rng: np.random.Generator) -> Scene:
        half = np.array(self.size_m) / 2
        low, high = np.array(self.centre_m) - half, np.array(self.centre_m) + half
        boxes = [Box(_triple(low), _triple(high), inward=True)]
        for k in range(5):
            size = rng.uniform(0.6, 1.4), rng.uniform(0.3, 0.6), rng.uniform(0.6, 1.8)
            boxes.append(_along_wall(low, high, k % 4, rng.uniform(0.15, 0.75), size))
        return make_scene(boxes, self.per_m2, rng)


@dataclass(frozen=True)
class CorridorGrid:
    """Corridors of `width_m` along the lines of a grid of `nodes` (east, north) crossings, `spacing_m` apart, with
    blocks of rooms between them, and cupboards along the outer walls.

    The crossing at `origin` (east, north) of the grid lies at the nav origin; floor and ceiling are at `floor_m` and
    `ceiling_m`. `per_m2` points per square metre.
    """

    nodes: tuple[int, int]
    spacing_m: float
    origin: tuple[int, int] = (0, 0)
    width_m: float = 3.0
    floor_m: float = -1.0
    ceiling_m: float = 2.0
    cupboards: int = 16
    per_m2: float = 12.0

    def __call__(self, rng: np.random.Generator) -> Scene:
        half = self.width_m / 2
        lines = [(np.arange(n) - at) * self.spacing_m for n, at in zip(self.nodes, self.origin, strict=True)]
        low = np.array([lines[0][0] - half, lines[1][0] - half, self.floor_m])
        high = np.array([lines[0][-1] + half, lines[1][-1] + half, self.ceiling_m])
        boxes = [Box(_triple(low), _triple(high), inward=True)]
        for west in lines[0][:-1]:
            for south in lines[1][:-1]:
                east, north = west + self.spacing_m - self.width_m, south + self.spacing_m - self.width_m
                low_corner = (float(west + half), float(south + half), self.floor_m)
                boxes.append(Box(low_corner, (float(east + half), float(north + half), self.ceiling_m)))
        for k in range(self.cupboards):
            size = rng.uniform(0.8, 2.0), 0.35, rng.uniform(0.8, 2.0)
            boxes.append(_along_wall(low, high, k % 4, rng.uniform(0.05, 0.95), size))
        return make_scene(boxes, self.per_m2, rng)


def _along_wall(low: Floats, high: Floats, side: int, share: float, size: tuple[float, float, float]) -> Box:
    """A piece of furniture of `size` (wide, deep, tall) that begins at `share` of a wall (south, east, north, west)."""
    wide, deep, tall = size
    along, across = (0, 1) if side in (0, 2) else (1, 0)
    a, b = low.copy(), high.copy()
    a[along] = low[along] + share * (high[along] - low[along] - wide)
    b[along] = a[along] + wide
    a[across], b[across] = (low[across], low[across] + deep) if side in (0, 3) else (high[across] - deep, high[across])
    b[2] = low[2] + tall
    return Box(_triple(a), _triple(b))


def _triple(values: Floats) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
