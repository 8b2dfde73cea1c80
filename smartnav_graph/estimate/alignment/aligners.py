"""The ways to a first state, in the order they are tried: each (first stretch) -> candidates.

A new one adds a function here and a row to `ALIGNERS`. Where a sensor gives positions that have to be computed first,
it adds a function to `inputs.POSITIONS` instead: all that align by fixes then use them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.alignment.first_stretch import OPEN_SIGMA, Candidate, FirstStretch
from smartnav_graph.estimate.alignment.initial_state import InitialState
from smartnav_graph.estimate.alignment.static import inertial_curve, kabsch_attitude
from smartnav_graph.graph.states import State

# Lengths (s) of the fitted curve: a short one suffers less from an unknown gyro bias, a long one from noise.
CURVE_S = (12.0, np.inf)
# Speed (m/s) above which the course of the fixes is taken as the first heading to try.
COURSE_SPEED = 1.0


def user_start(first: FirstStretch) -> list[Candidate]:
    """The user's position and heading, levelled by the accelerometer."""
    user = first.user
    if user is None:
        return []
    prior = first.levelled_prior(user.heading_deg, np.array(user.position), user.sigma_m, user.sigma_deg)
    how, stretch_s = "levelled over a rest" if first.rest is not None else "levelled by the first two seconds", 0.0
    magnetic = first.field_start
    if magnetic is not None and np.radians(user.sigma_deg) > OPEN_SIGMA:
        state = first.state(magnetic.nav_R_body, prior.start.nav.position(), np.zeros(3), magnetic.gyro_bias)
        sigma = np.array([*prior.sigma_rot[:2], magnetic.heading_sigma])
        prior = replace(prior, start=state, sigma_rot=sigma, magnetic_stage=first.magnetic_stage)
        how, stretch_s = f"{how}; turned to magnetic north", magnetic.length_s
    sentence = (
        f"Start given: heading {user.heading_deg:.1f} deg +- {user.sigma_deg:g} deg, position +- {user.sigma_m:g} m; "
        f"{how}."
    )
    final = InitialState(prior, "given", sentence, user.heading_deg, user.sigma_deg, stretch_s, 1, first.pass_state)
    return [Candidate(prior.start, final)]


def static_alignment(first: FirstStretch) -> list[Candidate]:
    """Without any position: a rest gives the vertical, the magnetometer the heading, and the start is the origin."""
    rest, magnetic = first.rest, first.magnetic_heading
    if len(first.fixes) or rest is None:
        return []
    tilt = first.noise.accel_bias_sigma / first.gravity  # of the levelling, which turns the heading to second order
    heading, sigma = magnetic if magnetic is not None else (0.0, max(1e-3, float(np.degrees(tilt**2))))
    prior = first.levelled_prior(heading, np.zeros(3), 1e-3, sigma)
    prior = replace(prior, magnetic_stage=None if magnetic is None else first.magnetic_stage)
    source = (
        f"heading {heading:.1f} deg from the magnetometer"
        if magnetic is not None
        else "heading and position set to zero (local frame)"
    )
    sentence = f"No absolute sensor: started from a rest of {rest.length_s:.1f} s; {source}."
    stretch_s = max(rest.length_s, first.field_start.length_s if first.field_start is not None else 0.0)
    final = InitialState(prior, "static", sentence, heading, sigma, stretch_s, 1, first.pass_state)
    return [Candidate(prior.start, final)]


