"""Positions from the ranges of short time groups: where the initialisation has no position fixes.

Least squares in each group of at least three anchors, from the linear solution of the differences of squared ranges,
with Huber's weights. The height is hardly measured where the anchors have one height: it has a prior below them, as of
a person under anchors on walls or ceilings. Good enough to start from; the graph then uses the ranges themselves.

Source: Groves (2013), Principles of GNSS, inertial and multisensor integrated navigation systems, 7.1.4.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.graph.robust import HUBER
from smartnav_graph.session.streams import Ranges

LEAST_ANCHORS = 3
GROUP_S = 1.0  # longest group
BELOW_M, HEIGHT_SIGMA = 1.0, 3.0  # prior of the height: below the mean height of the anchors
MODEL_SIGMA = 0.5  # m, biases of the anchors and motion within a group
FLAT = 0.05  # ratio of the axes of the anchors' plan below which they are on a line
LARGEST_DILUTION = 10.0  # of a position that is used
LARGEST_MISFIT = 5.0  # sigmas, root mean square of a group that is used
ITERATIONS = 20


class Multilaterated(NamedTuple):
    """t_ns (m,) mean time of each group, position (m, 3) m of the sensor in nav axes, row (m,) its first in the stream,
    available_ns (m,) when all of it was known."""

    t_ns: Times
    position: Floats
    row: Times
    available_ns: Times


def multilaterate(ranges: Ranges, anchor: Floats, sigma: Floats) -> Multilaterated:
    """Positions of the groups whose anchors determine one; `anchor` (n, 3) m nav axes, `sigma` (n,) m.

    Raises
    ------
    SessionError
        Fewer than three anchors, anchors on a line, or no three of them heard within `GROUP_S`.
    """
    _check_plan(ranges, anchor)
    group, heard = _groups(ranges)
    count = np.bincount(group)
    slot = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(count), int(count.max()))
    places, distance, weight = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
    places[group, slot], distance[group, slot] = anchor, ranges.range_m
    weight[group, slot] = 1.0 / (sigma**2 + MODEL_SIGMA**2)
    position, good = _solve(places, distance, weight)
    good &= heard >= LEAST_ANCHORS
    if not good.any():
        raise SessionError(
            "ranges",
            f"no {LEAST_ANCHORS} anchors within {GROUP_S:g} s determine a position",
            f"{LEAST_ANCHORS} anchors around the device, heard together",
            'add anchors or position fixes, or give --initial "e,n,u,heading_deg"',
            stream="ranges",
        )
    first = np.cumsum(count) - count
    middle = np.add.reduceat(ranges.t_ns - ranges.t_ns[0], first) // count + ranges.t_ns[0]
    known = np.maximum.reduceat(ranges.available_ns, first)
    return Multilaterated(middle[good], position[good], first[good], known[good])


def _check_plan(ranges: Ranges, anchor: Floats) -> None:
    """Refuse anchors that leave the position in plan ambiguous."""
    _, rows = np.unique(ranges.anchor_id.astype(str), return_index=True)
    plan = anchor[rows, :2] - anchor[rows, :2].mean(axis=0)
    axes = np.linalg.svd(plan, compute_uv=False)
    if len(rows) >= LEAST_ANCHORS and axes[1] > FLAT * axes[0]:
        return
    few = len(rows) < LEAST_ANCHORS
    found = f"{len(rows)} anchors" if few else f"all {len(rows)} anchors on a line"
    raise SessionError(
        "ranges",
        f"{found}: the position is ambiguous",
        f"at least {LEAST_ANCHORS} anchors that are not on a line",
        'add anchors or position fixes, or give --initial "e,n,u,heading_deg"',
        stream="ranges",
    )


def _groups(ranges: Ranges) -> tuple[Times, Times]:
    """Number (n,) of the group of each row, and how many anchors (m,) each has: a group is one round of the anchors, or
    what is heard of them within `GROUP_S`."""
    group: list[int] = []
    heard: list[set[str]] = []
    begin = 0
    for anchor, t_ns in zip(ranges.anchor_id.tolist(), ranges.t_ns.tolist(), strict=True):
        whole = bool(heard) and anchor in heard[-1] and len(heard[-1]) >= LEAST_ANCHORS
        if not heard or whole or t_ns - begin >= GROUP_S * NS:
            begin = t_ns
            heard.append(set())
        heard[-1].add(anchor)
        group.append(len(heard) - 1)
    return np.array(group), np.array([len(anchors) for anchors in heard])


def _solve(anchor: Floats, distance: Floats, weight: Floats) -> tuple[Floats, Mask]:
    """Position (m, 3) of each group of anchors (m, k, 3), and which (m,) are determined and fit."""
    there = weight > 0
    total = weight.sum(axis=1, keepdims=True)
    mean = np.einsum("mk,mki->mi", weight, anchor) / total
    height = mean[:, 2] - BELOW_M
    x = np.concatenate([_linear(anchor, distance, weight / total, height), height[:, None]], axis=1)
    scale = np.ones_like(weight)
    prior = np.diag([1e-9, 1e-9, HEIGHT_SIGMA**-2])
    for _ in range(ITERATIONS):
        way = x[:, None] - anchor
        length = np.maximum(np.linalg.norm(way, axis=2), 1e-6)
        direction, residual = way / length[:, :, None], length - distance
        norm = np.abs(residual) * np.sqrt(weight)
        scale = np.where(norm > HUBER, HUBER / np.maximum(norm, HUBER), 1.0)
        normal = np.einsum("mk,mki,mkj->mij", weight * scale, direction, direction) + prior
        slope = np.einsum("mk,mki,mk->mi", weight * scale, direction, residual)
        slope[:, 2] += prior[2, 2] * (x[:, 2] - height)
        x = x - np.linalg.solve(normal, slope[:, :, None])[:, :, 0]
    plan = np.linalg.inv(normal)[:, :2, :2]
    dilution = np.sqrt(np.trace(plan, axis1=1, axis2=2) * total[:, 0] / there.sum(axis=1))
    misfit = np.sqrt((weight * scale * residual**2).sum(axis=1) / there.sum(axis=1))
    return x, np.isfinite(x).all(axis=1) & (dilution < LARGEST_DILUTION) & (misfit < LARGEST_MISFIT)


def _linear(anchor: Floats, distance: Floats, share: Floats, height: Floats) -> Floats:
    """Plan position (m, 2) at a known height (m,): differences of squared ranges to their mean are linear in it."""
    mean = np.einsum("mk,mki->mi", share, anchor)
    away = anchor - mean[:, None]
    square = distance**2 - (anchor**2).sum(axis=2)
    right = square - (share * square).sum(axis=1, keepdims=True) + 2.0 * away[:, :, 2] * height[:, None]
    normal = np.einsum("mk,mki,mkj->mij", share, away[:, :, :2], away[:, :, :2]) + 1e-9 * np.eye(2)
    slope = np.einsum("mk,mki,mk->mi", share, away[:, :, :2], right)
    return np.asarray(np.linalg.solve(normal, -0.5 * slope[:, :, None])[:, :, 0])
