# %% [markdown]
# # Surveyor: a phone export and control points
#
# A phone on a trolley logs its inertial sensors and fixes of its receiver. The trolley halts at a few points whose
# coordinates are known. Wanted: the path in between, with a sigma for every position, and a check by points that
# the computation does not see.
#
# You need two files: the export of the phone's logging app as it comes (here a zip of Sensor Logger), and a list of
# the points.

# %% tags=["fold"] title="How the files of this page were made"
# The two files of this tutorial, made from a simulated recording: 6 min, receiver noise 3 m with a correlated error.
import dataclasses
import zipfile

import pandas as pd
from pyproj import Transformer

from smartnav_graph.simulation.fixes import GnssModel
from smartnav_graph.simulation.scenarios import find_scenario

scenario = dataclasses.replace(find_scenario("trolley-loop"), gnss=GnssModel(white_m=1.5, markov_m=2.5, markov_s=60.0))
made = scenario(4)


def table(t_ns, **columns):
    return pd.DataFrame({"time": t_ns, "seconds_elapsed": (t_ns - made.t0_ns) / 1e9, **columns})


tables = {
    "TotalAcceleration.csv": table(made.imu.t_ns, **dict(zip("zyx", made.imu.accel.T[::-1], strict=True))),
    "Gyroscope.csv": table(made.imu.t_ns, **dict(zip("zyx", made.imu.gyro.T[::-1], strict=True))),
    "Location.csv": table(
        made.gnss.t_ns,
        altitude=made.gnss.lla[:, 2],
        longitude=made.gnss.lla[:, 1],
        latitude=made.gnss.lla[:, 0],
        horizontalAccuracy=4.5,
        verticalAccuracy=6.0,
    ),
}
with zipfile.ZipFile("site-visit.zip", "w", zipfile.ZIP_DEFLATED) as archive:
    for name, rows in tables.items():
        archive.writestr(name, rows.to_csv(index=False, float_format="%.9f"))
    archive.writestr("Metadata.csv", "device name,platform\nGalaxy S2,android\n")

east, north = Transformer.from_crs(4979, 32632, always_xy=True).transform(
    made.control.lla[:, 1], made.control.lla[:, 0]
)
utc = [
    pd.to_datetime(edge, unit="ns").strftime("%Y-%m-%dT%H:%M:%SZ") for edge in (made.static.t_ns, made.static.t_end_ns)
]
points = pd.DataFrame(
    {
        "id": made.control.point_id,
        "start": utc[0],
        "end": utc[1],
        "E": east,
        "N": north,
        "h": made.control.lla[:, 2],
        "EPSG": 32632,
        "sigma": 0.02,
    }
).round(4)
points.to_csv("points.csv", index=False)

# %% [markdown]
# The list of points has an id, when the trolley was there (start and end, UTC), UTM coordinates with their EPSG code,
# ellipsoidal height, and a sigma in metres:

# %%
from pathlib import Path

print(Path("points.csv").read_text())

# %% [markdown]
# ## Import
#
# One command reads both, checks them, and ties them to one clock.

# %%
# !smartnav import site-visit.zip points.csv --out visit --quiet

# %% [markdown]
# `info` says what is in a session, and what looks wrong: rates, data gaps, units, clocks, gravity.

# %%
# !smartnav info visit --quiet

# %% [markdown]
# ## Compute the path
#
# The points P1, P3, P5, ... are withheld: they are compared with the result and not used by it. That is the
# independent check; the sigmas of the result are a claim, the withheld points test it.

# %%
# !smartnav smooth visit --out check --vehicle trolley --withhold control:every=2 --quiet

# %%
import pandas as pd

withheld = pd.read_parquet("check/withheld.parquet")
withheld[[c for c in withheld if c not in ("t_ns", "arrival_ns")]].round(3)

# %% [markdown]
# The final computation uses all points.

# %%
# !smartnav smooth visit --out final --vehicle trolley --rate 10 --quiet

# %% alt="Map of the path of the trolley in UTM coordinates with the fixes of the receiver scattered metres around it and the control points on it"
import matplotlib.pyplot as plt
from pyproj import Transformer

path = pd.read_csv("final/trajectory.csv")
utm = Transformer.from_crs(4979, 32632, always_xy=True)
east, north = utm.transform(path.lon_deg, path.lat_deg)
fixes = pd.read_parquet("visit/gnss.parquet")
figure, axes = plt.subplots(figsize=(7, 6))
axes.plot(*utm.transform(fixes.lon_deg, fixes.lat_deg), ".", color="0.6", label="receiver")
axes.plot(east, north, label="smoothed")
points = pd.read_csv("points.csv")
axes.plot(points.E, points.N, "k^", label="control points")
axes.set(xlabel="E m (EPSG:32632)", ylabel="N m", aspect="equal")
axes.ticklabel_format(useOffset=False, style="plain")
axes.tick_params(axis="x", rotation=30)
axes.legend()
plt.show()

# %% [markdown]
# ## The path in UTM, with its sigmas

# %%
# !smartnav export final --format csv --crs EPSG:32632 --out path-utm.csv --quiet

# %%
table = pd.read_csv("path-utm.csv")
utm = ["epsg32632_east_m", "epsg32632_north_m", "epsg32632_height_m"]
table[[*utm, "sigma_e_m", "sigma_n_m", "sigma_u_m"]].iloc[::600].round(3)

# %% [markdown]
# ## May I sign this?
#
# Every run ends with a verdict, by tests that the estimate did not make itself. The report (`final/report.html`) opens
# with it, and has the map, the residuals of every sensor and every rejected fix with its time.

# %%
import json

summary = json.loads(Path("final/summary.json").read_text())
print(summary["verdict"]["level"])
for reason in summary["verdict"]["reasons"]:
    print(f"{reason['sensor']}: {reason['text']}; {reason['remedy']}")

# %% [markdown]
# What the three words mean, and what to look at before you sign: [Can I rely on it?](../understand/sure.md)
#
# The figures of this page come from a simulated recording, so that the page can be rebuilt anywhere; what real
# recordings gave is under [Comparison with other software](../understand/comparison.md).
