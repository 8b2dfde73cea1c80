"""What a session holds, on one screen: when, where, which streams, what is missing, what looks wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.files import file_inside
from smartnav_graph.core.timebase import NS, utc_from_gps
from smartnav_graph.output.text import Row, Table, duration
from smartnav_graph.session.detect.clock import spaced_rows
from smartnav_graph.session.health import Health
from smartnav_graph.session.session import Session

_LISTED = 5  # of the longest gaps, and of the pictures that are missing


@dataclass(frozen=True)
class SessionInfo:
    """A session and its health, as text and as figures."""

    session: Session
    health: Health

    def to_text(self) -> str:
        """Plain lines for a terminal, findings last."""
        device, health = self.session.device, self.health
        lines = [
            f"device: {device.name}, forward {device.forward}, up {device.up}, vehicle {device.vehicle}",
            f"time: {self._when()}",
            f"clock: {health.clock_epoch}, time zero {health.t0_ns} ns",
            f"place: {self._where()}",
        ]
        rows = []
        for one in health.streams:
            rate = f"{one.rate_hz:.2f}" if one.rows > 1 else "-"
            rows.append(Row((one.name, str(one.rows), f"{one.start_s:.3f}", f"{one.length_s:.3f}", rate)))
        lines.append(Table(("stream", "rows", "start s", "length s", "rate Hz"), rows).text())
        listed, there = self._pictures()
        if listed:
            lines.append(f"pictures: {there} of {listed}")
        lines += self._gaps()
        quiet = health.quiet_accel_m_s2
        at_rest = "no quiet stretch" if quiet is None else f"{quiet:.4f} m/s^2 at rest"
        lines.append(f"gravity: {health.gravity_m_s2:.5f} m/s^2 expected, accelerometer {at_rest}")
        for name, counts in self.session.dropped.items():
            lines += [f"repaired: {name}: {count} {reason}" for reason, count in counts.items()]
        lines.append(f"missing: {', '.join(health.missing) or 'nothing'}")
        return "\n".join([*lines, *(f"{finding.level}: {finding}" for finding in health.findings)])

    def to_dict(self) -> dict[str, object]:
        """The same for JSON; times are seconds from time zero, dates ISO 8601 in UTC."""
        session, health = self.session, self.health
        start, end = self._span()
        listed, there = self._pictures()
        return {
            "device": {"name": session.device.name, "forward": session.device.forward, "up": session.device.up}
            | {"vehicle": session.device.vehicle, "mounting": session.device.mounting},
            "clock": {"epoch": health.clock_epoch, "t0_ns": health.t0_ns},
            "start": self._date(start),
            "end": self._date(end),
            "duration_s": (end - start) / NS,
            "origin": None if session.origin is None else vars(session.origin),
            "place": self._place(),
            "streams": [vars(stream) for stream in health.streams],
            "pictures": {"listed": listed, "there": there},
            "gaps": [
                {"start_s": float(session.seconds(gap.start_ns)), "length_s": gap.length_s, "kind": gap.kind}
                for gap in health.gaps
            ],
            "gravity_m_s2": health.gravity_m_s2,
            "quiet_accel_m_s2": health.quiet_accel_m_s2,
            "dropped": {name: dict(counts) for name, counts in session.dropped.items()},
            "missing": list(health.missing),
            "findings": [
                {"level": f.level, "where": f.where, "text": f.text, "remedy": f.remedy, "size": f.size}
                for f in health.findings
            ],
        }

    def _span(self) -> tuple[int, int]:
        """First and last stamp of the inertial data, else of all streams."""
        imu = self.session.imu
        if imu is not None and len(imu):
            return int(imu.t_ns[0]), int(imu.t_ns[-1])
        stamps = [stream.t_ns for stream in self.session.streams().values() if len(stream)]
        return min((int(t[0]) for t in stamps), default=0), max((int(t[-1]) for t in stamps), default=0)

    def _date(self, t_ns: int) -> str | None:
        """A stamp as a date; None where the clock has none."""
        if self.session.clock_epoch not in ("unix", "gps"):
            return None
        unix = int(utc_from_gps(np.array([t_ns]))[0]) if self.session.clock_epoch == "gps" else t_ns
        return f"{np.datetime64(unix, 'ns').astype('datetime64[ms]')}Z"

    def _when(self) -> str:
        start, end = self._span()
        length = duration((end - start) / NS)
        dates = self._date(start), self._date(end)
        return f"{length}, without dates" if None in dates else f"{dates[0]} to {dates[1]}, {length}"

    def _place(self) -> Mapping[str, float] | None:
        """Middle, extent and length of the fixes, or of the control points where there are none."""
        positions = {name: s for name, s in self.session.positions().items() if len(s)}
        if not positions:
            return None
        stream = next(iter(positions.values()))
        nav = self.session.nav_position(stream)[:, :2]
        rows = spaced_rows(stream.t_ns, nav)
        found = {
            "east_m": float(np.ptp(nav[:, 0])),
            "north_m": float(np.ptp(nav[:, 1])),
            "path_m": float(np.linalg.norm(np.diff(nav[rows], axis=0), axis=1).sum()),
        }
        if stream.lla is not None:
            found |= {"lat_deg": float(np.median(stream.lla[:, 0])), "lon_deg": float(np.median(stream.lla[:, 1]))}
        return found

    def _where(self) -> str:
        place = self._place()
        if place is None:
            return "not known: no positions"
        middle = f"{place['lat_deg']:.5f}, {place['lon_deg']:.5f} deg" if "lat_deg" in place else "local metres"
        return f"{middle}, {place['east_m']:.0f} m x {place['north_m']:.0f} m, {place['path_m']:.0f} m from fix to fix"

    def _pictures(self) -> tuple[int, int]:
        """Pictures that the images name, and those that are there."""
        images, folder = self.session.images, self.session.pictures
        files = [] if images is None else [file for file in map(str, images.file) if file]
        return len(files), sum(file_inside(folder, file) is not None for file in files) if folder is not None else 0

    def _gaps(self) -> list[str]:
        gaps = sorted(self.health.gaps, key=lambda gap: -gap.length_s)
        total = f", {sum(gap.length_s for gap in gaps):.2f} s in all" if gaps else ""
        shown = [
            f"  {gap.kind} {gap.length_s:.3f} s at {float(self.session.seconds(gap.start_ns)):.3f} s"
            for gap in sorted(gaps[:_LISTED], key=lambda gap: gap.start_ns)
        ]
        more = [f"  and {len(gaps) - _LISTED} shorter ones"] if len(gaps) > _LISTED else []
        return [f"gaps: {len(gaps)}{total}", *shown, *more]
