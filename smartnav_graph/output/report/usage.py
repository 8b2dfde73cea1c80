"""Measurements used, rejected, withheld and dropped: sentences and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Times
from smartnav_graph.factors import label_of, title_of
from smartnav_graph.graph.solution import Solution
from smartnav_graph.output.report.facts import chi2_by_sensor, withheld_counts
from smartnav_graph.output.summary_json import Summary, as_float, numbers_of, rows_of, table_of, text_of
from smartnav_graph.output.text import DASH, Row, Table, capital, count, listed, metres, number, seconds
from smartnav_graph.session.streams import POSITIONS

SMALL = 0.3  # chi2 per degree of freedom of noise that is stated too large
LOST_ROWS = 10  # more rejected fixes in a row than outliers explain


def used_table(summary: Summary, recorded: Mapping[str, int]) -> Table:
    """Per sensor: rows recorded (where known), factors used, rejected, withheld, dropped on reading, chi2 per dof.

    Columns of zeros are left out, except that of the rejected ones.
    """
    factors, rejected = numbers_of(summary, "factors"), numbers_of(summary, "rejected")
    dropped, withheld, chi2 = table_of(summary, "dropped"), withheld_counts(summary), chi2_by_sensor(summary)
    known = dict.fromkeys([*recorded, *factors, *rejected, *withheld, *dropped, *chi2])
    names = [name for name in known if not label_of(name).assumes]
    lost = {name: round(sum(numbers_of(dropped, name).values())) for name in names}
    columns: list[tuple[str, list[str]]] = [
        ("Sensor", [title_of(name) for name in names]),
        ("Recorded", [count(recorded.get(name)) for name in names] if recorded else []),
        ("Factors", [count(factors.get(name)) for name in names]),
        ("Rejected", [count(rejected.get(name, 0)) for name in names]),
        ("Withheld", [count(withheld.get(name, 0)) for name in names] if any(withheld.values()) else []),
        ("Dropped", [count(lost[name]) for name in names] if any(lost.values()) else []),
        ("χ² / dof", [number(chi2.get(name)) for name in names]),
    ]
    shown = [column for column in columns if column[1]]
    used, out = table_of(summary, "factors"), table_of(summary, "rejected")  # whole numbers stay whole
    data = [{"sensor": n, "used": used.get(n), "rejected": out.get(n), "dropped": lost[n]} for n in names]
    rows = [Row([cells[i] for _, cells in shown], data[i]) for i in range(len(names))]
    return Table([title for title, _ in shown], rows)


def models_table(summary: Summary) -> Table:
    """Priors, constraints and error models, and how many factors each has."""
    factors = table_of(summary, "factors")
    rows = [
        Row([title_of(name), count(factors[name]), meaning], {"model": name, "used": factors[name]})
        for name in factors
        if (meaning := label_of(name).assumes) and as_float(factors[name])
    ]
    return Table(("Priors, constraints, error models", "Factors", "Meaning"), rows, frozenset({2}))


def why_lines(summary: Summary) -> list[str]:
    """Why measurements were not used."""
    rejected = [f"{title_of(name)} {count(n)}" for name, n in numbers_of(summary, "rejected").items() if n]
    lines = [f"Rejected by the outlier test: {', '.join(rejected)}."] if rejected else []
    for stream in table_of(summary, "dropped"):
        reasons = numbers_of(table_of(summary, "dropped"), stream)
        lines += [f"{title_of(stream)}: {count(n)} {reason}." for reason, n in reasons.items() if n]
    return lines


def outcomes_table(summary: Summary, key: str, things: str) -> Table:
    """How many image pairs or tracks were used, and why the others were not: ``image_pairs``, ``tracks``."""
    found = numbers_of(summary, key)
    total = sum(found.values())
    rows = [
        Row([capital(reason), count(n), f"{number(100 * n / total, 2)} %"], {key.replace("_", "-"): reason, "n": n})
        for reason, n in found.items()
        if n
    ]
    return Table((f"{count(total)} {things}", "Count", "Share"), rows)


def camera_lines(summary: Summary) -> list[str]:
    """What the camera shows beside the gyroscope, and what other sensors make of it."""
    camera, lines = table_of(summary, "camera"), list[str]()
    offset, sigma, share = (as_float(camera.get(name)) for name in ("clock_offset_s", "clock_sigma_s", "sound_share"))
    if offset is not None and sigma is not None and camera.get("known"):
        lines.append(f"Clock offset beside the calibrated one: {1e3 * offset:.1f} ms, 1 sigma {1e3 * sigma:.1f} ms.")
        lines.append(f"{number(100.0 * (share or 0.0), 3)} % of the image pairs agree with the turns of the gyroscope.")
    elif offset is not None:
        lines.append("Clock offset not known: the camera turns too little.")
    if (direction := as_float(camera.get("direction_sigma_deg"))) is not None:
        lines.append(f"Direction between images: {direction:.2f} deg uncertain beside the noise of matches.")
    return lines


def rejections_table(summary: Summary) -> Table:
    """Every rejected measurement: time, sensor, size of the residual."""
    rows = []
    for one in rows_of(summary, "rejections"):
        size = as_float(one.get("size_m"))
        residual = metres(size) if size is not None else DASH
        cells = [
            seconds(one.get("t_s"), 1),
            title_of(text_of(one, "sensor")),
            residual,
            number(one.get("size_sigma")),
        ]
        rows.append(Row(cells, {"rejection-s": one.get("t_s"), "size-m": size}))
    return Table(("Time", "Sensor", "Residual", "Residual / sigma"), rows, frozenset({1}))


def withheld_table(summary: Summary) -> Table:
    """Errors at the withheld measurements."""
    rows = []
    for name in table_of(summary, "withheld"):
        score = table_of(table_of(summary, "withheld"), name)
        if score:
            keys = ("rms_horizontal_m", "rms_3d_m", "max_m")
            data = {"sensor": name, "withheld": score.get("count")} | {k.replace("_", "-"): score.get(k) for k in keys}
            rows.append(Row([title_of(name), count(score.get("count")), *(metres(score.get(k)) for k in keys)], data))
    return Table(("Withheld", "Count", "RMS horizontal", "RMS 3D", "Largest"), rows)


class Outage(NamedTuple):
    """The longest time of a run without a position in use."""

    start_s: float
    length_s: float
    sensors: Sequence[str]


def longest_outage(solution: Solution) -> Outage | None:
    """The longest time without a position fix in use, of any sensor; None where no fix was used."""
    r = solution.residuals
    names = [name for name in POSITIONS if (r.of(name) & r.used).any()] if len(r) else []
    if not names or not len(solution):
        return None
    used = np.any([r.of(name) for name in names], axis=0) & r.used
    t = np.concatenate([solution.t_ns[:1], np.unique(r.t_ns[used]), solution.t_ns[-1:]])
    longest = int(np.argmax(np.diff(t)))
    return Outage(float(t[longest] - solution.t0_ns) / 1e9, float(np.diff(t)[longest]) / 1e9, names)


def outage_sentence(outage: Outage) -> str:
    """The longest time without a fix as a sentence."""
    names = listed([title_of(name) for name in outage.sensors])
    length, start = seconds(outage.length_s), seconds(outage.start_s)
    return f"Longest time without a position in use ({names}): {length}, from t = {start}."


def lost_warnings(solution: Solution) -> list[tuple[str, str]]:
    """Position sensors with more rejected fixes in a row than outliers explain: what is wrong, remedy."""
    found = []
    for name in POSITIONS if len(solution.residuals) else ():
        row = _longest_row(solution, name)
        if len(row) >= LOST_ROWS:
            first, last = (row[[0, -1]] - solution.t0_ns) / 1e9
            found.append(
                (
                    f"{title_of(name)}: {count(len(row))} measurements in a row rejected, from {seconds(first)} to "
                    f"{seconds(last)}; outliers are not that many in a row",
                    "The estimate has diverged there, or the sensor was wrong for long: compare path and fixes on the "
                    "map, and smooth this time span by itself (--from, --to)",
                )
            )
    return found


def _longest_row(solution: Solution, sensor: str) -> Times:
    """Stamps of the longest row of fixes of which nothing was used."""
    r = solution.residuals
    rows = r.of(sensor)
    t, place = np.unique(r.t_ns[rows], return_inverse=True)
    kept = np.bincount(place, weights=r.used[rows], minlength=len(t)) > 0
    pieces = np.split(np.arange(len(t)), np.flatnonzero(np.diff(kept.astype(int))) + 1)
    lost = [piece for piece in pieces if len(piece) and not kept[piece[0]]]
    return np.asarray(t[max(lost, key=len)] if lost else t[:0], dtype=np.int64)


def small_residuals_sentence(summary: Summary) -> str:
    """That residuals are far smaller than the stated noise, where they are."""
    overall = numbers_of(summary, "chi2_per_dof").get("overall")
    if overall is None or overall >= SMALL:
        return ""
    small = [title_of(name) for name, value in chi2_by_sensor(summary).items() if value < SMALL]
    whose = f" of {listed(small)}" if small else ""
    return (
        f"The residuals{whose} are smaller than the stated noise (χ² / dof {number(overall)} overall): the noise "
        "is set too large, and the sigmas in this report are too large rather than too small."
    )
