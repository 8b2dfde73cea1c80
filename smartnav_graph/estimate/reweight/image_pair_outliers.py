"""Which image pairs, and which of their matches, an estimate believes: pass by pass until they are settled.

First by the rotation of the inertial data (two matches give the baseline); then at the smoothed states; then once more,
whereupon pairs are compressed. Where too few pairs agree with the solution without images, that is too inaccurate to
test them, and none is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.factors.camera import BORESIGHT, FOCAL, STREAM, CameraModel, Motion
from smartnav_graph.factors.coplanar_rows import COLUMNS, Relative, relative
from smartnav_graph.factors.coplanarity import (
    COMPRESSED,
    CONTRARY,
    IN_USE,
    OUTSIDE,
    POSE_DOF,
    REASONS,
    CoplanarityBuilder,
    PairSelection,
)
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import Builder, one_of
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.vision.epipolar import sampson
from smartnav_graph.vision.gating import Geometry
from smartnav_graph.vision.pairs import Pairs

# A match within so many sigmas of the smoothed states is one.
GATE = 4.0
# Share of the pairs with a baseline that must be kept for any to be used.
LEAST_PAIRS = 0.5
# A pair has diverged when the sigma of its second image exceeds this share of the baseline; share of pairs that may.
LARGEST_SIGMA, FEW_DIVERGED = 0.3, 0.1
# Sigma of a match beside that of its class: least and most.
SCALES = (0.3, 3.0)


# Name, among the selections of a pass, of the positions found without images.
WITHOUT_IMAGES = "without_images"


@dataclass(frozen=True)
class Positions:
    """Of keyframes: stamps t_ns (n,), p (n, 3) m and their covariance P (n, 3, 3), nav axes."""

    t_ns: Times
    p: Floats
    P: Floats

    @classmethod
    def of(cls, estimate: Estimate) -> Positions:
        """By an estimate."""
        return cls(estimate.t_ns, estimate.states()[1], estimate.covariance[:, 3:6, 3:6])


def check_pairs(builders: Iterable[Builder], estimate: Estimate, pass_state: PassState) -> PassState:
    """The pass state with the matches that agree with an estimate; unchanged once they are all tested."""
    builder = one_of(builders, CoplanarityBuilder)
    if builder is None or pass_state.tests(builder.name) >= COMPRESSED:
        return pass_state
    tests, scale = pass_state.tests(builder.name), pass_state.scale(builder.name)
    place, _ = estimate.keyframes_at(builder.image_ns, builder.merge_ns)
    R, _, v, bias = (x[place] for x in estimate.states())
    motion = Motion(R, v, bias[:, 3:])
    offset_s, _, focal = camera_states(builder.camera_model, estimate)
    selection = builder.with_motion(builder.selection(pass_state), offset_s, focal, motion)
    poses, inside = relative_poses(builder, selection, estimate)
    if tests == 0:
        use, verdict = builder.by_turn(selection.pairs, poses.R)
    else:
        use, verdict, scale = _by_states(builder, selection.pairs, poses, scale)
    verdict = np.where(inside, verdict, OUTSIDE)
    refused = _refusal(verdict)
    verdict = np.where(verdict == IN_USE, CONTRARY, verdict) if refused else verdict
    use = use & (verdict == IN_USE)[:, None]
    selection = replace(selection, use=use, verdict=verdict, refused=refused, poses=poses)
    rejected = {
        "matches": frozenset(np.flatnonzero(~np.asarray(selection.pairs.flat(use))).tolist()),
        builder.name: frozenset(np.flatnonzero(verdict != IN_USE).tolist()),
    }
    selections = {**pass_state.selections, builder.name: selection}
    if tests == 0 and not estimate.stacks(builder.name):
        selections[WITHOUT_IMAGES] = Positions.of(estimate)
    return replace(
        pass_state,
        rejected={**pass_state.rejected, **rejected},
        noise_scales={**pass_state.noise_scales, builder.name: scale},
        selections=selections,
        outlier_tests={**pass_state.outlier_tests, builder.name: COMPRESSED if refused else tests + 1},
    )


def images_diverged(builders: Iterable[Builder], estimate: Estimate, pass_state: PassState) -> bool:
    """Whether the motion between images is too uncertain for image pairs: a redescending loss does not converge from
    so far, and a baseline fits as well with the opposite sign."""
    builder = one_of(builders, CoplanarityBuilder)
    if builder is None:
        return False
    selection = builder.selection(pass_state)
    poses, inside = relative_poses(builder, selection, estimate)
    sigma = np.sqrt(np.diagonal(estimate.covariance, axis1=1, axis2=2)[:, 6:9].max(axis=1))
    place, _ = estimate.keyframes_at(builder.image_ns, builder.merge_ns)
    spread = sigma[place][builder.seen.images[:, 1]] * builder.seen.length_s
    diverged = spread > LARGEST_SIGMA * np.linalg.norm(poses.t, axis=1)
    used = inside & (selection.verdict == IN_USE)
    return bool(used.any() and diverged[used].mean() > FEW_DIVERGED)


def _by_states(
    builder: CoplanarityBuilder, pairs: Pairs, there: Relative, scale: float
) -> tuple[Mask, NDArray[np.intp], float]:
    """Matches (padded) that agree with the smoothed states, the verdict on each pair, and the scale of a match's
    sigma: that of their median, the freedom of each pair's pose taken out."""
    x0, x1, shift = pairs.matches
    white = np.abs(sampson(there.R, there.t, x0, x1, shift=shift).residual) / builder.sigma
    geometry = Geometry.of(pairs, there.R)
    use = (white < GATE * scale) & pairs.there
    use &= geometry.plausible(there.t, np.full(len(pairs), builder.sigma * scale), use)
    verdict = builder.verdict_by_count(pairs, use, geometry.parallax())
    good = use & (verdict == IN_USE)[:, None]
    left = int(good.sum()) - POSE_DOF * int((verdict == IN_USE).sum())
    if left > POSE_DOF:
        spread = 1.4826 * float(np.median(white[good])) * np.sqrt(good.sum() / left)
        scale = float(np.clip(spread, *SCALES))
    return use, verdict, scale


