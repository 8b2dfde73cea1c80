"""What a smoother gives: states with covariance in nav axes, and residuals by sensor."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core import figures, frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.so3 import quaternion
from smartnav_graph.core.timebase import NS, nearest, seconds_since, span_text, unix_ns
from smartnav_graph.session.streams import Imu

if TYPE_CHECKING:
    import pandas as pd

ROT, POS, VEL, ACCEL_BIAS, GYRO_BIAS = (slice(3 * i, 3 * i + 3) for i in range(5))
COVARIANCE_NAMES = tuple(
    f"{block}_{axis}"
    for block, axes in (("rot", "enu"), ("pos", "enu"), ("vel", "enu"), ("accel_bias", "xyz"), ("gyro_bias", "xyz"))
    for axis in axes
)

# Columns of the sigmas, in the order of the covariance.
SIGMA_NAMES = (
    *(f"sigma_rot_{axis}_rad" for axis in "enu"),
    *(f"sigma_{axis}_m" for axis in "enu"),
    *(f"sigma_v{axis}_m_s" for axis in "enu"),
    *(f"sigma_accel_bias_{axis}_m_s2" for axis in "xyz"),
    *(f"sigma_gyro_bias_{axis}_rad_s" for axis in "xyz"),
)


@dataclass(frozen=True, kw_only=True)
class Residuals(Summarised):
    """One row a scalar residual: time, sensor name, axis, whitened residual, robust weight, whether it was used."""

    t_ns: NDArray[np.int64]
    sensor: NDArray[Any]
    axis: NDArray[np.int64]
    whitened: Floats
    weight: Floats
    used: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.t_ns)

    def facts(self) -> dict[str, str]:
        """Scalar residuals of every sensor."""
        return {"rows": str(len(self)), **{name: str(int(self.of(name).sum())) for name in self.sensors()}}

    def plot(self, t0_ns: int) -> figures.AxesList:
        """Residuals of every sensor over seconds since `t0_ns`, as axes of matplotlib; see `Solution.plot`."""
        seconds = seconds_since(self.t_ns, t0_ns)
        rows = [(name, self.of(name)) for name in self.sensors()]
        return figures.scatter_rows([(name, seconds[m], self.whitened[m], self.used[m]) for name, m in rows])

    def of(self, sensor: str) -> NDArray[np.bool_]:
        """Mask of the rows of one sensor."""
        return np.asarray(self.sensor == sensor)

    def found_for(self, sensor: str, t_ns: NDArray[np.int64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Masks (n,) of a sensor's measurements at t_ns (n,): those with residuals, and of these those in use.

        Residuals have the stamps of keyframes, at or very near those of the measurements. Each belongs to the one
        measurement nearest to it, within 0.4 median spacings; else to one that is not there.
        """
        rows = self.of(sensor)
        at, used = self.t_ns[rows], self.used[rows]
        stamps, row = np.unique(t_ns, return_inverse=True)
        there, in_use = np.zeros((2, len(stamps)), dtype=bool)
        if len(at) and len(stamps):
            spacing = float(np.median(np.diff(stamps))) if len(stamps) > 1 else float(NS)
            own = nearest(at, stamps)
            close = np.abs(stamps[own] - at) <= max(0.4 * spacing, 1e6)
            there[own[close]], in_use[own[close & used]] = True, True
        return there[row], in_use[row]

    def sensors(self) -> list[str]:
        """Names of the sensors with residuals, sorted."""
        return sorted({str(name) for name in self.sensor})

    @classmethod
    def empty(cls) -> Residuals:
        """No rows."""
        none = np.zeros(0)
        return cls(
            t_ns=none.astype(np.int64),
            sensor=none.astype(object),
            axis=none.astype(np.int64),
            whitened=none,
            weight=none,
            used=none.astype(bool),
        )


