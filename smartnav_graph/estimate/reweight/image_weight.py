"""Weight of image pairs beside the other sensors.

Residuals of matches show the noise of a match. What is wrong with a pair as a whole, or lasts over many (calibration,
motion within the exposure, one observation in pairs of several spans), they do not show: it bends the solution until
inertial data and fixes contradict their noise. So an error of direction that the matches of a pair share is assumed to
be the larger, the more these do, by the chi-square of each over its own redundancy, and by the change d of positions
p0, P0 that were found without images: where nothing is wrong its covariance is P0 - P <= P0. What images contradict
at the largest error, they are not used beside.

Source: Hausman (1978), Specification tests in econometrics, Econometrica 46, 1251, for the change.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from smartnav_graph.core import chi_square
from smartnav_graph.estimate.reweight.image_pair_outliers import WITHOUT_IMAGES, Positions
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.factors.coplanarity import COMPRESSED, COPIED, IN_USE, SHARED, CoplanarityBuilder
from smartnav_graph.factors.coplanarity import CONTRARY as CONTRARY_PAIR
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.update import Builder, one_of
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.redundancy import redundancies

# Chi-square over redundancy from which on a sensor contradicts the images, how rarely one that agrees reaches it. Once
# one did, the error is to be the likely one, not the least that is not excluded.
CONTRARY, RARE = 1.1, 1e-3
# First and largest sigma of the direction, rad, and the least and most that it grows by in a pass.
FIRST, LARGEST = float(np.radians(0.5)), float(np.radians(5.0))
STEP = (1.6, 3.0)
# Share of a misfit that is left where a larger error of the direction is its cure. Name, among the selections,
# of the misfit with which that error last grew.
LEFT, LAST_MISFIT = 0.5, "misfit_at_the_last_growth"
# Mean square of the change of positions by images over what it has by their gain of information, from which it is none:
# changes are alike for long. Least share of the variance that counts as a gain.
CHANGED, LEAST_GAIN = 2.0, 0.1


def weigh_images(builders: Iterable[Builder], estimate: Estimate, pass_state: PassState) -> PassState:
    """The pass state with a larger error of the direction of image pairs where others contradict them."""
    builders = list(builders)
    pairs = one_of(builders, CoplanarityBuilder)
    if pairs is None or pass_state.tests(pairs.name) < COMPRESSED or pairs.selection(pass_state).refused:
        return pass_state
    before, last = pass_state.noise_scales.get(SHARED, 0.0), pass_state.selections.get(LAST_MISFIT)
    contrary, rare = (CONTRARY, RARE) if before == 0.0 else (1.0, 0.5)
    misfit, change = _misfit(builders, estimate, rare), _change(estimate, pass_state)
    if isinstance(last, float) and misfit - 1.0 > LEFT * (last - 1.0):  # not the images
        misfit = 1.0
    worst = max(misfit, change)
    if worst <= contrary:
        return pass_state
    if before >= LARGEST:
        return _refused(pairs, pass_state) if change > CONTRARY else pass_state
    wanted = FIRST if before == 0.0 else min(before * float(np.clip(np.sqrt(worst), *STEP)), LARGEST)
    scales, selections = {**pass_state.noise_scales, SHARED: wanted}, {**pass_state.selections, LAST_MISFIT: misfit}
    pass_state = replace(pass_state, noise_scales=scales, selections=selections)
    return _counted_once(pairs, pass_state) if before == 0.0 else pass_state


def _misfit(builders: Sequence[Builder], estimate: Estimate, rare: float) -> float:
    """Largest chi-square over redundancy of inertial data and fixes that is `rare`; 1 where there is none."""
    imu = one_of(builders, ImuBuilder)
    names = {builder.name for builder in position_builders(builders)} | ({imu.name} if imu is not None else set())
    fits = [(f.square, f.residuals - f.fitted) for name, f in redundancies(estimate).items() if name in names]
    return max((square / dof for square, dof in fits if dof >= 1.0 and chi_square.sf(square, dof) < rare), default=1.0)


def _change(estimate: Estimate, pass_state: PassState) -> float:
    """Mean square of the change of horizontal positions since the solution without images, over what it may be."""
    before = pass_state.selections.get(WITHOUT_IMAGES)
    if not isinstance(before, Positions):
        return 0.0
    now = Positions.of(estimate)
    _, old, new = np.intersect1d(before.t_ns, now.t_ns, return_indices=True)
    d, P0 = (now.p[new] - before.p[old])[:, :2], before.P[old, :2, :2]
    square = (d * np.linalg.solve(P0, d[:, :, None])[:, :, 0]).sum(axis=1).mean()
    gained = 2.0 - np.trace(np.linalg.solve(P0, now.P[new, :2, :2]), axis1=1, axis2=2).mean()
    return float(square / max(gained, 2.0 * LEAST_GAIN) / CHANGED)


def _refused(pairs: CoplanarityBuilder, pass_state: PassState) -> PassState:
    """The pass state without any pair."""
    selection = pairs.selection(pass_state)
    text = "image_pairs: refused, they contradict inertial data and fixes; check clock and calibration of the camera"
    verdict = np.where(selection.verdict == IN_USE, CONTRARY_PAIR, selection.verdict)
    selection = replace(selection, verdict=verdict, use=np.zeros_like(selection.use), refused=text)
    scales = {name: scale for name, scale in pass_state.noise_scales.items() if name != SHARED}
    selections = {**pass_state.selections, pairs.name: selection}
    return replace(pass_state, selections=selections, noise_scales=scales)


def weight_text(pass_state: PassState) -> list[str]:
    """A warning where image pairs count for less than the noise of their matches."""
    shared = pass_state.noise_scales.get(SHARED, 0.0)
    text = (
        "image_pairs: inertial data and fixes contradict the motion between images, whose direction counts as "
        f"{np.degrees(shared):.1f} deg uncertain, and each observation once; check the calibration of the camera"
    )
    return [text] if shared else []


def _counted_once(pairs: CoplanarityBuilder, pass_state: PassState) -> PassState:
    """The pass state without the pairs whose time holds shorter ones in use: their observations are in these."""
    selection = pairs.selection(pass_state)
    used = np.flatnonzero(selection.verdict == IN_USE)
    first, last = pairs.seen.images[used].T
    latest = np.full(int(last.max(initial=0)) + 2, -1)  # latest first image of the pairs that end at or before an image
    np.maximum.at(latest, last, first)
    latest = np.maximum.accumulate(latest)
    verdict = selection.verdict.copy()
    verdict[used[latest[last] > first]] = COPIED
    use = selection.use & (verdict == IN_USE)[:, None]
    selection = replace(selection, verdict=verdict, use=use)
    return replace(pass_state, selections={**pass_state.selections, pairs.name: selection})
