# %% [markdown]
# # Calibration: what your device adds to a measurement
#
# Every device has biases, scale factors, noise. Defaults of a device class are used where nothing is known; a
# calibration of your own device makes results better and their sigmas right. Three recordings are enough, no
# instrument is needed:
#
# | recording | how | gives |
# |---|---|---|
# | rests and turns | some seconds at rest in ten and more attitudes, turned by hand in between | bias, scale, misalignment |
# | at rest | an hour or more on a table | noise densities, bias instability |
# | pictures of a board | twenty pictures of a printed board from all sides | camera |

# %% tags=["fold"] title="How the files of this page were made"
# The recordings, simulated with errors that we know: scale 1 %, misalignment half a degree, bias 0.15 m/s^2.
import numpy as np
import smartnav_graph as sn
from scipy.spatial.transform import Rotation

rng = np.random.default_rng(5)
rate, g = 100.0, 9.80665
attitude, force_rows, rate_rows = Rotation.identity(), [], []
TRUE_ACCEL = np.eye(3) + np.array([[0.010, 0.004, -0.003], [0.0, -0.008, 0.005], [0.0, 0.0, 0.012]])
TRUE_GYRO = np.eye(3) + np.diag([0.006, -0.009, 0.004])
ACCEL_BIAS, GYRO_BIAS = np.array([0.15, -0.08, 0.11]), np.array([0.002, -0.001, 0.003])
for _ in range(18):
    for _ in range(int(6 * rate)):
        force_rows.append(attitude.inv().apply([0.0, 0.0, g]))
        rate_rows.append(np.zeros(3))
    axis = rng.normal(size=3)
    turn = axis / np.linalg.norm(axis) * np.radians(rng.uniform(70.0, 150.0))
    shape = np.sin(np.pi * (np.arange(200) + 0.5) / 200) ** 2
    for share in shape / shape.sum():
        attitude = attitude * Rotation.from_rotvec(0.5 * turn * share)
        force_rows.append(attitude.inv().apply([0.0, 0.0, g]))
        rate_rows.append(turn * share * rate)
        attitude = attitude * Rotation.from_rotvec(0.5 * turn * share)
force, turning = np.array(force_rows), np.array(rate_rows)
accel = force @ np.linalg.inv(TRUE_ACCEL).T + ACCEL_BIAS + 0.02 * rng.normal(size=force.shape)
gyro = turning @ np.linalg.inv(TRUE_GYRO).T + GYRO_BIAS + 0.001 * rng.normal(size=force.shape)
t_ns = 1_750_000_000_000_000_000 + np.round(np.arange(len(force)) / rate * 1e9).astype(np.int64)
sn.save(
    sn.Session(imu=sn.Imu(t_ns=t_ns, accel=accel, gyro=gyro), clock_epoch="unix", gravity_m_s2=g), "rests-and-turns"
)

count = 240_000
t_ns = 1_750_100_000_000_000_000 + np.arange(count, dtype=np.int64) * 20_000_000
walk = np.cumsum(3e-7 * rng.normal(size=(count, 3)), axis=0)
at_rest = sn.Imu(
    t_ns=t_ns,
    accel=[0.0, 0.0, g] + 0.02 * rng.normal(size=(count, 3)),
    gyro=GYRO_BIAS + walk + 0.001 * rng.normal(size=(count, 3)),
)
sn.save(sn.Session(imu=at_rest, clock_epoch="unix", gravity_m_s2=g), "on-the-table")

# %% [markdown]
# ## Rests and turns
#
# Rests are found by themselves. The size of gravity at every rest gives the accelerometer; how gravity turned from one
# rest to the next gives the gyroscope.

# %%
# !smartnav calibrate imu rests-and-turns --out calibration.toml --report imu.html --quiet

# %% [markdown]
# Every value has its sigma. The simulated truth was 0.010, -0.008, 0.012 for the scale of the accelerometer. What the
# recording does not determine would be refused by name instead of being returned as a number.
#
# [The report of this calibration](imu.html) has the rests, their residuals and the correlations.
#
# ## At rest
#
# An hour and a quarter on a table shows how noise averages: the Allan deviation falls with the root of time while noise is
# white, and rises where the bias walks.

# %%
# !smartnav calibrate static on-the-table --out calibration.toml --report static.html --quiet | head -24

# %% [markdown]
# [The report](static.html) draws the Allan deviation with its confidence limits.
#
# ## The file, and its use
#
# All of it is in one text file, which later calibrations add to:

# %%
# !smartnav calibrate show calibration.toml | head -20

# %% [markdown]
# Keep it with a recording; `match`, `smooth` and `replay` then use it:

# %%
# !smartnav calibrate apply calibration.toml rests-and-turns --out calibrated --quiet

# %% [markdown]
# ## A camera
#
# Print a board, take twenty pictures of it from all sides, near the corners of the picture too:
#
# ```
# smartnav calibrate board chessboard:9x6:0.025 --out board.pdf
# smartnav calibrate camera pictures/ --board chessboard:9x6:0.025 --report camera.html
# ```
#
# Its clock and its attitude in the device come from any walk with images, without a board. Here a recording whose
# camera is turned by 3 deg and 40 ms late, unknown to the session:

# %%
from dataclasses import replace
from smartnav_graph.simulation.scenarios import SCENARIOS

room = SCENARIOS["room-30s"]
model = replace(room.camera, boresight_deg=(0.0, 3.0, 0.0), clock_s=0.04, count=(120, 160))
sn.save(replace(room, camera=model)(0), "walk")

# %%
# !smartnav calibrate camera-imu walk --out camera.toml --quiet

# %% [markdown]
# What each kind of recording needs is in `smartnav calibrate KIND --help`, also on the page
# [Commands](../reference/commands.md#calibrate).
