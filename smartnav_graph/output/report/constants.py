"""What a run found once and for all (clock offsets, mounts, scales, noise) and how it began, in words and rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from smartnav_graph.output.report.facts import Summary, room, sensor_name, things
from smartnav_graph.output.report.text import DASH, Row, Table, as_float, capital, number, seconds

DEG = float(np.degrees(1.0))


class Part(NamedTuple):
    """One number of a state: what it is, the unit it is told in, and units told in one SI unit."""

    label: str
    unit: str = ""
    factor: float = 1.0


BODY = ("x", "y", "z")
PARTS: Mapping[str, Sequence[Part]] = {
    "vehicle_mount": (
        Part("Vehicle's axes in the device, pitch", "°", DEG),
        Part("Vehicle's axes in the device, yaw", "°", DEG),
        Part("Rear axle, forward of the IMU", "m"),
        Part("Rear axle, left of the IMU", "m"),
        Part("Rear axle on the road, above the IMU", "m"),
        Part("Lever arm of the pitching body", "m"),
        Part("Slip of the tyres", "°/(m/s²)", DEG),
        Part("Squat of the springs", "°/(m/s²)", DEG),
    ),
    "wheel_scale_and_delay_s": (Part("Wheel speed, scale", "%", 100.0), Part("Wheel speed, delay", "s")),
    "step_factor": (Part("Step factor, ahead"), Part("Step factor, to the left")),
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
    "vehicle_lateral_sigma": (Part("Sideways speed of a vehicle, 1 sigma", "m/s"),),
    "vehicle_vertical_sigma": (Part("Vertical speed of a vehicle, 1 sigma", "m/s"),),
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
    label = named(stem)
    if size == 1:
        return [Part(label, unit, factor)]
    axes = ("east", "north", "up") if name.endswith(NOISE) else BODY
    letters = axes if size == 3 else [str(i + 1) for i in range(size)]
    return [Part(f"{label}, {letter}", unit, factor) for letter in letters]


def named(name: str) -> str:
    """``gnss_time_offset`` -> ``GNSS time offset``, ``gnss_sigma`` -> ``GNSS 1 sigma``."""
    first, *rest = name.split("_")
    words = [first.upper() if first in ("gnss", "imu") else capital(first), *rest]
    return " ".join("1 sigma" if word == "sigma" else word for word in words)


def constants(summary: Summary) -> list[tuple[str, Table]]:
    """Titled tables: clocks, mounts and scales, noise; only those that a run has."""
    groups: dict[str, list[Row]] = {"Clock offsets": [], "Mounts and scales": [], "Noise": []}
    for name, state in room(summary, "states").items():
        if isinstance(state, Mapping):
            kind = "Clock offsets" if name.endswith(CLOCK) else "Noise" if name.endswith(NOISE) else "Mounts and scales"
            groups[kind] += _rows(name, state)
    return [
        (title, Table((title, "Value", "1 sigma", ""), rows, frozenset({3}))) for title, rows in groups.items() if rows
    ]


def _rows(name: str, state: Mapping[str, Any]) -> list[Row]:
    values, sigmas, seen = (_listed(state.get(key)) for key in ("value", "sigma", "observed"))
    held, rows = bool(state.get("held")), []
    for i, part in enumerate(parts_of(name, len(values))):
        value, sigma = as_float(values[i]), as_float(sigmas[i]) if i < len(sigmas) else None
        unseen = i < len(seen) and seen[i] is False
        how = "as given" if held else "rests on its prior" if unseen else "estimated"
        shown = DASH if held or sigma is None else number(sigma * part.factor)
        label = f"{part.label} [{part.unit}]" if part.unit else part.label
        data = {"state": name, "value": value, "sigma": sigma, "held": str(held).lower()}
        rows.append(Row([label, number(None if value is None else value * part.factor), shown, how], data))
    return rows


def _listed(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [] if value is None else [value]


def clock_sentences(summary: Summary) -> list[str]:
    """What each estimated clock offset means."""
    told = []
    for name, state in room(summary, "states").items():
        if not (name.endswith(CLOCK) and isinstance(state, Mapping)) or state.get("held"):
            continue
        value, sigma = (_listed(state.get(key)) for key in ("value", "sigma"))
        offset = as_float(value[0]) if value else None
        if offset is None:
            continue
        sensor = name.removesuffix(CLOCK)
        thing = things(sensor, 1).split(maxsplit=1)[-1]
        sure = f" (1 sigma {_milli(sigma[0])})" if sigma and as_float(sigma[0]) is not None else ""
        side = "later" if offset >= 0 else "earlier"
        article = "an" if thing[0] in "aeiou" else "a"
        told.append(
            f"{sensor_name(sensor)}: {article} {thing} was taken {_milli(abs(offset))} {side} than its stamp{sure}."
        )
    return told


def _milli(value: Any) -> str:
    v = as_float(value)
    return DASH if v is None else f"{number(1000 * v, 2)} ms" if abs(v) < 1 else seconds(v, 2)


START = {
    "method": "Method",
    "heading_deg": "Heading [°]",
    "sigma_heading_deg": "1 sigma of the heading [°]",
    "stretch_s": "Data it rests on [s]",
    "starts": "Starts that were tried",
}


def initialisation(summary: Summary) -> tuple[str, Table]:
    """How the start was found, in a sentence, and what else is known of it."""
    start = summary.get("initialisation")
    if isinstance(start, str):
        return plain_units(capital(start)), Table(("", ""), [])
    table = room(summary, "initialisation")
    sentence = plain_units(capital(str(table.get("sentence") or "")))
    rest = {k: v for k, v in table.items() if k != "sentence" and not isinstance(v, Mapping)}
    return sentence, Table(("", ""), [Row([START.get(k, named(k)), _told(v)]) for k, v in rest.items()])


def plain_units(text: str) -> str:
    """``30.6 deg +- 1.6 deg`` -> ``30.6° ± 1.6°``."""
    return text.replace(" deg", "°").replace("+-", "±").replace("±°", "± °")


def _told(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(number(v) for v in value)
    if isinstance(value, int):
        return str(value)
    return str(value) if as_float(value) is None else number(value)
