"""Headline, warnings and tables of summary.json. Nothing is claimed that the summary does not hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from smartnav_graph.factors import title_of
from smartnav_graph.output.summary_json import (
    GAP_KINDS,
    ImuGap,
    Summary,
    as_float,
    imu_gaps,
    numbers_of,
    other_warnings,
    table_of,
    text_of,
)
from smartnav_graph.output.text import (
    Row,
    Table,
    capital,
    count,
    distance,
    duration,
    fixed,
    metres,
    number,
    plural,
    seconds,
)

MOST_REJECTED = 0.25  # share of a sensor's measurements that may be outliers
MODES = {
    "batch": "smoothed in one batch",
    "replay": "replayed one window at a time",
    "dead-reckoning": "processed by dead reckoning",
    "visual-inertial": "processed by visual-inertial odometry",
}


def gap_sentence(gap: ImuGap) -> str:
    """One IMU data gap as a sentence."""
    kind = GAP_KINDS.get(gap.kind, gap.kind)
    return f"IMU data gap at {fixed(gap.start_s, 1)} s, {fixed(gap.length_s, 2)} s, {kind}"


@dataclass(frozen=True)
class Uncertainty:
    """One-sigma horizontal position over the run: median, largest and when, metres and seconds."""

    median_m: float
    largest_m: float
    largest_at_s: float


def headline(summary: Summary, uncertainty: Uncertainty | None = None) -> list[str]:
    """The result of the run in a few sentences."""
    sentences = [_processing(summary), _accuracy(summary, uncertainty), _left_out(summary), *_withheld(summary)]
    return [sentence for sentence in sentences if sentence]


def _processing(summary: Summary) -> str:
    kind, _, how = text_of(summary, "mode").replace(" odometry", "").partition(" ")
    done = MODES.get(kind, f"processed ({kind})") if kind else "smoothed"
    done += f" ({how.strip(' ,')})" if how else ""
    over = f" over {distance(summary['path_m'])}" if as_float(summary.get("path_m")) is not None else ""
    long = f" of {duration(summary['duration_s'])}" if as_float(summary.get("duration_s")) is not None else ""
    at = f" at {plural(summary['keyframes'], 'epoch')}" if as_float(summary.get("keyframes")) is not None else ""
    relative = kind in ("dead-reckoning", "visual-inertial")
    tail = "; there is no absolute position measurement, so the uncertainty grows with time" * relative
    return f"The recording{long}{over} was {done}{at}{tail}."


def _accuracy(summary: Summary, uncertainty: Uncertainty | None) -> str:
    failed = "The solver did not converge: do not rely on this result. " * (summary.get("converged") is False)
    unknown = " The heading is unknown." * (summary.get("heading_known") is False)
    if uncertainty is None:
        return (failed + unknown).strip()
    return (
        f"{failed}Horizontal position, 1 sigma: median {metres(uncertainty.median_m)}, largest "
        f"{metres(uncertainty.largest_m)} at t = {seconds(uncertainty.largest_at_s)}.{unknown}"
    )


def _left_out(summary: Summary) -> str:
    sentences = []
    rejected = [f"{title_of(name)} {count(n)}" for name, n in numbers_of(summary, "rejected").items() if n]
    if "rejected" in summary:
        sentences.append(
            f"Rejected as outliers: {', '.join(rejected)}." if rejected else "No measurement was rejected."
        )
    gaps = imu_gaps(summary)
    if "gaps" in summary:
        total = f"{count(len(gaps))}, {fixed(sum(gap.length_s for gap in gaps), 1)} s in all"
        sentences.append(f"IMU data gaps: {total}." if gaps else "No IMU data gaps.")
    return " ".join(sentences)


def _withheld(summary: Summary) -> list[str]:
    sentences = []
    for name in table_of(summary, "withheld"):
        score = numbers_of(table_of(summary, "withheld"), name)
        if score.get("count"):
            rms = f", RMS difference {metres(score['rms_horizontal_m'])} (horizontal)" * ("rms_horizontal_m" in score)
            sentences.append(f"Withheld {title_of(name)}: {plural(score['count'], 'measurement')}{rms}.")
    return sentences


def warnings(summary: Summary) -> list[tuple[str, str]]:
    """(what is wrong, what to do about it). A message ``found; expected; remedy`` is split at its first semicolon."""
    texts = [_with_label(text) for text in other_warnings(summary) if text.strip()]
    if any(w.startswith(("Dead reckoning", "Visual-inertial odometry")) for w in texts):  # the same with a consequence
        texts = [w for w in texts if not w.startswith("Session: no absolute sensor")]
    if summary.get("converged") is False and not any("converge" in w or "iteration limit" in w for w in texts):
        texts.insert(
            0,
            f"The solver stopped after {plural(summary.get('iterations'), 'iteration')} without converging; "
            "look at the residuals below, exclude the sensor that does not fit, or give --initial",
        )
    overall = numbers_of(summary, "chi2_per_dof").get("overall")
    if overall is not None and overall > 3.0 and not any("chi" in w for w in texts):
        texts.append(
            f"Residuals are larger than the stated noise (chi2 per degree of freedom {number(overall)}, expected 1); "
            "the sigmas in this report are too small by about its square root: set the noise in calibration.toml"
        )
    texts += _mostly_rejected(summary)
    return [(first.strip(), capital(rest.strip())) for first, _, rest in (w.partition(";") for w in texts)]


def _mostly_rejected(summary: Summary) -> list[str]:
    """Sensors with more rejections than outliers explain."""
    texts = []
    for name, used in numbers_of(summary, "used").items():
        rejected = numbers_of(summary, "rejected").get(name, 0.0)
        if rejected > MOST_REJECTED * (used + rejected):
            texts.append(
                f"{title_of(name)}: {count(rejected)} of {count(used + rejected)} measurements rejected, too many for "
                "outliers; they or the rest of the run are wrong: look at the residuals over time, and smooth this "
                "time span by itself (--from, --to)"
            )
    return texts


def _with_label(warning: str) -> str:
    """``imu: 1 stretch ..`` -> ``IMU: 1 stretch ..``."""
    first, colon, rest = warning.partition(": ")
    return f"{title_of(first)}: {rest}" if colon and first.isidentifier() else capital(warning)


def chi2_by_sensor(summary: Summary) -> dict[str, float]:
    """chi2 per degree of freedom by sensor."""
    return {name: value for name, value in numbers_of(summary, "chi2_per_dof").items() if name != "overall"}


def withheld_counts(summary: Summary) -> dict[str, float]:
    """How many measurements of each sensor were withheld."""
    withheld = table_of(summary, "withheld")
    return {name: numbers_of(withheld, name).get("count", 0.0) for name in withheld if table_of(withheld, name)}


def solver_table(summary: Summary) -> Table:
    """Cost, iterations, speed and memory."""
    update, polish = table_of(summary, "update_ms"), table_of(summary, "polish")
    change = f"{metres(polish.get('largest_change_m'))}, {number(polish.get('largest_change_deg'))}°"
    entries = [
        ("Converged", "converged", "yes" if summary.get("converged") else "no"),
        ("Passes", "passes", count(summary.get("passes"))),
        ("Iterations", "iterations", count(summary.get("iterations"))),
        ("χ² per degree of freedom", "chi2_per_dof", number(table_of(summary, "chi2_per_dof").get("overall"))),
        ("Real-time factor (recorded / computing time)", "real_time_factor", _speed(summary)),
        (
            "Update, median / 99 % / largest",
            "update_ms",
            " / ".join(number(update.get(k)) for k in ("median", "p99", "max")) + " ms",
        ),
        ("Data used before the first output", "delay_s", seconds(summary.get("delay_s"))),
        ("Largest change by the final batch solution", "polish", change),
        ("Peak memory", "peak_memory_mb", f"{count(summary.get('peak_memory_mb'))} MB"),
    ]
    return Table(("", ""), [Row([name, text]) for name, key, text in entries if summary.get(key) not in (None, {})])


def _speed(summary: Summary) -> str:
    """Recorded over computing seconds, of the total time where it is known."""
    total, recorded = numbers_of(summary, "timings_s").get("total"), as_float(summary.get("duration_s"))
    if total and recorded:
        return f"{number(recorded / total)} ×"
    return number(summary.get("real_time_factor"))


def timing_name(name: str, known: Mapping[str, float]) -> str:
    """A part of the computation; a report that is written with the other files cannot know how long writing takes."""
    return "Total, without writing" if name == "total" and "write" not in known else capital(name)


def timings_table(summary: Summary) -> Table:
    """Seconds of each part of the computation."""
    known = numbers_of(summary, "timings_s")
    return Table(("Part", "Seconds"), [Row([timing_name(k, known), fixed(v, 3)]) for k, v in known.items()])


def versions_table(summary: Summary) -> Table:
    """Versions of Python and of the packages."""
    return Table(("", ""), [Row([k, str(v)]) for k, v in table_of(summary, "versions").items()], frozenset({1}))
