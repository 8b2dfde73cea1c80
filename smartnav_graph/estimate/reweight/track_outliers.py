"""Which tracks, and which of their observations, an estimate believes.

Points are found at its states, and what disagrees with most of a track is left out: once at the solution that image
pairs (or inertial data and fixes alone) gave, once more at that with tracks. Where too few tracks agree, none is used,
and the pairs stay.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.so3 import exp
from smartnav_graph.estimate.reweight.image_pair_outliers import Account, camera_states
from smartnav_graph.factors.coplanarity import COMPRESSED, CoplanarityBuilder
from smartnav_graph.factors.smart import (
    CONTRARY,
    FEW,
    FLAT,
    IN_USE,
    LEAST_SEEN,
    OUTSIDE,
    REASONS,
    SmartBuilder,
    TrackSelection,
)
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import Builder, one_of
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.vision.points import Cameras, TrackPoints, triangulate

# Passes that test tracks.
ROUNDS = 2
# Share of its observations that a track must keep, and of tracks that must be kept for any to be used.
LEAST_SHARE = 0.5
# What a point takes of its observations.
POINT_DOF = 3
# Sigma of an observation beside that of its class: least and most.
SCALES = (0.3, 3.0)


def check_tracks(builders: Iterable[Builder], estimate: Estimate, pass_state: PassState) -> PassState:
    """The pass state with the tracks that agree with an estimate; unchanged until pairs are all tested, and once tracks
    are."""
    builder, pairs = one_of(builders, SmartBuilder), one_of(builders, CoplanarityBuilder)
    if builder is None or builder.selection(pass_state).refused or pass_state.tests(builder.name) >= ROUNDS:
        return pass_state
    if pairs is not None and (pass_state.tests(pairs.name) < COMPRESSED or pairs.selection(pass_state).refused):
        return pass_state
    tests, seen, before = pass_state.tests(builder.name), builder.sightings, builder.selection(pass_state)
    if not tests:
        before = replace(before, boresight=camera_states(builder.camera_model, estimate)[1])
    views = _views(builder, before, estimate)
    use = seen.there & views.known
    points = triangulate(seen, views.then, builder.sigma * pass_state.scale(builder.name), use)
    verdict = _verdict(builder, use, points)
    selection = replace(
        before,
        use=points.inside,
        xy=seen.xy + views.keyframe.project(points.point) - views.then.project(points.point),
        verdict=verdict,
        refused=_refusal(verdict),
    )
    pass_state = replace(pass_state, selections={**pass_state.selections, builder.name: selection})
    if selection.refused:
        return _without(builder, pass_state)
    states = [estimate.session[s.name] for s in builder.camera_model.states().values() if s.name in estimate.session]
    return replace(
        pass_state,
        fixed_states={**pass_state.fixed_states, **{state.name: state.value for state in states}},
        noise_scales={**pass_state.noise_scales, builder.name: _scale(builder, verdict, points)},
        outlier_tests={**pass_state.outlier_tests, builder.name: tests + 1},
    )


def _without(builder: SmartBuilder, pass_state: PassState) -> PassState:
    """The pass state with image pairs in use again, and the camera's states free."""
    names = {state.name for state in builder.camera_model.states().values()}
    return replace(
        pass_state,
        fixed_states={name: value for name, value in pass_state.fixed_states.items() if name not in names},
        outlier_tests={name: count for name, count in pass_state.outlier_tests.items() if name != builder.name},
    )


class _Views(NamedTuple):
    """Cameras at the keyframes of all observations, the same when these were made, and which have a keyframe (n, l)."""

    keyframe: Cameras
    then: Cameras
    known: Mask


def _views(builder: SmartBuilder, selection: TrackSelection, estimate: Estimate) -> _Views:
    seen, stamps = builder.sightings, builder.image_ns
    place, known = estimate.keyframes_at(stamps, builder.merge_ns)
    known[1:] &= place[1:] != place[:-1]  # one image a keyframe
    R, p, v, bias = (x[place][seen.image.ravel()] for x in estimate.states())
    delay = camera_states(builder.camera_model, estimate)[0] + builder.camera_model.delay(seen.xy.reshape(-1, 2))
    turn = builder.rates.turn(stamps[seen.image.ravel()], delay) - bias[:, 3:] * delay[:, None]
    later, on = R @ exp(turn), p + v * delay[:, None]
    at_once, then = (_camera(builder, selection, *pose) for pose in ((R, p), (later, on)))
    return _Views(at_once, then, known[seen.image])


