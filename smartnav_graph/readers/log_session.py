"""The session of a log: streams with their counts, origin at the first fix, forward and up where the data show them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Table
from smartnav_graph.core.errors import SessionError, warn
from smartnav_graph.core.frames import Origin
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.axes import find_body_axes
from smartnav_graph.readers.fixes import LoggedFixes, first_fix, fix_table
from smartnav_graph.readers.samples import Samples, inertial_table, magnetic_table
from smartnav_graph.readers.source import build_session
from smartnav_graph.session.session import Device, Mount, Session

_log = logging.getLogger(__name__)
SLOWEST_S = 0.3  # between inertial samples: slower, steps and turns are not seen at all


@dataclass
class LogParts:
    """Streams of a log while it is read: file and columns by name, and what was left out of each; refused : why there
    are no inertial data."""

    tables: dict[str, tuple[Path, Table]] = field(default_factory=dict)
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    refused: SessionError | None = None
    mounts: dict[str, Mount] = field(default_factory=dict)

    def add(self, stream: str, file: Path, table: Table, counts: Mapping[str, int] | None = None) -> None:
        """One more stream; counts of rows left out, by reason."""
        self.tables[stream] = (file, table)
        self.count(stream, counts or {})

    def count(self, stream: str, counts: Mapping[str, int]) -> None:
        """Counts of a stream, or of data that belong to none."""
        known = self.counts.setdefault(stream, {})
        for reason, count in counts.items():
            if count:
                known[reason] = known.get(reason, 0) + count

    def add_imu(self, gyro: Samples, accel: Samples) -> None:
        """The stream ``imu`` of angular rate rad/s and specific force m/s^2; none where rows are too far apart."""
        table, counts = inertial_table(gyro, accel)
        step = float(np.median(np.diff(table["t_ns"]))) / NS if len(table["t_ns"]) > 1 else np.inf
        if step > SLOWEST_S:
            reason = f"inertial, {step:.3g} s apart, left out: the motion between them is not known"
            self.count("imu", {reason: len(table["t_ns"])})
        else:
            self.add("imu", gyro.file, table, counts)

    def add_inertial(
        self, file: Path, gyro: Samples | None, accel: Samples | None, seen: Iterable[str], *, wanted: bool = False
    ) -> None:
        """As `add_imu`, of what there is: without one of them inertial data are left out where there are fixes, and
        `log_session` raises an error where there are none. `seen` : what the log has; wanted : both have to be there.
        """
        if gyro is not None and accel is not None:
            self.add_imu(gyro, accel)
        elif gyro is not None:
            self.count("imu", {"of the gyroscope left out: there is no accelerometer with gravity": len(gyro)})
            self.refused = no_accelerometer(file, seen)
        elif accel is not None or wanted:
            count = 0 if accel is None else len(accel)
            self.count("imu", {"of the accelerometer left out: there is no gyroscope": count})
            self.refused = no_gyro(file, seen)

    def add_magnetometer(self, field_ut: Samples) -> None:
        """The stream ``magnetometer`` of flux density uT."""
        self.add("magnetometer", field_ut.file, magnetic_table(field_ut), field_ut.counts)

    def add_single(self, stream: str, column: str, samples: Samples) -> None:
        """A stream of one quantity, such as ``barometer`` with pressure_hpa."""
        self.add(stream, samples.file, {"t_ns": samples.t_ns, column: samples.values[:, 0]}, samples.counts)

    def add_fixes(
        self, file: Path, fixes: LoggedFixes, skipped: Mapping[str, int] | None = None, *, may_repeat: bool = False
    ) -> None:
        """The stream ``gnss``; none where no row has a position. `skipped` : lines of the file that were left out;
        `may_repeat` : see `fix_table`."""
        table, counts = fix_table(fixes, may_repeat=may_repeat)
        counts |= skipped or {}
        if len(table["t_ns"]):
            self.add("gnss", file, table, counts)
            self.mounts = fixes.mounts(table)
        else:
            self.count("gnss", counts)


def log_session(
    parts: LogParts,
    repairs: tuple[str, ...],
    *,
    name: str,
    epoch: str,
    forward: str = "",
    up: str = "",
    vehicle: str = "none",
) -> Session:
    """The session of a log.

    Parameters
    ----------
    name, epoch : of the device and its clock
    forward, up : where the format defines them; else found in the data, and reported

    Raises
    ------
    SessionError
        No stream, or a faulty one; a part of the inertial data without fixes.
    """
    if parts.refused is not None and "gnss" not in parts.tables:
        raise parts.refused
    if parts.refused is not None:
        warn(f"{parts.refused}; fixes only are read")
    if not parts.tables:
        left_out = "; ".join(f"{n} rows {why}" for counts in parts.counts.values() for why, n in counts.items())
        what = f"holds no stream ({left_out})" if left_out else "holds no stream"
        raise SessionError(name, what, "inertial samples or fixes", "switch these sensors on")
    imu, fixes = (parts.tables[stream][1] if stream in parts.tables else None for stream in ("imu", "gnss"))
    if not up and imu is not None:
        found = find_body_axes(imu, fixes if fixes is not None and "lat_deg" in fixes else None)
        forward, up = forward or found.forward, found.up
        source = "by the course of the fixes" if found.forward_found else "by default; the fixes do not show it"
        _log.info("%s: up %s by gravity, forward %s %s", name, up, forward, source)
    origin: Origin | None = first_fix(fixes) if fixes is not None and "lat_deg" in fixes else None
    device = Device(name=name, forward=forward or "+y", up=up or "+z", vehicle=vehicle)
    session = build_session(
        parts.tables, repairs, device=device, clock_epoch=epoch, origin=origin, sensors=parts.mounts
    )
    names = [*parts.counts, *(stream for stream in session.dropped if stream not in parts.counts)]
    dropped = {stream: {**parts.counts.get(stream, {}), **session.dropped.get(stream, {})} for stream in names}
    return session.replace(dropped={stream: counts for stream, counts in dropped.items() if counts})


def no_gyro(file: Path, seen: Iterable[str]) -> SessionError:
    """The error of a log without angular rate."""
    found = f"holds no gyroscope (it has {', '.join(seen) or 'nothing that is known'})"
    return SessionError(file, found, "gyroscope and accelerometer", "switch the gyroscope on in the app", stream="imu")


def no_accelerometer(file: Path, seen: Iterable[str]) -> SessionError:
    """The error of a log without specific force."""
    found = f"holds no accelerometer with gravity (it has {', '.join(seen) or 'nothing that is known'})"
    remedy = "switch on the accelerometer with gravity, or gravity beside the linear acceleration"
    return SessionError(file, found, "gyroscope and accelerometer", remedy, stream="imu")
