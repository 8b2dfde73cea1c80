"""Image pairs: matches drawn on the second image, coloured by their use; their number over time."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from smartnav_graph.estimate.result.diagnostics import ImagePairs
from smartnav_graph.factors.coplanarity import CONTRARY, IN_USE, REASONS
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.cameras import CameraView
from smartnav_graph.output.rerun_log.events import stops
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.session.session import Session
from smartnav_graph.vision.pairs import pairs_of_matches

# A pair that was matched but not tested.
UNTESTED = len(REASONS)


def image_pairs(session: Session, of_run: ImagePairs | None) -> ImagePairs | None:
    """The pairs of a run; of a session alone those that were matched, not tested."""
    if of_run is not None or session.matches is None:
        return of_run
    pairs = pairs_of_matches(session.matches)
    everything = np.ones(len(pairs.pair), dtype=bool)
    return ImagePairs(pairs, everything, np.full(len(pairs), UNTESTED, dtype=np.intp))


def shown(seen: ImagePairs) -> NDArray[np.intp]:
    """One pair for each second image, in time order: one in use where there is any, the shortest of those."""
    images, waste = seen.pairs.images, seen.verdict != IN_USE
    order = np.lexsort((seen.pairs.length_s, waste, images[:, 1]))
    _, first = np.unique(images[order, 1], return_index=True)
    return np.asarray(order[first])


def log_pairs(recorder: Recorder, view: CameraView, seen: ImagePairs, end_ns: int) -> None:
    """Arrows from a point in the first image to the same in the second; counts; the use of each pair as status."""
    if not len(seen.pairs):
        return
    rows = shown(seen)
    place = np.full(len(seen.pairs), -1)
    place[rows] = np.arange(len(rows))
    mine = np.flatnonzero(place[seen.pairs.pair] >= 0)
    mine = mine[np.argsort(place[seen.pairs.pair[mine]], kind="stable")]
    start, end = view.drawn(seen.pairs.x0[mine]), view.drawn(seen.pairs.x1[mine])
    columns = rr.Arrows2D.columns(origins=start, vectors=end - start, colors=_colours(seen, mine))
    times = seen.pairs.t_ns[seen.pairs.images[rows, 1]]
    path = f"{view.points}/matches"
    recorder.rows(path, times, columns.partition(seen.pairs.count[rows]))
    recorder.style(path, rr.Arrows2D.from_fields(radii=rr.Radius.ui_points(0.6)))
    recorder.clear(path, stops(times, end_ns))
    if not (seen.verdict == UNTESTED).all():
        _log_counts(recorder, seen, rows, times)


def _colours(seen: ImagePairs, rows: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Of matches: in use, rejected, of a pair that is not used for another reason, not tested."""
    verdict, use = seen.verdict[seen.pairs.pair[rows]], seen.use[rows]
    bad = ((verdict == IN_USE) & ~use) | (verdict == CONTRARY)
    kind = np.select([verdict == UNTESTED, bad, verdict == IN_USE], [3, 1, 0], 2)
    palette = np.array([colours.MATCH, colours.OUTLIER, colours.UNUSED, colours.NEUTRAL], dtype=np.uint8)
    return np.asarray(palette[kind])


def _log_counts(recorder: Recorder, seen: ImagePairs, rows: NDArray[np.intp], times: NDArray[np.int64]) -> None:
    """Matches in use and not in use of each pair shown, and why pairs are not used."""
    inside = seen.verdict == IN_USE
    used = np.bincount(seen.pairs.pair[seen.use & inside[seen.pairs.pair]], minlength=len(seen.pairs))[rows]
    counts = np.stack([used, seen.pairs.count[rows] - used], axis=1).astype(np.float64)
    recorder.rows("/pairs/matches", times, rr.Scalars.columns(scalars=counts))
    names = ["in use", "not in use"]
    style = rr.SeriesLines(colors=[colours.MATCH, colours.OUTLIER], names=names, widths=[1.5, 1.0])
    recorder.style("/pairs/matches", style)
    states = [REASONS[verdict] for verdict in seen.verdict[rows].tolist()]
    recorder.states("/status/image_pairs", times, states)
