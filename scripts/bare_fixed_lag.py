"""The bare GTSAM job that the replay benchmark is measured against: nothing but library calls on a session in memory.

    python bare_fixed_lag.py SESSION [LAG_S]        prints one JSON line with milliseconds an update

A keyframe a fix; an update = preintegrate, build, IncrementalFixedLagSmoother.update, latest state and its covariances.
"""

import json
import sys
import time

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

import smartnav_graph as sn

session, lag = sn.load(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else 10.0
start = sn.smooth(session, end_s=60.0)  # where to begin is not what is measured
imu, fixes = session.require_imu(), session.gnss
positions, seconds = session.nav_position(fixes), session.seconds(fixes.t_ns)
first = int(np.searchsorted(fixes.t_ns, start.t_ns[np.searchsorted(start.t_ns, fixes.t_ns[2])]))
t_imu = session.seconds(imu.t_ns)

noise = (session.calibration or sn.Calibration()).imu_noise
params = gtsam.PreintegrationParams.MakeSharedU(session.gravity)
params.setAccelerometerCovariance(np.eye(3) * noise.accel_noise_density**2)
params.setGyroscopeCovariance(np.eye(3) * noise.gyro_noise_density**2)
params.setIntegrationCovariance(np.eye(3) * 1e-5)
walk = gtsam.noiseModel.Diagonal.Sigmas(np.array([noise.accel_bias_walk] * 3 + [noise.gyro_bias_walk] * 3))
fix_noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.5)

options = gtsam.ISAM2Params()
options.setFactorization("QR")
options.setRelinearizeThreshold(0.1)
options.relinearizeSkip = 1
smoother = gtsam.IncrementalFixedLagSmoother(lag, options)

at = int(np.searchsorted(start.t_ns, fixes.t_ns[first]))
pose = gtsam.Pose3(gtsam.Rot3(start.nav_R_body[at]), start.nav_t_body[at])
state = gtsam.NavState(pose, start.nav_v_body[at])
bias = gtsam.imuBias.ConstantBias(start.accel_bias[at], start.gyro_bias[at])

latency = []
for k in range(first, len(fixes)):
    begin = time.perf_counter()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    if k == first:
        graph.add(gtsam.PriorFactorPose3(X(k), pose, gtsam.noiseModel.Isotropic.Sigma(6, 0.2)))
        graph.add(gtsam.PriorFactorVector(V(k), state.velocity(), gtsam.noiseModel.Isotropic.Sigma(3, 1.0)))
        graph.add(gtsam.PriorFactorConstantBias(B(k), bias, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
    else:
        pim = gtsam.PreintegratedImuMeasurements(params, bias)
        i, j = np.searchsorted(t_imu, [seconds[k - 1], seconds[k]])
        edges = np.concatenate([t_imu[i:j], seconds[k : k + 1]])
        for row, dt in zip(range(i, j), np.diff(edges), strict=True):
            if dt > 0:
                pim.integrateMeasurement(imu.accel[row], imu.gyro[row], dt)
        state = pim.predict(state, bias)
        graph.add(gtsam.ImuFactor(X(k - 1), V(k - 1), X(k), V(k), B(k - 1), pim))
        graph.add(gtsam.BetweenFactorConstantBias(B(k - 1), B(k), gtsam.imuBias.ConstantBias(), walk))
    graph.add(gtsam.GPSFactor(X(k), positions[k], fix_noise))
    values.insert(X(k), state.pose())
    values.insert(V(k), state.velocity())
    values.insert(B(k), bias)
    smoother.update(graph, values, dict.fromkeys((X(k), V(k), B(k)), seconds[k]))
    state = gtsam.NavState(smoother.calculateEstimatePose3(X(k)), smoother.calculateEstimateVector(V(k)))
    bias = smoother.calculateEstimateConstantBias(B(k))
    for key in (X(k), V(k), B(k)):
        smoother.marginalCovariance(key)
    latency.append(1e3 * (time.perf_counter() - begin))

print(
    json.dumps(
        {"updates": len(latency), "median": np.median(latency), "p99": np.percentile(latency, 99), "max": max(latency)}
    )
)
