"""What a file of no known format looks like, and the description of its columns that may fit."""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.positions.headings import roles_in
from smartnav_graph.readers.source import first_bytes
from smartnav_graph.readers.stamps import is_date, ns_from_date
from smartnav_graph.readers.text_lines import head_of, missing_marks, text_rows
from smartnav_graph.readers.units import ACCELERATION, ANGULAR_RATE, FLUX_DENSITY, TIME_NS, quantity_in, unit_in

# First bytes of files that hold no text.
_KINDS = (
    (b"PK\x03\x04", "a zip archive"),
    (b"SQLite format 3", "an SQLite database"),
    (b"\x89HDF", "an HDF5 or MATLAB 7.3 file"),
    (b"MATLAB 5.0", "a MATLAB file"),
    (b"ULog\x01", "a PX4 ulog"),
    (b"#ROSBAG V2.0", "a ROS 1 bag"),
    (b"\x89MCAP", "an MCAP file"),
    (b"\xb5b", "a u-blox binary log"),
    (b"PAR1", "a Parquet file"),
    (b"\x1f\x8b", "a gzip file"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"\x89PNG", "a PNG picture"),
)
# Words of a heading or of the first lines -> the app that writes them.
_APPS = {
    "seconds_elapsed": "Sensor Logger",
    "ACCELEROMETER X": "AndroSensor",
    "loggingTime": "SensorLog",
    "HyperIMU": "HyperIMU",
    "gFx": "Physics Toolbox",
    "UncalAccel": "GnssLogger",
    "$FLYS": "FlySight",
    "RINEX VERSION": "RINEX of a receiver (observations, no positions)",
    "<kml": "KML",
}
_VECTOR = re.compile(r"(.*?)[\s_.:\-\[(]*([xyz])([\s_.\[(\])].*|)$", re.IGNORECASE)
# Words of a heading -> the letter of its quantity; vectors that are derived from the sensors are none of them.
_WORDS = {
    "m": r"mag|compass|^[mb]$|field",
    "a": r"acc|force|^a$|^gf$",
    "g": r"gyr|rotationrate|omega|^[gw]$|^rate|rate$",
}
_DERIVED = re.compile(r"orient|quat|vector|linear|user|gravity|delta|euler|attitude")
# Median size of a vector -> what it may be: letter of the quantity, least, most, unit.
_SIZES = (
    *(("a", 6.0, 16.0, "m/s2"), ("a", 0.6, 1.6, "g"), ("a", 600.0, 1600.0, "mg")),
    *(("m", 20.0, 90.0, "ut"), ("m", 0.2, 0.9, "gauss"), ("m", 200.0, 900.0, "mgauss"), ("m", 2e4, 9e4, "nt")),
)
_FAST_RATE = 10.0  # rad/s; a phone hardly turns faster, so that such numbers are degrees


@dataclass(frozen=True)
class UnknownFile:
    """What was seen in a file: lines of text, and a description of its columns where one may fit."""

    path: Path
    seen: tuple[str, ...]
    columns: str = ""

    def one_line(self) -> str:
        """What was seen, in one line."""
        return "; ".join(self.seen)


def describe_unknown(source: str | Path) -> UnknownFile:
    """What a file or folder of no known format looks like; nothing is raised."""
    path = Path(source)
    if path.is_dir():
        return _folder(path)
    data = first_bytes(str(path))
    if not data:
        return UnknownFile(path, ("an empty file",))
    kind = next((name for start, name in _KINDS if data.startswith(start)), None)
    if kind is None and data[4:8] == b"ftyp":
        kind = "a video or picture (MP4, HEIC)"
    text = "" if kind else head_of(path)
    if kind or not text:
        return UnknownFile(path, (kind or "a binary file",))
    app = next((name for word, name in _APPS.items() if word.lower() in text[:4096].lower()), None)
    likely = (f"likely of {app}",) if app else ()
    start = text.lstrip()[:1]
    if start in ("{", "[", "<"):
        return UnknownFile(path, (*likely, "XML" if start == "<" else "JSON"))
    return _table(path, text, likely)


