"""summary.json in plain words: sentences and tables. Nothing is claimed that the summary does not say."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from smartnav_graph.factors import label_of
from smartnav_graph.output.report.text import (
    Row,
    Table,
    as_float,
    capital,
    count,
    distance,
    duration,
    fixed,
    listed,
    metres,
    number,
    plural,
    seconds,
)

Summary = Mapping[str, Any]

MOST_REJECTED = 0.25  # share of a sensor's rows that may be outliers
HOLES = {"bridged": "bridged by interpolation", "missing": "no samples"}
MODES = {
    "batch": "smoothed in one batch",
    "replay": "replayed one window at a time",
    "dead-reckoning": "dead-reckoned",
}


def room(summary: Summary, key: str) -> Mapping[str, Any]:
    """A sub-table of the summary; empty when it is absent or no table."""
    value = summary.get(key)
    return value if isinstance(value, Mapping) else {}


def sensor_name(name: str) -> str:
    return label_of(name).title


def things(name: str, n: Any) -> str:
    """``3 GNSS fixes``."""
    label = label_of(name)
    return plural(n, label.one, label.many)


def gaps(summary: Summary) -> list[tuple[float, float, str]]:
    """IMU holes: start s, length s, kind."""
    found = [
        (as_float(g.get("start_s")), as_float(g.get("length_s")), g.get("kind")) for g in summary.get("gaps") or []
    ]
    return [(start, length, str(kind)) for start, length, kind in found if start is not None and length is not None]


def hole_sentence(start: float, length: float, kind: str) -> str:
    """One IMU hole in words."""
    return f"IMU hole at {fixed(start, 1)} s, {fixed(length, 2)} s, {HOLES.get(kind, kind)}"


@dataclass(frozen=True)
class Certainty:
    """One-sigma horizontal position over the run: median, worst and when, metres and seconds."""

    median_m: float
    worst_m: float
    worst_s: float


def headline(summary: Summary, certainty: Certainty | None = None) -> list[str]:
    """What happened, in a few sentences."""
    sentences = [_what(summary), _how_sure(summary, certainty), _left_out(summary), _withheld(summary)]
    return [sentence for sentence in sentences if sentence]


def _what(summary: Summary) -> str:
    mode = str(summary.get("mode") or "")
    kind, _, how = mode.partition(" ")
    done = MODES.get(kind, f"processed ({kind})") if mode else "smoothed"
    done += f" ({how})" if how else ""
    over = f" over {distance(summary['path_m'])}" if as_float(summary.get("path_m")) is not None else ""
    long = f" of {duration(summary['duration_s'])}" if as_float(summary.get("duration_s")) is not None else ""
    at = f" at {plural(summary['keyframes'], 'epoch')}" if as_float(summary.get("keyframes")) is not None else ""
    tail = "; nothing ties it to an absolute position, so its uncertainty grows with time" * (kind == "dead-reckoning")
    return f"The recording{long}{over} was {done}{at}{tail}."


def _how_sure(summary: Summary, certainty: Certainty | None) -> str:
    failed = "The solver did not converge: do not rely on this result. " * (summary.get("converged") is False)
    if certainty is None:
        return failed.strip()
    return (
        f"{failed}Half of the time the position is known to {metres(certainty.median_m)} (1 sigma, horizontal) "
        f"or better; the worst is {metres(certainty.worst_m)}, at t = {seconds(certainty.worst_s)}."
    )


def _left_out(summary: Summary) -> str:
    said = []
    rejected = {name: n for name, n in room(summary, "rejected").items() if as_float(n)}
    if rejected:
        were = "was" if sum(as_float(n) or 0 for n in rejected.values()) == 1 else "were"
        said.append(f"{listed([things(k, n) for k, n in rejected.items()])} {were} rejected as outliers")
    elif "rejected" in summary:
        said.append("no measurement was rejected")
    holes = gaps(summary)
    if holes:
        said.append(f"the IMU record has {plural(len(holes), 'hole')}, {fixed(sum(h[1] for h in holes), 1)} s in all")
    elif "gaps" in summary:
        said.append("the IMU record has no holes")
    return f"{capital('; '.join(said))}." if said else ""


def _withheld(summary: Summary) -> str:
    parts = []
    for name, score in room(summary, "withheld").items():
        if not isinstance(score, Mapping) or not as_float(score.get("count")):
            continue
        rms = as_float(score.get("rms_horizontal_m"))
        met = f"; the result meets them within {metres(rms)} (RMS, horizontal)" if rms is not None else ""
        were = "was" if as_float(score["count"]) == 1 else "were"
        parts.append(f"{things(name, score['count'])} {were} withheld from the estimate{met}.")
    return " ".join(parts)


def warnings(summary: Summary) -> list[tuple[str, str]]:
    """(what is wrong, what to do about it). A message ``found; expected; remedy`` is split at its first semicolon."""
    told = [_with_sensor(str(w)) for w in summary.get("warnings") or [] if str(w).strip()]
    if any(w.startswith("Dead reckoning") for w in told):  # says the same, and what follows from it
        told = [w for w in told if not w.startswith("Session: no absolute sensor")]
    if summary.get("converged") is False and not any("converge" in w or "iteration limit" in w for w in told):
        told.insert(
            0,
            f"The solver stopped after {plural(summary.get('iterations'), 'iteration')} without converging; "
            "look at the residuals below, exclude the sensor that does not fit, or give --initial",
        )
    overall = as_float(room(summary, "chi2_per_dof").get("overall"))
    if overall is not None and overall > 3.0 and not any("chi" in w for w in told):
        told.append(
            f"Residuals are larger than the stated noise explains (chi2 per degree of freedom {number(overall)}, "
            "1 is right); the sigmas in this report are too small by about its root: set the noise in calibration.toml"
        )
    told += _mostly_rejected(summary)
    return [(first.strip(), capital(rest.strip())) for first, _, rest in (w.partition(";") for w in told)]


def _mostly_rejected(summary: Summary) -> list[str]:
    """Sensors of positions of which more was rejected than outliers explain."""
    told = []
    for name, used in room(summary, "used").items():
        kept, out = as_float(used) or 0.0, as_float(room(summary, "rejected").get(name)) or 0.0
        if out > MOST_REJECTED * (kept + out):
            told.append(
                f"{sensor_name(name)}: {count(out)} of {things(name, kept + out)} rejected, too many for outliers; "
                "they or the rest of the run are wrong: look at the residuals over time, and smooth the stretch in "
                "question by itself (--from, --to)"
            )
    return told


def _with_sensor(warning: str) -> str:
    """``imu: 1 stretch ..`` -> ``IMU: 1 stretch ..``."""
    first, colon, rest = warning.partition(": ")
    return f"{sensor_name(first)}: {rest}" if colon and first.isidentifier() else capital(warning)


def chi2_by_sensor(summary: Summary) -> dict[str, float]:
    """chi2 per degree of freedom by sensor, whether the summary nests them or not."""
    table = room(summary, "chi2_per_dof")
    nested = [v for v in table.values() if isinstance(v, Mapping)]
    flat = {k: v for k, v in table.items() if k != "overall" and not isinstance(v, Mapping)}
    both = {k: as_float(v) for part in (flat, *nested) for k, v in part.items()}
    return {k: v for k, v in both.items() if v is not None}


def withheld_counts(summary: Summary) -> dict[str, Any]:
    return {k: v.get("count") for k, v in room(summary, "withheld").items() if isinstance(v, Mapping)}


def solver_table(summary: Summary) -> Table:
    """Cost, iterations, speed and memory."""
    update = room(summary, "update_ms")
    converged = "yes" if summary.get("converged") else "no"
    entries = [
        ("Converged", "converged", converged),
        ("Passes", "passes", count(summary.get("passes"))),
        ("Iterations", "iterations", count(summary.get("iterations"))),
        ("χ² per degree of freedom", "chi2_per_dof", number(room(summary, "chi2_per_dof").get("overall"))),
        ("Times faster than the recording", "real_time_factor", _speed(summary)),
        (
            "Update, median / 99 % / largest",
            "update_ms",
            " / ".join(number(update.get(k)) for k in ("median", "p99", "max")) + " ms",
        ),
        ("Data seen before the first output", "delay_s", seconds(summary.get("delay_s"))),
        ("Largest change by the final polish", "polish", _polish(room(summary, "polish"))),
        ("Peak memory", "peak_memory_mb", f"{count(summary.get('peak_memory_mb'))} MB"),
    ]
    return Table(("", ""), [Row([label, text]) for label, key, text in entries if summary.get(key) not in (None, {})])


def _polish(change: Mapping[str, Any]) -> str:
    return f"{metres(change.get('largest_change_m'))}, {number(change.get('largest_change_deg'))}°"


def _speed(summary: Summary) -> str:
    """Recorded over computing seconds, from the total time where that is told, so that its meaning is certain."""
    total, recorded = as_float(room(summary, "timings_s").get("total")), as_float(summary.get("duration_s"))
    if total and recorded:
        return f"{number(recorded / total)} ×"
    return number(summary.get("real_time_factor"))


def timings(summary: Summary) -> dict[str, float]:
    known = {k: as_float(v) for k, v in room(summary, "timings_s").items()}
    return {k: v for k, v in known.items() if v is not None}


def step_name(name: str, known: Mapping[str, float]) -> str:
    """A step of the computation; a report written with the other files cannot know how long those take."""
    return "Total, without writing" if name == "total" and "write" not in known else capital(name)


def timings_table(summary: Summary) -> Table:
    known = timings(summary)
    return Table(("Step", "Seconds"), [Row([step_name(k, known), fixed(v, 3)]) for k, v in known.items()])


def versions_table(summary: Summary) -> Table:
    return Table(("", ""), [Row([str(k), str(v)]) for k, v in room(summary, "versions").items()], frozenset({1}))


def evaluation_facts(evaluation: Any) -> Mapping[str, Any]:
    """The evaluation as its JSON table; empty when there is none."""
    if evaluation is None:
        return {}
    table = evaluation if isinstance(evaluation, Mapping) else evaluation.to_dict()
    return table if isinstance(table, Mapping) else {}


def evaluation_sentence(facts: Mapping[str, Any]) -> str:
    """Reference, alignment and how many epochs were matched."""
    align = str(facts.get("align") or "none")
    how = "without alignment" if align == "none" else f"after {align} alignment"
    reference = str(facts.get("reference") or "the reference").replace("\\", "/").rsplit("/", 1)[-1]
    lost = as_float(facts.get("unmatched"))
    rest = f", {plural(lost, 'epoch')} of it outside the run" if lost else ""
    return f"Compared with {reference} at {plural(facts.get('matched'), 'epoch')} {how}{rest}."


def evaluation_table(facts: Mapping[str, Any]) -> Table:
    """Absolute pose errors: RMS, mean and percentiles."""
    keys = ("rmse", "mean", "p50", "p67", "p95", "max")
    rows = []
    for key, label in (("ape_m", "Position [m]"), ("rotation_deg", "Rotation [°]")):
        error = room(facts, key)
        if error:
            data = {"error": key} | {k: error.get(k) for k in keys}
            rows.append(Row([label, *(number(error.get(k)) for k in keys)], data))
    return Table(("Error", "RMS", "Mean", "50 %", "67 %", "95 %", "Largest"), rows)


def relative_table(facts: Mapping[str, Any]) -> Table:
    """Relative pose errors over spans of time."""
    rows = [
        Row([seconds(r.get("delta_s"), 0), number(r.get("translation_m")), number(r.get("rotation_deg"))])
        for r in facts.get("rpe") or []
        if isinstance(r, Mapping)
    ]
    return Table(("Over", "Translation [m]", "Rotation [°]"), rows)


def nees_table(facts: Mapping[str, Any]) -> Table:
    """Normalised squared errors beside what an honest covariance gives, the number of components; and how many times
    larger the errors are than the sigmas say."""
    rows = []
    for name, found, expected in _nees(facts):
        data = {"nees": name, "found": found}
        rows.append(Row([capital(name), number(found), str(expected), number(math.sqrt(found / expected), 2)], data))
    return Table(("Mean NEES", "Found", "Expected", "Errors / sigma"), rows)


def _nees(facts: Mapping[str, Any]) -> list[tuple[str, float, int]]:
    known = {name: as_float(value) for name, value in room(facts, "nees").items()}
    return [(name, v, 1 if name == "yaw" else 3) for name, v in known.items() if v is not None and v >= 0]


def nees_sentence(facts: Mapping[str, Any]) -> str:
    """What the normalised errors mean for somebody who wants to rely on the sigmas."""
    if not _nees(facts):
        return ""
    if str(facts.get("align") or "none") != "none":
        return (
            "NEES compares errors with the sigmas of this report. After alignment it says little: the aligned path has "
            "errors also where the run started and its sigmas are nearly zero."
        )
    far = [(name, math.sqrt(v / n)) for name, v, n in _nees(facts) if v > 2.0 * n]
    if not far:
        return "NEES compares errors with the sigmas of this report: they are as large as they should be, or smaller."
    told = listed([f"{name} errors are {number(times, 2)} times their sigma" for name, times in far])
    return (
        f"NEES compares errors with the sigmas of this report: {told}. Either the sigmas are too small, or the "
        "reference is offset: check its datum, its antenna or body point (--body-T-ref) and its clock (--time-offset)."
    )
