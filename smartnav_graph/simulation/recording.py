"""A scenario -> a recorded session with its truth: the same type as of a reader, `reference` holding the exact states.

The truth is given at 10 Hz and at every epoch of a fix or an image, on exact inertial stamps. All recordings: 100 Hz
inertial samples, flat ENU frame at 52 N, 11 E, 100 m, gravity constant and straight down, no Earth rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats, Indices, Times
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.files import replacing
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.core.so3 import quaternion
from smartnav_graph.core.timebase import NS, ns_from_seconds
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.calibration.model import (
    BarometerNoise,
    Calibration,
    GnssNoise,
    MagnetometerNoise,
    RangeNoise,
)
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import ControlPoint, GnssFix, PoseFix, Ranges, Reference, StaticPeriod
from smartnav_graph.simulation import cameras, fixes, render, sensors
from smartnav_graph.simulation.cameras import SimulatedCamera
from smartnav_graph.simulation.fixes import GnssModel, PoseFixModel, RangeModel
from smartnav_graph.simulation.sensors import (
    PROFILES,
    BarometerModel,
    Biases,
    MagnetometerModel,
    SpeedModel,
    TemperatureModel,
)
from smartnav_graph.simulation.trajectory import Trajectory, Truth

ORIGIN = Origin(52.0, 11.0, 100.0)
START_NS = 1_748_772_000 * NS  # 2025-06-01 10:00 UTC
YEAR = 2025.41
RATE_HZ = 100
SLOW_ROWS = 10  # reference: every tenth inertial sample
_OWN_EPOCHS = ("gnss", "control", "pose_fixes", "ranges", "images")
CONTROL_SIGMA_M = 0.02


@dataclass(frozen=True)
class Scenario:
    """A motion of `seconds` (the first samples of it), a device and its sensors; call it with a seed.

    rest_sigma_m_s : sigma of the velocity at the listed standstills
    control_arm : from the body to the surveyed point under it, m in body axes; control_rest_s : shortest standstill
    on a surveyed point
    """

    name: str
    seconds: float
    motion: Callable[[float, np.random.Generator], Trajectory]
    vehicle: str = "none"
    profile: str = "mems"
    gnss: GnssModel | None = None
    control: bool = False
    magnetometer: MagnetometerModel | None = None
    barometer: BarometerModel | None = None
    wheel: SpeedModel | None = None
    velocity: SpeedModel | None = None
    pose_fixes: PoseFixModel | None = None
    camera: SimulatedCamera | None = None
    ranges: RangeModel | None = None
    rest_sigma_m_s: float = 0.01
    temperature: TemperatureModel | None = None
    control_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    control_rest_s: float = 0.0

    def __call__(self, seed: int = 0, *, calibrated: bool = True) -> Session:
        motion, noise = _motion(self, seed), PROFILES[self.profile]
        gravity = frames.normal_gravity(ORIGIN.lat_deg, ORIGIN.height_m)
        warming = None if self.temperature is None else self.temperature.gyro_bias(motion.t)
        imu, biases = sensors.imu(motion.truth, motion.t_ns, noise, gravity, motion.rng("imu"), warming)
        streams: dict[str, Stream | None] = {
            "gnss": _gnss(motion, self.gnss),
            "control": _control(motion, self) if self.control else None,
            "pose_fixes": _pose_fixes(motion, self.pose_fixes),
            "ranges": _ranges(motion, self.ranges),
            **_slow_sensors(motion, self),
            **_camera(motion, self.camera),
        }
        rows = [np.arange(0, len(motion.t), SLOW_ROWS)]
        rows += [np.searchsorted(motion.t_ns, s.t_ns) for n, s in streams.items() if s is not None and n in _OWN_EPOCHS]
        mounts = {} if self.gnss is None else {"gnss": Mount(body_t=self.gnss.body_t_antenna)}
        if any(self.control_arm):
            mounts["control"] = Mount(body_t=self.control_arm)
        if self.ranges is not None:
            mounts["ranges"] = Mount(body_t=self.ranges.body_t_sensor)
        if self.camera is not None:
            mounts[self.camera.name] = self.camera.mount
        return Session(
            device=Device(name=f"simulated {self.profile}", vehicle=self.vehicle),
            clock_epoch="unix",
            origin=ORIGIN,
            sensors=mounts,
            calibration=_calibration(self) if calibrated else None,
            imu=imu,
            static=_static(motion, self.rest_sigma_m_s),
            reference=reference(motion.truth, motion.t_ns, biases, np.unique(np.concatenate(rows))),
            **streams,  # type: ignore[arg-type]
        )


# Every purpose has separate random numbers: a new sensor is added at the end and does not change the others.
PURPOSES = (
    *("motion", "imu", "gnss", "control", "magnetometer", "barometer", "wheel", "velocity", "pose_fixes"),
    *("scene", "camera", "texture", "pictures", "ranges", "temperature"),
)


@dataclass(frozen=True)
class _Motion:
    """One motion sampled at the inertial stamps, and the random numbers of every purpose."""

    trajectory: Trajectory
    t: Floats
    truth: Truth
    seed: int
    frame: LocalFrame

    @property
    def t_ns(self) -> Times:
        return START_NS + ns_from_seconds(self.t)

    @property
    def rests(self) -> list[tuple[float, float]]:
        """Start and end (s) of the standstills, up to the last inertial sample."""
        end = float(self.t[-1])
        return [(start, min(stop, end)) for start, stop in self.trajectory.rests if start < end]

    def rng(self, purpose: str) -> np.random.Generator:
        return np.random.default_rng((self.seed, PURPOSES.index(purpose)))

    def rows(self, rate_hz: float) -> slice:
        """Every so many inertial samples."""
        return slice(None, None, round(RATE_HZ / rate_hz))


def _motion(scenario: Scenario, seed: int) -> _Motion:
    trajectory = scenario.motion(scenario.seconds, np.random.default_rng((seed, 0)))
    t = np.arange(round(scenario.seconds * RATE_HZ)) / RATE_HZ
    return _Motion(trajectory, t, trajectory.sample(t), seed, LocalFrame(ORIGIN))


def _gnss(motion: _Motion, model: GnssModel | None) -> GnssFix | None:
    if model is None:
        return None
    every = motion.rows(model.rate_hz)
    truth, t_ns = motion.truth.take(every), motion.t_ns[every]
    if model.offset_s:
        valid = motion.t[every] + model.offset_s
        inside = (valid >= 0.0) & (valid <= motion.trajectory.duration)
        truth, t_ns = motion.trajectory.sample(valid[inside]), t_ns[inside]
    return fixes.gnss(truth, t_ns, model, motion.frame, motion.rng("gnss"))


def _control(motion: _Motion, scenario: Scenario) -> ControlPoint:
    long = [(start, end) for start, end in motion.rests if end - start >= scenario.control_rest_s]
    at = np.searchsorted(motion.t, [(start + end) / 2 for start, end in long])
    names = [f"P{i}" for i in range(len(at))]
    rng = motion.rng("control")
    truth = motion.truth.take(at)
    truth = replace(truth, nav_t_body=truth.nav_t_body + truth.nav_R_body @ np.asarray(scenario.control_arm))
    return fixes.control(truth, motion.t_ns[at], names, CONTROL_SIGMA_M, motion.frame, rng)


def _pose_fixes(motion: _Motion, model: PoseFixModel | None) -> PoseFix | None:
    if model is None:
        return None
    at = np.searchsorted(motion.t, np.arange(model.first_s, motion.t[-1], model.every_s) - 1e-9)
    return fixes.simulate_pose_fixes(
        motion.truth.take(at), motion.t_ns[at], model, motion.frame, motion.rng("pose_fixes")
    )


def _ranges(motion: _Motion, model: RangeModel | None) -> Ranges | None:
    if model is None:
        return None
    every = motion.rows(model.rate_hz)
    return fixes.ranges(motion.truth.take(every), motion.t_ns[every], model, motion.frame, motion.rng("ranges"))


def _camera(motion: _Motion, model: SimulatedCamera | None) -> dict[str, Stream | None]:
    if model is None:
        return {}
    scene, every = model.scene(motion.rng("scene")), motion.rows(model.rate_hz)
    t_ns, t = motion.t_ns[every], motion.t[every]
    return cameras.take(model, motion.trajectory, t_ns, t, scene, motion.rng("camera"))


def simulate_to_folder(
    scenario: Scenario, seed: int, path: str | Path, *, force: bool = False, progress: Progress = silent
) -> Session:
    """The scenario's session as a folder, with its pictures where it renders some; gives the session.

    Pictures exist on disk only: a session in memory has their names.

    Raises
    ------
    SessionError
        `path` exists and `force` is not given, or the system refuses to write.
    """
    progress("simulating", 0, 0)
    recorded = scenario(seed)
    with replacing(path, force=force) as folder:
        session_folder.save(recorded, folder, progress=progress)
        if scenario.camera is not None and scenario.camera.pictures is not None:
            assert recorded.images is not None  # of the camera
            render.write_pictures(folder / "images", shots(scenario, seed), len(recorded.images), progress)
    return recorded


def shots(scenario: Scenario, seed: int) -> Iterator[render.Grey]:
    """The pictures (h, w) of a scenario that renders some, one per image of its session."""
    model, motion = scenario.camera, _motion(scenario, seed)
    if model is None or model.pictures is None:
        raise ConfigError("simulate", f"{scenario.name} renders no pictures", "a scenario whose camera does")
    painted = render.Painted.of(model.scene(motion.rng("scene")), model.pictures, motion.rng("texture"))
    t = motion.t[motion.rows(model.rate_hz)]
    yield from render.render_pictures(model, motion.trajectory, painted, t, model.pictures, motion.rng("pictures"))


def scenario_constants(scenario: Scenario) -> dict[str, object]:
    """Every constant of a scenario by its dotted name, and the noise of its device: all but the seed."""
    return _flat("", asdict(scenario) | {"noise": asdict(PROFILES[scenario.profile])})


def _flat(name: str, value: object) -> dict[str, object]:
    if isinstance(value, dict):
        parts = [_flat(f"{name}.{key}" if name else str(key), inner) for key, inner in value.items()]
        return {key: inner for part in parts for key, inner in part.items()}
    return {} if value is None else {name: getattr(value, "__name__", value)}


def _slow_sensors(motion: _Motion, scenario: Scenario) -> dict[str, Stream]:
    """The streams that make no keyframes."""
    made: dict[str, Stream] = {}
    if (mag := scenario.magnetometer) is not None:
        rows, rng = motion.rows(mag.rate_hz), motion.rng("magnetometer")
        field = frames.magnetic_field_ut(ORIGIN, YEAR)
        made["magnetometer"] = sensors.magnetometer(motion.truth.take(rows), motion.t_ns[rows], mag, field, rng)
    if (baro := scenario.barometer) is not None:
        rows, rng = motion.rows(baro.rate_hz), motion.rng("barometer")
        height = ORIGIN.height_m + motion.truth.nav_t_body[rows, 2]
        made["barometer"] = sensors.barometer(height, motion.t_ns[rows], baro, rng)
    if (warmth := scenario.temperature) is not None:
        rows, rng = motion.rows(warmth.rate_hz), motion.rng("temperature")
        made["temperature"] = sensors.thermometer(motion.t[rows], motion.t_ns[rows], warmth, rng)
    if (model := scenario.wheel) is not None:
        rows, rng = motion.rows(model.rate_hz), motion.rng("wheel")
        made["wheel"] = sensors.wheel(motion.trajectory.speed(motion.t[rows]), motion.t_ns[rows], model, rng)
    if (model := scenario.velocity) is not None:
        rows, rng = motion.rows(model.rate_hz), motion.rng("velocity")
        made["velocity"] = sensors.velocity(motion.truth.take(rows), motion.t_ns[rows], model, rng)
    return made


def _calibration(scenario: Scenario) -> Calibration:
    model = scenario.gnss or GnssModel()
    gnss = GnssNoise(
        horizontal_sigma=model.white_m,
        vertical_sigma=1.5 * model.white_m,
        correlated_horizontal_sigma=model.markov_m,
        correlated_vertical_sigma=1.5 * model.markov_m,
        correlated_time=model.markov_s,
    )
    noise = PROFILES[scenario.profile]
    made = Calibration(device=f"simulated {scenario.profile}", imu_noise=noise, gnss_noise=gnss)
    if (mag := scenario.magnetometer) is not None:  # correlated disturbances are simulated as passing iron only
        iron = MagnetometerNoise(sigma_ut=mag.sigma_ut, disturbance_ut=0.0, hard_iron_sigma_ut=mag.hard_iron_sigma_ut)
        made = replace(made, magnetometer_noise=iron)
    if (baro := scenario.barometer) is not None and baro.walk_hpa > 0:
        made = replace(made, barometer_noise=BarometerNoise(baro.sigma_hpa, baro.walk_hpa))
    if (ranging := scenario.ranges) is not None:
        made = replace(made, range_noise=RangeNoise(ranging.sigma_m, ranging.bias_sigma_m))
    if (camera := scenario.camera) is not None:
        made = replace(made, cameras={camera.name: camera.camera})
    return made


def _static(motion: _Motion, sigma_m_s: float) -> StaticPeriod | None:
    """The standstills, from the first to the last inertial sample taken at rest."""
    rests, t_ns = motion.rests, motion.t_ns
    if not rests:
        return None
    start, end = (t_ns[0] + ns_from_seconds([rest[i] for rest in rests]) for i in range(2))
    first, last = np.searchsorted(t_ns, start), np.searchsorted(t_ns, end, side="right") - 1
    source = np.full(len(rests), "simulation", dtype=object)
    return StaticPeriod(t_ns=t_ns[first], t_end_ns=t_ns[last], sigma_v=np.full(len(rests), sigma_m_s), source=source)


def reference(truth: Truth, t_ns: Times, biases: Biases, rows: Indices) -> Reference:
    """The exact states at these rows."""
    return Reference(
        t_ns=t_ns[rows],
        enu=truth.nav_t_body[rows],
        quat=quaternion(truth.nav_R_body[rows]),
        velocity=truth.nav_v_body[rows],
        accel_bias=biases.accel[rows],
        gyro_bias=biases.gyro[rows],
    )
