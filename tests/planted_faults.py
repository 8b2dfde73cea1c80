"""Faults of a recording, planted in a good one: for tests of the verdict, and for `scripts/reproduce_verdict`.

Every fault is a function of a session and random numbers; None where the session has nothing that it can spoil. A
verdict on it is right where it is not ``good``, where a named error refuses the recording, or where the result is as
good as without the fault, to `WORSE` times its horizontal error.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import smartnav_graph as sn
from smartnav_graph.core.errors import SmartnavError
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import ControlPoint, StaticPeriod
from smartnav_graph.simulation.fixes import PoseFixModel
from smartnav_graph.simulation.scenarios import find_scenario

DATASETS = Path(os.environ.get("SMARTNAV_DATASETS", Path(__file__).resolve().parents[1] / "../shared/datasets"))
WORSE = 1.5
Rng = np.random.Generator
Fault = Callable[[Session, Rng], Session | None]
HORIZONTAL = np.array([1.0, 1.0, 0.0])


# --- what faults change ---


def fixes(session: Session) -> tuple[str, Any]:
    """The stream that positions come from."""
    return next((name, s) for name in ("gnss", "pose_fixes", "control") if (s := getattr(session, name)) is not None)


def has_fixes(session: Session) -> bool:
    return any(getattr(session, name) is not None for name in ("gnss", "pose_fixes", "control"))


def inertial(change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Fault:
    """Gyro and accel (n, 3) changed."""

    def plant(session: Session, rng: Rng) -> Session:
        gyro, accel = change(session.imu.gyro, session.imu.accel)
        return session.replace(imu=replace(session.imu, gyro=gyro, accel=accel))

    return plant


def position(change: Callable[[np.ndarray, np.ndarray, Rng], np.ndarray], *, least: int = 20) -> Fault:
    """Positions (n, 3) m changed, by their times (n,) s since the first."""

    def plant(session: Session, rng: Rng) -> Session | None:
        if not has_fixes(session) or len(fixes(session)[1]) < least:
            return None
        name, stream = fixes(session)
        moved = change((stream.t_ns - stream.t_ns[0]) / NS, session.nav_position(stream), rng)
        return session.replace(**{name: replace(stream, lla=None, enu=moved)})

    return plant


def clock(seconds: Callable[[np.ndarray], np.ndarray] | float) -> Fault:
    """Stamps of the fixes that are late by so much."""

    def plant(session: Session, rng: Rng) -> Session | None:
        if not has_fixes(session):
            return None
        name, stream = fixes(session)
        t = (stream.t_ns - stream.t_ns[0]) / NS
        late = np.round(NS * (seconds(t) if callable(seconds) else np.full(len(t), seconds))).astype(np.int64)
        return session.replace(**{name: replace(stream, t_ns=stream.t_ns + late, arrival_ns=None)})

    return plant


def inertial_noise(factor: float) -> Fault:
    def plant(session: Session, rng: Rng) -> Session:
        from smartnav_graph.session.calibration.model import Calibration

        noise, imu = (session.calibration or Calibration()).imu_noise, session.imu
        per_sample = np.sqrt((factor**2 - 1.0) / (float(np.median(np.diff(imu.t_ns))) / NS))
        gyro = imu.gyro + rng.normal(0.0, noise.gyro_noise_density * per_sample, imu.gyro.shape)
        accel = imu.accel + rng.normal(0.0, noise.accel_noise_density * per_sample, imu.accel.shape)
        return session.replace(imu=replace(imu, gyro=gyro, accel=accel))

    return plant


def up_axis(axis: str) -> Fault:
    def plant(session: Session, rng: Rng) -> Session | None:
        if session.device.forward[1] == axis[1]:
            return None
        return session.replace(device=replace(session.device, up=axis))

    return plant


def lever_arm(body_t: tuple[float, float, float]) -> Fault:
    def plant(session: Session, rng: Rng) -> Session | None:
        if not has_fixes(session):
            return None
        name, _ = fixes(session)
        mount = session.mount(name)
        there = tuple(np.array(mount.body_t) + body_t)
        return session.replace(sensors={**session.sensors, name: replace(mount, body_t=there)})

    return plant


def white(sigma_m: float, stated_m: float) -> Fault:
    """Fixes with white noise of so much more, and what they state."""

    def plant(session: Session, rng: Rng) -> Session | None:
        if session.gnss is None:
            return None
        p = session.nav_position(session.gnss)
        p = p + rng.normal(0.0, sigma_m, p.shape)
        return session.replace(gnss=replace(session.gnss, lla=None, enu=p, sigma=np.full(p.shape, stated_m)))

    return plant


def _other(t: np.ndarray, p: np.ndarray, rng: Rng) -> np.ndarray:
    return p[::-1].copy()


def _burst(size_m: float, length_s: float) -> Fault:
    def shift(t: np.ndarray, p: np.ndarray, rng: Rng) -> np.ndarray:
        begin, way = t[-1] * rng.uniform(0.3, 0.6), rng.uniform(0.0, 2.0 * np.pi)
        inside = (t >= begin) & (t < begin + length_s)
        return p + np.where(inside, size_m, 0.0)[:, None] * [np.cos(way), np.sin(way), 0.0]

    return position(shift)


def _apart(
    where: Callable[[np.ndarray], np.ndarray], shift: tuple[float, float, float]
) -> Callable[[np.ndarray, np.ndarray, Rng], np.ndarray]:
    """Some rows shifted."""
    return lambda t, p, rng: p + where(np.arange(len(p)))[:, None] * np.array(shift)


def _stale(t: np.ndarray, p: np.ndarray, rng: Rng) -> np.ndarray:
    return p[2 * (np.arange(len(p)) // 2)]


def _frozen(t: np.ndarray, p: np.ndarray, rng: Rng) -> np.ndarray:
    """Thirty seconds that repeat one fix."""
    first = int(len(t) * rng.uniform(0.3, 0.6))
    rows = np.arange(len(t))
    return p[np.where((rows > first) & (t < t[first] + 30.0), first, rows)]


def _filtered(t: np.ndarray, p: np.ndarray, rng: Rng) -> np.ndarray:
    """A receiver that averages over some fixes, with an error of 4 m that lasts a minute."""
    wander = np.zeros_like(p)
    for i in range(1, len(p)):
        keep = np.exp(-(t[i] - t[i - 1]) / 60.0)
        wander[i] = keep * wander[i - 1] + rng.normal(0.0, 4.0 * np.sqrt(1.0 - keep**2), 3)
    return _causal_mean(p, 5) + _causal_mean(wander, 3)


def _causal_mean(values: np.ndarray, count: int) -> np.ndarray:
    padded = np.concatenate([np.repeat(values[:1], count - 1, axis=0), values])
    return np.stack([np.convolve(column, np.full(count, 1.0 / count), "valid") for column in padded.T], axis=1)


def _sigmas(factor: float) -> Fault:
    """Stated sigmas that many times too large; of fixes that state none, with an error of 3 m."""

    def plant(session: Session, rng: Rng) -> Session | None:
        if session.gnss is None:
            return None
        if session.gnss.sigma is None:
            return white(3.0, 3.0 * factor)(session, rng)
        return session.replace(gnss=replace(session.gnss, sigma=factor * session.gnss.sigma))

    return plant


def _latitude_first(session: Session, rng: Rng) -> Session | None:
    if session.gnss is None or session.gnss.lla is None:
        return None
    return session.replace(gnss=replace(session.gnss, lla=session.gnss.lla[:, [1, 0, 2]]))


def _standstill(session: Session, rng: Rng) -> Session | None:
    """Half a minute of motion listed as a standstill."""
    if not has_fixes(session):
        return None
    _, stream = fixes(session)
    p, t = session.nav_position(stream)[:, :2], stream.t_ns
    first = int(len(t) * rng.uniform(0.3, 0.5))
    while first < len(t) - 2 and np.linalg.norm(p[first + 1] - p[first]) < 0.5 * (t[first + 1] - t[first]) / NS:
        first += 1
    listed = session.static
    begin, end = int(t[first]), int(t[first]) + 30 * NS
    starts, ends = [begin], [end]
    if listed is not None:
        apart = (listed.t_end_ns < begin) | (listed.t_ns > end)
        starts, ends = [*listed.t_ns[apart], begin], [*listed.t_end_ns[apart], end]
    order = np.argsort(starts)
    periods = StaticPeriod(t_ns=np.array(starts)[order], t_end_ns=np.array(ends)[order])
    return session.replace(static=periods)


def _pascal(session: Session, rng: Rng) -> Session | None:
    if session.barometer is None:
        return None
    return session.replace(barometer=replace(session.barometer, pressure_hpa=100.0 * session.barometer.pressure_hpa))


def focal_length(factor: float) -> Fault:
    """Directions by a focal length that many times the true one."""

    def plant(session: Session, rng: Rng) -> Session | None:
        changes: dict[str, Any] = {}
        if session.tracks is not None:
            changes["tracks"] = replace(session.tracks, xy_n=session.tracks.xy_n / factor)
        if (m := session.matches) is not None:
            changes["matches"] = replace(m, xy0_n=m.xy0_n / factor, xy1_n=m.xy1_n / factor)
        return session.replace(**changes) if changes else None

    return plant


def camera_clock(seconds: float) -> Fault:
    def plant(session: Session, rng: Rng) -> Session | None:
        late, changes = round(seconds * NS), dict[str, Any]()
        for name in ("images", "tracks", "matches"):
            if (stream := getattr(session, name)) is not None:
                times = {"t_1_ns": stream.t_1_ns + late} if name == "matches" else {}
                changes[name] = replace(stream, t_ns=stream.t_ns + late, arrival_ns=None, **times)
        return session.replace(**changes) if session.tracks is not None or session.matches is not None else None

    return plant


def one_axis(k: int, factor: float) -> np.ndarray:
    return np.where(np.arange(3) == k, factor, 1.0)


FAULTS: Mapping[str, Fault] = {
    **{f"clock {s:+g} s": clock(s) for s in (0.5, -0.5, 5.0, -5.0, 18.0, 3600.0)},
    "clock jumps 3 s": clock(lambda t: np.where(t > 0.5 * t[-1], 3.0, 0.0)),
    "gyro sign": inertial(lambda g, a: (-g, a)),
    "gyro z sign": inertial(lambda g, a: (g * one_axis(2, -1.0), a)),
    "accelerometer sign": inertial(lambda g, a: (g, -a)),
    "axes exchanged": inertial(lambda g, a: (g[:, [1, 0, 2]], a[:, [1, 0, 2]])),
    "gyro in deg/s": inertial(lambda g, a: (np.degrees(g), a)),
    "accelerometer in g": inertial(lambda g, a: (g, a / 9.80665)),
    "up axis +y": up_axis("+y"),
    "up axis +x": up_axis("+x"),
    "north, east, down": position(lambda t, p, rng: p[:, [1, 0, 2]] * [1.0, 1.0, -1.0], least=4),
    "fixes of another drive": position(_other, least=4),
    "multipath of 130 m for 60 s": _burst(130.0, 60.0),
    "inertial noise x 10": inertial_noise(10.0),
    "scale 5 %": inertial(lambda g, a: (1.05 * g, 1.05 * a)),
    "lever arm 3 m": lever_arm((0.0, 3.0, 0.0)),
    "stale fixes": position(_stale),
    "filtered fixes": position(_filtered),
    "sigma / 100": white(3.0, 0.03),
    **{f"focal length x {factor:g}": focal_length(factor) for factor in (1.03, 1.05, 1.1, 1.2)},
    "camera clock 0.2 s": camera_clock(0.2),
    "pressure in Pa": _pascal,
    "false standstill": _standstill,
}
"""The faults that the package states its rate for."""

OTHERS: Mapping[str, Fault] = {
    **{f"clock {s:+g} s": clock(s) for s in (1.0, 2.0, -18.0, 60.0, -7200.0)},
    "clock 1 % slow": clock(lambda t: 0.01 * t),
    "clock jumps 60 s": clock(lambda t: np.where(t > 0.6 * t[-1], 60.0, 0.0)),
    "gyro x sign": inertial(lambda g, a: (g * one_axis(0, -1.0), a)),
    "gyro y sign": inertial(lambda g, a: (g * one_axis(1, -1.0), a)),
    "accelerometer x sign": inertial(lambda g, a: (g, a * one_axis(0, -1.0))),
    "accelerometer y sign": inertial(lambda g, a: (g, a * one_axis(1, -1.0))),
    "y sign of both": inertial(lambda g, a: (g * one_axis(1, -1.0), a * one_axis(1, -1.0))),
    "gyro x, y exchanged": inertial(lambda g, a: (g[:, [1, 0, 2]], a)),
    "gyro y, z exchanged": inertial(lambda g, a: (g[:, [0, 2, 1]], a)),
    "accelerometer y, z exchanged": inertial(lambda g, a: (g, a[:, [0, 2, 1]])),
    "gyro z in deg/s": inertial(lambda g, a: (g * one_axis(2, 180.0 / np.pi), a)),
    "gyro in rad/s twice": inertial(lambda g, a: (np.radians(g), a)),
    "accelerometer without gravity": inertial(lambda g, a: (g, a - np.median(a, axis=0))),
    "gyro z is zero": inertial(lambda g, a: (g * one_axis(2, 0.0), a)),
    "gyro scale 20 %": inertial(lambda g, a: (1.2 * g, a)),
    "accelerometer scale 20 %": inertial(lambda g, a: (g, 1.2 * a)),
    "gyro bias 0.2 rad/s": inertial(lambda g, a: (g + 0.2 * np.eye(3)[2], a)),
    "up axis -z": up_axis("-z"),
    "fixes mirrored": position(lambda t, p, rng: p * [-1.0, 1.0, 1.0], least=4),
    "latitude, longitude exchanged": _latitude_first,
    "fixes in feet": position(lambda t, p, rng: p / 0.3048, least=4),
    "multipath of 40 m for 30 s": _burst(40.0, 30.0),
    "frozen for 30 s": position(_frozen),
    "half of the fixes 1000 km away": position(
        lambda t, p, rng: p + np.where(rng.random(len(t)) < 0.5, 1e6, 0.0)[:, None] * [1.0, 0.0, 0.0]
    ),
    "every second fix 150 m away": position(_apart(lambda rows: rows % 2, (150.0, 0.0, 0.0))),
    "half of the fixes 150 m away": position(
        lambda t, p, rng: p + np.where(rng.random(len(t)) < 0.5, 150.0, 0.0)[:, None] * [0.6, 0.8, 0.0]
    ),
    "blocks of fixes 150 m away": position(_apart(lambda rows: (rows // 15) % 2, (0.0, 150.0, 0.0))),
    "two receivers 25 m apart": position(_apart(lambda rows: rows % 2, (15.0, 20.0, 0.0))),
    "two height datums": position(_apart(lambda rows: rows % 2, (0.0, 0.0, 47.0))),
    "heights 47 m up": position(lambda t, p, rng: p + np.where(t > 0.5 * t[-1], 47.0, 0.0)[:, None] * [0.0, 0.0, 1.0]),
    "sigma x 100": _sigmas(100.0),
    "focal length x 0.8": focal_length(0.8),
    "camera clock -0.1 s": camera_clock(-0.1),
    "inertial noise x 3": inertial_noise(3.0),
}
"""More of the same kinds."""


# --- what is right ---


@dataclass(frozen=True)
class Outcome:
    """What a run says of a recording: level of the verdict or ``refused``; horizontal RMS error m; the reasons."""

    level: str
    error_m: float
    reasons: str

    def is_right(self, clean: Outcome) -> bool:
        """Not good, refused, or as good as without the fault."""
        return self.level != "good" or self.error_m <= WORSE * clean.error_m


@dataclass(frozen=True)
class Truth:
    """True positions (n, 2) m at stamps (n,), at the body where the reference is simulated, and how late (s) the
    fixes are that it is taken from elsewhere."""

    t_ns: np.ndarray
    position: np.ndarray
    late_s: float = 0.0

    @classmethod
    def of(cls, session: Session) -> Truth:
        if session.reference is not None:
            return cls(session.reference.t_ns, session.reference.enu[:, :2])
        return cls(session.gnss.t_ns, session.nav_position(session.gnss)[:, :2], 0.06)

    def error(self, solution: sn.Solution) -> float:
        """Horizontal RMS error m of a solution."""
        inside = (self.t_ns >= solution.t_ns[0]) & (self.t_ns <= solution.t_ns[-1])
        p, v = (
            interpolate(self.t_ns[inside], solution.t_ns, x[:, :2]) for x in (solution.nav_t_body, solution.nav_v_body)
        )
        return float(np.sqrt(((p + self.late_s * v - self.position[inside]) ** 2).sum(axis=1).mean()))


def outcome(session: Session, truth: Truth) -> Outcome:
    """What a run with default options says of a session."""
    try:
        run = sn.run(session)
    except SmartnavError as error:
        return Outcome("refused", np.nan, str(error))
    found = run.summary["verdict"]
    return Outcome(
        found["level"],
        truth.error(run.solution),
        " | ".join(f"{reason['sensor']}: {reason['text']}" for reason in found["reasons"]),
    )


def recording(name: str, seed: int) -> Session:
    """A good recording: a simulated one by its scenario, or the KITTI drive, from another start for every seed but
    zero on, and with the noise of a phone's receiver for every second one."""
    if name != "kitti":
        return SCENES[name](seed) if name in SCENES else sn.simulate(name, seed)
    drive = sn.load("gtsam-kitti")
    if seed == 0:
        return drive
    begin = drive.t0_ns + round(np.random.default_rng(seed).uniform(0.0, 240.0) * NS)
    imu, gnss = (s.take((s.t_ns >= begin) & (s.t_ns < begin + 220 * NS)) for s in (drive.imu, drive.gnss))
    return drive.replace(imu=imu, gnss=gnss)


