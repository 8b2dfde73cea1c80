"""What happened in one run: the content of summary.json."""

from __future__ import annotations

import platform
import resource
import sys
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from smartnav_graph.estimate.alignment.initial_state import InitialState
from smartnav_graph.estimate.problem import Problem
from smartnav_graph.estimate.result.assemble import SolvedProblem, Withheld, used_counts
from smartnav_graph.estimate.result.chi2 import chi2_of
from smartnav_graph.estimate.result.reasons import VerdictInputs
from smartnav_graph.estimate.result.rejections import rejections
from smartnav_graph.estimate.result.score_tests import Unmodelled
from smartnav_graph.estimate.result.verdict import verdict
from smartnav_graph.estimate.reweight.false_standstills import refuted_text
from smartnav_graph.estimate.reweight.image_pair_outliers import Account, pair_account
from smartnav_graph.estimate.reweight.image_weight import weight_text
from smartnav_graph.estimate.reweight.imu_noise import NOISE_NAMES
from smartnav_graph.estimate.reweight.outliers import position_builders
from smartnav_graph.estimate.reweight.track_outliers import track_account
from smartnav_graph.estimate.reweight.update import OBSERVED
from smartnav_graph.factors.camera import STREAM
from smartnav_graph.factors.coplanarity import SHARED, SMART
from smartnav_graph.factors.gauss_markov import correlated_sigma
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.solution import POS, Solution
from smartnav_graph.session.session import Session
from smartnav_graph.smoothers.estimate import Estimate

PACKAGES = ("smartnav-graph", "gtsam", "numpy", "scipy", "opencv-python-headless", "pycolmap", "rerun-sdk")
# Chi-square per degree of freedom that no tolerable noise model explains: residuals twice their sigma.
MISFIT = 4.0


def versions() -> dict[str, str]:
    """Versions of what the result depends on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def peak_memory_mb() -> float:
    """Largest resident set of this process, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0 * 1024.0 if sys.platform == "darwin" else 1024.0)


HEADING_UNKNOWN = (
    "heading: unknown, every heading fits the measurements; add a magnetometer or a part in which the speed or the "
    "direction of travel changes, or give --initial"
)
POSITIONS_ONLY = "positions only"  # mode without inertial data; see `estimate.constant_velocity`


def _doubts(estimate: Estimate, mode: str, chi2: float, extra: Mapping[str, Any]) -> list[str]:
    doubts = [HEADING_UNKNOWN] * (extra.get("heading_known") is False and mode != POSITIONS_ONLY)
    if mode not in ("batch", POSITIONS_ONLY):
        relative = mode.replace("dead-", "dead ")
        doubts.append(f"{relative}: no absolute position measurement, errors grow with time; add position fixes")
    if not estimate.converged:
        doubts.append("solve: the iteration limit was reached before the cost settled; raise solver.max_iterations")
    if chi2 > MISFIT:
        doubts.append(
            f"solve: chi-square per degree of freedom is {chi2:.1f}, about 1 is expected: the measurements contradict "
            "each other or their sigmas are too small; check units, axes and clocks with `smartnav info`"
        )
    return doubts


def run_facts(summary: Mapping[str, Any]) -> dict[str, str]:
    """What is shown of a run in one line: verdict, mode, size, uncertainty, errors at withheld rows."""
    sigma, withheld = summary["position_sigma_m"]["median"], summary.get("withheld") or {}
    errors = (f"{name} {one['rms_horizontal_m']:.3f} m of {one['count']}" for name, one in withheld.items())
    return {
        "verdict": str(summary.get("verdict", {}).get("level", "none")),
        "mode": str(summary["mode"]),
        "span": f"{summary['duration_s']:.1f} s, {summary['path_m']:.1f} m, {summary['keyframes']} keyframes",
        "horizontal sigma (median)": f"{sigma:.3f} m",
        **({"withheld (horizontal RMS)": ", ".join(errors)} if withheld else {}),
    }


