# %% [markdown]
# # Robotics student: visual-inertial data, replay, truth, a factor of your own
#
# Half a minute of the EuRoC flight V1_01 comes with the gtsam package that this package depends on, so there is nothing
# to download: inertial data at 200 Hz and feature tracks at 20 Hz, no positions.

# %%
import smartnav_graph as sn

euroc = sn.load("gtsam-euroc")
{name: len(stream) for name, stream in euroc.streams().items()}

# %% [markdown]
# ## Batch
#
# All data at once. The flight begins with five seconds at rest, which give the vertical and the gyroscope bias; images
# and inertial data do the rest.

# %%
run = sn.run(euroc)
run.summary["mode"], run.summary["verdict"]["level"], round(run.summary["path_m"], 2)

# %% alt="Path of the flight in plan, and height, speed and heading over time with bands of two sigmas"
solution = run.solution
_ = solution.plot()

# %% [markdown]
# ## Replay
#
# `replay` sees one window of data after the other, as a robot would. Every keyframe is estimated from what was known at
# its time (`causal`); at the end the whole is solved once more (`solution`). `fixed-lag` is the default; `isam2` is
# GTSAM's incremental smoother.

# %%
replay = sn.run(euroc, causal=True)
updates = replay.summary["update_ms"]
print(f"an update takes {updates['median']:.1f} ms (median), {updates['p99']:.1f} ms (99 %)")

# %% [markdown]
# How much does the future help? The batch solution serves as reference for the causal one:

# %%
batch = sn.Reference(t_ns=solution.t_ns, enu=solution.nav_t_body, quat=solution.quat_wxyz)
found = sn.evaluate(replay.causal, batch, align="none")
print(f"causal against batch: {found.ape_m.rmse:.3f} m, {found.rotation_deg.rmse:.2f} deg")

# %% [markdown]
# ## Compare with truth
#
# The ground truth of EuRoC is part of its data set, not of gtsam. With the file at hand it is one line,
# `sn.evaluate(solution, sn.load_reference("V1_01_easy.csv"), align="yaw")`, or in the terminal:
#
# ```
# smartnav evaluate run --reference V1_01_easy.csv --align yaw
# ```
#
# Position and heading are free where there are no fixes, so they are aligned: `yaw` aligns exactly these four degrees
# of freedom. [Comparison with other software](../understand/comparison.md) has the figures. Here the same with a simulated
# room, whose truth is in the session:

# %%
room = sn.simulate("room-30s", 1)
found = sn.evaluate(sn.smooth(room, rate="imu"), room.reference, align="yaw")
print(f"position {found.ape_m.rmse:.3f} m, attitude {found.rotation_deg.rmse:.2f} deg")
print({name: round(value, 2) for name, value in found.nees.items() if value is not None})

# %% alt="Errors east, north and up with bands of two sigmas, and the rotation error, over time"
_ = found.plot()

# %% [markdown]
# The last line printed is the consistency (NEES): squared errors over their covariance, 3 on average for three components, 1
# for yaw, where the covariance is right. One recording is one draw of an error that drifts slowly, so average over several
# before you conclude anything from it.
#
# ## A factor of your own
#
# Measurements that the package does not know are added from a package of your own, without a change here: see
# [Write a factor or a reader of your own](../how-to/own-factor.md).
