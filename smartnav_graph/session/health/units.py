"""Readings in another unit: converted by the repair ``units``, else not used."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from smartnav_graph.core.errors import SessionError
from smartnav_graph.session.health import Finding, inspect
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import Imu


def in_right_units(session: Session) -> Session:
    """The session with every reading converted whose unit its health finds to be another one; `dropped` counts them."""
    converted: set[tuple[str, str]] = set()
    for finding in inspect(session).findings:
        if finding.convert is None or (finding.where, finding.convert[0]) in converted:
            continue
        field, factor = finding.convert
        converted.add((finding.where, field))
        stream = session.streams()[finding.where]
        counts = {**session.dropped.get(finding.where, {}), f"with {field} multiplied by {factor:.6g}": len(stream)}
        changed = replace(stream, **{field: factor * getattr(stream, field)})
        session = session.replace(**{finding.where: changed}, dropped={**session.dropped, finding.where: counts})
    return session


def without_wrong_units(session: Session, findings: Iterable[Finding]) -> tuple[Session, list[str]]:
    """The session without the readings that are in another unit, and their names; the rest of a stream stays where it
    can do without them.

    Raises
    ------
    SessionError
        Inertial readings in another unit.
    """
    wrong = set()
    for finding in findings:
        if finding.convert is not None:
            if finding.where == Imu.NAME:
                raise SessionError(finding.where, finding.text, remedy=finding.remedy, stream=finding.where)
            wrong.add((finding.where, finding.convert[0]))
    changes: dict[str, Stream | None] = {}
    for where, field in sorted(wrong):
        stream = session.streams()[where]
        spec = next(spec for spec in stream.specs() if spec.name == field)
        kept = {name: column for name, column in stream.columns().items() if name not in spec.metadata["columns"]}
        changes[where] = type(stream).from_columns(kept) if spec.default is None else None
    return session.replace(**changes), [f"{field} of {where}" for where, field in sorted(wrong)]
