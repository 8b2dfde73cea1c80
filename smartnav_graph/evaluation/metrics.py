"""Accuracy of a solution against a reference: absolute and relative errors, percentiles, consistency.

APE = |p_est - p_ref| after alignment; rotation = geodesic angle of R_ref^T R_est. RPE over pairs i, j with
|t_j - t_i - delta| <= half a reference period: with attitude, translation and angle of (Q_i^-1 Q_j)^-1 (P_i^-1 P_j);
without, the difference of the two displacements. NEES: see `_consistency`; an alignment fitted to the reference makes
every NEES a little too small.

Source: Sturm et al. (2012), A Benchmark for the Evaluation of RGB-D SLAM Systems, section IV (APE, RPE); Bar-Shalom,
Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, section 5.4 (NEES).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from smartnav_graph.core import chi_square, figures
from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import InputTypeError
from smartnav_graph.core.so3 import log, rotate_back
from smartnav_graph.core.timebase import NS, seconds_since
from smartnav_graph.evaluation.align import (
    FrameAlignment,
    StateSeries,
    check_overlap,
    find_time_offset,
    fit_alignment,
    states_of_reference,
    states_of_solution,
)
from smartnav_graph.graph.solution import POS, ROT, VEL, Solution
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Reference

LEAST_FOR_PERCENTILES = 20  # errors: the 95 % percentile is then below the largest


@dataclass(frozen=True)
class Statistics:
    """Root mean square, mean, percentiles (linear between ranks) and maximum of error magnitudes; no percentiles (None)
    of fewer than `LEAST_FOR_PERCENTILES`."""

    rmse: float
    mean: float
    p50: float | None
    p67: float | None
    p95: float | None
    max: float

    @classmethod
    def of(cls, magnitudes: ArrayLike) -> Statistics:
        """Of magnitudes (n,), n >= 1."""
        x = np.asarray(magnitudes, dtype=np.float64)
        p50, p67, p95 = map(float, np.percentile(x, [50, 67, 95])) if len(x) >= LEAST_FOR_PERCENTILES else [None] * 3
        return cls(float(np.sqrt((x**2).mean())), float(x.mean()), p50, p67, p95, float(x.max()))


@dataclass(frozen=True)
class RelativeError:
    """RMS error of the motion over `delta_s` seconds; None without a pair so far apart, or without attitude."""

    delta_s: float
    translation_m: float | None
    rotation_deg: float | None
    pairs: int


@dataclass(frozen=True, kw_only=True)
class Evaluation(Summarised):
    """How a solution agrees with a reference.

    `nees` are averages, expected 3 for position, velocity and attitude and 1 for yaw; None where the covariance or
    the reference does not allow them, `notes` say why; `nees_verdict` says in words what they mean. Per epoch, errors
    are solution minus reference after alignment: `t_ns` (n,) on the solution's clock, `error_enu_m` (n, 3),
    `rotation_error_deg` (n,) geodesic or None, `sigma_enu` (n, 3) m of the solution.
    """

    solution: str
    reference: str
    align: str
    time_offset_s: float
    unmatched: int
    rpe: tuple[RelativeError, ...]
    nees: dict[str, float | None]
    nees_verdict: dict[str, str]
    alignment: FrameAlignment
    t_ns: Times
    error_enu_m: Floats
    rotation_error_deg: Floats | None
    sigma_enu: Floats
    notes: tuple[str, ...] = ()

    def facts(self) -> dict[str, str]:
        """Epochs, alignment, RMS errors, consistency."""
        nees = ", ".join(f"{name} {value:.2f}" for name, value in self.nees.items() if value is not None)
        return {
            "epochs": f"{self.matched} of {self.matched + self.unmatched}, alignment {self.align}",
            "position RMS": f"{self.ape_m.rmse:.3f} m",
            **({} if self.rotation_deg is None else {"rotation RMS": f"{self.rotation_deg.rmse:.3f} deg"}),
            **({"NEES (expected 3, yaw 1)": nees} if nees else {}),
        }

    def plot(self) -> figures.AxesList:
        """Errors east, north, up with two sigmas of the solution, and of the rotation, as axes of matplotlib.

        Raises
        ------
        SmartnavError
            matplotlib is not installed.
        """
        panels = [
            figures.Panel(f"{name}, m", self.error_enu_m[:, i], self.sigma_enu[:, i], around_zero=True)
            for i, name in enumerate(("east", "north", "up"))
        ]
        if self.rotation_error_deg is not None:
            panels.append(figures.Panel("rotation, deg", self.rotation_error_deg))
        return figures.path_and_series(None, seconds_since(self.t_ns, int(self.t_ns[0])), panels)

    @property
    def matched(self) -> int:
        """Reference rows inside the run."""
        return len(self.t_ns)

    @cached_property
    def ape_m(self) -> Statistics:
        """Absolute position error."""
        return Statistics.of(np.linalg.norm(self.error_enu_m, axis=1))

    @cached_property
    def rotation_deg(self) -> Statistics | None:
        """Absolute attitude error; None without attitude in the reference."""
        return None if self.rotation_error_deg is None else Statistics.of(self.rotation_error_deg)

    def to_dict(self) -> dict[str, object]:
        """The figures as ``smartnav evaluate --json`` prints them."""
        return {
            "solution": self.solution,
            "reference": self.reference,
            "align": self.align,
            "time_offset_s": self.time_offset_s,
            "matched": self.matched,
            "unmatched": self.unmatched,
            "ape_m": asdict(self.ape_m),
            "rotation_deg": None if self.rotation_deg is None else asdict(self.rotation_deg),
            "rpe": [
                {"delta_s": r.delta_s, "translation_m": r.translation_m, "rotation_deg": r.rotation_deg}
                for r in self.rpe
            ],
            "nees": dict(self.nees),
            "nees_verdict": dict(self.nees_verdict),
        }


def evaluate(
    solution: Solution,
    reference: Reference | Session,
    *,
    align: str = "none",
    time_offset_s: float | Literal["auto"] = 0.0,
    rpe_deltas_s: Sequence[float] = (1.0, 5.0, 10.0),
    solution_name: str = "smoothed",
    reference_name: str = "reference",
) -> Evaluation:
    """Compare a solution with a reference.

    The inertial data carry the solution to each reference stamp inside the run (see `interpolate.states_at`); where it
    holds none it is interpolated (linear, attitude by slerp). Then it is aligned.

    Parameters
    ----------
    reference : or a session that has one
    align : ``none``, ``yaw`` (vertical rotation and translation), ``se3`` or ``sim3``
    time_offset_s : a reference stamp t is solution time t + offset; ``auto`` finds it (`find_time_offset`)
    rpe_deltas_s : seconds between the ends of the motions whose error is reported
    solution_name, reference_name : what to call them in the result

    Raises
    ------
    SessionError
        No reference stamp lies inside the run; unknown alignment, or one the positions do not determine.
    InputTypeError
        No solution, or neither a reference nor a session that has one.
    """
    reference = _compared(solution, reference)
    offset_s = find_time_offset(solution, reference, align) if time_offset_s == "auto" else float(time_offset_s)
    estimate, whole = states_of_solution(solution), states_of_reference(reference, round(offset_s * NS))
    check_overlap(estimate, whole, solution.t0_ns, offset_s)

    truth = whole.take(whole.inside(estimate))
    raw = estimate.at(truth.t_ns)
    alignment = fit_alignment(align, raw.position, truth.position)
    matched = aligned(raw, alignment)
    common, expected = _at_common_epochs(estimate, whole)
    averages, verdicts, notes = _consistency(aligned(common, alignment), expected)
    assert matched.covariance is not None
    return Evaluation(
        solution=solution_name,
        reference=reference_name,
        align=align,
        time_offset_s=offset_s,
        unmatched=len(whole) - len(truth),
        rpe=tuple(relative_error(matched, truth, delta) for delta in rpe_deltas_s),
        nees=averages,
        nees_verdict=verdicts,
        alignment=alignment,
        t_ns=truth.t_ns,
        error_enu_m=matched.position - truth.position,
        rotation_error_deg=rotation_error_deg(matched, truth),
        sigma_enu=np.sqrt(np.clip(np.diagonal(matched.covariance, axis1=1, axis2=2)[:, POS], 0.0, None)),
        notes=notes,
    )


def _compared(solution: Solution, reference: Reference | Session) -> Reference:
    """The reference, also that of a session; both arguments checked."""
    if not isinstance(solution, Solution):
        remedy = "sn.smooth(session) gives one; a run has it as run.solution"
        raise InputTypeError("solution", f"is {type(solution).__name__}", "a Solution", remedy)
    found = reference.reference if isinstance(reference, Session) else reference
    if not isinstance(found, Reference):
        what = "is a Session without reference" if isinstance(reference, Session) else f"is {type(found).__name__}"
        remedy = "sn.load_reference(FILE) reads one"
        raise InputTypeError("reference", what, "a Reference, or a Session that has one", remedy)
    return found


def aligned(states: StateSeries, alignment: FrameAlignment) -> StateSeries:
    """A solution's states, with covariances, after an alignment."""
    assert states.rotation is not None and states.velocity is not None and states.covariance is not None
    scale = np.repeat([1.0, alignment.scale, alignment.scale], 3)
    J = scale[:, None] * np.kron(np.eye(3), alignment.R)
    return StateSeries(
        t_ns=states.t_ns,
        position=alignment.position(states.position),
        rotation=alignment.R @ states.rotation,
        velocity=alignment.scale * states.velocity @ alignment.R.T,
        covariance=J @ states.covariance @ J.T,
    )


