"""What is assumed of the first keyframe. Weak by default: data, not the prior, decide.

Rotation sigma pi / sqrt(3) is that of an angle nobody knows; velocity 100 m/s bounds what moves on the ground;
position has no prior unless one was given; biases have the turn-on spread of the device class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.factors.magnetometer import IRON
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import Builder, FactorId, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.detect.stances import REST_SPEED

UNKNOWN_ANGLE = float(np.pi / np.sqrt(3.0))
UNKNOWN_PLACE = 1e5  # m


@dataclass(frozen=True)
class PriorConfig:
    """angle_sigma : sigma of the first attitude, rad; speed_sigma : sigma of the first velocity, m/s."""

    angle_sigma: float = UNKNOWN_ANGLE
    speed_sigma: float = 100.0

    def __post_init__(self) -> None:
        if not (self.angle_sigma > 0 and self.speed_sigma > 0):
            raise ConfigError("config [prior]", "angle_sigma or speed_sigma <= 0", "> 0")


@dataclass
class PriorBuilder(Builder):
    """Prior factors at the first keyframe.

    start : first state; sigma_rot (3,) rad nav axes, sigma_pos (3,) m or None, sigma_vel (3,) m/s,
    sigma_bias (6,) m/s^2 and rad/s around `bias_mean`; rest_end_ns : end of a rest that begins at the first keyframe.
    attitude is the mean of the rotation prior, that of `start` where there is none of its own. magnetic_stage : its
    heading comes from the magnetometer, and is used until the magnetometer's own factor is, from that stage on.
    Zero velocity at its keyframes ties tilt to accelerometer bias: a levelled start is off by the one as the other is.
    """

    start: State
    sigma_rot: Floats
    sigma_pos: Floats | None
    sigma_vel: Floats
    sigma_bias: Floats
    velocity_mean: Floats
    bias_mean: gtsam.imuBias.ConstantBias
    rest_end_ns: int | None = None
    attitude: gtsam.Rot3 | None = None
    magnetic_stage: int | None = None
    name: str = "prior"
    stage: int = 0

    def with_position(self) -> PriorBuilder:
        """The same for an incremental smoother, which solves at the first keyframe, before the first fix: a position
        sigma of 100 km where there is none, and the bias of `start` as the mean of its prior unless a rest gave it."""
        place = np.full(3, UNKNOWN_PLACE) if self.sigma_pos is None else self.sigma_pos
        mean = self.start.bias if self.rest_end_ns is None else self.bias_mean
        return replace(self, sigma_pos=place, bias_mean=mean)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """Prior factors and initial values of the first keyframe; later only zero velocity while the rest lasts."""
        from scipy.linalg import block_diag

        if window.kind != "first":
            if self.rest_end_ns is not None and window.t1_ns <= self.rest_end_ns:
                still = gtsam.noiseModel.Isotropic.Sigma(3, REST_SPEED)
                zero = gtsam.PriorFactorVector(key("V", window.index), np.zeros(3), still)
                update.add(FactorId("rest", window.t1_ns), zero)
            return
        update.predicted, update.bias = self.start.nav, self.start.bias
        tag = FactorId("prior", window.t1_ns)
        x, v, b = (key(letter, window.index) for letter in "XVB")
        pose = self.start.nav.pose()
        attitude = pose.rotation() if self.attitude is None else self.attitude
        nav_R_body = attitude.matrix()
        rot = nav_R_body.T @ np.diag(self._sigma_rot(pass_state) ** 2) @ nav_R_body
        if self.sigma_pos is None:
            update.add(tag, gtsam.PoseRotationPrior3D(x, attitude, gtsam.noiseModel.Gaussian.Covariance(rot)))
        else:
            place = nav_R_body.T @ np.diag(self.sigma_pos**2) @ nav_R_body
            mean, model = gtsam.Pose3(attitude, pose.translation()), gtsam.noiseModel.Gaussian.Covariance
            update.add(tag, gtsam.PriorFactorPose3(x, mean, model(block_diag(rot, place))))
        sigmas = gtsam.noiseModel.Diagonal.Sigmas
        update.add(tag, gtsam.PriorFactorVector(v, self.velocity_mean, sigmas(self.sigma_vel)))
        update.add(tag, gtsam.PriorFactorConstantBias(b, self.bias_mean, sigmas(self.sigma_bias)))

    def _sigma_rot(self, pass_state: PassState) -> Floats:
        if self.magnetic_stage is None or pass_state.stage < self.magnetic_stage or IRON in pass_state.fixed_states:
            return self.sigma_rot
        return np.array([*self.sigma_rot[:2], UNKNOWN_ANGLE])
