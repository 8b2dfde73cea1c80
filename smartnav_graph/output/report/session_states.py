"""States of the session (clock offsets, mounts, scales, noise) and the initialisation: sentences and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from smartnav_graph.factors import title_of
from smartnav_graph.output.summary_json import Summary, as_float, list_of, table_of, text_of
from smartnav_graph.output.text import DASH, Row, Table, capital, number, seconds

DEG = float(np.degrees(1.0))


class Part(NamedTuple):
    """One number of a state: its name, the unit it is shown in, and the factor from SI to that unit."""

    label: str
    unit: str = ""
    factor: float = 1.0


BODY = ("x", "y", "z")
PARTS: Mapping[str, Sequence[Part]] = {
    "vehicle_mount": (
        Part("Vehicle mount, pitch", "°", DEG),
        Part("Vehicle mount, yaw", "°", DEG),
        Part("Rear axle, forward of the IMU", "m"),
        Part("Rear axle, left of the IMU", "m"),
        Part("Rear axle, above the IMU", "m"),
        Part("Lever arm of the pitch motion", "m"),
        Part("Tyre slip per acceleration", "°/(m/s²)", DEG),
        Part("Suspension pitch per acceleration", "°/(m/s²)", DEG),
    ),
    "wheel_scale_and_delay_s": (Part("Wheel speed, scale", "%", 100.0), Part("Wheel speed, delay", "s")),
    "step_factor": (Part("Step factor, forward"), Part("Step factor, left")),
    "imu_scale_misalignment": tuple(
        Part(f"{sensor}, {'scale' if i == j else 'misalignment'} {i}{'' if i == j else j}", "%", 100.0)
        for sensor in ("Accelerometer", "Gyroscope")
        for i in BODY
        for j in BODY
    ),
    "accel_noise_density": (Part("Accelerometer noise density", "m/s²/√Hz"),),
    "gyro_noise_density": (Part("Gyroscope noise density", "°/s/√Hz", DEG),),
    "accel_bias_walk": (Part("Accelerometer bias walk", "m/s²/√s"),),
    "gyro_bias_walk": (Part("Gyroscope bias walk", "°/s/√s", DEG),),
    "vehicle_lateral_sigma": (Part("Lateral velocity of the vehicle, 1 sigma", "m/s"),),
    "vehicle_vertical_sigma": (Part("Vertical velocity of the vehicle, 1 sigma", "m/s"),),
    "wheel_sigma": (Part("Wheel speed, 1 sigma", "m/s"),),
}
UNITS = (
    ("_rad_s", "°/s", DEG),
    ("_m_s2", "m/s²", 1.0),
    ("_m_s", "m/s", 1.0),
    ("_deg", "°", 1.0),
    ("_rad", "°", DEG),
    ("_hpa", "hPa", 1.0),
    ("_ut", "µT", 1.0),
    ("_m", "m", 1.0),
    ("_s", "s", 1.0),
)
CLOCK = "_time_offset_s"
NOISE = ("_sigma", "_sigma_m", "_noise_density", "_bias_walk")


def parts_of(name: str, size: int) -> list[Part]:
    """Label and unit of each of the `size` numbers of a state; the unit is the suffix of its name."""
    known = PARTS.get(name, ())
    if len(known) == size:
        return list(known)
    stem, unit, factor = next(
        ((name.removesuffix(suffix), unit, factor) for suffix, unit, factor in UNITS if name.endswith(suffix)),
        (name, "", 1.0),
    )
    name_of_all = named(stem)
    if size == 1:
        return [Part(name_of_all, unit, factor)]
    axes = ("east", "north", "up") if name.endswith(NOISE) else BODY
    letters = axes if size == 3 else [str(i + 1) for i in range(size)]
    return [Part(f"{name_of_all}, {letter}", unit, factor) for letter in letters]


def named(name: str) -> str:
    """``gnss_time_offset`` -> ``GNSS time offset``, ``gnss_sigma`` -> ``GNSS 1 sigma``."""
    first, *rest = name.split("_")
    words = [first.upper() if first in ("gnss", "imu") else capital(first), *rest]
    return " ".join("1 sigma" if word == "sigma" else word for word in words)


def tables(summary: Summary) -> list[tuple[str, Table]]:
    """Tables with titles: clock offsets, mounts and scales, noise; without the empty ones."""
    groups: dict[str, list[Row]] = {"Clock offsets": [], "Mounts and scales": [], "Noise": []}
    for name, state in _states(summary):
        if state:
            kind = "Clock offsets" if name.endswith(CLOCK) else "Noise" if name.endswith(NOISE) else "Mounts and scales"
            groups[kind] += _rows(name, state)
    return [
        (title, Table((title, "Value", "1 sigma", ""), rows, frozenset({3}))) for title, rows in groups.items() if rows
    ]


def _states(summary: Summary) -> list[tuple[str, Summary]]:
    states = table_of(summary, "states")
    return [(name, table_of(states, name)) for name in states]


def _rows(name: str, state: Summary) -> list[Row]:
    values, sigmas, observed = (list_of(state, key) for key in ("value", "sigma", "observed"))
    fixed, rows = bool(state.get("held")), []
    for i, part in enumerate(parts_of(name, len(values))):
        value, sigma = as_float(values[i]), as_float(sigmas[i]) if i < len(sigmas) else None
        unobservable = i < len(observed) and observed[i] is False
        how = "fixed" if fixed else "not observable (prior only)" if unobservable else "estimated"
        shown = DASH if fixed or sigma is None else number(sigma * part.factor)
        title = f"{part.label} [{part.unit}]" if part.unit else part.label
        data = {"state": name, "value": value, "sigma": sigma, "fixed": str(fixed).lower()}
        rows.append(Row([title, number(None if value is None else value * part.factor), shown, how], data))
    return rows


def clock_sentences(summary: Summary) -> list[str]:
    """The meaning of each estimated clock offset."""
    sentences = []
    for name, state in _states(summary):
        value, sigma = ([as_float(x) for x in list_of(state, key)] for key in ("value", "sigma"))
        if not name.endswith(CLOCK) or state.get("held") or not value or value[0] is None:
            continue
        spread = f" (1 sigma {_milli(sigma[0])})" if sigma and sigma[0] is not None else ""
        side = "later" if value[0] >= 0 else "earlier"
        sensor = title_of(name.removesuffix(CLOCK))
        sentences.append(f"{sensor}: measured {_milli(abs(value[0]))} {side} than the time stamp{spread}.")
    return sentences


def _milli(value: float) -> str:
    return f"{number(1000 * value, 2)} ms" if abs(value) < 1 else seconds(value, 2)


START = {
    "method": "Method",
    "heading_deg": "Heading [°]",
    "sigma_heading_deg": "1 sigma of the heading [°]",
    "stretch_s": "Data used [s]",
    "starts": "Initial guesses tried",
}


def initialisation(summary: Summary) -> tuple[str, Table]:
    """The initialisation: a sentence, and a table of the rest."""
    start = summary.get("initialisation")
    if isinstance(start, str):
        return plain_units(capital(start)), Table(("", ""), [])
    table = table_of(summary, "initialisation")
    sentence = plain_units(capital(text_of(table, "sentence")))
    rest = {k: v for k, v in table.items() if k != "sentence" and not isinstance(v, Mapping)}
    return sentence, Table(("", ""), [Row([START.get(k, named(k)), _shown(v)]) for k, v in rest.items()])


def plain_units(text: str) -> str:
    """``30.6 deg +- 1.6 deg`` -> ``30.6° ± 1.6°``."""
    return text.replace(" deg", "°").replace("+-", "±").replace("±°", "± °")


def _shown(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(number(v) for v in value)
    if isinstance(value, int):
        return str(value)
    return str(value) if as_float(value) is None else number(value)