def rotation_error_deg(estimate: StateSeries, truth: StateSeries) -> Floats | None:
    """Geodesic angle (n,) between the attitudes; None where one has none."""
    if estimate.rotation is None or truth.rotation is None:
        return None
    return np.asarray(np.degrees(np.linalg.norm(_rotation_error(estimate.rotation, truth.rotation), axis=1)))


def _rotation_error(estimate: Floats, truth: Floats) -> Floats:
    """Rotation vectors (n, 3) rad, nav axes: R_ref = Exp(theta) R_est."""
    return log(truth @ estimate.transpose(0, 2, 1))


def relative_error(estimate: StateSeries, truth: StateSeries, delta_s: float) -> RelativeError:
    """Error of the motion over `delta_s`, RMS over all pairs that far apart, half a period more or less."""
    i, j = _pairs(truth.t_ns, delta_s)
    if not len(i):
        return RelativeError(delta_s, None, None, 0)
    motion, expected = (one.position[j] - one.position[i] for one in (estimate, truth))
    if estimate.rotation is None or truth.rotation is None:
        return RelativeError(delta_s, _rms(motion - expected), None, len(i))
    R, Q = estimate.rotation, truth.rotation
    difference = rotate_back(R[i], motion) - rotate_back(Q[i], expected)
    turn = _rotation_error(R[i].transpose(0, 2, 1) @ R[j], Q[i].transpose(0, 2, 1) @ Q[j])
    return RelativeError(delta_s, _rms(difference), float(np.degrees(_rms(turn))), len(i))


