"""The navigation frame: local ENU, gravity, heading. The one place where degrees and NED conventions appear.

Source: Hofmann-Wellenhof, Legat, Wieser (2003), Navigation, ch. 3 and 4 (local frames, normal gravity, attitude).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import SessionError

if TYPE_CHECKING:
    from pyproj import Transformer

STANDARD_GRAVITY = 9.80665

_AXES = {
    sign + name: (1.0 if sign == "+" else -1.0) * np.eye(3)[i] for i, name in enumerate("xyz") for sign in ("+", "-")
}

# What heights of a result count from.
ELLIPSOIDAL = "ellipsoidal (WGS84)"
ABOVE_SEA = "above mean sea level (geoid not known)"
PARTLY_ABOVE_SEA = "partly above mean sea level (geoid not known)"
LOCAL_HEIGHTS = "above the local origin"


@dataclass(frozen=True)
class Origin:
    """Origin of the local frame: WGS84 latitude and longitude in degrees, ellipsoidal height in metres."""

    lat_deg: float
    lon_deg: float
    height_m: float

    def __post_init__(self) -> None:
        for name in ("lat_deg", "lon_deg", "height_m"):  # numpy scalars print as np.float64(...), which PROJ reads as 0
            object.__setattr__(self, name, float(getattr(self, name)))
        if not (abs(self.lat_deg) <= 90.0 and abs(self.lon_deg) <= 360.0 and np.isfinite(self.height_m)):
            raise SessionError(
                "session.toml [origin]",
                f"lat_deg {self.lat_deg}, lon_deg {self.lon_deg}, height_m {self.height_m}",
                "latitude in [-90, 90], longitude in [-360, 360] degrees and a finite height",
                "give WGS84 degrees",
            )


@dataclass(frozen=True)
class LocalFrame:
    """ENU tangent plane at `origin`; geodetic (lat deg, lon deg, ellipsoidal height m) <-> nav metres."""

    origin: Origin

    @cached_property
    def _pipeline(self) -> Transformer:
        import pyproj

        o = self.origin
        return pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={o.lat_deg!r} +lon_0={o.lon_deg!r} +h_0={o.height_m!r}"
        )

    def nav_from_lla(self, lla: ArrayLike) -> Floats:
        """ENU metres (n, 3) of geodetic rows (n, 3): lat deg, lon deg, height m."""
        rows = np.asarray(lla, dtype=np.float64).reshape(-1, 3)
        e, n, u = self._pipeline.transform(rows[:, 1], rows[:, 0], rows[:, 2])
        return np.stack([e, n, u], axis=-1)

    def lla_from_nav(self, enu: ArrayLike) -> Floats:
        """Geodetic rows (n, 3): lat deg, lon deg, height m, of ENU metres (n, 3)."""
        rows = np.asarray(enu, dtype=np.float64).reshape(-1, 3)
        lon, lat, height = self._pipeline.transform(rows[:, 0], rows[:, 1], rows[:, 2], direction="INVERSE")
        return np.stack([lat, lon, height], axis=-1)

    def nav_from_ecef(self, ecef: ArrayLike) -> Floats:
        """ENU metres (n, 3) of Earth-centred Earth-fixed metres (n, 3)."""
        return self.nav_from_lla(lla_from_ecef(ecef))

    @property
    def nav_R_ecef(self) -> Floats:
        """Rotation (3, 3) that takes ECEF vectors to ENU."""
        lat, lon = np.radians([self.origin.lat_deg, self.origin.lon_deg])
        sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
        return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


def lla_from_ecef(ecef: ArrayLike) -> Floats:
    """Geodetic rows (n, 3): lat deg, lon deg, height m, of Earth-centred Earth-fixed metres (n, 3)."""
    import pyproj

    rows = np.asarray(ecef, dtype=np.float64).reshape(-1, 3)
    return np.stack(pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979").transform(*rows.T), axis=-1)


def normal_gravity(lat_deg: float, height_m: float) -> float:
    """Normal gravity in m/s^2 on and above the WGS84 ellipsoid.

    Somigliana's closed formula with the second-order height series (Moritz 2000, Geodetic Reference System 1980;
    constants NIMA TR8350.2). Accurate to 1e-6 m/s^2 below 20 km.
    """
    a, f, m = 6378137.0, 1 / 298.257223563, 0.00344978650684
    s2 = np.sin(np.radians(lat_deg)) ** 2
    surface = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - 0.00669437999014 * s2)
    h = height_m / a
    return float(surface * (1 - 2 * (1 + f + m - 2 * f * s2) * h + 3 * h**2))


def magnetic_field_ut(origin: Origin, year: float) -> Floats:
    """Flux density (3,) uT of the Earth's field, ENU, at a decimal year.

    World Magnetic Model 2025; outside its five years the secular variation is extrapolated (at most 0.1 deg and 0.1 uT
    a year in most places), which a phone's magnetometer cannot resolve.
    """
    from pygeomag import GeoMag

    field = GeoMag().calculate(
        glat=origin.lat_deg,
        glon=origin.lon_deg,
        alt=origin.height_m / 1000.0,
        time=year,
        allow_date_outside_lifespan=True,
    )
    return np.array([field.y, field.x, -field.z]) / 1000.0


def axis_vector(name: str) -> Floats:
    """Unit vector (3,) of a signed body axis such as ``+y`` or ``-z``.

    Raises
    ------
    SessionError
        The name is none of +x, -x, +y, -y, +z, -z.
    """
    if name not in _AXES:
        raise SessionError("session.toml [device]", f"axis {name!r}", "one of +x, -x, +y, -y, +z, -z")
    return np.asarray(_AXES[name].copy())


def body_R_vehicle(forward: str, up: str) -> Floats:
    """Rotation (3, 3) from vehicle axes (forward, left, up) to body axes."""
    x, z = axis_vector(forward), axis_vector(up)
    if abs(x @ z) > 1e-9:
        raise SessionError("session.toml [device]", f"forward {forward!r} and up {up!r}", "two different axes")
    return np.stack([x, np.cross(z, x), z], axis=-1)


def heading_pitch_roll_deg(nav_R_body: ArrayLike, forward: str = "+y", up: str = "+z") -> Floats:
    """Heading clockwise from north in [0, 360), pitch nose up, roll right side down; degrees, shape (n, 3)."""
    R = np.asarray(nav_R_body, dtype=np.float64).reshape(-1, 3, 3) @ body_R_vehicle(forward, up)
    heading = np.degrees(np.arctan2(R[:, 0, 0], R[:, 1, 0])) % 360.0
    pitch = np.degrees(np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0)))
    roll = np.degrees(np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    return np.stack([heading, pitch, roll], axis=-1)


def nav_R_body_from_heading(heading_deg: float, body_up: ArrayLike, forward: str = "+y") -> Floats:
    """Attitude (3, 3) of a body whose up direction `body_up` (3,) is known and whose forward axis heads `heading_deg`.

    When forward points along gravity the heading is that of the body axis nearest to horizontal.
    """
    up = np.asarray(body_up, dtype=np.float64)
    up = up / np.linalg.norm(up)
    ahead = axis_vector(forward)
    if abs(ahead @ up) > 0.999:
        ahead = np.eye(3)[int(np.argmin(np.abs(up)))]
    ahead = ahead - up * (ahead @ up)
    ahead /= np.linalg.norm(ahead)
    body_R_level = np.stack([ahead, np.cross(up, ahead), up], axis=-1)
    a = np.radians(90.0 - heading_deg)
    nav_R_level = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(nav_R_level @ body_R_level.T)
