"""Matched points of many image pairs, padded to one length so that all pairs are computed at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import Matches, Tracks

Ints = NDArray[np.intp]

# Smallest spacing of images over that of the rate: stamps jitter.
NEARLY = 0.95


@dataclass(frozen=True)
class Pairs:
    """Pairs of images of one camera.

    t_ns (k,) : stamps of the images, in time order; images (n, 2) : index of the first and second image of each pair
    x0, x1 (m, 2) : undistorted normalised coordinates; pair (m,) : of each match, ascending
    shift (m, 3) : baseline of each match less that of its pair, m in the axes of the first camera (rolling shutter: its
    rows were not exposed at the time of the image)
    """

    t_ns: NDArray[np.int64]
    images: Ints
    x0: Floats
    x1: Floats
    pair: Ints
    shift: Floats | None = None

    def __len__(self) -> int:
        return len(self.images)

    @cached_property
    def count(self) -> Ints:
        """Matches (n,) of each pair."""
        return np.bincount(self.pair, minlength=len(self)).astype(np.intp)

    @cached_property
    def length_s(self) -> Floats:
        """Time (n,) between the images of each pair."""
        return np.asarray((self.t_ns[self.images[:, 1]] - self.t_ns[self.images[:, 0]]) / NS)

    @cached_property
    def slots(self) -> Ints:
        """Index (n, k) of the match of each entry of the padded arrays, -1 of empty ones."""
        first = np.concatenate([[0], np.cumsum(self.count)])[:-1]
        place = np.arange(max(int(self.count.max(initial=0)), 1))
        return np.where(place < self.count[:, None], first[:, None] + place, -1)

    @cached_property
    def there(self) -> NDArray[np.bool_]:
        """Mask (n, k) of the entries that hold a match."""
        return self.slots >= 0

    @cached_property
    def matches(self) -> tuple[Floats, Floats, Floats | None]:
        """x0, x1 (n, k, 2) and shift (n, k, 3), padded."""
        x0, x1 = (np.asarray(self.padded(x)) for x in (self.x0, self.x1))
        return x0, x1, None if self.shift is None else np.asarray(self.padded(self.shift))

    def of(self, rows: Ints) -> Pairs:
        """Some of the pairs, in ascending order."""
        mine = np.isin(self.pair, rows)
        pair = np.searchsorted(rows, self.pair[mine])
        shift = None if self.shift is None else self.shift[mine]
        return Pairs(self.t_ns, self.images[rows], self.x0[mine], self.x1[mine], pair, shift)

    def until(self, t_ns: int) -> Pairs:
        """The pairs whose second image is no later."""
        return self.of(np.flatnonzero(self.t_ns[self.images[:, 1]] <= t_ns))

    def padded(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """One value or row a match (m, ...) as (n, k, ...); zero in empty entries."""
        if not len(values):
            return np.zeros((*self.slots.shape, *values.shape[1:]), dtype=values.dtype)
        return np.where(self.there.reshape(*self.there.shape, *[1] * (values.ndim - 1)), values[self.slots], 0)

    def flat(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """The inverse of `padded`."""
        return values[self.there]


def pairs_of_matches(matches: Matches) -> Pairs:
    """Pairs as they were matched; the later image is the second."""
    swap = matches.t_1_ns < matches.t_ns
    early, late = np.minimum(matches.t_ns, matches.t_1_ns), np.maximum(matches.t_ns, matches.t_1_ns)
    x0 = np.where(swap[:, None], matches.xy1_n, matches.xy0_n)
    x1 = np.where(swap[:, None], matches.xy0_n, matches.xy1_n)
    apart = early != late
    stamps = np.unique(np.concatenate([early[apart], late[apart]]))
    both = np.stack([np.searchsorted(stamps, early[apart]), np.searchsorted(stamps, late[apart])], axis=1)
    images, pair = np.unique(both[:, ::-1], axis=0, return_inverse=True)  # by the second image: the order of a replay
    order = np.argsort(pair.ravel(), kind="stable")
    rows = np.flatnonzero(apart)[order]
    return Pairs(stamps, images[:, ::-1].astype(np.intp), x0[rows], x1[rows], pair.ravel()[order].astype(np.intp))


def pairs_of_tracks(tracks: Tracks, rate_hz: float, spans: Sequence[int]) -> Pairs:
    """Common tracks of images that are `spans` apart, of images at most `rate_hz` a second."""
    stamps = np.unique(tracks.t_ns)
    stamps = stamps[rows_at_rate(stamps, rate_hz)]
    seen = np.flatnonzero(np.isin(tracks.t_ns, stamps))
    image = np.searchsorted(stamps, tracks.t_ns[seen])
    order = np.lexsort((tracks.track_id[seen], image))
    image, track, xy = image[order], tracks.track_id[seen][order], tracks.xy_n[seen][order]
    edges = np.searchsorted(image, np.arange(len(stamps) + 1))
    images: list[tuple[int, int]] = []
    rows: list[tuple[Ints, Ints]] = []
    for second in range(len(stamps)):
        for span in spans:
            if second < span:
                continue
            a, b = (slice(edges[i], edges[i + 1]) for i in (second - span, second))
            _, left, right = np.intersect1d(track[a], track[b], assume_unique=True, return_indices=True)
            if len(left):
                images.append((second - span, second))
                rows.append((left + a.start, right + b.start))
    if not rows:
        return Pairs(stamps, np.zeros((0, 2), np.intp), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.intp))
    pair = np.repeat(np.arange(len(rows)), [len(left) for left, _ in rows])
    left, right = (np.concatenate([both[i] for both in rows]) for i in range(2))
    return Pairs(stamps, np.array(images, dtype=np.intp), xy[left], xy[right], pair)


def rows_at_rate(t_ns: Times, rate_hz: float) -> Ints:
    """Rows of ascending stamps (n,) such that there are at most `rate_hz` a second."""
    least, rows, last = NEARLY * NS / rate_hz, list[int](), -(2**62)
    for row, stamp in enumerate(t_ns.tolist()):
        if stamp - last >= least:
            rows.append(row)
            last = stamp
    return np.array(rows, dtype=np.intp)
