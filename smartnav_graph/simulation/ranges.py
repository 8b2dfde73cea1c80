"""Ranges to anchors and their errors: white noise, a bias for each anchor, detours of radio waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Times
from smartnav_graph.core.frames import LocalFrame
from smartnav_graph.session.streams import Ranges
from smartnav_graph.simulation.trajectory import Truth

# Corners of a hall, two metres and more over the device.
HALL = ((-16.0, -8.0, 2.0), (5.0, -8.0, 3.0), (5.0, 8.0, 2.0), (-16.0, 8.0, 3.0))


@dataclass(frozen=True)
class RangeModel:
    """Two-way ranging at `rate_hz` with all `anchors` (e, n, u m) at once: white noise and bias of an anchor, sigma m;
    a share of `detours` is longer by `detour_m` (least, most)."""

    anchors: tuple[tuple[float, float, float], ...] = HALL
    rate_hz: float = 2.0
    sigma_m: float = 0.1
    bias_sigma_m: float = 0.2
    detours: float = 0.0
    detour_m: tuple[float, float] = (2.0, 8.0)
    body_t_sensor: tuple[float, float, float] = (0.0, 0.0, 0.0)


def ranges(truth: Truth, t_ns: Times, model: RangeModel, frame: LocalFrame, rng: np.random.Generator) -> Ranges:
    """Ranges at `truth`, one row an epoch and anchor. Column `is_outlier` (kept in `extra`) marks detours with 1."""
    anchors, n = np.array(model.anchors), len(model.anchors)
    bias = model.bias_sigma_m * rng.standard_normal(n)
    sensor = truth.nav_t_body + truth.nav_R_body @ np.asarray(model.body_t_sensor)
    distance = np.linalg.norm(sensor[:, None] - anchors, axis=2)
    detour = rng.random(distance.shape) < model.detours
    error = (
        bias
        + model.sigma_m * rng.standard_normal(distance.shape)
        + detour * rng.uniform(*model.detour_m, distance.shape)
    )
    return Ranges(
        t_ns=np.repeat(t_ns, n),
        anchor_id=np.tile(np.array([f"A{i}" for i in range(n)], dtype=object), len(t_ns)),
        range_m=np.maximum(distance + error, 0.0).ravel(),
        sigma=np.full(distance.size, model.sigma_m),
        lla=np.tile(frame.lla_from_nav(anchors), (len(t_ns), 1)),
        extra={"is_outlier": detour.ravel().astype(np.int64)} if model.detours else {},
    )
