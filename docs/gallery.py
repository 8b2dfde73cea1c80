# %% [markdown]
# # Gallery
#
# Recordings and their reports, made when this site was built. Each report is one file; open it.
#
# ## A car drive
#
# The drive of 471 s that comes with GTSAM, with one fix in ten: the other nine are compared with the result.

# %% tags=["fold"]
import matplotlib.pyplot as plt
import numpy as np
import smartnav_graph as sn

INK = {"path": "#3949ab", "fix": "#d2691e", "point": "#111111"}


def draw(run, title, fixes=None, points=None, name=None):
    """Path, speed, and horizontal sigma over time."""
    solution = run.solution
    figure, axes = plt.subplot_mosaic([["map", "speed"], ["map", "sigma"]], figsize=(10, 4.6), layout="constrained")
    if fixes is not None:
        axes["map"].plot(*fixes[:, :2].T, ".", ms=3, color=INK["fix"], label="fixes")
    axes["map"].plot(*solution.nav_t_body[:, :2].T, lw=1.4, color=INK["path"], label="smoothed")
    if points is not None:
        axes["map"].plot(*points[:, :2].T, "^", ms=6, color=INK["point"], label="control points")
    axes["map"].set(xlabel="east m", ylabel="north m", aspect="equal", title=title)
    axes["map"].legend(loc="best", fontsize=8)
    axes["speed"].plot(solution.seconds, np.linalg.norm(solution.nav_v_body, axis=1), lw=1, color=INK["path"])
    axes["speed"].set(ylabel="speed m/s")
    axes["sigma"].plot(solution.seconds, np.hypot(*solution.sigmas[:, 3:5].T), lw=1, color=INK["path"])
    axes["sigma"].set(ylabel="horizontal sigma m", xlabel="s", ylim=(0, None))
    if name:
        figure.savefig(name, dpi=100)
    plt.show()


def report(run, name):
    """The report of a run as one file."""
    from pathlib import Path

    sn.write_run(run, "run", force=True, recording=False)
    Path(name).write_bytes(Path("run/report.html").read_bytes())


# %% tags=["fold"] alt="Path of the car of 3.7 km with the fixes, its speed, and the horizontal sigma over time"
kitti = sn.load("gtsam-kitti")
drive = sn.run(kitti, withhold=("gnss:every=10",))
draw(drive, "One fix in ten", kitti.nav_position(kitti.gnss), name="gallery-kitti.png")
report(drive, "gallery-kitti.html")
print("withheld fixes:", {k: round(v, 3) for k, v in drive.summary["withheld"]["gnss"].items()})

# %% [markdown]
# [Report of the drive](gallery-kitti.html) · [the picture](gallery-kitti.png)
#
# ## A walk with a phone
#
# One minute with the noise of a phone of 2011: magnetometer, barometer, fixes of 3 m.

# %% tags=["fold"] alt="Path of the walk with scattered fixes, speed, and sigma over time"
walk = sn.simulate("walk-60s", 2)
walked = sn.run(walk, rate="10")
draw(walked, "A walk of one minute", walk.nav_position(walk.gnss))
report(walked, "gallery-walk.html")

# %% [markdown]
# [Report of the walk](gallery-walk.html)
#
# ## A trolley that halts on control points
#
# No satellites: inertial data, standstills, nine visits of surveyed points.

# %% tags=["fold"] alt="Path of the trolley through the control points; between them the sigma rises and falls back at each point"
loop = sn.simulate("trolley-loop", 1)
pushed = sn.run(loop, rate="10")
draw(pushed, "A trolley, four rounds", points=loop.nav_position(loop.control))
report(pushed, "gallery-trolley.html")

# %% [markdown]
# [Report of the trolley](gallery-trolley.html)
#
# ## Half a minute of flight with images
#
# EuRoC V1_01 from GTSAM: inertial data and feature tracks, no positions at all.

# %% tags=["fold"] alt="Path of the flight indoors, speed, and the sigma that grows with the distance from the start"
flight = sn.run(sn.load("gtsam-euroc"))
draw(flight, "Visual-inertial odometry")
report(flight, "gallery-flight.html")

# %% [markdown]
# [Report of the flight](gallery-flight.html)
#
# ## When something is wrong
#
# The first 200 s of the drive, the clock of its receiver three seconds off. The verdict says so:

# %% tags=["fold"]
from dataclasses import replace

wrong = kitti.replace(gnss=replace(kitti.gnss, t_ns=kitti.gnss.t_ns + 3_000_000_000))
faulty = sn.run(wrong, end_s=200.0)
print(faulty.summary["verdict"]["level"])
for reason in faulty.summary["verdict"]["reasons"]:
    print(f"{reason['sensor']}: {reason['text']}; {reason['remedy']}")
report(faulty, "gallery-wrong.html")

# %% [markdown]
# [Report of the run with the wrong clock](gallery-wrong.html)
