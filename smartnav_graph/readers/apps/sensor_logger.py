"""Sensor Logger (Kelvin Choi; Android and iOS): folder or archive of CSV files, one a sensor, or one file of all, JSON
or CSV, with a column ``sensor`` or with columns such as Gyroscope_x.

Units and signs as its page UNITS.md and CROSSPLATFORM.md say: m/s^2, rad/s, uT, mbar; Unix nanoseconds. Android writes
the acceleration with gravity to TotalAcceleration, without it to Accelerometer; iOS writes only the latter, and both
it and Gravity with the opposite sign, AccelerometerUncalibrated in g, unless the units were standardised.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from smartnav_graph.core.errors import SessionError, warn
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.readers.axes import sign_by_turn
from smartnav_graph.readers.fixes import LoggedFixes
from smartnav_graph.readers.log_session import LogParts, log_session
from smartnav_graph.readers.samples import Samples, in_time_order, summed
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.text import TextTable, read_bytes, read_text
from smartnav_graph.readers.text_lines import head_of, heading_of
from smartnav_graph.session.session import Session

_SENSORS = (
    *("Accelerometer", "TotalAcceleration", "Gravity", "AccelerometerUncalibrated", "Gyroscope"),
    *("GyroscopeUncalibrated", "Magnetometer", "MagnetometerUncalibrated", "Barometer"),
    *("Location", "LocationGps", "LocationNetwork"),
)
_METADATA = "Metadata"
_LOCATION = (
    *("time", "seconds_elapsed", "latitude", "longitude", "altitude", "horizontalaccuracy", "verticalaccuracy"),
    *("speed", "speedaccuracy", "bearing", "bearingaccuracy", "altitudeabovemeansealevel"),
)


def _csv_files(folder: Path) -> dict[str, Path]:
    """Files of known sensors in a folder, by name, with the heading of the app."""
    if not folder.is_dir():
        return {}
    found = {file.stem.lower(): file for file in sorted(folder.iterdir()) if file.suffix.lower() == ".csv"}
    return {name: file for name in (*_SENSORS, _METADATA) if (file := found.get(name.lower())) is not None}


def _is_ours(file: Path) -> bool:
    return {"time", "seconds_elapsed"} <= {name.lower() for name in heading_of(file)}


def _is_json(path: Path) -> bool:
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    head = "".join(head_of(path).lower().split())
    records = '"seconds_elapsed"' in head or '"values"' in head
    return records and any(f'{key}:"{name.lower()}"' in head for key in ('"sensor"', '"name"') for name in _SENSORS)


def _matches(source: str) -> bool:
    try:
        path = Path(source)
        if path.is_file() and path.suffix.lower() in (".csv", ".txt"):
            return bool(_combined_columns(heading_of(path)))
        return _is_json(path) or any(_is_ours(file) for name, file in _csv_files(path).items() if name != _METADATA)
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    path = Path(source)
    if _is_json(path):
        tables, about = _of_json(path)
    elif path.is_file():
        tables, about = _of_combined(path), {}
    else:
        tables = {}
        for name, file in _csv_files(path).items():
            if name != _METADATA and file.stat().st_size > 0 and _has_rows(file):
                tables[name] = _small_letters(read_text(file, whole=True))
        about = _metadata(path)
    parts = LogParts()
    samples = {name: _vector(table, repairs) for name, table in tables.items() if {"x", "y", "z"} <= set(table.cells)}
    if "Magnetometer" in samples:
        parts.add_magnetometer(samples["Magnetometer"])
    elif "MagnetometerUncalibrated" in samples:
        parts.count("magnetometer", {"uncalibrated left out": len(samples["MagnetometerUncalibrated"])})
    if "Barometer" in tables and "pressure" in tables["Barometer"].cells:
        table = tables["Barometer"]
        parts.add_single("barometer", "pressure_hpa", _samples(table, ("pressure",), repairs))
    for name, table in tables.items():
        if not (name in samples or name.startswith("Location") or "pressure" in table.cells):
            parts.count("session", {f"of {name} left out: no columns x, y, z or pressure": len(table)})
    location = next((tables[name] for name in ("Location", "LocationGps", "LocationNetwork") if name in tables), None)
    fixes = None if location is None else replace(_fixes(location), above_sea=_is_ios(about))
    if location is not None and fixes is not None:
        parts.add_fixes(location.path, fixes, location.skipped)
        parts.count("gnss", {f"column {name} not used": 1 for name in location.cells if name not in _LOCATION})
    _add_imu(path, parts, samples, about, fixes)
    device = about.get("device name") or about.get("devicename") or about.get("platform") or "Sensor Logger"
    return log_session(parts, repairs, name=device, epoch="unix")


def _combined_columns(heading: list[str]) -> dict[str, dict[str, str]]:
    """Columns of a file of all sensors, by sensor: heading to name in the sensor's own file. Of a file with a column
    `sensor`, under its name.  Empty for other files."""
    names = {name.lower(): name for name in heading}
    if not {"time", "seconds_elapsed"} <= set(names):
        return {}
    stamp = names["time"]
    if "sensor" in names:
        return {"sensor": {name: name.lower() for name in heading}}
    found: dict[str, dict[str, str]] = {}
    for name in heading:
        sensor, _, own = name.replace(".", "_").replace(" ", "_").partition("_")
        known = next((known for known in _SENSORS if known.lower() == sensor.lower()), None)
        if known is not None and own:
            found.setdefault(known, {stamp: "time"})[name] = own.lower()
    return found


def _of_combined(path: Path) -> dict[str, TextTable]:
    """Tables by sensor of one CSV file: rows with readings of a sensor, or rows of the sensor that they name."""
    table = read_text(path, whole=True)
    columns = _combined_columns(list(table.cells))
    tables: dict[str, TextTable] = {}
    if "sensor" in columns:
        cells = {own: table.cells[name] for name, own in columns["sensor"].items()}
        whole = TextTable(path, cells, table.skipped)
        present = {str(name).lower() for name in set(whole.texts("sensor"))}
        for sensor in _SENSORS:
            if sensor.lower() in present:
                rows = whole.rows(np.array([str(name).lower() == sensor.lower() for name in whole.texts("sensor")]))
                filled = {name: cells for name, cells in rows.cells.items() if not rows.is_empty(name)}
                tables[sensor] = TextTable(path, filled, rows.skipped)
        return tables
    for sensor, names in columns.items():
        own = TextTable(path, {short: table.cells[name] for name, short in names.items()}, table.skipped)
        read = np.any([own.known(short) for short in own.cells if short != "time"], axis=0)
        if read.any():
            tables[sensor] = own.rows(read)
    return tables


def _has_rows(file: Path) -> bool:
    """Whether a file is more than a heading; also where it is no text, which `read_text` says."""
    return not (head := head_of(file)) or len(head.strip().splitlines()) > 1


def _small_letters(table: TextTable) -> TextTable:
    names = [name.lower() for name in table.cells]
    if len(set(names)) < len(names):
        return table
    return TextTable(table.path, dict(zip(names, table.cells.values(), strict=True)), table.skipped)


def _metadata(folder: Path) -> dict[str, str]:
    """The only row of Metadata.csv by column, in small letters; empty without the file."""
    file = _csv_files(folder).get(_METADATA)
    rows = [] if file is None else list(csv.reader(head_of(file).splitlines()))
    return _about(dict(zip(rows[0], rows[1], strict=False))) if len(rows) > 1 else {}


def _about(values: Mapping[str, object]) -> dict[str, str]:
    return {name.strip().lower(): "" if value is None else str(value).strip() for name, value in values.items()}


def _of_json(path: Path) -> tuple[dict[str, TextTable], dict[str, str]]:
    """Tables by sensor, and the metadata, of a list of records ``{sensor, time, x, y, z}``, ``{sensor, time, values}``,
    or of the messages that the app pushes."""
    try:
        found = json.loads(read_bytes(path).decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise SessionError(path, f"is no JSON ({error})", "a whole JSON file", "export the recording again") from error
    rows: dict[str, list[dict[str, str]]] = {}
    about: dict[str, str] = {}
    known = {name.lower(): name for name in (*_SENSORS, _METADATA)}
    for record in _records(found):
        values = record.get("values")
        flat = _about({**record, **(values if isinstance(values, dict) else {})})
        name = known.get(str(record.get("sensor") or record.get("name") or "").lower())
        if name == _METADATA:
            about = flat
        elif name is not None:
            rows.setdefault(name, []).append(flat)
    if not rows:
        raise SessionError(path, "holds no record of a known sensor", "a list of {sensor, time, ...}", "export as JSON")
    tables = {}
    for name, of_sensor in rows.items():
        columns = [column for column in of_sensor[0] if column not in ("sensor", "name", "values")]
        tables[name] = TextTable.of(path, {column: [row.get(column, "") for row in of_sensor] for column in columns})
    return tables, about


def _records(found: object) -> Iterator[dict[str, object]]:
    """The records of a file, those inside messages too."""
    if isinstance(found, list):
        for record in found:
            yield from _records(record)
    elif isinstance(found, dict):
        if isinstance(found.get("payload"), list):
            yield from _records(found["payload"])
        else:
            yield found


def _vector(table: TextTable, repairs: tuple[str, ...]) -> Samples:
    return _samples(table, ("x", "y", "z"), repairs)


def _samples(table: TextTable, names: tuple[str, ...], repairs: tuple[str, ...]) -> Samples:
    table.require(["time", *names])
    stamped = table.known("time")
    rows = table if stamped.all() else table.rows(stamped)
    found = in_time_order(table.path, rows.times("time", 1), rows.floats(*names), repairs)
    counts = {**table.skipped, **({"without a stamp left out": int((~stamped).sum())} if not stamped.all() else {})}
    return Samples(found.file, found.t_ns, found.values, {**counts, **found.counts})


def _add_imu(
    path: Path,
    parts: LogParts,
    samples: Mapping[str, Samples],
    about: Mapping[str, str],
    fixes: LoggedFixes | None,
) -> None:
    gyro = samples.get("Gyroscope") or samples.get("GyroscopeUncalibrated")
    accel, sign_known = _specific_force(samples, about)
    if accel is not None and not sign_known:
        sign = 0.0 if gyro is None or fixes is None else sign_by_turn(accel, gyro, fixes)
        sign = _likely_sign(path, accel, sign)
        accel = Samples(accel.file, accel.t_ns, accel.values * sign, accel.counts)
    parts.add_inertial(path, gyro, accel, samples, wanted="Accelerometer" in samples)


def _is_ios(about: Mapping[str, str]) -> bool:
    """Whether a phone of Apple wrote it: its heights are above mean sea level, those of Android ellipsoidal."""
    return about.get("platform", "").lower() in ("ios", "ipados", "iphone")


def _specific_force(samples: Mapping[str, Samples], about: Mapping[str, str]) -> tuple[Samples | None, bool]:
    """Specific force m/s^2, and whether its sign is known: with gravity where the app has it, else the sum, else the
    uncalibrated one, whose unit shows the system."""
    ios = _is_ios(about)
    standard = about.get("standardisation", about.get("standardization", "")).lower() in ("true", "1", "yes", "on")
    sign, unit = (1.0 if standard or not ios else -1.0), (1.0 if standard or not ios else STANDARD_GRAVITY)
    if "TotalAcceleration" in samples:
        found = samples["TotalAcceleration"]
    elif "Accelerometer" in samples and "Gravity" in samples:
        found = summed(samples["Accelerometer"], samples["Gravity"])
    elif "AccelerometerUncalibrated" in samples:
        found = samples["AccelerometerUncalibrated"]
        if not about:  # units of iOS show the system
            unit = STANDARD_GRAVITY if np.median(np.linalg.norm(found.values, axis=1)) < 3.0 else 1.0
            sign = -1.0 if unit != 1.0 else 1.0
            return Samples(found.file, found.t_ns, found.values * sign * unit, found.counts), True
        sign *= unit
    else:
        return None, True
    known = bool(about) or "TotalAcceleration" in samples
    return Samples(found.file, found.t_ns, found.values * sign, found.counts), known


def _likely_sign(path: Path, force: Samples, by_turn: float) -> float:
    """Sign of iOS or Android where the log does not say which: by the turns, else a phone lies on its back, or its top
    is up."""
    middle = np.median(force.values, axis=0)
    sign = by_turn or (-1.0 if middle[int(np.argmax(np.abs(middle)))] < 0 else 1.0)
    system = "iOS (opposite sign)" if sign < 0 else "Android"
    how = "turns of the gyroscope and the course of the fixes agree so"
    if not by_turn:
        how = "a phone mostly lies on its back or with its top up; else give the Metadata.csv of the app"
    warn(f"{path}: no Metadata: taken as of {system}: {how}")
    return sign


def _fixes(table: TextTable) -> LoggedFixes:
    table.require(["time", "latitude", "longitude"])
    table = table.rows(table.known("time"))

    return LoggedFixes(
        table.times("time", 1),
        table.floats("latitude"),
        table.floats("longitude"),
        height=table.optional("altitude"),
        horizontal=table.optional("horizontalaccuracy"),
        vertical=table.optional("verticalaccuracy"),
        speed=table.optional("speed"),
        course=table.optional("bearing"),
        speed_sigma=table.optional("speedaccuracy"),
        course_sigma=table.optional("bearingaccuracy"),
    )


READER = Reader(
    name="sensor-logger",
    summary="Sensor Logger app (Android, iOS): CSV folder, zip or JSON",
    recognised_by="CSV files such as Gyroscope.csv with columns time and seconds_elapsed, or its JSON",
    matches=_matches,
    read_source=_read,
)
