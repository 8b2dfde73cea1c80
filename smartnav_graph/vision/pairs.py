"""Matched points of many image pairs side by side, padded to one length so that all pairs are treated at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.streams import Matches, Tracks

Ints = NDArray[np.intp]

# Images closer than this share of the spacing asked for count as far enough apart: stamps jitter.
NEARLY = 0.95


@dataclass(frozen=True)
class Pairs:
    """Pairs of images of one camera.

    t_ns (k,) : stamps of the images, in time order; images (n, 2) : places of the first and second image of each pair
    x0, x1 (m, 2) : undistorted normalised coordinates; pair (m,) : of each match, ascending
    shift (m, 3) : what the baseline of each match has beyond that of its pair, m in the axes of the first camera: their
    rows were not seen at the time of the image
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
        """Match (n, k) behind each place of the padded arrays, -1 behind empty ones."""
        first = np.concatenate([[0], np.cumsum(self.count)])[:-1]
        place = np.arange(max(int(self.count.max(initial=0)), 1))
        return np.where(place < self.count[:, None], first[:, None] + place, -1)

    @cached_property
    def there(self) -> NDArray[np.bool_]:
        """Mask (n, k) of the places that hold a match."""
        return self.slots >= 0

    @cached_property
    def matches(self) -> tuple[Floats, Floats, Floats | None]:
        """x0, x1 (n, k, 2) and shift (n, k, 3), padded."""
        x0, x1 = (np.asarray(self.padded(x)) for x in (self.x0, self.x1))
        return x0, x1, None if self.shift is None else np.asarray(self.padded(self.shift))

    def of(self, rows: Ints) -> Pairs:
        """Some of the pairs, in ascending order."""
        chosen = np.isin(self.pair, rows)
        pair = np.searchsorted(rows, self.pair[chosen])
        shift = None if self.shift is None else self.shift[chosen]
        return Pairs(self.t_ns, self.images[rows], self.x0[chosen], self.x1[chosen], pair, shift)

    def padded(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """One value or row a match (m, ...) as (n, k, ...); zero in empty places."""
        if not len(values):
            return np.zeros((*self.slots.shape, *values.shape[1:]), dtype=values.dtype)
        return np.where(self.there.reshape(*self.there.shape, *[1] * (values.ndim - 1)), values[self.slots], 0)

    def flat(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """The inverse of `padded`."""
        return values[self.there]


def of_matches(matches: Matches) -> Pairs:
    """Pairs as they were matched; the later image is the second."""
    turned = matches.t_1_ns < matches.t_ns
    early, late = np.where(turned, matches.t_1_ns, matches.t_ns), np.where(turned, matches.t_ns, matches.t_1_ns)
    x0 = np.where(turned[:, None], matches.xy1_n, matches.xy0_n)
    x1 = np.where(turned[:, None], matches.xy0_n, matches.xy1_n)
    moved = early != late
    stamps = np.unique(np.concatenate([early[moved], late[moved]]))
    both = np.stack([np.searchsorted(stamps, early[moved]), np.searchsorted(stamps, late[moved])], axis=1)
    images, pair = np.unique(both[:, ::-1], axis=0, return_inverse=True)  # by the second image: the order of a replay
    order = np.argsort(pair.ravel(), kind="stable")
    rows = np.flatnonzero(moved)[order]
    return Pairs(stamps, images[:, ::-1].astype(np.intp), x0[rows], x1[rows], pair.ravel()[order].astype(np.intp))


def of_tracks(tracks: Tracks, rate_hz: float, spans: Sequence[int]) -> Pairs:
    """What images `spans` apart have in common, of images at most `rate_hz` a second."""
    stamps = _thinned(np.unique(tracks.t_ns), rate_hz)
    chosen = np.flatnonzero(np.isin(tracks.t_ns, stamps))
    image = np.searchsorted(stamps, tracks.t_ns[chosen])
    order = np.lexsort((tracks.track_id[chosen], image))
    image, track, xy = image[order], tracks.track_id[chosen][order], tracks.xy_n[chosen][order]
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


def _thinned(stamps: NDArray[np.int64], rate_hz: float) -> NDArray[np.int64]:
    """Stamps at most `rate_hz` a second."""
    least, kept = NEARLY * NS / rate_hz, list[int]()
    for stamp in stamps.tolist():
        if not kept or stamp - kept[-1] >= least:
            kept.append(stamp)
    return np.array(kept, dtype=np.int64)
