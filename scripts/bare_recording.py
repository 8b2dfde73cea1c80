"""The baseline of writing a recording: the same arrays through Rerun's own send_columns, nothing else.

    python scripts/bare_recording.py SESSION RUN FILE     one JSON line: processor seconds, size of the file

Inertial samples, poses, velocities, ellipsoids, biases with their variances, sigmas, residuals: as they are in the
session and in the run, without layout, states, log, graph or a second time line.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

import smartnav_graph as sn
from smartnav_graph.graph.solution import ACCEL_BIAS, GYRO_BIAS, POS, Solution
from smartnav_graph.output.run_folder import read_run
from smartnav_graph.session.session import Session


def columns_of(session: Session, solution: Solution) -> Iterable[tuple[str, np.ndarray, Any]]:
    """Entity, stamps and columns."""
    imu, t, sigma = session.require_imu(), solution.t_ns, solution.sigmas
    yield "imu/accel", imu.t_ns, rr.Scalars.columns(scalars=imu.accel)
    yield "imu/gyro", imu.t_ns, rr.Scalars.columns(scalars=imu.gyro)
    at = solution.nav_t_body.astype(np.float32)
    quaternion = Rotation.from_matrix(solution.nav_R_body).as_quat()
    yield "body", t, rr.Transform3D.columns(translation=at, quaternion=quaternion)
    yield "velocity", t, rr.Arrows3D.columns(origins=at, vectors=solution.nav_v_body)
    values, vectors = np.linalg.eigh(solution.covariance[:, POS, POS])
    vectors[np.linalg.det(vectors) < 0, :, 0] *= -1.0
    axes = Rotation.from_matrix(vectors).as_quat()
    yield "covariance", t, rr.Ellipsoids3D.columns(centers=at, half_sizes=np.sqrt(values), quaternions=axes)
    for name, bias, part in (
        ("accel", solution.accel_bias, ACCEL_BIAS),
        ("gyro", solution.gyro_bias, GYRO_BIAS),
    ):
        yield f"bias/{name}", t, rr.Measurements.columns(values=bias, variances=sigma[:, part] ** 2)
    yield "sigma", t, rr.Scalars.columns(scalars=sigma[:, POS])
    residuals = solution.residuals
    for sensor in np.unique(residuals.sensor.astype(str)):
        mine = residuals.of(sensor)
        yield f"residuals/{sensor}", residuals.t_ns[mine], rr.Scalars.columns(scalars=residuals.whitened[mine])


def main() -> None:
    session, solution, file = sn.load(sys.argv[1]), read_run(sys.argv[2]).solution, Path(sys.argv[3])
    begin = time.process_time()
    stream = rr.RecordingStream("bare", recording_id="bare", send_properties=False)
    stream.save(file)
    for path, t_ns, columns in columns_of(session, solution):
        elapsed = (t_ns - session.t0_ns).astype("timedelta64[ns]")
        stream.send_columns(path, [rr.TimeColumn("elapsed", duration=elapsed)], columns)
    stream.flush()
    stream.disconnect()
    seconds = time.process_time() - begin
    print(json.dumps({"seconds": seconds, "size_mb": round(file.stat().st_size / 1e6, 2)}))


if __name__ == "__main__":
    main()
