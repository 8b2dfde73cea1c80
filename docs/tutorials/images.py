# %% [markdown]
# # Images: motion from pictures and inertial data
#
# No satellites, no points: ten seconds with a phone in a room, its pictures and its inertial data. Pictures hold the
# rotation and the direction of travel, inertial data their scale.

# %% tags=["fold"] title="How the files of this page were made"
# A recording with pictures, rendered from a simulated room; with its truth in reference.parquet.
from dataclasses import replace
from pathlib import Path

from smartnav_graph.simulation.recording import simulate_to_folder
from smartnav_graph.simulation.scenarios import find_scenario

scenario = find_scenario("rendered-room-10s")
_ = simulate_to_folder(replace(scenario, camera=replace(scenario.camera, rate_hz=4.0)), 1, Path("room"))

# %%
# !smartnav info room --quiet

# %% alt="One picture of the recording: a furnished room with textured walls"
import matplotlib.pyplot as plt
from pathlib import Path

picture = sorted(Path("room/images").rglob("*.*"))[12]
figure, axes = plt.subplots(figsize=(6, 4.5))
axes.imshow(plt.imread(picture), cmap="gray")
axes.axis("off")
plt.show()

# %% [markdown]
# ## Match
#
# `match` finds points that several pictures show. It stores them in the session, so that it is done once.

# %%
# !smartnav match room --features orb --quiet

# %% [markdown]
# ## Smooth
#
# Every match is one condition between two pictures: both rays and the way between the pictures lie in one plane. No
# point in space is estimated. Before anything is estimated, the turns of the images are compared with those of the
# gyroscope: that shows a wrong clock, a wrong mount or a wrong calibration.

# %%
import smartnav_graph as sn

room = sn.load("room")
run = sn.run(room, rate="imu")
run.summary["verdict"]["level"], run.summary["camera"]

# %% [markdown]
# The simulation has the truth. Position and heading at the start are free without fixes, so both are aligned:

# %%
found = sn.evaluate(run.solution, room.reference, align="yaw")
print(f"position {found.ape_m.rmse:.3f} m, attitude {found.rotation_deg.rmse:.2f} deg")

# %%
from smartnav_graph.factors.coplanarity import CoplanarityConfig

without = sn.smooth(room, sn.Config(image_pairs=CoplanarityConfig(enabled=False)), rate="imu")
found_without = sn.evaluate(without, room.reference, align="yaw")
print(f"without images: position {found_without.ape_m.rmse:.3f} m, attitude {found_without.rotation_deg.rmse:.2f} deg")

# %% alt="Path in plan: with images it lies on the truth, without images it drifts away from it"
figure, axes = plt.subplots(figsize=(7, 4))
axes.plot(*room.reference.enu[:, :2].T, "k", label="truth")
axes.plot(*run.solution.nav_t_body[:, :2].T, label="with images")
axes.plot(*without.nav_t_body[:, :2].T, "--", label="without")
axes.set(xlabel="east m", ylabel="north m", aspect="equal")
axes.legend()
plt.show()

# %% [markdown]
# Real cameras have a mount, a clock and distortion that have to be known: [Calibration](calibration.md) finds them, and
# [Use images](../how-to/images.md) says what else can be done with pictures: point tracks, a COLMAP model as a map,
# copies of the pictures with position.
