"""What determined a state, in sentences and tables that a surveyor understands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.evaluation.influence import CALIBRATION
from smartnav_graph.factors import label_of
from smartnav_graph.output.explain.figures import (
    DIRECTION,
    HEIGHT,
    LEVEL_PLACE,
    NO_ROWS,
    PLACE,
    QUANTITIES,
    RESTS,
    TILT,
    VELOCITY,
    Explanation,
    Quantity,
    pulls,
)
from smartnav_graph.output.explain.nearby import Nearby, Stretch

CALIBRATED = "the calibration (of clocks, lever arms, mounts)"
# A share below this is not told in a sentence.
SPOKEN = 0.1
# What stands at the instant itself is told from this share on.
HERE = 0.02
# A pull below this many sigmas is none.
FELT = 0.05
SHORT = {"accelerometer bias": "acc bias", "gyroscope bias": "gyro bias"}
WINDS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")


def words(source: str) -> str:
    """A source as people call it."""
    return CALIBRATED if source == CALIBRATION else label_of(source).as_source


def sentences(found: Explanation, near: Nearby) -> list[str]:
    """What a surveyor asks first, in order."""
    told = [_instant(found), _known(found)]
    told += [_made_of(found, quantity) for quantity in (LEVEL_PLACE, HEIGHT, DIRECTION)]
    told += [_reach(found), *_rests(found), _here(found), *_measured(found, near), *_pulled(found)]
    return [*told, *_around(near)]


def table(found: Explanation) -> str:
    """Whose uncertainty each quantity has, and what pulls at the keyframe, source by source."""
    names = [SHORT.get(quantity.name, quantity.name) for quantity in QUANTITIES]
    lines = ["", f"{'uncertainty from':<18}{''.join(f'{name:>10}' for name in names)}"]
    shares = np.array([found.share(quantity) for quantity in QUANTITIES]).T
    for source, row in zip(found.held.sources, shares, strict=True):
        lines.append(f"{source:<18}{''.join(f'{share:>10.1%}' for share in row)}")
    lines.append(f"{'sigma':<18}{''.join(f'{found.sigma(quantity):>10.3g}' for quantity in QUANTITIES)}")
    lines.append(f"{'':<18}{''.join(f'{quantity.unit:>10}' for quantity in QUANTITIES)}")
    lines.append(f"{'measured here':<18}{''.join(f'{found.here(quantity):>10.1%}' for quantity in QUANTITIES)}")
    return "\n".join([*lines, *(_pull_lines(found) if found.balanced else [])])


def _pull_lines(found: Explanation) -> list[str]:
    """Pulls in sigmas: of all factors of a source, and of those that touch the keyframe."""
    sides = "".join(f"{name:>10}" for name in ("east", "north", "up", "clockwise"))
    lines = ["", f"{'pull in sigmas':<18}{sides}   {'touching it':>11}{sides}"]
    held = found.held
    for source, pull, count, here in zip(held.sources, held.pull, held.touching, held.pull_here, strict=True):
        by_all, by_these = (
            "".join(f"{round(x, 2) + 0.0:>+10.2f}" for x in pulls(part).values()) for part in (pull, here)
        )
        lines.append(f"{source:<18}{by_all}   {count:>11}{by_these if count else ''}".rstrip())
    return lines


def _instant(found: Explanation) -> str:
    frames, place = found.influence.keyframes, found.held.place
    t_s, kind = found.seconds(found.t_ns), str(frames.kind[place])
    what = {"gap": ", at the end of a gap in the inertial data", "static": ", at a standstill", "first": ", the first"}
    where = f"keyframe {place + 1} of {len(frames)}{what.get(kind, '')}"
    if found.asked_ns is None:
        return f"The least certain instant of the run is {t_s:.2f} s ({where})."
    asked = found.seconds(found.asked_ns)
    if abs(asked - t_s) < 0.005:
        return f"At {t_s:.2f} s ({where})."
    return (
        f"{asked:.2f} s is told by the nearest keyframe, at {t_s:.2f} s ({where}); in between inertial data carry on."
    )


def _known(found: Explanation) -> str:
    largest, heading = _largest(found)
    return (
        f"The position is known to {_metres(found.sigma(LEVEL_PLACE))} (1 sigma, horizontal; the larger part, "
        f"{_metres(largest)}, along {heading:.0f} deg from north) and {_metres(found.sigma(HEIGHT))} in height, "
        f"the heading to {_degrees(found.sigma(DIRECTION))}, the tilt to {_degrees(found.sigma(TILT))}, "
        f"the velocity to {found.sigma(VELOCITY):.2g} m/s."
    )


def _largest(found: Explanation) -> tuple[float, float]:
    """Longer half axis of the ellipse of one sigma, m, and its direction, degrees clockwise from north in [0, 180)."""
    variances, axes = np.linalg.eigh(found.held.covariance[3:5, 3:5])
    east, north = axes[:, -1]
    return float(np.sqrt(variances[-1])), float(np.degrees(np.arctan2(east, north)) % 180.0)


def _made_of(found: Explanation, quantity: Quantity) -> str:
    share = found.share(quantity)
    order = [i for i in np.argsort(-share) if share[i] >= SPOKEN] or [int(np.argmax(share))]
    parts = [f"{words(found.held.sources[i])} ({share[i]:.0%})" for i in order]
    name = {"up": "height"}.get(quantity.name, quantity.name)
    return f"What is uncertain about the {name} comes from {_listed(parts)}."


def _reach(found: Explanation) -> str:
    place, heading = found.reach_s(PLACE), found.reach_s(DIRECTION)
    return f"Half of that comes from within {place:.2f} s for the position and {heading:.2f} s for the heading."


def _rests(found: Explanation) -> Iterator[str]:
    """What would be lost without each source; that nothing goes without inertial data is no news."""
    for i, source in enumerate(found.held.sources):
        factors = [(quantity.name, found.without(quantity)[i]) for quantity in (PLACE, DIRECTION, TILT, VELOCITY)]
        lost = [f"the {name}" for name, factor in factors if np.isinf(factor)]
        weak = [f"the {name} {factor:.0f} times less certain" for name, factor in factors if RESTS < factor < np.inf]
        if source != "imu" and (lost or weak):
            told = [f"{_listed(lost)} would be lost"] if lost else []
            yield f"Without {words(source)} {', '.join([*told, *weak])}."


def _here(found: Explanation) -> str:
    here = [(quantity.name, found.here(quantity)) for quantity in QUANTITIES]
    measured = [f"{name} {share:.0%}" for name, share in here if share >= HERE]
    carried = [name for name, share in here if share < HERE]
    if not measured:
        return "Nothing of weight is measured at this very instant: the neighbours carry everything here."
    told = f"Measured at this very instant: {_listed(measured)}"
    return f"{told}; carried here by the neighbours alone: {_listed(carried)}." if carried else f"{told}."


def _measured(found: Explanation, near: Nearby) -> Iterator[str]:
    told = [f"{words(name)} {_sides(one.before_s, one.after_s)}" for name, one in near.used.items()]
    if told:
        yield f"In use around it: {'; '.join(told)}."


def _sides(before: float | None, after: float | None) -> str:
    sides = [(before, "before"), (after, "after")]
    return ", ".join(f"{away:.2f} s {side}" if away else "at it" for away, side in sides if away is not None)


def _pulled(found: Explanation) -> Iterator[str]:
    """By the source, and by the single measurement, that pull most."""
    if not found.balanced:
        yield (
            "The states of this replay were never solved together (no polish): the figures say what all data together "
            "tell, and pulls are left out."
        )
        return
    h, m = found.held, found.held.measurements
    sources = [i for i, source in enumerate(h.sources) if source not in NO_ROWS and _felt(h.pull[i])]
    if sources:
        most = max(sources, key=lambda i: float(np.abs(h.pull[i, 2:6]).max()))
        yield f"Together {words(h.sources[most])} pull it {_pull(found, h.pull[most])}; all else holds against them."
    felt = [i for i in found.strongest() if _felt(m.pull[i])]
    if not felt:
        yield f"No single measurement pulls by {FELT} sigma."
        return
    source, when = words(str(m.source[felt[0]])).removeprefix("the "), found.seconds(int(m.t_ns[felt[0]]))
    yield f"The strongest pull of one measurement, of {source} at {when:.2f} s: {_pull(found, m.pull[felt[0]])}."


def _felt(pull: Floats) -> bool:
    """Whether a pull (15,) moves the place or the heading at all."""
    return bool(np.abs(pull[2:6]).max() >= FELT)


def _pull(found: Explanation, pull: Floats) -> str:
    level, turn = float(np.hypot(*pull[3:5])), -float(pull[2])
    metres = _metres(float(np.hypot(*(pull * found.held.sigma)[3:5])))
    side = "clockwise" if turn > 0 else "anticlockwise"
    return f"{level:.2f} sigma ({metres}) to the {_wind(*pull[3:5])} and {abs(turn):.2f} sigma {side} in heading"


def _around(near: Nearby) -> Iterator[str]:
    if near.gap is None:
        yield "The inertial data have no gap."
    else:
        how = "filled by straight lines" if near.gap.kind == "bridged" else "without samples"
        yield _stretch("gap in the inertial data", near.gap, how)
    if near.rejection is None:
        yield "No measurement was rejected."
    else:
        one = near.rejection
        size = f"{one['size_sigma']:.0f} sigma" + (f", {one['size_m']:.1f} m" if "size_m" in one else "")
        yield f"The nearest rejection: {one['sensor']} at {one['t_s']:.2f} s, {_away(one['away_s'])} ({size})."
    if near.standstill is not None:
        yield _stretch("standstill", near.standstill, "")


def _stretch(name: str, one: Stretch, how: str) -> str:
    told = f"{one.length_s:.2f} s from {one.start_s:.2f} s{f', {how}' if how else ''}"
    if one.away_s == 0.0:
        return f"It lies inside a {name}: {told}."
    return f"The nearest {name} is {_away(one.away_s)}: {told}."


def _away(seconds: float) -> str:
    return f"{abs(seconds):.2f} s {'later' if seconds > 0 else 'earlier'}"


def _wind(east: float, north: float) -> str:
    return WINDS[round(np.arctan2(north, east) / (np.pi / 4)) % 8]


def _metres(value: float) -> str:
    return f"{value:.3f} m" if value < 10 else f"{value:.1f} m"


def _degrees(value: float) -> str:
    return f"{value:.2g} deg" if value < 1 else f"{value:.1f} deg"


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
