"""Findings of `detect.axes` in words, and the up axis of the device against gravity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from smartnav_graph.core import frames
from smartnav_graph.core.arrays import Floats
from smartnav_graph.session.detect.axes import Axes, AxesFault
from smartnav_graph.session.health.facts import Facts, Finding
from smartnav_graph.session.session import Session

_TILTED_DEG, _OPPOSITE_DEG = 45.0, 135.0  # a device in use, even on a foot, tilts less on the median
_SENSORS = {
    "gyro": ("imu", "gyro turns against the course of the fixes and the tilt: it fits with"),
    "accel": ("imu", "accel contradicts the accelerations of the fixes and the turns of gyro: it fits with"),
    "fixes": ("gnss", "fixes turn and accelerate against the inertial data: they fit"),
}

_REMEDIES = {
    "gyro": "flip the sign of gyro, or correct its axes,",
    "accel": "correct the axes of accel",
    "fixes": "exchange east and north (latitude and longitude) of the fixes",
}


def up_angle_deg(accel: Floats, up: Floats) -> float:
    """Angle between the median specific force of (n, 3) and the up axis (3,), deg."""
    force = np.median(accel, axis=0)
    cosine = float(force @ up) / max(float(np.linalg.norm(force)), 1e-9)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def up_axis(facts: Facts) -> Iterator[Finding]:
    """Specific force at right angles to the up axis, or against it."""
    if facts.imu is None:
        return
    accel, up = facts.imu.accel, facts.session.device.up
    angle, force = up_angle_deg(accel, frames.axis_vector(up)), np.median(accel, axis=0)
    if angle < _TILTED_DEG:
        return
    k = int(np.abs(force).argmax())
    axis = f"{'+' if force[k] > 0 else '-'}{'xyz'[k]}"
    found = f"specific force points {angle:.0f} deg away from the up axis {up}, mostly along {axis}"
    if angle > _OPPOSITE_DEG:
        remedy = f'flip the sign of accel, or set [device] up = "{axis}" in session.toml'
    else:
        remedy = f'set [device] up = "{axis}" (and forward) in session.toml'
    yield Finding("imu", found, remedy, verdict="contradictory", size=round(angle, 1))


def axes_finding(session: Session, fault: AxesFault) -> Finding:
    """The fault in words, without the hypotheses that gravity along the up axis contradicts."""
    up, accel = frames.axis_vector(session.device.up), session.require_imu().accel

    def against(axes: Axes) -> bool:
        return up_angle_deg(accel @ axes.accel, up) > 90.0

    likely = [axes for axes in fault.axes if not against(axes)] or list(fault.axes)
    where, text = _SENSORS[likely[0].sensor]
    named = " or ".join(
        axes.text if axes.sensor == likely[0].sensor else f"{axes.sensor} {axes.text}" for axes in likely
    )
    remedy = f"{_REMEDIES[likely[0].sensor]} where the log is imported"
    text = f"{text} {named} (log likelihood +{fault.gain:.0f})"
    return Finding(where, text, remedy, verdict="contradictory", size=round(fault.gain, 1))


RULES = (up_axis,)
