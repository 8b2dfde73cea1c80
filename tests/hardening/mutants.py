"""Inputs with one fault each: read as they are meant, or refused by a message that names file and place.

    python tests/hardening/mutants.py --count 2000 --seed 1

Every mutant is read in a child of this process with a limit on time; its memory is measured.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import tomllib
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import tomli_w

sys.path.insert(0, str(Path(__file__).parents[1] / "readers" / "apps"))
sys.path.insert(0, str(Path(__file__).parents[1] / "readers"))
from test_mutants import EXPORTS

from smartnav_graph import readers
from smartnav_graph.core.errors import SmartnavError
from smartnav_graph.estimate import config
from smartnav_graph.readers.reference import load_reference
from smartnav_graph.session import folder as sessions
from smartnav_graph.session import health
from smartnav_graph.session.calibration import model
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.simulation import scenarios

AS_WRITTEN = ("config", "calibration")  # any value inside of its rule is as good as another
LONGEST_S, LARGEST_KB = 90, 2_000_000
PLACE = re.compile(
    r"\brow \d|line \d|record \d|at byte|column|key |\w = |\w\[\d|variable|\w+_(m|s|ns|deg|ut|hpa)\b|stamp"
)
HOSTILE = [
    float("nan"),
    float("inf"),
    -1,
    0,
    True,
    "0x10",
    "",
    1.5,
    10**30,
    1e300,
    [],
    {},
    [1, "a"],
    "x" * 20_000,
    -0.0,
]
CELLS = ["NaN", "inf", "", "x7", "1e300", "-1e300", "0x10", "\x1b[31m", "9" * 400, "=1+1", "1,5", '"']
DEEP = {"toml": "a = " + "[" * 50_000, "json": "[" * 100_000, "yaml": "[" * 20_000}


@dataclass
class Base:
    """An input: written into a folder, read by `read`; what it gives is described by text and by columns."""

    write: Callable[[Path], Path]
    read: Callable[[Path], object]


@cache
def short_session() -> Session:
    """20 s of a walk with a camera in its calibration and a mount."""
    whole = scenarios.simulate("walk-60s", 1)
    end = whole.t0_ns + 20 * 10**9
    imu, gnss = (stream.take(stream.t_ns < end) for stream in (whole.imu, whole.gnss))
    known = model.Calibration(cameras={"cam0": Camera(640, 480, 500.0, 500.0, 319.5, 239.5)})
    return whole.replace(
        imu=imu, gnss=gnss, reference=None, calibration=known, sensors={"gnss": Mount((0.1, 0.0, 0.0))}
    )


def write_session(path: Path) -> Path:
    sessions.save(short_session(), path / "session")
    return path / "session"


def write_csv(path: Path) -> Path:
    (path / "csv").mkdir()
    session = short_session()
    for name, stream in session.streams().items():
        pd.DataFrame(stream.take(slice(0, 300)).columns()).to_csv(path / "csv" / f"{name}.csv", index=False)
    header = {key: value for key, value in sessions.header_of(session).items() if key != "calibration"}
    (path / "csv" / "session.toml").write_text(tomli_w.dumps(header))
    return path / "csv"


def text_base(name: str, text: Callable[[], str]) -> Callable[[Path], Path]:
    def write(path: Path) -> Path:
        (path / name).write_text(text())
        return path / name

    return write


def tum() -> str:
    return "".join(f"{100 + i * 0.1:.1f} {i} {2 * i} 0.5 0 0 0 1\n" for i in range(50))


def comma(path: Path) -> Path:
    root = path / "segment" / "processed_log" / "IMU"
    for name in ("accelerometer", "gyro"):
        (root / name).mkdir(parents=True)
        for part, rows in (("t", np.arange(200) / 100.0), ("value", np.tile([0.1, 0.2, 9.8], (200, 1)))):
            with open(root / name / part, "wb") as file:
                np.save(file, rows)
    return path / "segment"


def foot(path: Path) -> Path:
    from scipy.io import savemat

    rows = {"imu_data": np.tile([0.1, 0.2, 9.8, 0.0, 0.0, 0.1], (200, 1)), "timestamps": np.arange(200) / 200.0}
    savemat(
        path / "foot.mat", {**rows, "strideIndex": [[10, 90]], "GCP": [[0.0, 0.0], [1.0, 2.0]]}, do_compression=True
    )
    return path / "foot.mat"


def exported(name: str) -> Callable[[Path], Path]:
    file, write = EXPORTS[name]
    return lambda path: Path(write(path / file))


def read_session(path: Path) -> object:
    found = readers.load(path)
    camera = repr(found.calibration.cameras) if found.calibration is not None else ""
    checked = health.inspect(found)
    texts = [str(finding) for finding in checked.findings]
    tables = {name: pd.DataFrame(stream.columns()).astype(str) for name, stream in found.streams().items()}
    rows = {name: int(pd.util.hash_pandas_object(table).sum() % 2**53) for name, table in tables.items()}
    texts += [f"there is no {part}" for part in checked.missing]
    return [rows, camera], [*texts, *(f"{k} {v}" for k, v in found.dropped.items())]


def read_toml_of(load: Callable[[Path], object], text: Callable[[object], str]) -> Callable[[Path], object]:
    """What is read, and the keys that are read with another value than the file has."""

    def read(path: Path) -> object:
        found = load(path)
        return repr(found), unlike(tomllib.loads(path.read_text()), tomllib.loads(text(found)))

    return read


def unlike(wanted: object, found: object, where: str = "") -> list[str]:
    """Keys whose value is another one; those that `wanted` does not have take their default."""
    if isinstance(wanted, dict) and isinstance(found, dict):
        return [key for name in wanted for key in unlike(wanted[name], found.get(name), f"{where}.{name}")]
    return [] if wanted == found or wanted != wanted else [f"{where} = {found}"]


BASES: dict[str, Base] = {
    "session": Base(write_session, read_session),
    "csv": Base(write_csv, read_session),
    "config": Base(
        text_base("config.toml", lambda: config.dumps(config.Config())), read_toml_of(config.load, config.dumps)
    ),
    "calibration": Base(
        text_base("calibration.toml", lambda: model.calibration_toml(short_session().calibration)),
        read_toml_of(model.load_calibration, model.calibration_toml),
    ),
    "tum": Base(text_base("truth.tum", tum), lambda p: (repr(load_reference(p)), [])),
    "comma2k19": Base(comma, read_session),
    "foot": Base(foot, read_session),
    **{name: Base(exported(name), read_session) for name in EXPORTS},
}


def of_bytes(data: bytes, rng: random.Random) -> bytes:
    """A fault of a disk or a transfer."""
    at = rng.randrange(len(data) or 1)
    kinds = [
        lambda: data[:at],
        lambda: data[:at] + bytes(rng.randrange(1, 64)) + data[at + 1 :],
        lambda: data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :],
        lambda: data[:at] + rng.randbytes(16) + data[at:],
        lambda: data + data,
        lambda: b"",
        lambda: rng.randbytes(300),
        lambda: data[at:],
    ]
    return rng.choice(kinds)()


def of_table(table: dict, rng: random.Random) -> dict:
    """A key with another value, another name, or none."""
    key = rng.choice(list(table))
    if isinstance(table[key], dict) and table[key] and rng.random() < 0.9:
        return {**table, key: of_table(table[key], rng)}
    others = {name: value for name, value in table.items() if name != key}
    kind = rng.random()
    return (
        others
        if kind < 0.1
        else {**others, f"{key}x": table[key]}
        if kind < 0.2
        else {**table, key: rng.choice(HOSTILE)}
    )


def of_columns(path: Path, rng: random.Random) -> None:
    """A cell, a column or rows of a Parquet file."""
    table = pd.read_parquet(path)
    column, row = rng.choice(list(table)), rng.randrange(len(table))
    kind = rng.randrange(8)
    if kind == 0:
        table = table.drop(columns=column)
    elif kind == 1:
        table = table.rename(columns={column: f"{column}2"})
    elif kind == 2:
        table[column] = table[column].astype(str)
    elif kind == 3:
        table = table.iloc[[*range(row), *range(max(row - 2, 0), len(table))]]
    elif kind == 4:
        table["t_ns"] = table["t_ns"] // rng.choice([10**3, 10**6, 10**9])
    elif kind == 5:
        table["t_ns"] = table["t_ns"].where(table.index < row, table["t_ns"] + 10 ** rng.randrange(12, 19))
    elif not pd.api.types.is_numeric_dtype(table[column]):
        table[column] = [rng.choice(CELLS) if i == row else text for i, text in enumerate(table[column])]
    else:
        table[column] = table[column].astype(float)
        table.loc[table.index[row], column] = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e7, 0.5])
    table.to_parquet(path)


def of_text(data: bytes, rng: random.Random) -> bytes:
    """A cell or a line of delimited text."""
    lines = data.split(b"\n")
    row = rng.randrange(len(lines))
    mark = max((b",", b";", b"\t", b" "), key=lines[row].count)
    cells = lines[row].split(mark)
    cells[rng.randrange(len(cells))] = rng.choice(CELLS).encode()
    kinds = [mark.join(cells), mark.join(cells), lines[row] + mark + b"7", mark.join(cells[1:]), lines[row][::-1]]
    lines[row] = rng.choice(kinds)
    return b"\n".join(lines)


def mutate(file: Path, rng: random.Random) -> bool:
    """Change one file; whether the fault has a place that a message can name."""
    data, suffix = file.read_bytes(), file.suffix
    if rng.random() < 0.03:
        file.unlink()
        return False
    if rng.random() < 0.03 and suffix[1:] in DEEP:
        file.write_text(DEEP[suffix[1:]])
        return False
    if rng.random() < 0.3 or suffix not in (".toml", ".parquet", ".csv", ".txt", ".tum"):
        file.write_bytes(of_bytes(data, rng))
        return False
    if suffix == ".toml":
        file.write_text(tomli_w.dumps(of_table(tomllib.loads(data.decode()), rng)))
    elif suffix == ".parquet":
        of_columns(file, rng)
    else:
        file.write_bytes(of_text(data, rng))
    return True


def holds(source: Path, file: Path) -> bool:
    """Whether a session has the readings of a file of its own: any in their range are as good as others."""
    streams = readers.load(source).streams()
    if file.stem not in streams:
        return False
    found = pd.DataFrame(streams[file.stem].columns())
    try:
        written = pd.read_csv(file) if file.suffix == ".csv" else pd.read_parquet(file).reset_index(drop=True)
    except ValueError:
        return False
    same = set(found) == set(written) and len(found) == len(written)
    return same and bool(np.all([_same(found[name], written[name]) for name in found]))


def _same(first: pd.Series, second: pd.Series) -> bool:
    if not pd.api.types.is_numeric_dtype(first):  # labels; pandas takes some for numbers
        first, second = (column.astype(str).str.lower() for column in (first, second))
    return bool(((first == second) | (first.isna() & second.isna())).all())


def in_a_child(work: Callable[[], object], folder: Path) -> tuple[str, object, float, int]:
    """How reading ended (read, refused, traceback, killed), what it gave, seconds, kB."""
    begin, answer = time.perf_counter(), folder / "answer.json"
    pid = os.fork()
    if not pid:
        try:
            signal.alarm(LONGEST_S)
            resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
            logging.basicConfig(filename=folder / "log.txt", force=True)
            logging.captureWarnings(True)
            try:
                found = ["read", work()]
            except SmartnavError as error:
                found = ["refused", str(error)]
            except BaseException:
                found = ["traceback", traceback.format_exc()[-1500:]]
            answer.write_text(json.dumps(found, default=str))
        finally:
            os._exit(0)
    _, status, usage = os.wait4(pid, 0)
    code, seconds = os.waitstatus_to_exitcode(status), time.perf_counter() - begin
    how, what = json.loads(answer.read_text()) if answer.exists() else ("killed", f"exit code {code}")
    return how, what, seconds, usage.ru_maxrss


def judge(folder: Path, name: str, seed: int, counts: Counter[str]) -> list[str]:
    """One mutant; what is wrong with how it is read."""
    base, rng = BASES[name], random.Random(f"{name} {seed}")
    source = base.write(folder)
    with_base = json.loads(json.dumps(base.read(source), default=str))
    files = [source] if source.is_file() else sorted(f for f in source.rglob("*") if f.is_file())
    file = rng.choice(files)
    before = file.read_bytes()
    placed = mutate(file, rng)
    changed = not file.exists() or file.read_bytes() != before
    how, what, seconds, kilobytes = in_a_child(lambda: base.read(source), folder)
    log = folder / "log.txt"
    not_said = not (log.exists() and log.read_text())
    counts[how] += 1
    where, faults = f"{name} {seed} {file.name}", []
    if how in ("traceback", "killed"):
        faults.append(f"{how}: {what}")
    if seconds > LONGEST_S or kilobytes > LARGEST_KB:
        faults.append(f"{seconds:.0f} s, {kilobytes / 1e6:.1f} GB")
    if how == "refused":
        text = str(what)
        if not any(part in text for part in (file.name, file.stem, source.name)) or "expected" not in text:
            faults.append(f"names no file or rule: {text[:300]}")
        counts["refused, with a place to name"] += placed
        counts["refused, place named"] += placed and bool(PLACE.search(text))
        if placed and not PLACE.search(text):
            counts[f"no place: {text[:160]}"] += 1
    if how == "read" and changed and name in AS_WRITTEN:
        faults += [f"another value than in the file: {text}" for text in what[1]]
    elif how == "read" and changed and name in ("session", "csv") and file.exists() and holds(source, file):
        counts["read as written"] += 1
    elif how == "read" and changed and what[0] != with_base[0] and what[1] == with_base[1] and not_said:
        counts["read, other than its base, not reported"] += 1
        counts[f"silent{'' if placed else ', bytes'}: {where}"] += 1
    return [f"{where}: {fault}" for fault in faults]


def judged(count: int, seed: int, names: list[str]) -> tuple[list[str], Counter[str]]:
    """What is wrong with `count` mutants, and counts of how they were read."""
    faults, counts = [], Counter[str]()
    for i in range(count):
        with tempfile.TemporaryDirectory() as top:
            for fault in judge(Path(top), names[i % len(names)], seed + i // len(names), counts):
                faults.append(fault)
                print(fault, flush=True)
    return faults, counts


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(BASES))
    options = parser.parse_args()
    found, totals = judged(options.count, options.seed, options.only.split(","))
    for text, n in totals.most_common():
        print(n, text)
    print(f"{options.count} mutants, {len(found)} faults")
