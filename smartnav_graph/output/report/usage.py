"""What was recorded, used, rejected, withheld and dropped, and why: sentences and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.factors import label_of
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report.facts import Summary, chi2_by_sensor, room, sensor_name, things, withheld_counts
from smartnav_graph.output.report.text import DASH, Row, Table, as_float, capital, count, metres, number, seconds
from smartnav_graph.session.streams import POSITIONS

SMALL = 0.3  # chi2 per degree of freedom of noise that is stated too large
LOST_ROWS = 10  # fixes in a row that are no outliers any more
FATES = {
    "in use": "in use",
    "outside the stretch": "outside the stretch that was solved",
    "too few matches": "too few matches",
    "no baseline to speak of": "the camera hardly moved between the two",
    "contradicts the turn or the way": "contradict the motion that the other sensors tell",
}


def used_table(summary: Summary, recorded: Mapping[str, int]) -> Table:
    """Per sensor: rows recorded (where told), factors used, rejected, withheld, dropped on reading, chi2 per dof.

    Columns of zeros are left out, all but the rejected ones.
    """
    factors, rejected, dropped = (room(summary, k) for k in ("factors", "rejected", "dropped"))
    withheld, chi2 = withheld_counts(summary), chi2_by_sensor(summary)
    names = [
        n
        for n in dict.fromkeys([*recorded, *factors, *rejected, *withheld, *dropped, *chi2])
        if not label_of(n).assumes
    ]
    lost = {name: round(sum(as_float(n) or 0.0 for n in room(dropped, name).values())) for name in names}
    columns: list[tuple[str, list[str]]] = [
        ("Sensor", [sensor_name(name) for name in names]),
        ("Recorded", [count(recorded.get(name)) for name in names] if recorded else []),
        ("Factors", [count(factors.get(name)) for name in names]),
        ("Rejected", [count(rejected.get(name, 0)) for name in names]),
        ("Withheld", [count(withheld.get(name, 0)) for name in names] if any(map(as_float, withheld.values())) else []),
        ("Dropped", [count(lost[name]) for name in names] if any(lost.values()) else []),
        ("χ² / dof", [number(chi2.get(name)) for name in names]),
    ]
    shown = [column for column in columns if column[1]]
    data = [{"sensor": n, "used": factors.get(n), "rejected": rejected.get(n), "dropped": lost[n]} for n in names]
    rows = [Row([cells[i] for _, cells in shown], data[i]) for i in range(len(names))]
    return Table([title for title, _ in shown], rows)


def assumed_table(summary: Summary) -> Table:
    """What was assumed besides the measurements, and how often."""
    factors = room(summary, "factors")
    rows = [
        Row([sensor_name(name), count(factors[name]), meaning], {"assumed": name, "used": factors[name]})
        for name in factors
        if (meaning := label_of(name).assumes) and as_float(factors[name])
    ]
    return Table(("Assumed besides", "Factors", "Meaning"), rows, frozenset({2}))


def why_lines(summary: Summary) -> list[str]:
    """Why rows were not used."""
    lines = [
        f"{capital(things(name, n))} rejected: farther from the solution than {'its' if n == 1 else 'their'} "
        "own uncertainty allows."
        for name, n in room(summary, "rejected").items()
        if as_float(n) and name not in ("image_pairs", "smart")
    ]
    for stream, reasons in room(summary, "dropped").items():
        known = {reason: n for reason, n in room({"r": reasons}, "r").items() if as_float(n)}
        lines += [f"{sensor_name(stream)}: {count(n)} {reason}." for reason, n in known.items()]
    return lines


def fates_table(summary: Summary, key: str, things: str) -> Table:
    """What became of the image pairs or tracks: ``image_pairs`` or ``tracks`` of the summary."""
    found = {reason: as_float(n) or 0.0 for reason, n in room(summary, key).items()}
    total = sum(found.values())
    rows = [
        Row(
            [capital(FATES.get(reason, reason)), count(n), f"{number(100 * n / total, 2)} %"],
            {key.replace("_", "-"): reason, "n": n},
        )
        for reason, n in found.items()
        if n
    ]
    return Table((f"{count(total)} {things}", "Count", "Share"), rows)


def rejections_table(summary: Summary) -> Table:
    """Every rejected measurement: when, which sensor, how far off."""
    rows = []
    for one in summary.get("rejections") or []:
        size = as_float(one.get("size_m"))
        off = metres(size) if size is not None else DASH
        cells = [seconds(one.get("t_s"), 1), sensor_name(str(one.get("sensor"))), off, number(one.get("size_sigma"))]
        rows.append(Row(cells, {"rejection-s": one.get("t_s"), "size-m": size}))
    return Table(("Time", "Sensor", "Off by", "Times its sigma"), rows, frozenset({1}))


def withheld_table(summary: Summary) -> Table:
    """Errors at the measurements that were withheld."""
    rows = []
    for name, score in room(summary, "withheld").items():
        if isinstance(score, Mapping):
            keys = ("rms_horizontal_m", "rms_3d_m", "max_m")
            data = {"sensor": name, "withheld": score.get("count")} | {k.replace("_", "-"): score.get(k) for k in keys}
            rows.append(
                Row([sensor_name(name), count(score.get("count")), *(metres(score.get(k)) for k in keys)], data)
            )
    return Table(("Withheld", "Count", "RMS horizontal", "RMS 3D", "Largest"), rows)


class Silence(NamedTuple):
    """The longest stretch of a run without a position in use."""

    start_s: float
    length_s: float
    sensors: Sequence[str]


def longest_silence(solution: Solution) -> Silence | None:
    """The longest stretch without a position fix in use, whichever sensor; None where no fix was used."""
    r = solution.residuals
    names = [name for name in POSITIONS if (r.of(name) & r.used).any()] if len(r) else []
    if not names or not len(solution):
        return None
    used = np.any([r.of(name) for name in names], axis=0) & r.used
    t = np.concatenate([solution.t_ns[:1], np.unique(r.t_ns[used]), solution.t_ns[-1:]])
    longest = int(np.argmax(np.diff(t)))
    return Silence(float(t[longest] - solution.t0_ns) / 1e9, float(np.diff(t)[longest]) / 1e9, names)


def silence_sentence(silence: Silence) -> str:
    """The longest stretch without a fix, in words."""
    what = " or ".join(things(name, 1).split(maxsplit=1)[-1] for name in silence.sensors)
    return (
        f"The longest stretch without a {what} in use is {seconds(silence.length_s)}, from t = "
        f"{seconds(silence.start_s)} on."
    )


def lost_warnings(solution: Solution) -> list[tuple[str, str]]:
    """Sensors of positions of which more fixes in a row were rejected than outliers come: what, remedy."""
    told = []
    for name in POSITIONS if len(solution.residuals) else ():
        row = _longest_row(solution, name)
        if len(row) >= LOST_ROWS:
            first, last = (row[[0, -1]] - solution.t0_ns) / 1e9
            told.append(
                (
                    f"{sensor_name(name)}: {things(name, len(row))} in a row rejected, from {seconds(first)} to "
                    f"{seconds(last)}; outliers do not come like this",
                    "The estimate has lost its way there, or the sensor has for long: compare path and fixes on the "
                    "map, and smooth this stretch by itself (--from, --to)",
                )
            )
    return told


def _longest_row(solution: Solution, sensor: str) -> NDArray[np.int64]:
    """Stamps of the longest row of fixes of which nothing was used."""
    r = solution.residuals
    rows = r.of(sensor)
    t, place = np.unique(r.t_ns[rows], return_inverse=True)
    kept = np.bincount(place, weights=r.used[rows], minlength=len(t)) > 0
    pieces = np.split(np.arange(len(t)), np.flatnonzero(np.diff(kept.astype(int))) + 1)
    lost = [piece for piece in pieces if len(piece) and not kept[piece[0]]]
    return np.asarray(t[max(lost, key=len)] if lost else t[:0], dtype=np.int64)


def careful_sentence(summary: Summary) -> str:
    """That residuals are far smaller than the stated noise, where they are."""
    small = [sensor_name(name) for name, value in chi2_by_sensor(summary).items() if value < SMALL]
    overall: Any = as_float(room(summary, "chi2_per_dof").get("overall"))
    if overall is None or overall >= SMALL:
        return ""
    whose = f" of {' and '.join(small)}" if small else ""
    return (
        f"The residuals{whose} are smaller than the stated noise explains (χ² / dof {number(overall)} overall): the "
        "noise is set on the careful side, and the sigmas in this report are rather too large than too small."
    )