def visual_alignment(first: FirstStretch) -> list[Candidate]:
    """Without any position and rest: gravity and velocity by images (`visual.visual_start`), heading and position
    zero."""
    found = first.visual
    if found is None or first.rest is not None:
        return []
    R = frames.nav_R_body_from_heading(0.0, -found.gravity, first.forward)
    velocity = R @ found.velocity
    state = State.of(0, first.start_ns, (R, np.zeros(3), velocity), found.bias)
    tilt = first.noise.accel_bias_sigma / first.gravity
    sigma_rot, sigma_v = np.array([tilt, tilt, 1e-3]), float(np.linalg.norm(found.velocity_sigma))
    prior = first.prior(
        state, sigma_rot=sigma_rot, sigma_pos=np.full(3, 1e-3), sigma_vel=np.full(3, sigma_v), velocity_mean=velocity
    )
    sentence = (
        f"No absolute sensor and no rest: started in motion at {np.linalg.norm(velocity):.2f} m/s +- {sigma_v:.2f} m/s "
        f"by images and inertial data of {found.length_s:.0f} s; heading and position set to zero (local frame)."
    )
    final = InitialState(prior, "visual", sentence, 0.0, 0.1, found.length_s, 1, first.pass_state)
    return [Candidate(state, final)]


def pedestrian_alignment(first: FirstStretch) -> list[Candidate]:
    """The start of the whole path of a pedestrian, laid on the fixes (`pedestrian.walked`)."""
    if first.walk is None or not len(first.fixes):
        return []
    return [Candidate(first.walk.state(), values=first.walk.values, count=len(first.walk.windows))]


def attitude_alignment(first: FirstStretch) -> list[Candidate]:
    """The attitude of the first pose fixes (`attitude.attitude_start`)."""
    found = first.attitude_start
    if found is None:
        return []
    return [Candidate(first.state(found.nav_R_body, *first.first_motion, found.gyro_bias))]


def magnetic_alignment(first: FirstStretch) -> list[Candidate]:
    """Magnetic field and gravity (`magnetic.field_start`), or the mean field over a rest."""
    if first.field_start is not None:
        found = first.field_start
        return [Candidate(first.state(found.nav_R_body, *first.first_motion, found.gyro_bias))]
    return [] if first.magnetic_heading is None else [_levelled(first, first.magnetic_heading[0])]


def in_motion_alignment(first: FirstStretch) -> list[Candidate]:
    """The inertial curve laid on the fixes: Wahba's problem, solved as by Kabsch (1976)."""
    t_ns, fixes = first.fixes.t_ns[first.known], first.fixes.position[first.known]
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3) if first.rest is None else first.rest.gyro)
    t, at = (t_ns - first.start_ns) / NS, np.searchsorted(first.ends_ns, t_ns)
    curve = inertial_curve(first.windows[: first.count], bias)[np.minimum(at, first.count - 1)]
    found: list[tuple[Floats, Floats, Floats]] = []
    for length_s in CURVE_S:
        near = t <= t[0] + length_s
        if near.sum() >= 4 and not (found and near.all()):
            found.append(kabsch_attitude(curve[near], fixes[near], t[near], first.gravity))
    return [Candidate(first.state(*start)) for start in found]


def headings_all_round(first: FirstStretch) -> list[Candidate]:
    """Headings all round, from the course of the fixes on, levelled by the accelerometer."""
    velocity, count = first.first_motion[1], first.config.starts
    moving = float(np.linalg.norm(velocity[:2])) > COURSE_SPEED
    course = float(np.degrees(np.arctan2(velocity[0], velocity[1]))) if moving else 0.0
    return [_levelled(first, float(heading)) for heading in course + np.arange(count) * 360.0 / count]


def _levelled(first: FirstStretch, heading_deg: float) -> Candidate:
    return Candidate(first.state(first.nav_R_body(heading_deg), *first.first_motion))


class Aligner(NamedTuple):
    """candidates : see the module; alone : its candidate is the first state where it fits, without a comparison."""

    candidates: Callable[[FirstStretch], Sequence[Candidate]]
    alone: bool = False


ALIGNERS: Mapping[str, Aligner] = {
    "user": Aligner(user_start, alone=True),
    "static": Aligner(static_alignment, alone=True),
    "visual": Aligner(visual_alignment, alone=True),
    "pedestrian": Aligner(pedestrian_alignment, alone=True),
    "attitude": Aligner(attitude_alignment),
    "magnetic": Aligner(magnetic_alignment),
    "in_motion": Aligner(in_motion_alignment),
    "headings": Aligner(headings_all_round),
}