@dataclass(frozen=True, kw_only=True)
class Solution(Summarised):
    """States at n epochs.

    t_ns (n,) int64 on the IMU's clock; nav_R_body (n, 3, 3); nav_t_body (n, 3) m; nav_v_body (n, 3) m/s;
    accel_bias (n, 3) m/s^2 and gyro_bias (n, 3) rad/s in body axes; covariance (n, 15, 15) in the order rotation,
    position, velocity (nav axes), accelerometer bias, gyroscope bias (body axes). The rotation error is the nav-axes
    vector theta of R_true = Exp(theta) R. `t0_ns` is the session's time zero, `origin` its local frame,
    `clock_epoch` that of the stamps (``unix``, ``gps``, ``boot``, ``unknown``). `imu` is the inertial
    stream that carries the states from epoch to epoch, under `gravity` m/s^2; None where it is not known. `heights`
    says what the geodetic heights count from.
    """

    t_ns: NDArray[np.int64]
    nav_R_body: Floats
    nav_t_body: Floats
    nav_v_body: Floats
    accel_bias: Floats
    gyro_bias: Floats
    covariance: Floats
    t0_ns: int
    origin: Origin | None = None
    forward: str = "+y"
    up: str = "+z"
    residuals: Residuals = field(default_factory=Residuals.empty)
    imu: Imu | None = None
    gravity: float = frames.STANDARD_GRAVITY
    clock_epoch: str = "unknown"
    heights: str = frames.ELLIPSOIDAL

    def __len__(self) -> int:
        return len(self.t_ns)

    def facts(self) -> dict[str, str]:
        """Epochs, span, path, median sigmas."""
        horizontal = np.hypot(*self.sigmas[:, 3:5].T)
        median = {"horizontal": f"{np.median(horizontal):.3g} m", "height": f"{np.median(self.sigmas[:, 5]):.3g} m"}
        sigma = ", ".join(f"{name} {text}" for name, text in median.items())
        return {
            "epochs": str(len(self)),
            "span": span_text(self.t_ns),
            "path": f"{self.path_length():.1f} m",
            "sigma (median)": f"{sigma}, heading {np.median(self.sigma_heading_deg):.3g} deg",
        }

    @property
    def seconds(self) -> Floats:
        """Seconds since the session's time zero, (n,)."""
        return seconds_since(self.t_ns, self.t0_ns)

    @property
    def quat_wxyz(self) -> Floats:
        """Unit quaternions (n, 4) w x y z of nav_R_body, w >= 0."""
        return quaternion(self.nav_R_body)

    @property
    def sigmas(self) -> Floats:
        """One-sigma (n, 15) of every state."""
        return np.sqrt(np.clip(np.diagonal(self.covariance, axis1=1, axis2=2), 0.0, None))

    @property
    def heading_pitch_roll_deg(self) -> Floats:
        """(n, 3) degrees; heading clockwise from north."""
        return frames.heading_pitch_roll_deg(self.nav_R_body, self.forward, self.up)

    @property
    def sigma_heading_deg(self) -> Floats:
        """(n,) degrees: rotation about the vertical."""
        return np.degrees(self.sigmas[:, 2])

    def path_length(self) -> float:
        """Metres along the epochs."""
        return float(np.linalg.norm(np.diff(self.nav_t_body, axis=0), axis=1).sum())

    def trajectory_columns(self) -> dict[str, NDArray[Any]]:
        """The columns of trajectory.csv; lat, lon and height are NaN without an origin."""
        if self.origin is None:
            lla = np.full((len(self), 3), np.nan)
        else:
            lla = LocalFrame(self.origin).lla_from_nav(self.nav_t_body)
        names = [
            *("e_m", "n_m", "u_m", "lat_deg", "lon_deg", "height_m", "qw", "qx", "qy", "qz"),
            *("ve_m_s", "vn_m_s", "vu_m_s", "heading_deg", "pitch_deg", "roll_deg"),
            *("sigma_e_m", "sigma_n_m", "sigma_u_m", "sigma_heading_deg"),
        ]
        values = [
            self.nav_t_body,
            lla,
            self.quat_wxyz,
            self.nav_v_body,
            self.heading_pitch_roll_deg,
            self.sigmas[:, POS],
            self.sigma_heading_deg[:, None],
        ]
        return {"t_ns": self.t_ns} | dict(zip(names, np.concatenate(values, axis=1).T, strict=True))

    def all_columns(self) -> dict[str, NDArray[Any]]:
        """The columns of solution.parquet: trajectory, biases and the upper triangle of the covariance."""
        columns = self.trajectory_columns()
        for name, bias, unit in (("accel_bias", self.accel_bias, "m_s2"), ("gyro_bias", self.gyro_bias, "rad_s")):
            columns |= {f"{name}_{axis}_{unit}": bias[:, i] for i, axis in enumerate("xyz")}
        for i, row in enumerate(COVARIANCE_NAMES):
            for j in range(i, 15):
                columns[f"cov_{row}__{COVARIANCE_NAMES[j]}"] = self.covariance[:, i, j]
        return columns

    def to_pandas(self) -> pd.DataFrame:
        """The columns of trajectory.csv, biases, and one sigma of every state, as a pandas DataFrame.

        The index is the time in UTC where the clock gives a date (`clock_epoch` ``unix`` or ``gps``), with the seconds
        since time zero as a column ``seconds``; else these seconds. Sigmas: ``sigma_rot_e_rad`` ... of the rotation
        about east, north, up; ``sigma_e_m``, ``sigma_ve_m_s``, ``sigma_accel_bias_x_m_s2``,
        ``sigma_gyro_bias_x_rad_s`` ...
        """
        import pandas as pd

        columns = {name: value for name, value in self.all_columns().items() if not name.startswith("cov_")}
        columns |= dict(zip(SIGMA_NAMES, self.sigmas.T, strict=True))
        unix = unix_ns(self.t_ns, self.clock_epoch)
        if unix is None:
            return pd.DataFrame(columns, index=pd.Index(self.seconds, name="seconds"))
        return pd.DataFrame({"seconds": self.seconds} | columns, index=pd.DatetimeIndex(unix, tz="UTC", name="time"))

    def plot(self) -> figures.AxesList:
        """Path, and height, speed and heading over time, with bands of two sigmas, as axes of matplotlib.

        ``solution.plot()[0].figure.savefig("run.png")`` writes a file; a notebook shows the figure by itself.

        Raises
        ------
        SmartnavError
            matplotlib is not installed.
        """
        e, n, u = self.nav_t_body.T
        speed = np.linalg.norm(self.nav_v_body, axis=1)
        along = self.nav_v_body / np.maximum(speed, 1e-9)[:, None]
        spread = np.sqrt(np.clip(np.einsum("ni,nij,nj->n", along, self.covariance[:, VEL, VEL], along), 0.0, None))
        heading = np.degrees(np.unwrap(np.radians(self.heading_pitch_roll_deg[:, 0])))
        panels = (
            figures.Panel("height, m", u, self.sigmas[:, 5]),
            figures.Panel("speed, m/s", speed, spread),
            figures.Panel("heading, deg", heading, self.sigma_heading_deg),
        )
        return figures.path_and_series(figures.Path("east, m", "north, m", e, n), self.seconds, panels)