def summarise(
    solved: SolvedProblem,
    initial: InitialState,
    keyframes: Solution,
    withheld: Mapping[str, Withheld],
    timings: Mapping[str, float],
    extra: Mapping[str, Any],
    looked_at: Unmodelled | None = None,
) -> dict[str, Any]:
    """The content of summary.json; `extra` overrides and adds."""
    problem, estimate, pass_state = solved.problem, solved.estimate, solved.pass_state
    duration = float(keyframes.seconds[-1] - keyframes.seconds[0])
    used = used_counts(problem, pass_state)
    seen = pair_account(problem.builders, pass_state)
    tracks = track_account(problem.builders, pass_state)
    fit = chi2_of(solved, keyframes, tracks)
    chi2 = fit.per_dof()
    mode = _mode(problem, used, seen, tracks)
    # States that left a lag one after the other were never solved together: their misfit says nothing of the data.
    together = "polish" in extra or not str(extra.get("mode", "")).startswith("replay")
    refused = [one.refused for one in (seen, tracks) if one is not None and one.refused] + weight_text(pass_state)
    warnings = [*problem.warnings, *refused, *_doubts(estimate, mode, chi2["overall"] if together else 0.0, extra)]
    warnings += refuted_text(problem.rests, pass_state, problem.session.t0_ns)
    summary: dict[str, Any] = {
        "verdict": verdict(VerdictInputs(solved, fit, withheld, together, looked_at)),
        "mode": mode,
        "vehicle": problem.vehicle,
        "session": _session(problem.session),
        "duration_s": duration,
        "path_m": keyframes.path_length(),
        "keyframes": len(keyframes),
        "factors": {problem.label(name): count for name, count in _factor_counts(estimate).items()},
        "chi2_per_dof": chi2,
        "redundancy": {name: round(part.redundancy, 3) for name, part in fit.parts.items()},
        "without_chi2": fit.reasons(),
        "iterations": estimate.iterations,
        "converged": estimate.converged,
        "cost": estimate.cost,
        "states": _states(solved),
        "clock": problem.clocks.to_dict(),
        "camera": _camera(problem, pass_state),
        **({} if problem.pictures is None else {"pictures": asdict(problem.pictures)}),
        "timings_s": {name: round(value, 4) for name, value in timings.items()},
        "real_time_factor": round(duration / max(timings["total"], 1e-9), 2),
        "peak_memory_mb": round(peak_memory_mb(), 1),
        "gaps": _gaps(problem),
        "standstills": _standstills(problem),
        "dropped": {name: dict(counts) for name, counts in problem.dropped.items()},
        "used": dict(used),
        "rejected": _rejected(pass_state, seen, tracks),
        **({} if seen is None else {"image_pairs": dict(seen.reasons)}),
        **({} if tracks is None else {"tracks": dict(tracks.reasons)}),
        "rejections": rejections(solved),
        "withheld": {name: rows.to_dict() for name, rows in withheld.items()},
        "position_sigma_m": _sigma_summary(keyframes),
        "initialisation": initial.to_dict(),
        "warnings": warnings,
        "versions": versions(),
    }
    return summary | dict(extra)


def _mode(problem: Problem, used: Mapping[str, int], seen: Account | None, tracks: Account | None) -> str:
    """What holds the position."""
    images = (seen is not None and seen.used > 0) or (tracks is not None and tracks.in_force)
    mode = "batch" if used else "visual-inertial odometry" if images else "dead-reckoning"
    return POSITIONS_ONLY if problem.positions_only else mode


def _session(session: Session) -> dict[str, Any]:
    return {
        "device": session.device.name,
        "clock_epoch": session.clock_epoch,
        "t0_ns": session.t0_ns,
        "forward": session.device.forward,
        "up": session.device.up,
        "gravity_m_s2": session.gravity,
    }


def _factor_counts(estimate: Estimate) -> dict[str, int]:
    counts = Counter(tag.sensor for tag, _ in estimate.factors)
    for block in estimate.blocks:
        counts[block.sensor] += len(block.keys)
    return dict(counts)


def _gaps(problem: Problem) -> list[dict[str, Any]]:
    t0 = problem.session.t0_ns
    return [
        {"start_s": round((gap.start_ns - t0) / 1e9, 3), "length_s": round(gap.length_s, 3), "kind": gap.kind}
        for gap in problem.gaps
    ]


def _rejected(pass_state: PassState, seen: Account | None, tracks: Account | None) -> dict[str, int]:
    """Rows rejected as outliers, by sensor; image pairs and tracks that contradict the trajectory, and matches and
    observations of those that do not."""
    found = {name: len(rows) for name, rows in pass_state.rejected.items() if name not in ("image_pairs", "matches")}
    if seen is not None:
        found |= {"image_pairs": seen.contrary, "matches": seen.outliers}
    if tracks is not None and tracks.in_force:
        found |= {SMART: tracks.contrary, "tracks": tracks.outliers}
    return found