def _folder(path: Path) -> UnknownFile:
    files = sorted(file for file in path.rglob("*") if file.is_file())
    if not files:
        return UnknownFile(path, ("an empty folder",))
    shown = [f"{file.relative_to(path)} ({describe_unknown(file).seen[0]})" for file in files[:6]]
    more = [f"and {len(files) - len(shown)} more"] if len(files) > len(shown) else []
    return UnknownFile(path, (f"a folder of {len(files)} files: {', '.join([*shown, *more])}",))


def _table(path: Path, text: str, likely: tuple[str, ...]) -> UnknownFile:
    rows = text_rows(path, lambda: iter([text.encode()]), with_heading=True, comments="#%@", whole=True)
    separator = rows.separator
    lines = b"".join(rows.blocks()).decode("utf-8", "replace").splitlines()
    split = (line.split() if separator == " " else next(csv.reader([line], delimiter=separator)) for line in lines)
    cells = [[cell.strip() for cell in row] for row in split if row]
    first = rows.heading.decode("utf-8", "replace").strip()
    names = [n.strip().strip('"') for n in (first.split() if separator == " " else first.split(separator))]
    if all(_number(name) is not None for name in names):  # no heading
        cells.insert(0, names)
        names = [f"#{i + 1}" for i in range(len(names))]
    marks = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "blank"}
    what = f"{marks.get(separator, separator)} separated text with {len(names)} columns"
    kept = [row for row in cells if len(row) >= len(names)]
    if len(names) < 2 or len(kept) < 3:
        return _rows_amid_text(path, text, likely) or UnknownFile(
            path, (*likely, f"text without a table of at least three rows ({what})")
        )
    columns = {name: [row[i] for row in kept] for i, name in enumerate(names)}
    shown = f"{what}: {', '.join(names[:12])}" + (f" and {len(names) - 12} more" if len(names) > 12 else "")
    return _fitting(path, (*likely, shown), columns)


def _rows_amid_text(path: Path, text: str, likely: tuple[str, ...]) -> UnknownFile | None:
    """Of a file whose rows come after lines of other text: the most frequent kind of row; None where there is none."""
    lines = [line.strip() for line in text.splitlines()]
    kinds = Counter((mark, line.count(mark)) for line in lines for mark in ",;\t" if line.count(mark) > 1)
    if not kinds:
        return None
    (mark, count), rows = kinds.most_common(1)[0]
    if rows < 3:
        return None
    table = [line.split(mark) for line in lines if line.count(mark) == count]
    shown = f"rows of {count + 1} cells without headings, among lines of other text"
    columns = {f"#{i + 1}": [row[i].strip() for row in table] for i in range(count + 1)}
    seen = _fitting(path, (*likely, shown), columns)
    return UnknownFile(path, (*seen.seen, "delete the other lines to describe the columns"))


def _number(text: str) -> float | None:
    try:
        return float("nan") if text.lower() in missing_marks() else float(text.replace(",", "."))
    except ValueError:
        return None


def _fitting(path: Path, seen: tuple[str, ...], columns: dict[str, list[str]]) -> UnknownFile:
    """The quantities that the columns may be."""
    numbers = {name: values for name, texts in columns.items() if (values := _numbers(texts)) is not None}
    found, items = list(seen), []
    time = _time_column(columns, numbers)
    if time is None:
        found.append("no column that grows like a time")
    else:
        name, unit, rate = time
        items.append(f"time={_item(name)}:{unit}")
        found.append(f"{name} may be the time in {unit}: {rate:.4g} Hz")
    for letter, names, unit, text in _vectors(numbers):
        found.append(text)
        suffix = f":{unit}" if unit else ""
        items += [f"{letter}{axis}={_item(name)}{suffix}" for axis, name in zip("xyz", names, strict=True) if letter]
    roles = roles_in(list(numbers))
    if {"lat", "lon"} <= roles.keys():
        known = {"lat": "lat", "lon": "lon", "up": "height", "sigma": "accuracy", "speed": "speed", "course": "course"}
        items += [f"{known[role]}={_item(name)}" for role, name in roles.items() if role in known]
        found.append(f"{roles['lat']} and {roles['lon']} may be fixes")
    return UnknownFile(path, tuple(found), ", ".join(items) if time is not None and len(items) > 1 else "")