def read(path: str | Path) -> dict[str, NDArray[Any]]:
    """Columns of a solution.parquet."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def from_columns(
    columns: dict[str, NDArray[Any]],
    *,
    t0_ns: int,
    origin: Origin | None,
    forward: str = "+y",
    up: str = "+z",
    residuals: Residuals | None = None,
    imu: Imu | None = None,
    gravity: float = frames.STANDARD_GRAVITY,
    clock_epoch: str = "unknown",
    heights: str = frames.ELLIPSOIDAL,
) -> Solution:
    """The inverse of `Solution.all_columns`."""

    from scipy.spatial.transform import Rotation

    def stack(*names: str) -> Floats:
        return np.stack([np.asarray(columns[name], dtype=np.float64) for name in names], axis=-1)

    n = len(columns["t_ns"])
    covariance = np.zeros((n, 15, 15))
    for i, row in enumerate(COVARIANCE_NAMES):
        for j in range(i, 15):
            covariance[:, i, j] = covariance[:, j, i] = columns[f"cov_{row}__{COVARIANCE_NAMES[j]}"]
    return Solution(
        t_ns=np.asarray(columns["t_ns"], dtype=np.int64),
        nav_R_body=Rotation.from_quat(stack("qx", "qy", "qz", "qw")).as_matrix(),
        nav_t_body=stack("e_m", "n_m", "u_m"),
        nav_v_body=stack("ve_m_s", "vn_m_s", "vu_m_s"),
        accel_bias=stack(*(f"accel_bias_{a}_m_s2" for a in "xyz")),
        gyro_bias=stack(*(f"gyro_bias_{a}_rad_s" for a in "xyz")),
        covariance=covariance,
        t0_ns=t0_ns,
        origin=origin,
        forward=forward,
        up=up,
        residuals=residuals or Residuals.empty(),
        imu=imu,
        gravity=gravity,
        clock_epoch=clock_epoch,
        heights=heights,
    )
