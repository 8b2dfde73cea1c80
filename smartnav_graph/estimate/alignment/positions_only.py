"""First state where there are no inertial data: at the first position, level, with an unknown velocity."""

from __future__ import annotations

import numpy as np

from smartnav_graph.estimate.alignment.initial_state import InitialState
from smartnav_graph.estimate.alignment.inputs import absolute_positions
from smartnav_graph.estimate.problem import Problem
from smartnav_graph.factors.prior import UNKNOWN_ANGLE, PriorBuilder
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State

# rad, of the level device of the motion model, whose heading is none: a residual in its axes depends on them.
MODEL_SIGMA = 1e-4


def first_position(problem: Problem) -> InitialState:
    """See `estimate.constant_velocity` for the model."""
    fixes, noise = absolute_positions(problem), problem.calibration.imu_noise
    position = fixes.position[int(np.argmin(fixes.t_ns))]
    state = State.of(0, problem.windows[0].t1_ns, (np.eye(3), position, np.zeros(3)), np.zeros(6))
    prior = PriorBuilder(
        start=state,
        sigma_rot=np.full(3, MODEL_SIGMA),
        sigma_pos=None,
        sigma_vel=np.full(3, problem.config.prior.speed_sigma),
        sigma_bias=np.array([noise.accel_bias_sigma] * 3 + [noise.gyro_bias_sigma] * 3),
        velocity_mean=np.zeros(3),
        bias_mean=state.bias,
    )
    sentence = "Begins at the first position; without inertial data the attitude is not estimated."
    sigma_deg = float(np.degrees(UNKNOWN_ANGLE))
    return InitialState(prior, "positions", sentence, 0.0, sigma_deg, 0.0, 1, PassState())
