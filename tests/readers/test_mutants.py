"""Exports with faults: read as they are meant, or refused with an error that names the file; no traceback, no silent
wrong number.

A mutant that is read holds the readings of the export, or says in `dropped` what it left out.
"""

import random
import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent / "apps"))
from exports import ACCEL, GYRO, UNIX, lat, lines, times
from exports import EXPORTS as APPS

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError


def wide(path):
    """A row of all sensors of an app that is not known."""
    heading = "timestamp (ms),acc_x (m/s^2),acc_y (m/s^2),acc_z (m/s^2),gyro_x (rad/s),gyro_y (rad/s),gyro_z (rad/s)"
    rows = [
        ",".join(map(str, [round((UNIX + t) * 1000), *ACCEL, *GYRO, lat(i // 50), 11.0, 500.0, 3.0]))
        for i, t in enumerate(times())
    ]
    return lines(path, [f"{heading},latitude,longitude,altitude,accuracy", *rows])


def euroc(folder):
    heading = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1]"
    heading += ",a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    rows = [",".join(map(str, [round((UNIX + t) * 1000) * 10**6, *GYRO, *ACCEL])) for t in times()]
    lines(folder / "mav0" / "imu0" / "data.csv", [heading, *rows])
    return folder


def kitti(root):
    """Pictures of an odometry sequence, a metre ahead from one to the next, which turns to the right."""
    count = 6
    (root / "image_0").mkdir(parents=True)
    for i in range(count):
        cv2.imwrite(str(root / "image_0" / f"{i:06d}.png"), np.full((8, 12), 100 + i, np.uint8))
    angle = 0.05 * np.arange(count)
    c, s, x, z = np.cos(angle), np.sin(angle), np.cumsum(np.sin(angle)), np.cumsum(np.cos(angle))
    poses = [f"{c[i]:.9f} 0 {s[i]:.9f} {x[i]:.6f} 0 1 0 0 {-s[i]:.9f} 0 {c[i]:.9f} {z[i]:.6f}" for i in range(count)]
    lines(root / "poses.txt", poses)
    lines(root / "times.txt", [f"{0.1 * i:.6e}" for i in range(count)])
    lines(root / "calib.txt", ["P0: 7.0e+02 0 6.0 0 0 7.1e+02 4.0 0 0 0 1 0", "P1: 7e2 0 6 -386 0 7e2 4 0 0 0 1 0"])
    return root


EXPORTS = {
    **APPS,
    "kitti-odometry": ("sequence", kitti),
    "wide-csv": ("log.csv", wide),
    "euroc": ("V1_01", euroc),
}


def files_of(source):
    return [source] if source.is_file() else sorted(file for file in source.rglob("*") if file.is_file())


def cut(data, rng):
    return data[: rng.randrange(len(data))]


def lines_of(data):
    return data.split(b"\n")


def nan_cell(data, rng):
    rows = lines_of(data)
    row = rng.randrange(1, len(rows))
    mark = rng.choice([b",", b";"])
    cells = rows[row].split(mark)
    cells[rng.randrange(len(cells))] = rng.choice([b"NaN", b"", b"N/A", b"null", b"x7", b"inf"])
    rows[row] = mark.join(cells)
    return b"\n".join(rows)


def repeated_line(data, rng):
    rows = lines_of(data)
    row = rng.randrange(1, max(len(rows) - 1, 2))
    return b"\n".join([*rows[: row + 1], *rows[row:]])


def swapped_lines(data, rng):
    rows = lines_of(data)
    row = rng.randrange(len(rows) // 2, max(len(rows) - 2, len(rows) // 2 + 1))
    rows[row], rows[row - 1] = rows[row - 1], rows[row]
    return b"\n".join(rows)


def missing_line(data, rng):
    rows = lines_of(data)
    del rows[rng.randrange(len(rows))]
    return b"\n".join(rows)


def swapped_columns(data, rng):
    rows = [row.split(b",") for row in lines_of(data)]
    width = max(map(len, rows))
    i, j = rng.randrange(width), rng.randrange(width)
    for row in rows:
        if len(row) > max(i, j):
            row[i], row[j] = row[j], row[i]
    return b"\n".join(b",".join(row) for row in rows)


def missing_column(data, rng):
    rows = [row.split(b",") for row in lines_of(data)]
    column = rng.randrange(max(map(len, rows)))
    return b"\n".join(b",".join(c for i, c in enumerate(row) if i != column) for row in rows)


def decimal_commas(data, rng):
    return re.sub(rb"(\d)\.(\d)", rb"\1,\2", data)


def decimal_commas_and_semicolons(data, rng):
    return re.sub(rb"(\d)\.(\d)", rb"\1,\2", data.replace(b",", b";"))


MUTATIONS = {
    "cut": cut,
    "nan": nan_cell,
    "repeated line": repeated_line,
    "swapped lines": swapped_lines,
    "missing line": missing_line,
    "swapped columns": swapped_columns,
    "missing column": missing_column,
    "decimal commas": decimal_commas,
    "semicolons": decimal_commas_and_semicolons,
    "mark": lambda data, rng: b"\xef\xbb\xbf" + data,
    "CRLF": lambda data, rng: data.replace(b"\n", b"\r\n"),
    "CR": lambda data, rng: data.replace(b"\n", b"\r"),
    "UTF-16": lambda data, rng: data.decode("utf-8", errors="replace").encode("utf-16"),
    "code page": lambda data, rng: data.decode("utf-8", errors="replace").encode("cp1252", errors="replace"),
    "capitals": lambda data, rng: lines_of(data)[0].upper() + data[len(lines_of(data)[0]) :],
    "heading again": lambda data, rng: data + lines_of(data)[0] + b"\n",
    "sep line": lambda data, rng: b"sep=,\n" + data,
    "empty": lambda data, rng: b"",
    "heading only": lambda data, rng: lines_of(data)[0] + b"\n",
    "zeros": lambda data, rng: data[: len(data) // 2] + b"\0" * 64 + data[len(data) // 2 :],
    "noise": lambda data, rng: bytes(rng.randrange(256) for _ in range(200)),
    "no line end": lambda data, rng: data.rstrip(b"\n"),
}


def attempt(source):
    """The session of a source, or the text of the error."""
    try:
        return readers.read(source), ""
    except SessionError as error:
        return None, str(error)


def run(name, mutation, seed, tmp_path):
    file, write = EXPORTS[name]
    source = write(tmp_path / file)
    original = readers.read(source)
    rng = random.Random(f"{name} {mutation} {seed}")
    mutated = rng.choice([f for f in files_of(source) if f.stat().st_size])
    mutated.write_bytes(MUTATIONS[mutation](mutated.read_bytes(), rng))
    return source, original, mutated


SAME_NS = 5_000_000  # clocks are tied by medians, which a row less moves by less than the step of the rows

LATER_NS = 60_000_000  # of a fix in every row, the first of which is missing

# A byte among the numbers of a binary file may be any: nothing shows that it is another.
BINARY = dict.fromkeys(("gopro", "matlab-mobile"), ("cut", "zeros", "empty", "noise", "mark"))
# Names and readings of these have other places in their lines: an exchange would give readings other names.
# Poses of other pictures, or other axes of a place, are poses too.
POSES = {"kitti-odometry": tuple(name for name in MUTATIONS if name not in ("swapped columns", "swapped lines"))}
PREFIXED = dict.fromkeys(("gnss-logger", "flysight"), tuple(name for name in MUTATIONS if name != "swapped columns"))
CASES = [
    (name, mutation) for name in EXPORTS for mutation in {**BINARY, **PREFIXED, **POSES}.get(name, tuple(MUTATIONS))
]


@pytest.mark.parametrize(("name", "mutation"), CASES)
def test_a_faulty_export_is_read_rightly_or_refused(tmp_path, name, mutation):
    check_mutant(name, mutation, 0, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPORTS)
def test_two_hundred_faulty_exports(tmp_path, name):
    mutations = [mutation for other, mutation in CASES if other == name]
    for seed in range(1, 200 // len(mutations) + 2):
        for mutation in mutations:
            check_mutant(name, mutation, seed, tmp_path / f"{seed} {mutation}")


def clock_shift(session, original):
    """Zero; where the file that ties the clock to Unix time is spoilt, and the epoch unknown, that of the first row."""
    if session.clock_epoch == original.clock_epoch or session.imu is None:
        return 0
    assert session.clock_epoch == "unknown"
    return int(original.imu.t_ns[0] - session.imu.t_ns[0])


def check_fixes(session, whole, where):
    """Every fix is one of the original: its place, its stamp and its sigma."""
    original, found = whole.gnss, session.gnss
    found = replace(found, t_ns=found.t_ns + clock_shift(session, whole))
    for row in range(len(found)):
        same = np.abs(found.t_ns[row] - original.t_ns) < LATER_NS
        same &= np.isclose(found.lla[row, :2], original.lla[:, :2], rtol=0.0, atol=1e-9).all(axis=1)
        assert same.any(), f"{where}: {found.t_ns[row]} {found.lla[row]}"
        if found.sigma is not None and original.sigma is not None:
            known = found.sigma[row, :2]
            assert np.isnan(known).all() or np.allclose(known, original.sigma[same][0, :2]), f"{where}: {known}"


def check_mutant(name, mutation, seed, folder):
    folder.mkdir(parents=True, exist_ok=True)
    source, original, mutated = run(name, mutation, seed, folder)
    session, error = attempt(source)
    if session is None:
        assert source.name in error or mutated.name in error, f"{mutation}: names no file: {error}"
        return
    if session.gnss is not None and original.gnss is not None:
        check_fixes(session, original, f"{name}, {mutation} {seed} of {mutated.name}")
    if original.reference is not None:
        same = [
            getattr(session.reference, name) == getattr(original.reference, name) for name in ("t_ns", "enu", "quat")
        ]
        assert all(part.all() for part in same) and (session.images.t_ns == original.images.t_ns).all()
        assert session.calibration == original.calibration
    if session.imu is None:
        return
    assert len(session.imu) <= len(original.imu), mutation
    t_ns = session.imu.t_ns + clock_shift(session, original)
    nearest = original.imu.t_ns[np.argmin(np.abs(t_ns[:, None] - original.imu.t_ns), axis=1)]
    assert np.abs(t_ns - nearest).max() < SAME_NS, f"{name}, {mutation} {seed} of {mutated.name}: stamps"
    gyro, accel = session.imu.gyro, session.imu.accel
    right = np.isclose(gyro, GYRO, atol=3e-4).all(axis=1) & np.isclose(accel, ACCEL, atol=2e-3).all(axis=1)
    assert right.all(), f"{name}, {mutation} {seed} of {mutated.name}: {gyro[~right][0]}, {accel[~right][0]}"


@pytest.mark.parametrize("name", [name for name in EXPORTS if name in ("sensor-logger", "phyphox")])
def test_one_sensor_missing(tmp_path, name):
    file, write = EXPORTS[name]
    for missing in files_of(write(tmp_path / file)):
        source = write(tmp_path / f"without {missing.stem}" / file)
        (source / missing.relative_to(tmp_path / file)).unlink()
        session, error = attempt(source)
        if session is None:
            assert str(source) in error
            continue
        if session.imu is None:
            assert "there is no" in str(session.dropped["imu"]) and len(session.gnss)
            continue
        assert np.allclose(session.imu.accel, ACCEL, atol=1e-6) and np.allclose(session.imu.gyro, GYRO, atol=1e-9)


TEXTS = [name for name in EXPORTS if name not in BINARY]


def spoilt(name, folder, file, row, column):
    """The error of an export in which one cell is no number; None where it is read."""
    source = EXPORTS[name][1](folder / EXPORTS[name][0])
    path = source if source.is_file() else source / file
    rows = path.read_text(encoding="utf-8").splitlines()
    mark = "," if rows[row].count(",") else " "
    cells = rows[row].split(mark)
    cells[column] = "x7"
    rows[row] = mark.join(cells)
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return attempt(source)[1]


@pytest.mark.parametrize("name", TEXTS)
def test_the_row_that_is_named_is_that_of_the_fault(tmp_path, name):
    """The row named moves with the fault: by as many rows of its kind as lie between."""
    source = EXPORTS[name][1](tmp_path / "whole" / EXPORTS[name][0])
    named = 0
    for path in [f for f in files_of(source) if f.suffix in (".csv", ".CSV", ".txt")]:
        rows = path.read_text(encoding="utf-8").splitlines()
        kinds = [row.split(",")[0] if row[:1].isalpha() or row[:1] == "$" else "" for row in rows]
        if len(rows) < 6:
            continue
        kind = max(set(kinds[len(rows) // 3 :]), key=kinds.count)
        own = [i for i, k in enumerate(kinds) if k == kind]
        first, second = own[len(own) // 2], own[-2]
        file = "" if source.is_file() else path.relative_to(source)
        for column in range(len(rows[first].split("," if "," in rows[first] else " "))):
            errors = [
                spoilt(name, tmp_path / f"{path.stem} {column} {row}", file, row, column) for row in (first, second)
            ]
            places = [re.search(r"\b(?:row|record|line) #?(\d+)", error) for error in errors]
            if all(places):
                apart = own.index(second) - own.index(first)
                assert int(places[1][1]) - int(places[0][1]) == apart, errors
                named += 1
    assert named
