"""Withheld rows: not given to the smoother, but scored afterwards."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Positioned

EXPECTED = "SENSOR:every=N or SENSOR:outage=FROM-TO (seconds), for example gnss:every=10 or gnss:outage=100-130"


@dataclass(frozen=True)
class Withhold:
    """One specification: keep every n-th row, or drop the rows with start_s <= t < end_s."""

    sensor: str
    every: int | None = None
    outage: tuple[float, float] | None = None

    @classmethod
    def parse(cls, text: str) -> Withhold:
        """Of ``gnss:every=10`` or ``gnss:outage=100-130``.

        Raises
        ------
        ConfigError
            Anything else.
        """
        sensor, _, rule = text.partition(":")
        name, _, value = rule.partition("=")
        try:
            if name == "every" and int(value) >= 1:
                return cls(sensor, every=int(value))
            if name == "outage":
                start, end = (float(part) for part in value.split("-"))
                if start < end:
                    return cls(sensor, outage=(start, end))
        except ValueError:
            pass
        raise ConfigError("--withhold", f"{text!r}", EXPECTED)

    def kept(self, t_s: Floats) -> Mask:
        """Mask (n,) of the rows that stay, by their seconds since time zero."""
        if self.every is not None:
            return np.asarray(np.arange(len(t_s)) % self.every == 0)
        assert self.outage is not None
        return np.asarray((t_s < self.outage[0]) | (t_s >= self.outage[1]))


def split(session: Session, specs: Iterable[str]) -> tuple[Session, dict[str, Positioned]]:
    """The session without the withheld rows, and those rows by sensor.

    Raises
    ------
    ConfigError
        A specification that cannot be read, or names a stream of positions that the session does not have.
    """
    kept: dict[str, Mask] = {}
    for spec in (Withhold.parse(text) for text in specs):
        stream = session.streams().get(spec.sensor)
        if not isinstance(stream, Positioned):
            found = list(session.positions())
            raise ConfigError(
                "--withhold", f"no stream of positions {spec.sensor!r}", f"one of {', '.join(found) or 'none here'}"
            )
        mask = spec.kept(session.seconds(stream.t_ns))
        kept[spec.sensor] = kept.get(spec.sensor, np.ones(len(stream), dtype=bool)) & mask
    held = {name: getattr(session, name).take(~mask) for name, mask in kept.items()}
    changes = {name: getattr(session, name).take(mask) for name, mask in kept.items()}
    return session.replace(**changes), {name: stream for name, stream in held.items() if len(stream)}
