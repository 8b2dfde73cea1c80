# %% [markdown]
# # Data scientist: DataFrames in, DataFrames out
#
# The samples are in tables: inertial data of some device at 100 Hz, and positions once a second. Wanted: one table with
# position, velocity and attitude at any rate, each with its sigma.

# %% tags=["fold"]
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
# Each stream checks its rows when it is made: units by their names, times as whole nanoseconds, no NaN.

# %%
from smartnav_graph.core.frames import Origin
from smartnav_graph.session.streams import GnssFix, Imu

session = sn.Session(
    imu=Imu(
        t_ns=inertial.index.as_unit("ns").asi8,
        gyro=inertial[["wx", "wy", "wz"]].to_numpy(),
        accel=inertial[["ax", "ay", "az"]].to_numpy(),
    ),
    gnss=GnssFix(t_ns=positions.index.as_unit("ns").asi8, lla=positions.to_numpy()),
    origin=Origin(*positions.iloc[0]),
    clock_epoch="unix",
)
{name: len(stream) for name, stream in session.streams().items()}

# %% [markdown]
# ## Smooth
#
# `sn.smooth` gives a `Solution`. Its arrays have rows = epochs; `to_pandas` makes a table of it.

# %%
solution = sn.smooth(session, rate="10")
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

# %% alt="Time series of the whitened residuals of the position fixes, scattered around zero within three sigmas"
import matplotlib.pyplot as plt

gnss = rows[rows.sensor == "gnss"]
figure, axes = plt.subplots(figsize=(8, 3))
axes.plot(gnss.seconds, gnss.whitened, ".")
axes.set(xlabel="s", ylabel="residual, in sigmas")
axes.axhline(0.0, color="0.7")
plt.show()

# %% [markdown]
# ## Join with your own data
#
# Epochs of the solution have integer nanoseconds of the recording's clock. Where that clock is a date they are
# datetimes, and `merge_asof` joins them with any other table:

# %%
at = pd.to_datetime(solution.t_ns, unit="ns", utc=True)
track = table.set_index(at)[["e_m", "n_m", "sigma_e_m"]]
events = pd.DataFrame({"event": ["door", "lift"]}, index=at[[120, 400]] + pd.Timedelta("13ms"))
pd.merge_asof(events, track, left_index=True, right_index=True, direction="nearest").round(2)

# %% [markdown]
# ## Keep it
#
# A session is a folder of Parquet files, a run too: `pandas.read_parquet` opens them everywhere.

# %%
sn.save(session, "walk")
sn.write_run(run, "walk-run", recording=False)
sorted(p.name for p in __import__("pathlib").Path("walk-run").iterdir())

# %% [markdown]
# The columns are on the pages [The session folder](../session-format.md) and
# [The run folder](../reference/run-folder.md).
