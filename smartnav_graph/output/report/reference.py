"""Comparison with a reference trajectory: sentences and tables."""

from __future__ import annotations

import math

from smartnav_graph.output.summary_json import Summary, as_float, numbers_of, rows_of, table_of, text_of
from smartnav_graph.output.text import Row, Table, capital, listed, number, plural, seconds


def matched_sentence(compared: Summary) -> str:
    """Reference, alignment and how many epochs were matched."""
    align = text_of(compared, "align") or "none"
    how = "without alignment" if align == "none" else f"after {align} alignment"
    reference = (text_of(compared, "reference") or "the reference").replace("\\", "/").rsplit("/", 1)[-1]
    lost = as_float(compared.get("unmatched"))
    rest = f", {plural(lost, 'epoch')} of it outside the run" if lost else ""
    return f"Compared with {reference} at {plural(compared.get('matched'), 'epoch')} {how}{rest}."


def absolute_table(compared: Summary) -> Table:
    """Absolute pose errors: RMS, mean and percentiles."""
    keys = ("rmse", "mean", "p50", "p67", "p95", "max")
    rows = []
    for key, name in (("ape_m", "Position [m]"), ("rotation_deg", "Rotation [°]")):
        error = table_of(compared, key)
        if error:
            data = {"error": key} | {k: error.get(k) for k in keys}
            rows.append(Row([name, *(number(error.get(k)) for k in keys)], data))
    return Table(("Error", "RMS", "Mean", "50 %", "67 %", "95 %", "Largest"), rows)


def relative_table(compared: Summary) -> Table:
    """Relative pose errors over time intervals."""
    rows = [
        Row([seconds(r.get("delta_s"), 0), number(r.get("translation_m")), number(r.get("rotation_deg"))])
        for r in rows_of(compared, "rpe")
    ]
    return Table(("Over", "Translation [m]", "Rotation [°]"), rows)


def nees_table(compared: Summary) -> Table:
    """Mean NEES beside its expected value (the number of components), and the ratio of errors to sigmas."""
    rows = []
    for name, found, expected in _nees(compared):
        data = {"nees": name, "found": found}
        rows.append(Row([capital(name), number(found), str(expected), number(math.sqrt(found / expected), 2)], data))
    return Table(("Mean NEES", "Found", "Expected", "Errors / sigma"), rows)


def _nees(compared: Summary) -> list[tuple[str, float, int]]:
    known = numbers_of(compared, "nees")
    return [(name, value, 1 if name == "yaw" else 3) for name, value in known.items() if value >= 0]


def nees_sentence(compared: Summary) -> str:
    """Whether the sigmas agree with the errors."""
    if not _nees(compared):
        return ""
    if (text_of(compared, "align") or "none") != "none":
        return (
            "NEES compares errors with the sigmas of this report. After alignment it is not meaningful: the aligned "
            "path has errors also at the start of the run, where the sigmas are nearly zero."
        )
    far = [(name, math.sqrt(v / n)) for name, v, n in _nees(compared) if v > 2.0 * n]
    if not far:
        return "NEES compares errors with the sigmas of this report: the sigmas are as large as the errors, or larger."
    errors = listed([f"{name} errors are {number(times, 2)} times their sigma" for name, times in far])
    return (
        f"NEES compares errors with the sigmas of this report: {errors}. Either the sigmas are too small, or the "
        "reference is offset: check its datum, its antenna or body point (--body-T-ref) and its clock (--time-offset)."
    )
