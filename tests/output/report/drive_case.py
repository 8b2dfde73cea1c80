"""A made-up car drive with everything a report can show: data gaps, rejected and withheld fixes, an outage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from smartnav_graph.core.frames import Origin
from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.graph.solution import Residuals, Solution
from smartnav_graph.session.session import Device, Session
from smartnav_graph.session.streams import GnssFix, Imu

T0 = 46_534_478_375_790
GAPS = [(36.4, 1.59, "bridged"), (198.7, 1.62, "bridged"), (219.7, 1.5, "bridged"), (307.8, 2.41, "missing")]
REJECTED = (50, 51, 52, 301)


@dataclass(frozen=True)
class Drive:
    session: Session
    solution: Solution
    causal: Solution
    summary: dict[str, Any]
    evaluation: Any
    withheld: dict[str, Any]
    updates: Updates


@dataclass(frozen=True)
class Compared:
    """Stands for an Evaluation."""

    t_ns: Any
    error_enu_m: Any
    rotation_error_deg: Any
    sigma_enu: Any
    notes: Any = ()

    def to_dict(self) -> dict[str, Any]:
        e = np.linalg.norm(self.error_enu_m, axis=1)
        p = dict(zip(("p50", "p67", "p95"), np.percentile(e, [50, 67, 95]).tolist(), strict=True))
        ape = {"rmse": float(np.sqrt(np.mean(e**2))), "mean": float(e.mean()), "max": float(e.max())} | p
        rotation = {"rmse": 0.41, "mean": 0.36, "max": 1.2, "p50": 0.33, "p67": 0.4, "p95": 0.9}
        return {
            "solution": "smoothed",
            "reference": "/home/someone/truth.csv",
            "align": "yaw",
            "time_offset_s": 0.0,
            "matched": len(e),
            "unmatched": 4,
            "ape_m": ape,
            "rotation_deg": rotation,
            "rpe": [{"delta_s": d, "translation_m": 0.05 * d, "rotation_deg": 0.1} for d in (1.0, 10.0)],
            "nees": {"position": 2.9, "velocity": None, "attitude": 3.3, "yaw": 1.1},
        }


@dataclass(frozen=True)
class Scored:
    """Stands for the errors at withheld rows."""

    t_ns: Any
    error: Any


def drive(n: int = 470) -> Drive:
    """`n` keyframes at 1 Hz: a town loop of straights and bends, with two stops."""
    rng = np.random.default_rng(3)
    t = np.arange(n, dtype=float)
    turns = 0.12 * np.sin(t / 23.0) ** 3 + 0.02 * np.sin(t / 61.0) + 0.004
    heading = np.cumsum(turns)
    speed = np.clip(9.0 + 6.0 * np.sin(t / 37.0) - 14.0 * np.exp(-(((t - 150) / 9.0) ** 2)), 0.0, None)
    velocity = np.stack([speed * np.sin(heading), speed * np.cos(heading), 0.3 * np.sin(t / 50.0)], axis=1)
    position = np.cumsum(velocity, axis=0)
    roll, pitch = 0.03 * np.sin(t / 5.0), 0.02 * np.sin(t / 11.0)
    R = Rotation.from_euler("ZYX", np.stack([np.pi / 2 - heading, pitch, roll], axis=1)).as_matrix()
    outage = np.exp(-(((t - 110.0) / 12.0) ** 2))
    sigma = np.empty((n, 15))
    sigma[:, 0:2], sigma[:, 2] = 2e-3, 8e-3 + 2e-2 * np.exp(-t / 20)
    sigma[:, 3:6] = (0.08 + 1.1 * outage + 0.05 * np.exp(-t / 10))[:, None] * [1.0, 1.2, 1.8]
    sigma[:, 6:9], sigma[:, 9:12] = 0.05, (0.01 + 0.1 * np.exp(-t / 30))[:, None]
    sigma[:, 12:15] = (2e-4 + 3e-3 * np.exp(-t / 30))[:, None]
    covariance = sigma[:, :, None] * np.eye(15) * sigma[:, None, :]
    covariance[:, 3, 4] = covariance[:, 4, 3] = 0.5 * sigma[:, 3] * sigma[:, 4]
    solution = Solution(
        t_ns=T0 + (t * 1e9).astype(np.int64),
        nav_R_body=R,
        nav_t_body=position,
        nav_v_body=velocity,
        accel_bias=0.05 + 0.02 * np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n),
        gyro_bias=1e-3 + 4e-4 * np.cumsum(rng.normal(size=(n, 3)), axis=0) / np.sqrt(n),
        covariance=covariance,
        t0_ns=T0,
        origin=Origin(49.011, 8.4228, 112.8),
        forward="+x",
        residuals=_residuals(t, rng),
    )
    return Drive(
        _session(solution, rng),
        solution,
        _causal(solution, rng),
        summary(n),
        _compared(solution, rng),
        _withheld(solution, rng),
        _updates(solution, rng),
    )


def _residuals(t: np.ndarray, rng: np.random.Generator) -> Residuals:
    kept = np.flatnonzero(np.arange(len(t)) % 2 == 0)
    kept = np.union1d(kept, [r for r in REJECTED if r < len(t)])
    g = np.repeat(kept, 3)
    i = np.repeat(np.arange(len(t) - 1), 9)
    white = np.concatenate([rng.normal(size=len(g)), 0.9 * rng.normal(size=len(i))])
    used = np.ones(len(white), dtype=bool)
    used[: len(g)] = ~np.isin(g, REJECTED)
    white[~used] *= 9.0
    return Residuals(
        t_ns=T0 + np.concatenate([g, i]).astype(np.int64) * 1_000_000_000,
        sensor=np.array(["gnss"] * len(g) + ["imu"] * len(i), dtype=object),
        axis=np.concatenate([np.tile(np.arange(3), len(kept)), np.tile(np.arange(9), len(t) - 1)]),
        whitened=white,
        weight=used.astype(float),
        used=used,
    )


def _session(solution: Solution, rng: np.random.Generator) -> Session:
    n = len(solution)
    step = np.arange((n - 1) * 50 + 1)
    fixes = solution.nav_t_body + rng.normal(size=(n, 3)) * [0.6, 0.6, 1.2]
    for row in REJECTED:
        if row < n:
            fixes[row, :2] += [45.0, 30.0]
    accel = rng.normal(size=(len(step), 3)) * 0.4 + [0.0, 0.0, 9.81]
    return Session(
        device=Device(name="test car", forward="+x"),
        origin=solution.origin,
        imu=Imu(t_ns=T0 + step * 20_000_000, gyro=rng.normal(size=(len(step), 3)) * 0.05, accel=accel),
        gnss=GnssFix(t_ns=solution.t_ns, lla=None, enu=fixes),
    )


def _causal(solution: Solution, rng: np.random.Generator) -> Solution:
    from dataclasses import replace

    drift = np.cumsum(rng.normal(size=(len(solution), 3)), axis=0) * 0.25
    return replace(solution, nav_t_body=solution.nav_t_body + drift, covariance=solution.covariance * 6.0)


def _withheld(solution: Solution, rng: np.random.Generator) -> dict[str, Any]:
    rows = slice(1, None, 2)
    return {"gnss": Scored(solution.t_ns[rows], rng.normal(size=(len(solution), 3))[rows] * 0.2)}


def _compared(solution: Solution, rng: np.random.Generator) -> Compared:
    sigma = solution.sigmas[:, 3:6]
    return Compared(
        solution.t_ns, rng.normal(size=sigma.shape) * sigma, np.abs(rng.normal(size=len(sigma))) * 0.4, sigma
    )


def _updates(solution: Solution, rng: np.random.Generator) -> Updates:
    n = len(solution)
    estimated = np.stack([0.06 + 0.1 * np.exp(-np.arange(n) / 9), 0.003 + 0.2 * np.exp(-np.arange(n) / 9)], axis=1)
    return Updates(
        t_ns=solution.t_ns,
        solved=np.full(n, 30),
        relinearised=np.arange(n) % 30,
        doubted=np.zeros(n, dtype=np.int64),
        corrected=np.where(np.arange(n) % 50 == 0, 3.0, 1e-15),
        latency_ms=np.linspace(1.0, 5.0, n),
        edge=np.zeros(n + 1, dtype=np.int64),
        past_ns=solution.t_ns[:0],
        past=np.zeros((0, 3)),
        states={"gnss_time_offset_s": estimated, "vehicle_mount.0": estimated},
    )


def summary(n: int = 470) -> dict[str, Any]:
    return {
        "mode": "batch",
        "duration_s": n - 1.0,
        "path_m": 4318.27,
        "keyframes": n,
        "factors": {"imu": n - 1, "gnss": 231, "prior": 1, "vehicle": 460, "image_pairs": 60},
        "used": {"gnss": 231},
        "standstills": {"count": 2, "total_s": 21.5, "at_rest_s": 14.0, "spans_s": [[148.0, 158.5], [300.0, 311.0]]},
        "image_pairs": {"in use": 60, "insufficient baseline": 39, "inconsistent with the other sensors": 1},
        "chi2_per_dof": {"overall": 1.04, "imu": 0.97, "gnss": 1.11},
        "iterations": 7,
        "converged": True,
        "states": {
            "gnss_time_offset_s": {"value": 0.0612, "sigma": 0.0031, "held": False},
            "gnss_lever_arm_m": {"value": [0.05, -0.31, 0.8], "sigma": None, "held": True},
            "images_time_offset_s": {"value": -0.004, "sigma": 0.0005, "held": False},
            "vehicle_mount": {
                "value": [-0.0077, 0.0023, 0.13, -0.27, -0.99, 1.54, 0.0033, 0.0041],
                "sigma": [0.0009, 0.0016, 0.06, 1.45, 0.27, 0.22, 0.0018, 0.0009],
                "held": False,
                "observed": [True, True, True, False, True, True, True, True],
            },
            "gnss_sigma_m": {"value": [0.6, 0.6, 1.2], "sigma": None, "held": False},
        },
        "timings_s": {
            "load": 0.12,
            "preintegrate": 0.21,
            "build": 0.08,
            "solve": 0.52,
            "covariance": 0.19,
            "write": 0.11,
            "total": 1.23,
        },
        "real_time_factor": 381.0,
        "update_ms": {"median": 0.31, "p99": 0.64, "max": 2.2},
        "peak_memory_mb": 214.3,
        "gaps": [{"start_s": s, "length_s": length, "kind": kind} for s, length, kind in GAPS],
        "dropped": {"gnss": {"fixes outside the IMU's time span": 2}, "imu": {"repeated stamps dropped": 17}},
        "rejected": {"gnss": len(REJECTED)},
        "withheld": {"gnss": {"count": 235, "rms_horizontal_m": 0.284, "rms_3d_m": 0.41, "max_m": 1.32}},
        "initialisation": {
            "method": "moving",
            "sentence": "started while moving, heading 31.2 deg +- 1.8 deg from the first 4 fixes",
            "sigma_heading_deg": 1.8,
        },
        "warnings": [
            "imu: 4 data gaps, 7.1 s in all; the uncertainty is raised inside; record without interruption if you can",
            "gnss: sigma <b>missing</b> & assumed 3 m",
        ],
        "versions": {"smartnav-graph": "0.1.0", "gtsam": "4.3.0", "numpy": "2.4.1", "python": "3.11.7"},
    }
