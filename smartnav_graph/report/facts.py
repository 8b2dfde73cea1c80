"""summary.json in plain words: sentences and tables. Nothing is claimed that the summary does not say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from smartnav_graph.report.text import (
    DASH,
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

SENSORS = {
    "imu": ("IMU", "IMU sample", "IMU samples"),
    "imu_bias": ("IMU bias walk", "bias step", "bias steps"),
    "gnss": ("GNSS", "GNSS fix", "GNSS fixes"),
    "control": ("Control points", "control point", "control points"),
    "pose_fixes": ("Pose fixes", "pose fix", "pose fixes"),
    "prior": ("Prior", "prior", "priors"),
    "rest": ("Rest at the start", "zero velocity", "zero velocities"),
    "static": ("Standstills", "standstill", "standstills"),
    "magnetometer": ("Magnetometer", "magnetometer sample", "magnetometer samples"),
    "barometer": ("Barometer", "pressure sample", "pressure samples"),
    "temperature": ("Temperature", "temperature sample", "temperature samples"),
    "velocity": ("Velocity", "velocity", "velocities"),
    "wheel": ("Wheel speed", "wheel speed", "wheel speeds"),
    "images": ("Images", "image", "images"),
    "tracks": ("Tracked points", "tracked point", "tracked points"),
    "matches": ("Matched points", "matched point", "matched points"),
    "coplanarity": ("Image pairs", "image pair", "image pairs"),
    "smart": ("Tracks in space", "track", "tracks"),
    "static_turn": ("Rests without turn", "rest without turn", "rests without turn"),
}
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
    return SENSORS[name][0] if name in SENSORS else capital(name.replace("_", " "))


def things(name: str, n: Any) -> str:
    """``3 GNSS fixes``."""
    one, many = SENSORS[name][1:] if name in SENSORS else (f"{name} measurement", f"{name} measurements")
    return plural(n, one, many)


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
    told = [str(w) for w in summary.get("warnings") or [] if str(w).strip()]
    if summary.get("converged") is False and not any("converge" in w for w in told):
        told.insert(
            0,
            f"The solver stopped after {plural(summary.get('iterations'), 'iteration')} without converging; "
            "look at the residuals below, exclude the sensor that does not fit, or give --initial",
        )
    overall = as_float(room(summary, "chi2_per_dof").get("overall"))
    if overall is not None and not 0.3 < overall < 3.0 and not any("chi2" in w for w in told):
        side = "larger" if overall > 1 else "smaller"
        told.append(
            f"Residuals are {side} than the stated noise explains (chi2 per degree of freedom {number(overall)}, "
            "1 is right); the sigmas in this report are wrong by about its root: set the noise in calibration.toml"
        )
    return [(first.strip(), capital(rest.strip())) for first, _, rest in (w.partition(";") for w in told)]


def chi2_by_sensor(summary: Summary) -> dict[str, float]:
    """chi2 per degree of freedom by sensor, whether the summary nests them or not."""
    table = room(summary, "chi2_per_dof")
    nested = [v for v in table.values() if isinstance(v, Mapping)]
    flat = {k: v for k, v in table.items() if k != "overall" and not isinstance(v, Mapping)}
    both = {k: as_float(v) for part in (flat, *nested) for k, v in part.items()}
    return {k: v for k, v in both.items() if v is not None}


def withheld_counts(summary: Summary) -> dict[str, Any]:
    return {k: v.get("count") for k, v in room(summary, "withheld").items() if isinstance(v, Mapping)}


def used_table(summary: Summary, recorded: Mapping[str, int]) -> Table:
    """Per sensor: rows recorded (where told), factors used, rejected, withheld, dropped on reading, chi2 per dof."""
    factors, rejected, dropped = (room(summary, k) for k in ("factors", "rejected", "dropped"))
    withheld, chi2 = withheld_counts(summary), chi2_by_sensor(summary)
    names = dict.fromkeys([*recorded, *factors, *rejected, *withheld, *dropped, *chi2])
    rows = []
    for name in names:
        lost = round(sum(as_float(n) or 0.0 for n in room(dropped, name).values()))
        known = [count(recorded.get(name))] if recorded else []
        used = [count(t.get(name, 0)) for t in (factors, rejected, withheld)]
        data = {"sensor": name, "used": factors.get(name), "rejected": rejected.get(name), "dropped": lost}
        rows.append(Row([sensor_name(name), *known, *used, count(lost), number(chi2.get(name))], data))
    first = ("Sensor", "Recorded") if recorded else ("Sensor",)
    return Table((*first, "Factors", "Rejected", "Withheld", "Dropped", "χ² / dof"), rows)


def why_lines(summary: Summary) -> list[str]:
    """Why rows were not used."""
    lines = [
        f"{capital(things(name, n))} rejected: farther from the solution than {'its' if n == 1 else 'their'} "
        "own uncertainty allows."
        for name, n in room(summary, "rejected").items()
        if as_float(n)
    ]
    for stream, reasons in room(summary, "dropped").items():
        known = {reason: n for reason, n in room({"r": reasons}, "r").items() if as_float(n)}
        lines += [f"{sensor_name(stream)}: {count(n)} {reason}." for reason, n in known.items()]
    return lines


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
    rows = []
    for name, score in room(summary, "withheld").items():
        if isinstance(score, Mapping):
            keys = ("rms_horizontal_m", "rms_3d_m", "max_m")
            data = {"sensor": name, "withheld": score.get("count")} | {k.replace("_", "-"): score.get(k) for k in keys}
            rows.append(
                Row([sensor_name(name), count(score.get("count")), *(metres(score.get(k)) for k in keys)], data)
            )
    return Table(("Withheld", "Count", "RMS horizontal", "RMS 3D", "Largest"), rows)


def states_table(summary: Summary) -> Table:
    """Estimated constants such as clock offsets; the unit is the suffix of the name."""
    rows = []
    for name, state in room(summary, "states").items():
        if isinstance(state, Mapping):
            value, sigma, held = state.get("value"), state.get("sigma"), bool(state.get("held"))
            cells = [
                _state_name(name),
                _values(value),
                DASH if held else _values(sigma),
                "held" if held else "estimated",
            ]
            rows.append(Row(cells, {"state": name, "value": value, "sigma": sigma, "held": str(held).lower()}))
    return Table(("State", "Value", "1 sigma", ""), rows, frozenset({3}))


UNITS = (
    ("_rad_s", "rad/s"),
    ("_m_s2", "m/s²"),
    ("_m_s", "m/s"),
    ("_deg", "°"),
    ("_rad", "rad"),
    ("_hpa", "hPa"),
    ("_ut", "µT"),
    ("_m", "m"),
    ("_s", "s"),
)


def _state_name(name: str) -> str:
    for suffix, unit in UNITS:
        if name.endswith(suffix):
            return f"{sensor_first(name.removesuffix(suffix))} [{unit}]"
    return sensor_first(name)


def sensor_first(name: str) -> str:
    """``gnss_time_offset`` -> ``GNSS time offset``."""
    first, *rest = name.split("_")
    return " ".join([first.upper() if first in ("gnss", "imu") else capital(first), *rest])


def _values(value: Any) -> str:
    items = value if isinstance(value, list | tuple) else [value]
    return ", ".join(number(v) for v in items)


def initialisation(summary: Summary) -> tuple[str, Table]:
    """How the start was found, in a sentence, and what else is known of it."""
    start = summary.get("initialisation")
    if isinstance(start, str):
        return capital(start), Table(("", ""), [])
    table = room(summary, "initialisation")
    sentence = capital(str(table.get("sentence") or ""))
    rest = {k: v for k, v in table.items() if k != "sentence" and not isinstance(v, Mapping)}
    rows = [
        Row([_state_name(k), str(v) if as_float(v) is None and not isinstance(v, list) else _values(v)])
        for k, v in rest.items()
    ]
    return sentence, Table(("", ""), rows)


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


def timings_table(summary: Summary) -> Table:
    return Table(("Step", "Seconds"), [Row([capital(k), fixed(v, 3)]) for k, v in timings(summary).items()])


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
    """Normalised squared errors beside what an honest covariance gives: the number of components."""
    rows = [
        Row([capital(k), number(v), "1" if k == "yaw" else "3"])
        for k, v in room(facts, "nees").items()
        if as_float(v) is not None
    ]
    return Table(("Mean NEES", "Found", "Expected"), rows)
