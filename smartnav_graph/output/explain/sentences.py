"""What determines a state, in sentences and tables for a surveyor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.factors import title_of
from smartnav_graph.output.explain.figures import (
    DEPENDS,
    HEADING,
    HORIZONTAL,
    NO_ROWS,
    POSITION,
    QUANTITIES,
    TILT,
    UP,
    VELOCITY,
    Explanation,
    Quantity,
    shifts,
)
from smartnav_graph.output.explain.nearby import Nearby, Span
from smartnav_graph.output.summary_json import GAP_KINDS
from smartnav_graph.output.text import Row, Table, listed

# A smaller share of a variance is left out of the sentences.
SMALL_SHARE = 0.1
# A smaller share of the measurements at the epoch itself is left out.
SMALL_SHARE_AT_EPOCH = 0.02
# A smaller shift, in sigmas, is left out.
SMALL_SHIFT = 0.05
SHORT = {"accelerometer bias": "acc bias", "gyroscope bias": "gyro bias"}
DIRECTIONS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
WINDOWS = {"gap": ", at the end of an IMU data gap", "static": ", at a standstill", "first": ", the first"}


def sentences(found: Explanation, near: Nearby) -> list[str]:
    """What a surveyor asks first, in order."""
    variances = [
        _variance("Horizontal position", found, HORIZONTAL),
        _variance("Height", found, UP),
        _variance("Heading", found, HEADING),
    ]
    determined = [*variances, _half_within(found), *_without_source(found), _at_epoch(found)]
    return [_epoch(found), _accuracy(found), *determined, *_in_use(near), *_shifted(found), *_surroundings(near)]


def variance_table(found: Explanation) -> str:
    """Variance of each quantity by source, and the shifts at the keyframe by source."""
    names = [SHORT.get(quantity.name, quantity.name) for quantity in QUANTITIES]
    shares = np.array([found.share(quantity) for quantity in QUANTITIES]).T
    rows = [
        (source, *(f"{share:.1%}" for share in row)) for source, row in zip(found.keyframe.sources, shares, strict=True)
    ]
    rows.append(("sigma", *(f"{found.sigma(quantity):.3g}" for quantity in QUANTITIES)))
    rows.append(("", *(quantity.unit for quantity in QUANTITIES)))
    rows.append(("from this epoch", *(f"{found.measured_at_epoch(quantity):.1%}" for quantity in QUANTITIES)))
    table = Table(("variance by source", *names), list(map(Row, rows)))
    return "\n".join(["", table.text(), *(_shift_tables(found) if found.balanced else [])])


def _shift_tables(found: Explanation) -> Iterator[str]:
    """Shifts in sigmas: of all factors of a source, and of those that touch the keyframe."""
    sides, h = ("east", "north", "up", "clockwise"), found.keyframe
    rows = zip(h.sources, h.shift, h.touching, h.shift_at_keyframe, strict=True)
    by_all, by_these = [], []
    for source, shift, count, near in rows:
        cells, close = ([f"{round(x, 2) + 0.0:+.2f}" for x in shifts(part).values()] for part in (shift, near))
        by_all.append(Row((source, *cells)))
        by_these.append(Row((source, *(close if count else [""] * len(close)), str(count))))
    yield "\n" + Table(("shift in sigmas", *sides), by_all).text()
    yield "\n" + Table(("at this keyframe", *sides, "factors"), by_these).text()


def _epoch(found: Explanation) -> str:
    frames, place = found.influence.keyframes, found.keyframe.place
    t_s, kind = found.seconds(found.t_ns), str(frames.kind[place])
    where = f"keyframe {place + 1} of {len(frames)}{WINDOWS.get(kind, '')}"
    if found.asked_ns is None:
        return f"Largest position uncertainty of the run: at {t_s:.2f} s ({where})."
    asked = found.seconds(found.asked_ns)
    if abs(asked - t_s) < 0.005:
        return f"At {t_s:.2f} s ({where})."
    return f"At {t_s:.2f} s ({where}), the keyframe nearest to {asked:.2f} s; inertial data connect the two."


def _accuracy(found: Explanation) -> str:
    largest, azimuth = _major_axis(found)
    return (
        f"1 sigma: position {_metres(found.sigma(HORIZONTAL))} horizontal (major semi-axis {_metres(largest)}, azimuth "
        f"{azimuth:.0f} deg) and {_metres(found.sigma(UP))} vertical, heading {_degrees(found.sigma(HEADING))}, "
        f"tilt {_degrees(found.sigma(TILT))}, velocity {found.sigma(VELOCITY):.2g} m/s."
    )


def _major_axis(found: Explanation) -> tuple[float, float]:
    """Major semi-axis of the 1 sigma ellipse, m, and its azimuth, degrees clockwise from north in [0, 180)."""
    variances, axes = np.linalg.eigh(found.keyframe.covariance[3:5, 3:5])
    east, north = axes[:, -1]
    return float(np.sqrt(variances[-1])), float(np.degrees(np.arctan2(east, north)) % 180.0)


def _variance(name: str, found: Explanation, quantity: Quantity) -> str:
    share = found.share(quantity)
    order = [i for i in np.argsort(-share) if share[i] >= SMALL_SHARE] or [int(np.argmax(share))]
    parts = [f"{title_of(found.keyframe.sources[i])} {100 * share[i]:.0f} %" for i in order]
    return f"{name} variance by source: {', '.join(parts)}."


def _half_within(found: Explanation) -> str:
    position, heading = found.half_within_s(POSITION), found.half_within_s(HEADING)
    return (
        f"Half of this variance comes from within {position:.2f} s for the position, {heading:.2f} s for the heading."
    )


def _without_source(found: Explanation) -> Iterator[str]:
    """What is not observable without a source, or much less certain; the IMU is always required."""
    for i, source in enumerate(found.keyframe.sources):
        factors = [(quantity.name, found.without(quantity)[i]) for quantity in (POSITION, HEADING, TILT, VELOCITY)]
        lost = [name for name, factor in factors if np.isinf(factor)]
        weak = [f"{name} sigma {factor:.0f} times larger" for name, factor in factors if DEPENDS < factor < np.inf]
        if source != "imu" and (lost or weak):
            parts = [f"{listed(lost)} not observable"] if lost else []
            yield f"Without the source {title_of(source)}: {', '.join([*parts, *weak])}."


def _at_epoch(found: Explanation) -> str:
    shares = [(quantity.name, found.measured_at_epoch(quantity)) for quantity in QUANTITIES]
    measured = [f"{name} {100 * share:.0f} %" for name, share in shares if share >= SMALL_SHARE_AT_EPOCH]
    others = [name for name, share in shares if share < SMALL_SHARE_AT_EPOCH]
    if not measured:
        return "No significant measurement at this epoch: the neighbouring keyframes determine the state."
    text = f"Share of the variance from measurements at this epoch: {', '.join(measured)}"
    return f"{text}; only neighbouring keyframes determine {listed(others)}." if others else f"{text}."


def _in_use(near: Nearby) -> Iterator[str]:
    parts = [f"{title_of(name)} {_before_after(one.before_s, one.after_s)}" for name, one in near.used.items()]
    if parts:
        yield f"Nearest measurements in use: {'; '.join(parts)}."
    for name, (start, end) in near.outages.items():
        yield f"This epoch is inside an outage: no {title_of(name)} in use {_between(start, end)}."


def _between(start: float | None, end: float | None) -> str:
    if start is not None and end is not None:
        return f"between {start:.1f} and {end:.1f} s"
    return f"before {end:.1f} s" if start is None else f"after {start:.1f} s"


def _before_after(before: float | None, after: float | None) -> str:
    sides = [(before, "before"), (after, "after")]
    return ", ".join(f"{away:.2f} s {side}" if away else "at this epoch" for away, side in sides if away is not None)


def _shifted(found: Explanation) -> Iterator[str]:
    """The source, and the single measurement, with the largest shift."""
    if not found.balanced:
        yield "This replay has no final batch solution of all states together: shifts are not available."
        return
    h, m = found.keyframe, found.keyframe.measurements
    sources = [i for i, source in enumerate(h.sources) if source not in NO_ROWS and _significant(h.shift[i])]
    if sources:
        most = max(sources, key=lambda i: float(np.abs(h.shift[i, 2:6]).max()))
        yield (
            f"Source with the largest effect: {title_of(h.sources[most])}; it {_shift(found, h.shift[most])}; the "
            "other sources balance this."
        )
    single = [i for i in found.strongest() if _significant(m.shift[i])]
    if not single:
        yield f"No single measurement shifts the estimate by {SMALL_SHIFT} sigma."
        return
    source, when = title_of(str(m.source[single[0]])), found.seconds(int(m.t_ns[single[0]]))
    yield (
        f"Single measurement with the largest effect: {source} at {when:.2f} s; it {_shift(found, m.shift[single[0]])}."
    )


def _significant(shift: Floats) -> bool:
    """Whether a shift (15,) moves the position or the heading."""
    return bool(np.abs(shift[2:6]).max() >= SMALL_SHIFT)


def _shift(found: Explanation, shift: Floats) -> str:
    horizontal, clockwise = float(np.hypot(*shift[3:5])), -float(shift[2])
    metres = _metres(float(np.hypot(*(shift * found.keyframe.sigma)[3:5])))
    side = "clockwise" if clockwise > 0 else "anticlockwise"
    return (
        f"shifts the estimate {horizontal:.2f} sigma {_direction(*shift[3:5])} ({metres}) and the heading "
        f"{abs(clockwise):.2f} sigma {side}"
    )


def _surroundings(near: Nearby) -> Iterator[str]:
    if near.gap is None:
        yield "No IMU data gaps."
    else:
        yield _span("IMU data gap", near.gap, GAP_KINDS.get(near.gap.kind, near.gap.kind))
    if near.rejection is None:
        yield "No measurement was rejected."
    else:
        one = near.rejection
        sizes = [f"{size:.{digits}f} {unit}" for size, digits, unit in
                 ((one.size_sigma, 0, "sigma"), (one.size_m, 1, "m")) if size is not None]  # fmt: skip
        size = f" ({', '.join(sizes)})" if sizes else ""
        yield f"Nearest rejected measurement: {title_of(one.sensor)} at {one.t_s:.2f} s, {_away(one.away_s)}{size}."
    if near.standstill is not None:
        yield _span("standstill", near.standstill, "")


def _span(name: str, one: Span, how: str) -> str:
    text = f"{one.length_s:.2f} s from {one.start_s:.2f} s{f', {how}' if how else ''}"
    if one.away_s == 0.0:
        return f"This epoch is inside the {name} of {text}."
    return f"Nearest {name}: {text} ({_away(one.away_s)})."


def _away(seconds: float) -> str:
    return f"{abs(seconds):.2f} s {'later' if seconds > 0 else 'earlier'}"


def _direction(east: float, north: float) -> str:
    return DIRECTIONS[round(np.arctan2(north, east) / (np.pi / 4)) % 8]


def _metres(value: float) -> str:
    return f"{value:.3f} m" if value < 10 else f"{value:.1f} m"


def _degrees(value: float) -> str:
    return f"{value:.2g} deg" if value < 1 else f"{value:.1f} deg"