def _item(name: str) -> str:
    """A heading as it is given in a description of columns."""
    return f'"{name}"' if "," in name else name


def _numbers(texts: list[str]) -> Floats | None:
    values = [_number(text) for text in texts]
    known = [value for value in values if value is not None]
    return np.array(known) if len(known) == len(values) and np.isfinite(known).any() else None


def _time_column(columns: dict[str, list[str]], numbers: dict[str, Floats]) -> tuple[str, str, float] | None:
    """Name, unit and rate of the column that grows most like a clock; one that is named so comes first."""
    of_dates = {name: texts for name, texts in columns.items() if all(map(is_date, texts))}
    dates = {name: np.array([ns_from_date(text) / NS for text in texts]) for name, texts in of_dates.items()}
    best = None
    for name, values in {**numbers, **dates}.items():
        step = np.diff(values)
        if not (step >= 0.0).all() or not (step > 0.0).mean() > 0.5:
            continue
        named = re.match(r"t(?:ime|s)?(?:stamp|$|[^a-z])|.*time", name, re.IGNORECASE) is not None
        median = float(step.mean())
        units = {"date": NS} if name in dates else {u: TIME_NS[u] for u in ("s", "ms", "us", "ns")}
        own = next((u for u in (unit_in(name), name.rpartition("_")[2].lower()) if u in units), None)
        fits = [own] if own else [u for u, ns in units.items() if name in dates or 0.5 < NS / (median * ns) < 3000.0]
        if fits and (best is None or named > best[0]):
            unit = fits[0]
            best = (named, name, unit, NS / (median * (NS if name in dates else units[unit])))
    return None if best is None else best[1:]


def _vectors(numbers: dict[str, Floats]) -> list[tuple[str, list[str], str, str]]:
    """Letter of the quantity (empty: not usable), columns, unit and text of the first of every kind of three columns
    for x, y and z."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in numbers:
        match = _VECTOR.match(name)
        if match:
            groups.setdefault((match[1].lower(), match[3].lower()), {})[match[2].lower()] = name
    found: dict[str, tuple[str, list[str], str, str]] = {}
    for (before, _), axes in groups.items():
        word = quantity_in(before)
        if axes.keys() != {"x", "y", "z"} or _DERIVED.search(word):
            continue
        names = [axes[axis] for axis in "xyz"]
        meaning = _meaning(word, names, np.stack([numbers[name] for name in names], axis=-1))
        if meaning is not None:
            found.setdefault(meaning[0] or word, meaning)
    return list(found.values())


def _meaning(word: str, names: list[str], rows: Floats) -> tuple[str, list[str], str, str] | None:
    """As `_vectors`, of one vector (n, 3) by the word in its headings and its size; None for what is no quantity."""
    where, size = ", ".join(names), float(np.nanmedian(np.linalg.norm(rows, axis=1)))
    letter = next((letter for letter, pattern in _WORDS.items() if re.search(pattern, word)), "")
    own = unit_in(names[0])
    if letter == "g":
        guess = "deg/s" if np.nanmax(np.abs(rows)) > _FAST_RATE else "rad/s"
        known = own in ANGULAR_RATE
        return (
            letter,
            names,
            "" if known else guess,
            f"{where}: angular rates" + ("" if known else f", {guess}? check it"),
        )
    if not letter and len(word) > 2:
        return None
    fits = [(kind, unit) for kind, least, most, unit in _SIZES if least < size < most and letter in ("", kind)]
    if fits:
        kind, unit = fits[0]
        what = {"a": "specific force with gravity", "m": "a magnetic field"}[kind]
        known = own in (ACCELERATION if kind == "a" else FLUX_DENSITY)
        return kind, names, "" if known else unit, f"{where}: size {size:.4g}, {what} in {own if known else unit}"
    if letter == "a":
        text = f"{where}: size {size:.4g}, without gravity ({STANDARD_GRAVITY:.2f} m/s2, 1 g): not usable alone"
        return "", names, "", text
    return ("m", names, "", f"{where}: a magnetic field") if letter and own in FLUX_DENSITY else None
