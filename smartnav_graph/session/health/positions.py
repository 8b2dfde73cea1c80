"""Positions: jumps, exchanged axes, wrong units, the zero of heights, and the velocities and attitudes of fixes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.session.detect.heights import control_offset
from smartnav_graph.session.detect.out_of_reach import out_of_reach
from smartnav_graph.session.detect.scatter import scatter
from smartnav_graph.session.health.facts import (
    LEAST_ROWS,
    Facts,
    Finding,
    count_of,
    decimated,
    odd_speed,
    over_chords,
    repeats,
)
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_MAX_FIX_SPEED = 100.0  # m/s; faster than any car
_FAR_M = 50_000.0  # two sensors of one session
_FROZEN_FIXES_S = 10.0
_MANY_OUT, _MOST_OUT = 0.1, 0.3  # share of positions out of reach: suspect, and two places at once
_LARGE_SCATTER = 4.0  # times the stated sigma
_STALE_SPEED, _STALE_SHARE = 1.0, 0.2  # m/s between fixes, share of rows
_HEIGHTS_M = (-500.0, 9000.0)  # of the Earth's land
_GEOID_M = (8.0, 110.0)  # offsets of two heights that look like the geoid
_ATTITUDE_PAIRS, _LEAST_PAIRS, _ATTITUDE_PAIR_S = 100, 5, 15.0


def reach_finding(session: Session, name: str, out: Mask) -> Finding:
    """The finding of positions of one stream, some of which are `out` (n,) of reach of the others."""
    stream, rows = session.positions()[name], np.flatnonzero(out)
    position, kept = session.nav_position(stream), np.flatnonzero(~out)
    others = kept[np.clip(np.searchsorted(kept, rows), 0, len(kept) - 1)]
    size, share = float(np.linalg.norm(position[rows] - position[others], axis=1).max()), float(out.mean())
    level = "contradictory" if share > _MOST_OUT else "doubtful" if share > _MANY_OUT else "good"
    text = f"{len(rows)} of {len(out)} positions lie up to {size / 1e3:.4g} km from the others, more than any motion"
    remedy = "remove what is wrong: one device was not in both places"
    start_ns, end_ns = int(stream.t_ns[rows[0]]), int(stream.t_ns[rows[-1]])
    return Finding(name, text, remedy, verdict=level, size=size, start_ns=start_ns, end_ns=end_ns)


def _jumps(facts: Facts) -> Iterator[Finding]:
    for name in ("gnss", "pose_fixes"):
        stream = getattr(facts.session, name)
        if stream is None or len(stream) < 2:
            continue
        position = facts.session.nav_position(stream)
        out = out_of_reach(stream, position)
        if out.any():
            yield reach_finding(facts.session, name, out)
            continue
        # a jump must exceed the noise of both fixes, or 10 Hz fixes would always jump
        sigma = np.linalg.norm(np.nan_to_num(stream.sigma, nan=5.0), axis=1) if stream.sigma is not None else 5.0
        noise = 4.0 * np.broadcast_to(sigma, len(position))
        allowed = _MAX_FIX_SPEED * np.diff(stream.t_ns) / NS + np.hypot(noise[1:], noise[:-1])
        jump = np.linalg.norm(np.diff(position, axis=0), axis=1) > allowed
        if jump.any():
            at = float(facts.session.seconds(stream.t_ns[1:][jump][0]))
            text = f"{count_of(int(jump.sum()), 'jump')} faster than {_MAX_FIX_SPEED:g} m/s, the first at {at:.3f} s"
            yield Finding(name, text, "keep a robust loss on, or remove the outliers")


def _sigmas_and_heights(facts: Facts) -> Iterator[Finding]:
    for name, stream in facts.session.streams().items():
        if not isinstance(stream, Positioned):
            continue
        if stream.sigma is None:
            yield Finding(name, "has no sigma columns", "the default of the device class will be used", "info")
        elif bad := int(np.isnan(stream.sigma).any(axis=1).sum()):
            text = f"{bad} of {len(stream)} rows have no sigma"
            yield Finding(name, text, "the default of the device class will be used there", "info")
        flat = int((~stream.has_height).sum())
        if flat:
            text = f"{flat} of {len(stream)} rows have no height"
            yield Finding(name, text, "used as horizontal fixes", "info" if flat < len(stream) else "warning")
        mount = facts.session.mount(name)
        if mount.above_sea and stream.lla is not None and not np.isfinite(mount.geoid_m):
            text = "heights are above mean sea level, the height of the geoid is not known: so are those of the result"
            remedy = f"for heights above the ellipsoid give geoid_m in [sensors.{name}]"
            located = [other for other, rows in facts.session.positions().items() if rows.lla is not None]
            others = [other for other in located if not facts.session.mount(other).above_sea]
            if others:
                text += f", but those of {', '.join(others)} are not"
            yield Finding(name, text, remedy, verdict="doubtful" if others else "good")
        elif mount.above_sea:
            yield Finding(name, "heights are above mean sea level, not above the ellipsoid", level="info")


def _scatter(facts: Facts) -> Iterator[Finding]:
    """Stated sigmas against the scatter of the fixes beside a cubic through their neighbours."""
    for name in ("gnss", "pose_fixes"):
        stream = getattr(facts.session, name)
        if stream is None or stream.sigma is None:
            continue
        position = facts.session.nav_position(stream)
        for what, axes in (("horizontally", slice(0, 2)), ("in height", slice(2, 3))):
            stated = stream.sigma[:, axes]
            rows = np.isfinite(stated).all(axis=1) & (stream.has_height | (axes.start == 0))
            found = scatter(stream.t_ns[rows], position[rows, axes]) if rows.any() else None
            ratio = 0.0 if found is None else found.sigma / float(np.sqrt(np.median(stated[rows] ** 2)))
            if found is not None and found.is_noise and ratio > _LARGE_SCATTER:
                text = f"fixes scatter {found.sigma:.2g} m {what}, {ratio:.0f} times their stated sigma"
                yield Finding(name, text, "check the unit of the sigma columns, or leave them out")


def _exchanged(facts: Facts) -> Iterator[Finding]:
    """Latitude and longitude against those of the other streams and of the origin; radians."""
    centres = {name: np.median(lla, axis=0) for name, lla in _geodetic(facts).items()}
    origin = facts.session.origin
    if origin is not None:
        centres["origin"] = np.array([origin.lat_deg, origin.lon_deg, origin.height_m])
    names = list(centres)
    for i, name in enumerate(names):
        for other in names[i + 1 :]:
            away, turned = (_degrees_apart(centres[name][order], centres[other][:2]) for order in ([0, 1], [1, 0]))
            if np.radians(away) * 6.4e6 > _FAR_M:
                apart = f"lies {np.radians(away) * 6.4e3:.0f} km from {other}"
                if turned < 0.5:
                    text = f"{apart}, and near it with latitude and longitude exchanged"
                    yield Finding(name, text, f"exchange lat_deg and lon_deg of {name} or of {other}")
                else:
                    yield Finding(name, apart, "check lat_deg, lon_deg and [origin]")
    for name, lla in _geodetic(facts).items():
        if not lla[:, :2].any():
            text = "latitude and longitude are 0 in all rows, as receivers write them without a fix"
            yield Finding(name, text, f"remove {name}: it has no positions", "error")
        elif np.abs(lla[:, 0]).max() < np.pi / 2 and np.abs(lla[:, 1]).max() < np.pi:
            text = "latitudes and longitudes are all within pi of zero, where there is no land: they look like radians"
            yield Finding(name, text, "give degrees", "error")


def _geodetic(facts: Facts) -> dict[str, Floats]:
    """Latitude and longitude (deg) and height (n, 3) m of the geodetic streams."""
    return {name: s.lla for name, s in facts.session.positions().items() if len(s) and s.lla is not None}


def _degrees_apart(one: Floats, other: Floats) -> float:
    """Angle between two (lat, lon) in degrees, good enough to separate kilometres from thousands of them."""
    if abs(one[0]) > 90.0:
        return 180.0
    lon = (one[1] - other[1] + 180.0) % 360.0 - 180.0
    return float(np.hypot(one[0] - other[0], lon * np.cos(np.radians(other[0]))))


def _heights(facts: Facts) -> Iterator[Finding]:
    for name, lla in _geodetic(facts).items():
        height = lla[np.isfinite(lla[:, 2]), 2]
        if not len(height):
            continue
        if len(height) >= LEAST_ROWS and not height.any():
            yield Finding(name, "height_m is zero in all rows", "the log holds no heights; give large sigma_u_m")
        elif not _HEIGHTS_M[0] < float(np.median(height)) < _HEIGHTS_M[1]:
            text = f"median height {np.median(height):.6g} m, where land lies between -430 and 8849 m"
            yield Finding(name, text, "give metres above the ellipsoid")
    found = control_offset(facts.session)
    if found is None:
        return
    middle, spread = found
    frames = {facts.session.mount(name).frame for name in ("gnss", "control")}
    if _GEOID_M[0] < abs(middle) < _GEOID_M[1] and abs(middle) > 4.0 * spread and len(frames) == 1:
        text = f"heights lie {middle:+.1f} m off those of the control points, as the geoid does"
        yield Finding("gnss", text, 'one of them is above sea level: declare it by frame = "msl" in [sensors]')


def _frozen(facts: Facts) -> Iterator[Finding]:
    """A fix repeated while the device moves."""
    for name in ("gnss", "pose_fixes"):
        stream = getattr(facts.session, name)
        if stream is None or facts.imu is None or len(stream) < LEAST_ROWS:
            continue
        position = facts.session.nav_position(stream)
        for first, last in repeats(position):
            seconds, rows = (stream.t_ns[last] - stream.t_ns[first]) / NS, last - first
            frozen = seconds >= _FROZEN_FIXES_S and LEAST_ROWS // 2 <= rows < len(stream) - 1
            if frozen and _moves(facts, stream.t_ns[[first, last]]):
                at = float(facts.session.seconds(stream.t_ns[first]))
                text = f"repeats one position for {seconds:.0f} s from {at:.1f} s on, while the inertial data move"
                yield Finding(name, text, "receiver output frozen; remove the repeated rows")


def _stale(facts: Facts) -> Iterator[Finding]:
    """Rows that repeat the fix before, in a stream whose fixes move: a log with more rows than fixes."""
    for name in ("gnss", "pose_fixes"):
        stream = getattr(facts.session, name)
        if stream is None or len(stream) < LEAST_ROWS:
            continue
        position = facts.session.nav_position(stream)[:, :2]
        fixes = np.flatnonzero(np.concatenate([[True], np.diff(position, axis=0).any(axis=1)]))
        if len(fixes) < 2:
            continue
        step = np.linalg.norm(np.diff(position[fixes], axis=0), axis=1)
        speed = step / np.maximum(np.diff(stream.t_ns[fixes]) / NS, 1e-9)
        moving = speed > _STALE_SPEED
        rows = int((np.diff(fixes) - 1)[moving].sum())
        if rows >= LEAST_ROWS and rows > _STALE_SHARE * len(stream):
            text = f"{rows} of {len(stream)} rows repeat the fix before, at {np.median(speed[moving]):.1f} m/s"
            yield Finding(name, text, "remove the rows without a new fix", size=round(rows / len(stream), 3))


def _moves(facts: Facts, span: Times) -> bool:
    """Whether rate or force in a time span scatter more than at rest."""
    imu = facts.imu
    assert imu is not None
    inside = (imu.t_ns >= span[0]) & (imu.t_ns <= span[1])
    if inside.sum() < LEAST_ROWS:
        return False
    return bool(imu.gyro[inside].std(axis=0).max() > 0.05 or imu.accel[inside].std(axis=0).max() > 0.4)


def _velocities(facts: Facts) -> Iterator[Finding]:
    """Velocities that come with the fixes against the motion between them."""
    gnss, chords = facts.session.gnss, facts.chords
    if gnss is None or gnss.velocity is None:
        return
    known = np.isfinite(gnss.velocity[:, :2]).all(axis=1)
    flat = int((known & np.isnan(gnss.velocity[:, 2])).sum())
    if flat:  # phones filter speed and course: they lag behind the fixes
        text = f"{flat} velocities have no vertical part, as those of speed and course"
        yield Finding("gnss", text, "not used in the estimate", "info")
    if chords is None:
        return
    if known.sum() < LEAST_ROWS or chords.clear.sum() < LEAST_ROWS:
        return
    measured = over_chords(chords, gnss.t_ns[known], gnss.velocity[known, :2])[chords.clear]
    motion = chords.velocity[chords.clear]
    yield from odd_speed("gnss", "velocity", np.linalg.norm(measured[:, :2], axis=1), chords.speed[chords.clear])
    length = np.linalg.norm(measured[:, :2], axis=1) * np.linalg.norm(motion[:, :2], axis=1)
    along = float(np.median((measured[:, :2] * motion[:, :2]).sum(axis=1) / np.maximum(length, 1e-9)))
    turned = float(np.median((measured[:, [1, 0]] * motion[:, :2]).sum(axis=1) / np.maximum(length, 1e-9)))
    if along < -0.7:
        yield Finding("gnss", "velocity points against the motion of the fixes", "flip its sign")
    elif turned > 0.9 and along < 0.7:
        yield Finding("gnss", "velocity fits the fixes with east and north exchanged", "exchange ve and vn")


def _attitudes(facts: Facts) -> Iterator[Finding]:
    """Attitudes of pose fixes against the gyro between them and the accelerometer."""
    from scipy.spatial.transform import Rotation

    fixes, imu = facts.session.pose_fixes, facts.imu
    if fixes is None or fixes.quat is None or imu is None:
        return
    quat = fixes.quat[np.isfinite(fixes.quat).all(axis=1)]
    t_ns = fixes.t_ns[np.isfinite(fixes.quat).all(axis=1)]
    pairs = np.flatnonzero((np.diff(t_ns) > 0) & (np.diff(t_ns) < _ATTITUDE_PAIR_S * NS) & (t_ns[:-1] >= imu.t_ns[0]))
    pairs = pairs[t_ns[pairs + 1] <= imu.t_ns[-1]]
    if len(pairs) < _LEAST_PAIRS:
        return
    pairs = pairs[np.linspace(0, len(pairs) - 1, min(_ATTITUDE_PAIRS, len(pairs))).astype(int)]
    slow = decimated(imu)
    turned = [_turn(slow.t_ns, slow.gyro, t_ns[k], t_ns[k + 1]) for k in pairs]
    readings = {
        "unchanged": quat[:, [1, 2, 3, 0]],
        "with qw last": quat,
        "inverted": quat[:, [1, 2, 3, 0]] * [-1, -1, -1, 1],
    }
    off = {}
    for name, xyzw in readings.items():
        R = Rotation.from_quat(xyzw)
        differs = (R[pairs].inv() * R[pairs + 1]).inv() * Rotation.concatenate(turned)
        off[name] = float(np.degrees(np.quantile(differs.magnitude(), 0.75)))
    best = min(off, key=lambda name: off[name])
    if best != "unchanged" and off["unchanged"] > 20.0 and off[best] < 0.25 * off["unchanged"]:
        text = f"attitudes turn {off['unchanged']:.0f} deg away from gyro, {off[best]:.1f} deg if read {best}"
        yield Finding("pose_fixes", text, "give qw, qx, qy, qz of nav_R_body")
        return
    up = interpolate(t_ns, slow.t_ns, slow.accel)
    vertical = float(np.median(Rotation.from_quat(readings["unchanged"]).apply(up)[:, 2]))
    if vertical < -0.5 * facts.session.gravity:
        text = f"attitudes turn specific force to {vertical:.1f} m/s^2 along up: they look like north, east, down"
        yield Finding("pose_fixes", text, "give nav_R_body with nav = east, north, up", verdict="contradictory")


def _turn(t_ns: Times, gyro: Floats, begin: int, end: int) -> Rotation:
    """Rotation of the body from `begin` to `end` by its rates."""
    from scipy.spatial.transform import Rotation

    inside = t_ns[(t_ns > begin) & (t_ns < end)]
    edges = np.concatenate([[begin], inside, [end]])
    rate = interpolate(edges, t_ns, gyro)
    turn = Rotation.identity()
    for w in 0.5 * (rate[1:] + rate[:-1]) * (np.diff(edges) / NS)[:, None]:
        turn = turn * Rotation.from_rotvec(w)
    return turn


RULES = (_jumps, _scatter, _exchanged, _heights, _frozen, _stale, _velocities, _attitudes, _sigmas_and_heights)