@dataclass(frozen=True)
class Account:
    """What became of image pairs or tracks (by reason, as in `REASONS`): of how many matches or observations of those
    in use were outliers, why none is used, and whether they are in force."""

    reasons: Mapping[str, int]
    outliers: int
    refused: str
    in_force: bool = True

    @classmethod
    def of(cls, verdict: NDArray[np.intp], reasons: Sequence[str], *rest: Any) -> Account:
        """With the verdicts (n,), places in `reasons`, counted."""
        count = np.bincount(verdict, minlength=len(reasons))
        return cls(dict(zip(reasons, count.tolist(), strict=True)), *rest)

    @property
    def used(self) -> int:
        """Pairs or tracks in use."""
        return self.reasons[REASONS[IN_USE]]

    @property
    def contrary(self) -> int:
        """Pairs or tracks that contradict the trajectory."""
        return self.reasons[REASONS[CONTRARY]]


def pair_account(builders: Iterable[Builder], pass_state: PassState) -> Account | None:
    """The account of the image pairs of a run; None where there are none, or tracks replace them."""
    builder = one_of(builders, CoplanarityBuilder)
    if builder is None or builder.replaced(pass_state):
        return None
    selection = builder.selection(pass_state)
    wrong = (selection.verdict[builder.seen.pair] == IN_USE) & ~builder.used_matches(pass_state)
    return Account.of(selection.verdict, REASONS, int(wrong.sum()), selection.refused)


def relative_poses(builder: CoplanarityBuilder, selection: PairSelection, estimate: Estimate) -> tuple[Relative, Mask]:
    """Relative camera poses of all pairs at an estimate, and which pairs have both keyframes."""
    place, known = estimate.keyframes_at(builder.image_ns, builder.merge_ns)
    R, p, v, _ = (x[place] for x in estimate.states())
    pose = np.tile(np.eye(4), (len(place), 1, 1))
    pose[:, :3, :3], pose[:, :3, 3] = R, p
    first, second = builder.seen.images.T
    data = np.zeros((len(first), COLUMNS))
    data[:, 1:4], data[:, 4:7] = selection.rate[first], selection.rate[second]
    states, (offset_s, boresight, _) = [pose[first], pose[second]], camera_states(builder.camera_model, estimate)
    if builder.rig.timed:
        states += [v[first], v[second], np.full((len(first), 1), offset_s + builder.rig.known_s)]
    if builder.rig.boresight:
        states.append(np.tile(boresight, (len(first), 1)))
    return relative(builder.rig, states, data), known[first] & known[second]


def camera_states(camera: CameraModel, estimate: Estimate) -> tuple[float, Floats, float]:
    """Clock offset (s) beside the one that the keyframes at the images have, boresight (3,) rad and correction of the
    focal length, by an estimate, as expected where they are not states of it."""
    expected = {state.name: state.initial for state in camera.states().values()}
    found = {name: one.value for name, one in estimate.session.items() if name in expected}
    names = (f"{STREAM}_time_offset_s", BORESIGHT, FOCAL)
    clock, boresight, focal = ({**expected, **found}.get(name) for name in names)
    offset_s = 0.0 if clock is None else float(clock[0]) - camera.rig.known_s
    return offset_s, np.zeros(3) if boresight is None else boresight, 0.0 if focal is None else float(focal[0])


def _refusal(verdict: NDArray[np.intp]) -> str:
    """Why no pair is to be used; empty where they are."""
    kept, asked = int((verdict == IN_USE).sum()), int(np.isin(verdict, [IN_USE, CONTRARY]).sum())
    if kept >= LEAST_PAIRS * asked:
        return ""
    return (
        f"image_pairs: refused, only {kept} of {asked} image pairs agree with the solution without images: too "
        "poor to test them by; add fixes, control points or standstills"
    )