def _states(solved: SolvedProblem) -> dict[str, dict[str, Any]]:
    problem, estimate, pass_state = solved.problem, solved.estimate, solved.pass_state
    found: dict[str, dict[str, Any]] = {}
    for state in estimate.session.values():
        sigma = state.prior_sigma if state.held else state.sigma
        if state.name == f"{STREAM}_time_offset_s" and problem.camera_turns is not None and problem.camera_turns.known:
            turns = problem.camera_turns  # a clock that drifts has no offset that is better known than turns show it
            sigma = np.hypot(sigma, max(turns.sigma_s, abs(float(state.value[0]) - turns.offset_s)))
        value, spread = ([round(float(x), 6) for x in numbers] for numbers in (state.value, sigma))
        alone = len(value) == 1
        pair = (value[0], spread[0]) if alone else (value, spread)
        found[state.name] = _state(*pair, held=state.held)
        if not alone and not state.held:
            found[state.name]["observed"] = (state.sigma < OBSERVED * state.prior_sigma).tolist()
    found |= _noise(problem, pass_state)
    for builder in position_builders(problem.builders):
        if builder.name in pass_state.correlated:
            value = correlated_sigma(builder.noise).tolist()
            found[f"{builder.name}_correlated_sigma_m"] = _state(value, held=True)
        if builder.name in pass_state.noise_scales:
            row = np.lexsort([~builder.measures_height, builder.own_sigma])[0]  # one with heights, where there is one
            sigma = builder.scaled_sigma(pass_state)[row]
            found[f"{builder.name}_sigma_m"] = _state([round(float(s), 4) for s in sigma])
    return found


def _camera(problem: Problem, pass_state: PassState) -> dict[str, Any]:
    """The camera beside the gyroscope, and the error of the direction of image pairs that the others ask for."""
    turns, shared = problem.camera_turns, pass_state.noise_scales.get(SHARED, 0.0)
    found: dict[str, Any] = {} if turns is None else dict(turns.to_dict())
    return found | ({"direction_sigma_deg": round(float(np.degrees(shared)), 3)} if shared else {})


def _state(value: object, sigma: object = None, *, held: bool = False) -> dict[str, Any]:
    return {"value": value, "sigma": sigma, "held": held}


def _noise(problem: Problem, pass_state: PassState) -> dict[str, dict[str, Any]]:
    """Noise densities, bias walks and sigmas of the constraints; held where the data said too little of them."""
    noise = problem.calibration.imu_noise
    if problem.positions_only:
        density = float(f"{noise.accel_noise_density * pass_state.scale('accel'):.4g}")
        return {"motion_model_acceleration_density": _state(density, held="accel" not in pass_state.noise_scales)}
    inertial = NOISE_NAMES if problem.config.imu.estimate_noise else {}
    used = [(name, group, getattr(noise, name)) for group, name in inertial.items()]
    for builder in problem.builders:
        used += [(f"{group}_sigma", group, sigma) for group, sigma in builder.noise_groups.items()]
    return {
        name: _state(float(f"{sigma * pass_state.scale(group):.4g}"), held=group not in pass_state.noise_scales)
        for name, group, sigma in used
    }


def _standstills(problem: Problem) -> dict[str, Any]:
    """Number and duration of the standstills in the solved time span, and how much of it is completely at rest."""
    rests = problem.rests
    if rests is None:
        return {}
    first, last = problem.windows[0].t1_ns, problem.windows[-1].t1_ns
    found = {"total_s": rests.spans(), "at_rest_s": rests.rests()}
    inside = {
        name: [(max(a, first), min(b, last)) for a, b in spans if b > first and a < last]
        for name, spans in found.items()
    }
    seconds = {name: round(sum(b - a for a, b in spans) / 1e9, 3) for name, spans in inside.items()}
    t0 = problem.session.t0_ns
    spans = [[round((a - t0) / 1e9, 3), round((b - t0) / 1e9, 3)] for a, b in inside["total_s"]]
    return {"count": len(spans), **seconds, "on_foot": rests.on_foot, "spans_s": spans}


def _sigma_summary(solution: Solution) -> dict[str, float]:
    horizontal = np.hypot(*solution.sigmas[:, POS][:, :2].T)
    return {
        "median": float(np.median(horizontal)),
        "p95": float(np.percentile(horizontal, 95)),
        "max": float(horizontal.max()),
    }