def _rms(vectors: Floats) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _pairs(t_ns: Times, delta_s: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices i < j of all pairs `delta_s` +- half a median period apart."""
    if len(t_ns) < 2:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    delta, half = round(delta_s * NS), int(np.median(np.diff(t_ns))) // 2
    first = np.searchsorted(t_ns, t_ns + delta - half, side="left")
    first = np.maximum(first, np.arange(len(t_ns)) + 1)
    last = np.maximum(np.searchsorted(t_ns, t_ns + delta + half, side="right"), first)
    count = last - first
    i = np.repeat(np.arange(len(t_ns)), count)
    j = np.arange(len(i)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    return i, j


def _consistency(
    estimate: StateSeries, truth: StateSeries
) -> tuple[dict[str, float | None], dict[str, str], tuple[str, ...]]:
    """Average NEES of position, velocity, attitude, yaw, what they mean, and notes.

    Sigmas of the reference, where given, are added to the covariance of the position.
    """
    if not len(truth):
        none = dict.fromkeys(("position", "velocity", "attitude", "yaw"))
        return none, {}, ("nees: no epoch of the run in reference",)
    P = estimate.covariance
    assert P is not None and estimate.rotation is not None and estimate.velocity is not None
    position = P[:, POS, POS]
    if truth.sigma is not None:
        position = position + np.nan_to_num(truth.sigma)[:, :, None] ** 2 * np.eye(3)
    checks = {"position": (estimate.position - truth.position, position)}
    if truth.velocity is not None:
        checks["velocity"] = (estimate.velocity - truth.velocity, P[:, VEL, VEL])
    if truth.rotation is not None:
        theta = _rotation_error(estimate.rotation, truth.rotation)
        checks["attitude"] = (theta, P[:, ROT, ROT])
        checks["yaw"] = (theta[:, 2:], P[:, 2:3, 2:3])
    averages: dict[str, float | None] = {}
    verdicts: dict[str, str] = {}
    notes: list[str] = []
    for name in ("position", "velocity", "attitude", "yaw"):
        averages[name] = None
        if name not in checks:
            notes.append(f"nees {name}: the reference has no {'velocity' if name == 'velocity' else 'attitude'}")
            continue
        values = nees(*checks[name])
        bad = int((~np.isfinite(values)).sum())
        if bad:
            notes.append(f"nees {name}: covariance not positive definite at {bad} of {len(values)} epochs")
        else:
            averages[name] = float(values.mean())
            verdicts[name] = nees_verdict(float(values.mean()), *checks[name])
    return averages, verdicts, tuple(notes)


def nees_verdict(average: float, errors: Floats, covariances: Floats) -> str:
    """What the average NEES of errors (n, k) says of their covariances (n, k, k), in words.

    It is right inside the 95 % interval of chi2 with as many degrees of freedom as the whitened errors have independent
    values, n / (1 + 2 sum of their autocorrelation up to its first zero) a component.
    """
    white = np.linalg.solve(np.linalg.cholesky(covariances), errors[:, :, None])[:, :, 0]
    n, k = white.shape
    power = np.fft.rfft(white, 2 * n, axis=0)
    correlation = np.fft.irfft(np.abs(power) ** 2, axis=0)[:n]
    correlation = correlation / np.maximum(correlation[0], 1e-300)
    positive = np.logical_and.accumulate(correlation > 0.0, axis=0)
    independent = float((n / np.maximum(2.0 * (correlation * positive).sum(axis=0) - 1.0, 1.0)).sum())
    low, high = chi_square.ppf([0.025, 0.975], independent) / independent
    ratio = average / k
    if low <= ratio <= high:
        return "sigmas right"
    factor = max(float(np.sqrt(ratio)), 1e-9)
    return f"sigmas {factor:.2g} times too small" if factor > 1.0 else f"sigmas {1.0 / factor:.2g} times too large"


def nees(errors: ArrayLike, covariances: ArrayLike) -> Floats:
    """Normalised estimation error squared, e^T P^-1 e, of every row.

    Expected value k (the dimension) where the covariance is right; a larger mean means that it is too small.

    Parameters
    ----------
    errors : (n, k)
    covariances : (n, k, k), same units squared

    Returns
    -------
    (n,) dimensionless; NaN where the covariance is not finite or not positive definite.
    """
    e = np.asarray(errors, dtype=np.float64)
    P = np.asarray(covariances, dtype=np.float64)
    out = np.full(len(e), np.nan)
    good: Mask = np.asarray(np.isfinite(P).all(axis=(1, 2)))
    # eigvalsh finds indefinite matrices without raising for the whole stack, as a Cholesky would
    good[good] = np.linalg.eigvalsh(P[good])[:, 0] > 0.0
    out[good] = np.einsum("ni,ni->n", e[good], np.linalg.solve(P[good], e[good][:, :, None])[:, :, 0])
    return out


def _at_common_epochs(estimate: StateSeries, truth: StateSeries) -> tuple[StateSeries, StateSeries]:
    """Both at the epochs of whichever is sparser, the denser one interpolated: a linear interpolation over 1 s errs by
    more than a good solution's sigma. Rows inside a gap of the reference are left out."""
    inside, covered = truth.take(truth.inside(estimate)), estimate.take(estimate.inside(truth))
    if len(inside) <= len(covered):
        return estimate.at(inside.t_ns), inside
    after = np.clip(np.searchsorted(truth.t_ns, covered.t_ns), 1, len(truth) - 1)
    step = np.diff(truth.t_ns)
    covered = covered.take(step[after - 1] <= 3 * np.median(step))
    return covered, truth.at(covered.t_ns)
