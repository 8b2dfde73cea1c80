# %% [markdown]
# # Data scientist: DataFrames in, DataFrames out
#
# The samples are in tables: inertial data of some device at 100 Hz, and positions once a second. Wanted: one table with
# position, velocity and attitude at any rate, each with its sigma.

# %% tags=["fold"] title="How the files of this page were made"
# Two tables with names of their own, as they come from a database: a walk of one minute with a phone.
import numpy as np
import pandas as pd

import smartnav_graph as sn

made = sn.simulate("walk-60s", 3)
inertial = pd.DataFrame(
    np.hstack([made.imu.gyro, made.imu.accel]),
    columns=["wx", "wy", "wz", "ax", "ay", "az"],
    index=pd.to_datetime(made.imu.t_ns, unit="ns", utc=True),
)
positions = pd.DataFrame(
    made.gnss.lla, columns=["lat", "lon", "height"], index=pd.to_datetime(made.gnss.t_ns, unit="ns", utc=True)
)

# %%
inertial.head(3).round(3)

# %%
positions.head(3)

# %% [markdown]
# ## Build a session
#
# A session takes tables with the column names of [The session folder](../session-format.md), which carry their unit. The
# times are the index, datetimes of any unit and time zone. What does not fit is refused with the cure: seconds as
# floating numbers, a column in another unit, a name that is unknown.

# %%
gyro = {"wx": "gyro_x_rad_s", "wy": "gyro_y_rad_s", "wz": "gyro_z_rad_s"}
accel = {"ax": "accel_x_m_s2", "ay": "accel_y_m_s2", "az": "accel_z_m_s2"}
place = {"lat": "lat_deg", "lon": "lon_deg", "height": "height_m"}

session = sn.Session.from_pandas(
    imu=inertial.rename(columns=gyro | accel),
    gnss=positions.rename(columns=place),
)
session

# %%
try:
    sn.Session.from_pandas(imu=inertial)
except sn.SmartnavError as error:
    print(error)

# %% [markdown]
# Arrays work the same way: `sn.Session.from_arrays(imu={"time": ..., "gyro": ..., "accel": ...})`.
#
# ## Smooth
#
# `sn.smooth` gives a `Solution`. Its arrays have rows = epochs; `to_pandas` makes a table of it.

# %%
solution = sn.smooth(session, rate="10")
solution

# %%
table = solution.to_pandas()
table[["e_m", "n_m", "u_m", "heading_deg", "sigma_e_m", "sigma_n_m", "sigma_heading_deg"]].iloc[::100].round(3)

# %% [markdown]
# The columns have their unit in their name; [Conventions](../understand/conventions.md) has frames and signs. The full
# covariance of every epoch is an array of 15 x 15 (rotation, position, velocity, biases):

# %%
solution.covariance.shape, np.sqrt(np.diagonal(solution.covariance[-1]))[3:6].round(3)

# %% [markdown]
# ## All results of a run
#
# `sn.run` also has the summary, the residuals of every measurement and the errors at withheld ones. Withholding is
# cross-validation: fixes that the computation does not see are predicted by it.

# %%
run = sn.run(session, withhold=("gnss:every=5",))
run.summary["withheld"]["gnss"], run.summary["verdict"]["level"]

# %% [markdown]
# Residuals are whitened: divided by their sigma. Their mean square is about 1 where the noise model is right.

# %%
residuals = run.solution.residuals
rows = pd.DataFrame(
    {
        "seconds": session.seconds(residuals.t_ns),
        "sensor": residuals.sensor,
        "whitened": residuals.whitened,
        "used": residuals.used,
    }
)
rows.groupby("sensor").whitened.agg(["count", "mean", "std"]).round(2)

# %% alt="Path in plan, and height, speed and heading over time with bands of two sigmas"
_ = solution.plot()

# %% alt="Whitened residuals of every sensor over time, scattered around zero, with lines at two sigmas"
_ = run.plot_residuals()

# %% [markdown]
# ## Join with your own data
#
# The index is the time in UTC where the clock of the recording is a date, so `merge_asof` joins it with any other table:

# %%
track = table[["e_m", "n_m", "sigma_e_m"]]
events = pd.DataFrame({"event": ["bus stop", "lift"]}, index=table.index[[120, 400]] + pd.Timedelta("13ms"))
pd.merge_asof(events, track, left_index=True, right_index=True, direction="nearest").round(2)

# %% [markdown]
# ## Keep it
#
# A session is a folder of Parquet files, a run too: `pandas.read_parquet` opens them everywhere.

# %%
sn.save(session, "walk")
sn.write_run(run, "walk-run", recording=False)
pd.read_parquet("walk-run/solution.parquet").shape

# %% [markdown]
# The columns are on the pages [The session folder](../session-format.md) and
# [The run folder](../reference/run-folder.md).
