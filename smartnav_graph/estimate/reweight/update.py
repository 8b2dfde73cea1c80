"""What one pass leaves to the next: which fixes to reject, and the noise of the sensors.

Rejection: least squares first; where residuals are large, a Cauchy pass finds the outliers, a chi-square gate decides,
and rows inside the gate are let in again. A redescending loss ignores what lies far beyond its sigma, and the
position at a fix of centimetres is predicted to metres: so the loss is as wide as that first, and narrowed pass by
pass. Where configured, truncated least squares by graduated non-convexity comes between the two, started from the
first. Noise: the variance component of a group of fixes, sum r^2 / redundancy,
with the redundancy read from the posterior covariance (Koch 1999, Parameter estimation, 3.6). What needs the
trajectory found first (time offsets, vehicle constraints, correlated errors) joins when nothing changes
without it; session states that the data do not determine are held at their calibrated value.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from smartnav_graph.core import chi_square
from smartnav_graph.core.arrays import Mask, runs
from smartnav_graph.estimate.reweight.constraint_noise import row_scales
from smartnav_graph.estimate.reweight.false_standstills import drop_standstills
from smartnav_graph.estimate.reweight.image_pair_outliers import check_pairs
from smartnav_graph.estimate.reweight.image_weight import weigh_images
from smartnav_graph.estimate.reweight.imu_noise import RELAXATION, noise_scales, worse_than_class
from smartnav_graph.estimate.reweight.lasting_errors import lasting_errors
from smartnav_graph.estimate.reweight.outliers import (
    FixResiduals,
    Verdict,
    _position_verdict,
    fix_residuals,
    position_builders,
    verdicts,
)
from smartnav_graph.estimate.reweight.track_outliers import ROUNDS, check_tracks
from smartnav_graph.factors.coplanarity import CoplanarityBuilder
from smartnav_graph.factors.gnss import PositionBuilder
from smartnav_graph.factors.imu import ImuBuilder
from smartnav_graph.factors.smart import SmartBuilder
from smartnav_graph.factors.vehicle import VehicleBuilder
from smartnav_graph.graph import gnc
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState, Phase
from smartnav_graph.graph.states import kind_of
from smartnav_graph.graph.update import Builder, one_of
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.detect.scatter import Scatter
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.redundancy import factor_fits

# No fix is believed better than this, metres horizontally and vertically: clocks and lever arms are not.
LEAST_SIGMA = (0.02, 0.01)
LEAST_REDUNDANCY = 10.0
# What the scatter of the fixes by themselves counts, in residuals, where their sigma rises beyond it.
PRIOR_FIXES = 30.0
# Stated sigmas are believed unless so large squares are rarer than this; and the most that noise with tails exceeds the
# sigma of its middle.
RARE, TAILS = 1e-3, 1.5
# Share and number of rejected fixes above which the solution is suspect; above the last share whatever their number.
SUSPECT_SHARE, LEAST_SUSPECTS, MOST_REJECTED = 0.1, 10, 0.15
# Outliers are looked for when the worst fix of all would be so rare among good ones.
SURPRISE = 0.01
# Noise is found once the logarithm of its sigma changes by less than this: fixes, and inertial groups, whose walks
# have few degrees of freedom and change slowly.
STEADY = 0.1
STEADY_INERTIAL = 0.1
# What needs the trajectory found joins once the sigma of fixes changes by less than this: residuals hold what it will
# explain, so that the rest of the noise is found beside it.
CLOSE = 0.4


# Growth of mu a pass, and the most passes that takes.
GROWTH = 4.0
GRADUATED_PASSES = 14

# Share of the least sigma of fixes under a redescending loss that the next pass has.
NARROWER = 0.1

# A session state is held where the data leave more than this of its prior sigma.
OBSERVED = 0.7


def update_pass_state(
    builders: Sequence[Builder], windows: Sequence[Window], estimate: Estimate, pass_state: PassState
) -> tuple[PassState, bool]:
    """The pass state of the next pass, and whether nothing changed."""
    new, done = _update_noise_and_fixes(builders, windows, estimate, pass_state)
    if new.stage < LAST_STAGE or (not done and _images_wait(builders, pass_state)):
        return new, done
    tested = check_pairs(builders, estimate, new)
    tested = check_tracks(builders, estimate, tested) if tested is new else tested
    tested = weigh_images(builders, estimate, new) if done and tested is new else tested
    if done and tested is new:
        tested = drop_standstills(builders, windows, estimate, new)
    return tested, done and tested is new


def _images_wait(builders: Sequence[Builder], pass_state: PassState) -> bool:
    """Whether image pairs join only once nothing changes without them: what they change then, they change alone."""
    pairs = one_of(builders, CoplanarityBuilder)
    return pairs is not None and not pass_state.tests(pairs.name) and bool(position_builders(builders))


def _update_noise_and_fixes(
    builders: Sequence[Builder], windows: Sequence[Window], estimate: Estimate, pass_state: PassState
) -> tuple[PassState, bool]:
    """The same by fixes and inertial data alone."""
    found = {b.name: (b, fix_residuals(b, windows, estimate, pass_state)) for b in position_builders(builders)}
    found = {name: pair for name, pair in found.items() if len(pair[1].rows)}
    new = pass_state
    exact = pass_state.stage == LAST_STAGE and pass_state.phase in (Phase.PLAIN, Phase.GATED)
    fits = factor_fits(estimate) if exact else None
    for builder, residuals in found.values():
        fitted = None if fits is None else fits.of(builder.name, residuals.rows, 3)
        new = _rescaled(builder, replace(residuals, fitted=fitted), new)
    tested = verdicts(builders, {name: residuals for name, (_, residuals) in found.items()}, estimate, new)
    worst = {v.name: v.outside(1.0 - SURPRISE / len(v.rows)) for v in tested}
    if pass_state.phase is Phase.PLAIN and any(worst.values()):
        return replace(new, phase=Phase.ROBUST), False
    if pass_state.narrowing and estimate.converged:  # otherwise a narrower loss has even less to go by
        return replace(new, robust_floor_m=_shrink_robust_scale(found, pass_state.robust_floor_m)), False
    outliers = {v.name: v.outside() - pass_state.trusted.get(v.name, frozenset()) for v in tested}
    trusted = {name: suspects(builder, outliers.get(name, frozenset())) for name, (builder, _) in found.items()}
    if any(trusted.values()):  # least squares again, with them
        outliers = {name: rows - trusted.get(name, frozenset()) for name, rows in outliers.items()}
        trusted = {name: rows | pass_state.trusted.get(name, frozenset()) for name, rows in trusted.items()}
        new = replace(new, phase=Phase.GATED, rejected=outliers, weights={}, robust_floor_m=0.0)
        imu = one_of(builders, ImuBuilder)
        return replace(new, trusted=trusted, noise_scales={} if imu is None else imu.prior_scales()), False
    if pass_state.phase in (Phase.ROBUST, Phase.GRADUATED):
        weighed = _next_gnc(tested, pass_state)
        if weighed is not None:
            return replace(weighed, noise_scales=new.noise_scales), False
        return replace(new, phase=Phase.GATED, rejected=outliers, weights={}, robust_floor_m=0.0), False
    if pass_state.phase is Phase.GATED:
        new = replace(new, rejected=outliers)
    names = [name for builder, _ in found.values() for name in (*builder.noise_names, builder.stated_name)]
    change = max((abs(np.log(new.scale(name) / pass_state.scale(name))) for name in names), default=0.0)
    stated = _square_per_redundancy(found, pass_state, stated=True)
    new, calm = _inertial(builders, windows, estimate, pass_state, new, stated)
    if new.rejected != pass_state.rejected:
        return new, False
    settled = calm and change < STEADY
    if not (settled or (new.stage < LAST_STAGE and change < CLOSE)):
        return new, False
    square = _square_per_redundancy(found, pass_state)
    grown = enable_second_stage(builders, estimate, new, square)
    return (grown, grown == new) if settled or grown.stage > new.stage else (new, False)


def suspects(builder: PositionBuilder, rejected: frozenset[int]) -> frozenset[int]:
    """Rejected fixes that agree with their neighbours, where a large share is rejected and most of it agrees: not they
    are suspect, but the solution. A run of rejected fixes must agree with those before and after it too: a burst of
    outliers does not. A few are left alone."""
    n = len(builder.agrees)
    if len(rejected) <= min(max(SUSPECT_SHARE * n, LEAST_SUSPECTS), MOST_REJECTED * n):
        return frozenset()
    out = np.isin(np.arange(n), list(rejected))
    found = [
        range(first, end)
        for first, end in runs(out)
        if builder.agrees[[*range(max(first - 1, 2), first + 1), *range(end - 1, min(end, n - 3) + 1)]].all()
    ]
    agreeing = frozenset(row for run in found for row in run)
    return agreeing if len(agreeing) > len(rejected) / 2 else frozenset()


def widen_robust_scale(builders: Iterable[Builder], pass_state: PassState, metres: float) -> PassState:
    """The pass state of a robust pass from a start that is off by so many metres."""
    sigmas = [float(np.median(b.scaled_sigma(pass_state)[:, :2])) for b in position_builders(builders) if b.gated]
    return replace(pass_state, robust_floor_m=metres if min(sigmas, default=metres) < metres / 3 else 0.0)


def _shrink_robust_scale(found: Mapping[str, tuple[PositionBuilder, FixResiduals]], control: float) -> float:
    """The next least sigma (m) of fixes under the loss: a share of this one, less where most fixes agree better, none
    once it would be below what is known of them."""
    known = [(float(np.median(one.sigma[:, :2])), float(np.median(one.square))) for _, one in found.values()]
    level = float(chi_square.ppf(0.5, 3))
    wanted = min(NARROWER * control, 2.0 * max(sigma * np.sqrt(max(square / level, 1.0)) for sigma, square in known))
    return float(wanted) if wanted > min(sigma for sigma, _ in known) else 0.0


def _next_gnc(tested: Sequence[Verdict], pass_state: PassState) -> PassState | None:
    """The pass state with the weights of the next mu; None where every weight is 0 or 1, or GNC is not configured."""
    asked = [v for v in tested if v.gnc]
    if not asked:
        return None
    squares = {v.name: v.relative() for v in asked}
    if pass_state.phase is Phase.ROBUST:
        mu = min(gnc.first_mu(square, 1.0) for square in squares.values())
    else:
        mu = GROWTH * pass_state.gnc_mu
    found = {name: gnc.weights(square, 1.0, mu) for name, square in squares.items()}
    if all(gnc.converged(weight) for weight in found.values()):
        return None
    weights = {v.name: dict(zip(v.rows.tolist(), found[v.name].tolist(), strict=True)) for v in asked}
    rejected = {v.name: v.outside() for v in tested if not v.gnc}
    return replace(pass_state, phase=Phase.GRADUATED, rejected=rejected, weights=weights, gnc_mu=mu)


def extra_passes(builders: Iterable[Builder]) -> int:
    """Passes that graduated non-convexity, and tracks that follow on image pairs, need beyond those of the others."""
    builders = list(builders)
    also_gnc = any(b.config.loss == "gnc" for b in position_builders(builders))
    return GRADUATED_PASSES * also_gnc + ROUNDS * (one_of(builders, SmartBuilder) is not None)


def enable_second_stage(
    builders: Sequence[Builder], estimate: Estimate, pass_state: PassState, fixes_square: float
) -> PassState:
    """The pass state with what joins once the trajectory is found, with fixes of this normalised square; session states
    that are not observable are fixed."""
    positions = position_builders(builders)
    imu = one_of(builders, ImuBuilder)
    worse = {} if imu is None else worse_than_class(imu, pass_state, fixes_square)
    doubtful = pass_state.stage == LAST_STAGE and bool(worse)
    correlated = frozenset(b.name for b in positions if b.has_correlated_error(pass_state, doubtful=doubtful))
    if pass_state.stage < LAST_STAGE:
        later = any(b.has_second_stage(pass_state) for b in builders)
        return replace(pass_state, stage=LAST_STAGE, correlated=correlated) if later else pass_state
    # Not by a solution with images: what is wrong with these would be taken for errors of the fixes.
    may_last = [builder for builder in positions if builder.noise.is_correlated and not pass_state.outlier_tests]
    correlated |= lasting_errors(may_last, estimate, replace(pass_state, correlated=pass_state.correlated | correlated))
    blind = {
        state.name: state.prior_mean
        for state in estimate.session.values()
        if not state.held and kind_of(state.key).fixable and (state.sigma > OBSERVED * state.prior_sigma).all()
    }
    return replace(pass_state, fixed_states={**pass_state.fixed_states, **blind}, correlated=correlated)


def _square_per_redundancy(
    found: Mapping[str, tuple[PositionBuilder, FixResiduals]], pass_state: PassState, *, stated: bool = False
) -> float:
    """Normalised square of the fixes in use over their redundancy, at least 1; stated : of those with sigmas of their
    own."""
    square = redundancy = 0.0
    for name, (builder, one) in found.items():
        used = pass_state.used(name, one.rows)
        if stated:
            used = used & builder.own_sigma[one.rows]
        square += float(one.square[used].sum())
        redundancy += float(one.redundancy[used].sum())
    return max(1.0, square / redundancy) if redundancy > 0.0 else 1.0


def _inertial(
    builders: Sequence[Builder],
    windows: Sequence[Window],
    estimate: Estimate,
    pass_state: PassState,
    new: PassState,
    level: float,
) -> tuple[PassState, bool]:
    """`new` with the inertial noise found, and whether that changed little. Beside correlated fixes it is no less than
    that of the class: the solution follows slow errors of the sensor as it follows those of the fixes, and residuals
    show the fast part.
    Beside constraints of a vehicle too: these are kept to less than their sigma says. Beside images it stays as it was
    without them: it would grow and hide what contradicts them (`image_weight`)."""
    scales = noise_scales(builders, windows, estimate, pass_state, level)
    if any(builder.has_correlated_error(pass_state) for builder in position_builders(builders)):
        scales = {name: max(scale, 1.0) for name, scale in scales.items()}
    if pass_state.outlier_tests:
        scales = {}
    if one_of(builders, VehicleBuilder) is not None:
        scales = {name: max(scale, min(1.0, pass_state.scale(name))) for name, scale in scales.items()}
    if pass_state.stage == LAST_STAGE:
        scales |= row_scales(builders, estimate, pass_state)
    change = [abs(np.log(scale / pass_state.scale(name))) for name, scale in scales.items()]
    return replace(new, noise_scales={**new.noise_scales, **scales}), max(change, default=0.0) < STEADY_INERTIAL


def _rescaled(builder: PositionBuilder, found: FixResiduals, pass_state: PassState) -> PassState:
    """Variance components, horizontal and vertical, of the rows without a sigma of their own; rows outside the gate do
    not count."""
    if not builder.config.estimate_sigma:
        return pass_state
    outside = _position_verdict(builder, found, pass_state).outside() | pass_state.rejected.get(
        builder.name, frozenset()
    )
    own = builder.own_sigma[found.rows]
    inside = ~np.isin(found.rows, list(outside)) & (builder.interpolated[found.rows] == 0)
    normalised = (found.residual / found.sigma) ** 2
    scales = {**pass_state.noise_scales, **_stated(builder, found, own & inside, pass_state)}
    parts = zip(builder.noise_names, (slice(0, 2), slice(2, 3)), builder.scatter, LEAST_SIGMA, strict=True)
    for name, axes, known, least in parts:
        used = inside & ~own & (builder.measures_height[found.rows] | (axes.start == 0))
        redundancy = float(found.redundancy[used, axes].sum())
        if redundancy < LEAST_REDUNDANCY:
            continue
        square, default = float(normalised[used, axes].sum()), float(builder.sigma[found.rows[used], axes].min())
        sigma = default * pass_state.scale(name)
        scales[name] = _fix_sigma(sigma, square / redundancy, redundancy, default, known, least) / default
    return replace(pass_state, noise_scales=scales)


def _stated(builder: PositionBuilder, found: FixResiduals, used: Mask, pass_state: PassState) -> dict[str, float]:
    """Scale of the stated sigmas, at least 1: by the fixes inside the gate where so large squares are rare, and where
    the fixes are white noise by themselves of no more than that scatter with tails."""
    known, name = builder.scatter[0], builder.stated_name
    counted = used[:, None] & (builder.measures_height[found.rows, None] | (np.arange(3) < 2))
    redundancy = float(found.redundancy[counted].sum())
    if known is None or not known.is_noise or redundancy < PRIOR_FIXES:
        return {}
    square, before = float(((found.residual / found.sigma)[counted] ** 2).sum()), pass_state.scale(name)
    if before == 1.0 and chi_square.sf(square, redundancy) > RARE:
        return {}
    most = max(1.0, TAILS * known.sigma / float(np.median(builder.sigma[found.rows[used], :2])))
    wanted = np.sqrt((before**2 * square + PRIOR_FIXES) / (redundancy + PRIOR_FIXES))
    return {name: float(np.clip(wanted, 1.0, most))}


def _fix_sigma(
    sigma: float, square: float, redundancy: float, default: float, known: Scatter | None, floor: float
) -> float:
    """Next sigma (m) of fixes, at least `floor`, by the mean square of their residuals, and by their own scatter.

    A solution that is wrong would make the fixes bad until they agree with it: beyond what the fixes show by themselves
    their sigma rises reluctantly, and it stays within a factor of two of their scatter, where that is noise. Where it
    holds motion, it is an upper bound, and so are three times the default of the class.
    """
    least, most, likely = floor, 3.0 * default, default
    if known is not None and known.is_noise:
        least, most, likely = known.sigma / 2.0, 2.0 * known.sigma, known.sigma
    elif known is not None:
        most, likely = min(2.0 * known.sigma, most), min(known.sigma, default)
    step = float(np.sqrt(square))
    wanted = sigma * float(np.clip(step if step > 1.0 else step**RELAXATION, 0.2, 5.0))
    if wanted > likely:
        wanted = float(np.sqrt((redundancy * wanted**2 + PRIOR_FIXES * likely**2) / (redundancy + PRIOR_FIXES)))
    return float(np.clip(wanted, max(least, floor), max(most, floor)))