def _camera_with_fixes(seed: int) -> Session:
    """Half a minute in a room with a camera, pose fixes every second."""
    pose_fixes = PoseFixModel(every_s=1.0, sigma_m=0.2, sigma_rad=0.0)
    return replace(find_scenario("room-30s"), pose_fixes=pose_fixes)(seed)


def _trolley_with_camera(seed: int) -> Session:
    """Six minutes of a trolley with surveyed points and matched images."""
    return replace(find_scenario("thesis-indoor"), seconds=400.0)(seed)


def _euroc(seed: int) -> Session:
    """The half minute of EuRoC that comes with gtsam, with a point of the truth every three seconds."""
    session, truth = (
        sn.load("gtsam-euroc"),
        sn.load_reference(DATASETS / "euroc_v101/groundtruth_openvins/V1_01_easy.csv"),
    )
    at = session.seconds(truth.t_ns)
    truth = truth.take((at > 0.0) & (at < 29.9))
    rows = np.searchsorted(session.seconds(truth.t_ns), np.arange(1.0, 29.0, 3.0))
    enu = truth.enu[rows] + np.random.default_rng(seed).normal(0.0, 0.02, (len(rows), 3))
    names = np.array([f"P{row}" for row in rows], dtype=object)
    points = ControlPoint(t_ns=truth.t_ns[rows], enu=enu, sigma=np.full(enu.shape, 0.02), point_id=names)
    return session.replace(control=points, reference=truth)


SCENES: Mapping[str, Callable[[int], Session]] = {
    "camera-fixes": _camera_with_fixes,
    "trolley-images": _trolley_with_camera,
    "euroc": _euroc,
}