def _camera(builder: SmartBuilder, selection: TrackSelection, R: Floats, p: Floats) -> Cameras:
    """Cameras of bodies at R (n l, 3, 3), p (n l, 3)."""
    shape = builder.sightings.image.shape
    place = p + R @ builder.camera_model.rig.body_t_cam
    return Cameras((R @ builder.body_R_cam(selection)).reshape(*shape, 3, 3), place.reshape(*shape, 3))


def _verdict(builder: SmartBuilder, use: Mask, points: TrackPoints) -> NDArray[np.intp]:
    """What becomes of each track (n,), of its observations in the stretch (n, l)."""
    asked, kept = use.sum(axis=1), points.inside.sum(axis=1)
    cases = {
        OUTSIDE: (asked < LEAST_SEEN) & (builder.sightings.count >= LEAST_SEEN),
        CONTRARY: (asked >= LEAST_SEEN) & (kept < LEAST_SHARE * asked),
        FEW: kept < LEAST_SEEN,
        FLAT: points.parallax < builder.config.least_parallax,
    }
    return np.select(list(cases.values()), list(cases), IN_USE).astype(np.intp)


def _refusal(verdict: NDArray[np.intp]) -> str:
    """Why no track is to be used; empty where they are."""
    kept, asked = int((verdict == IN_USE).sum()), int(np.isin(verdict, [IN_USE, CONTRARY]).sum())
    if kept >= LEAST_SHARE * asked and kept:
        return ""
    return (
        f"smart: refused, only {kept} of {asked} tracks agree with the solution without them: too poor to test them "
        "by; leave image_pairs on, or add fixes, control points or standstills"
    )


def _scale(builder: SmartBuilder, verdict: NDArray[np.intp], points: TrackPoints) -> float:
    """Scale of the sigma of an observation: the root mean square of those in use, what the points take put back."""
    tracks = verdict == IN_USE
    square = (points.residual[points.inside & tracks[:, None]] ** 2).sum() / builder.sigma**2
    left = 2 * int(points.inside[tracks].sum()) - POINT_DOF * int(tracks.sum())
    return float(np.clip(np.sqrt(square / left), *SCALES))


def whitened(
    builders: Iterable[Builder], estimate: Estimate, pass_state: PassState
) -> tuple[NDArray[np.int64], Floats, Mask] | None:
    """Keyframe stamps (m,), whitened residuals (m, 2) and whether in use (m,), of the observations of the tracks in
    use; None where tracks are not in force."""
    builder = one_of(builders, SmartBuilder)
    if builder is None or not builder.in_force(pass_state):
        return None
    seen, selection = builder.sightings, builder.selection(pass_state)
    sigma = builder.sigma * pass_state.scale(builder.name)
    points = triangulate(seen, _views(builder, selection, estimate).then, sigma, selection.use)
    tested = seen.there & (selection.verdict == IN_USE)[:, None]
    return builder.image_ns[seen.image[tested]], points.residual[tested] / sigma, selection.use[tested]


def track_account(builders: Iterable[Builder], pass_state: PassState) -> Account | None:
    """The account of the tracks of a run; None where they are not asked for."""
    builder, pairs = one_of(builders, SmartBuilder), one_of(builders, CoplanarityBuilder)
    if builder is None:
        return None
    selection, refused = builder.selection(pass_state), ""
    if pairs is not None and pairs.selection(pass_state).refused:
        refused = "smart: tracks are refused as the image pairs are"
    wrong = builder.sightings.there & (selection.verdict == IN_USE)[:, None] & ~selection.use
    refused = selection.refused or refused
    return Account.of(selection.verdict, REASONS, int(wrong.sum()), refused, builder.in_force(pass_state))
