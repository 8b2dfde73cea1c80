"""An exact recording of a known motion, and the graph that the package makes of it.

Readings are without noise, local frame, gravity 9.81 m/s^2. Fixes stand between inertial samples, so that borders of
windows are interpolated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import gtsam
import numpy as np

from smartnav_graph.core.timebase import NS, Gap, ns_from_seconds
from smartnav_graph.estimate.config import Config
from smartnav_graph.factors import FactorContext, make_builders
from smartnav_graph.factors.gnss import GnssConfig
from smartnav_graph.graph.interpolate import Kinematics
from smartnav_graph.graph.keyframes import KeyframeConfig, keyframe_times, make_windows
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import STATES, State, key
from smartnav_graph.graph.update import FactorId, build_update
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.streams import ControlPoint, GnssFix
from smartnav_graph.simulation import motions, sensors
from smartnav_graph.simulation.sensors import Biases
from smartnav_graph.simulation.trajectory import Trajectory, Truth
from smartnav_graph.smoothers.estimate import Estimate, Posterior, posterior
from smartnav_graph.smoothers.whole_graph import WholeGraph, custom_factor

GRAVITY = 9.81
START_NS = 1_000 * NS
LEVER = (0.1, -0.6, 0.9)  # m, body axes


@dataclass(frozen=True)
class Recording:
    """A session and the motion it was made of."""

    session: Session
    trajectory: Trajectory
    biases: Biases

    def truth(self, t_ns: Any) -> Truth:
        """Exact states at these stamps."""
        return self.trajectory.sample((np.asarray(t_ns) - START_NS) / NS)

    def bias(self, t_ns: Any) -> np.ndarray:
        """True biases (n, 6), accelerometer then gyroscope, at these stamps."""
        at = self.session.imu.t_ns
        rows = np.concatenate([self.biases.accel, self.biases.gyro], axis=1)
        return np.stack([np.interp(np.asarray(t_ns) - START_NS, at - START_NS, column) for column in rows.T], axis=-1)


def eight(seconds: float = 30.0) -> Trajectory:
    """A phone carried round a figure eight after 5 s of rest."""
    return motions.figure_eight(seconds)


def record(
    trajectory: Trajectory | None = None,
    *,
    hertz: float = 100.0,
    every_s: float = 1.0,
    noise: Any = None,
    fix_sigma: float = 1.0,
    seed: int | None = None,
) -> Recording:
    """A session of `trajectory`; `noise` (ImuNoise) and a `seed` make it noisy."""
    trajectory = trajectory or eight()
    t = np.arange(int(trajectory.duration * hertz + 1e-6) + 1) / hertz
    t_ns = START_NS + ns_from_seconds(t)
    rng = np.random.default_rng(seed)
    imu, biases = sensors.imu(trajectory.sample(t), t_ns, noise, GRAVITY, rng)
    at = np.arange(0.5037, t[-1], every_s)
    streams = {}
    for name, times in (("gnss", at), ("control", at[2::5] + 0.25)):
        times = times[times < t[-1]]
        there = trajectory.sample(times)
        enu = there.nav_t_body + there.nav_R_body @ np.array(LEVER)
        if seed is not None:
            enu = enu + fix_sigma * rng.standard_normal(enu.shape)
        rows = {"t_ns": START_NS + ns_from_seconds(times), "enu": enu, "sigma": np.full(enu.shape, fix_sigma)}
        points = {"point_id": np.array([f"P{i}" for i in range(len(times))], dtype=object)}
        streams[name] = GnssFix(**rows) if name == "gnss" else ControlPoint(**rows, **points)
    session = Session(
        device=Device(name="exact"),
        gravity_m_s2=GRAVITY,
        sensors={name: Mount(body_t=LEVER) for name in streams},
        calibration=None if noise is None else Calibration(imu_noise=noise),
        imu=imu,
        **streams,
    )
    return Recording(session, trajectory, biases)


@dataclass(frozen=True)
class Graph:
    """Windows, builders by name, and the factors of every update at given states."""

    windows: Sequence[Window]
    builders: dict[str, Any]
    updates: Sequence[Any]
    values: Any

    def factors(self, *sensors: str) -> list[tuple[FactorId, Any]]:
        """Tagged factors of these sensors."""
        return [item for update in self.updates for item in update.factors if item[0].sensor in sensors]

    def rows(self, *sensors: str) -> list[tuple[FactorId, Any]]:
        """Tagged rows of the blocks of these sensors, each as a factor of its own without loss."""
        return [
            (FactorId(block.sensor, block.t_ns, row), custom_factor(replace(block, loss="none"), i, update.held))
            for update in self.updates
            for block in update.blocks
            if block.sensor in sensors
            for i, row in enumerate(block.rows)
        ]


def assemble(
    session: Session,
    truth: Callable[[Any], Truth],
    *,
    bias: Callable[[Any], np.ndarray] = lambda t: np.zeros((len(t), 6)),
    gaps: Sequence[Gap] = (),
    pass_state: PassState | None = None,
    keyframes: KeyframeConfig | None = None,
    span: tuple[int, int] | None = None,
    known: Mapping[str, Any] = MappingProxyType({}),
    options: Mapping[str, Any] = MappingProxyType({}),
) -> Graph:
    """The graph of `session` with every update built at the states that `truth` and `bias` tell; `known` are the true
    values of session states by name, the others stand at their initial ones; `options` are sections of the config."""
    keyframes = keyframes or KeyframeConfig()
    imu = session.require_imu()
    span = span or (int(imu.t_ns[0]), int(imu.t_ns[-1]))
    aiding = {name: stream.t_ns for name, stream in session.absolute().items()}
    times = keyframe_times(span, list(aiding.values()), gaps, keyframes)
    windows = make_windows(imu, times, gaps, aiding, keyframes)
    calibration, config = session.calibration or Calibration(), Config(**{"gnss": GnssConfig(loss="none")} | options)
    context = FactorContext(session, calibration, gaps, session.device.vehicle, config)
    builders = {builder.name: builder for builder in make_builders(context)}
    there, biases = truth(times), bias(times)
    states = [state(there, k, int(t), biases[k]) for k, t in enumerate(times)]
    updates = [
        build_update(w, states[k - 1] if k else None, builders.values(), pass_state or PassState(), int(times[0]))
        for k, w in enumerate(windows)
    ]
    values = values_of(states)
    for update in updates:
        own = {s.key: known.get(s.name, s.initial) for s in update.session.values()} | update.chain
        for name, value in own.items():
            if not values.exists(name):
                values.insert(name, np.asarray(value, dtype=np.float64))
    return Graph(windows, builders, updates, values)


def state(truth: Truth, row: int, t_ns: int, bias: np.ndarray) -> State:
    """One row of the truth as a state of the graph."""
    pose = gtsam.Pose3(gtsam.Rot3(truth.nav_R_body[row]), truth.nav_t_body[row])
    return State(row, t_ns, gtsam.NavState(pose, truth.nav_v_body[row]), gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))


def values_of(states: Sequence[State]) -> Any:
    """gtsam.Values of these states."""
    values = gtsam.Values()
    for s in states:
        values.insert(key("X", s.index), s.nav.pose())
        values.insert(key("V", s.index), s.nav.velocity())
        values.insert(key("B", s.index), s.bias)
    return values


def estimate_of(graph: Graph, covariance: np.ndarray | None = None) -> Estimate:
    """An estimate that stands at the graph's own values, with the fits of its factors where it is determined, but no
    covariance."""
    n = len(graph.windows)
    marginals = Posterior(np.zeros((n, 15, 15)), np.zeros((n - 1, 15, 15)), {})
    with suppress(RuntimeError):
        found = posterior(WholeGraph.of(graph.updates), graph.values, graph.updates)
        marginals = replace(marginals, counts=found.counts, residual=found.residual, fitted=found.fitted)
    return Estimate(
        values=graph.values,
        indices=range(n),
        t_ns=np.array([w.t1_ns for w in graph.windows], dtype=np.int64),
        covariance=np.zeros((n, 15, 15)) if covariance is None else covariance,
        factors=[item for update in graph.updates for item in update.factors],
        blocks=[block for update in graph.updates for block in update.blocks],
        iterations=1,
        converged=True,
        cost=0.0,
        marginals=marginals,
    )


def kinematics(truth: Truth) -> Kinematics:
    """The truth as smoothed states without bias."""
    return Kinematics(truth.nav_R_body, truth.nav_t_body, truth.nav_v_body, np.zeros((len(truth), 6)))


def angle_deg(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Rotation angle (n,) between attitudes (n, 3, 3), degrees; exact near zero."""
    sine = np.linalg.norm(one - other, axis=(-2, -1)) / np.sqrt(8.0)
    return np.degrees(2.0 * np.arcsin(np.clip(sine, 0.0, 1.0)))


def numerical_jacobian(factor, values, name: int, size: int, step: float = 1e-5) -> np.ndarray:
    """Central differences of the whitened residual on the tangent of one state."""
    columns = []
    for i in range(size):
        moved = []
        for sign in (1.0, -1.0):
            delta = gtsam.VectorValues()
            delta.insert(name, sign * step * np.eye(size)[i])
            moved.append(factor.whitenedError(values.retract(delta)))
        columns.append((moved[0] - moved[1]) / (2 * step))
    return np.stack(columns, axis=-1)


def assert_derivative(factor, values) -> None:
    """The factor's own derivative is the numerical one, to a fifty-thousandth of its largest element."""
    analytic, _ = factor.linearize(values).jacobian()
    blocks = [(name, STATES[chr(gtsam.symbolChr(name))].dim) for name in list(factor.keys())]
    numeric = np.hstack([numerical_jacobian(factor, values, name, n) for name, n in blocks])
    np.testing.assert_allclose(analytic, numeric, atol=2e-5 * np.abs(numeric).max())
