"""Damaged logs: read as far as they are whole, or refused with a SessionError; never another error, never for long."""

import random
import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from bags import KINDS, drive
from test_kf_gins import fixes, inertial
from test_kitti_raw import write as write_kitti
from test_ulog import FORMATS, flight
from test_vectornav import write as write_vectornav
from ulogs import ulog

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

MUTANTS = 200


def px4(folder):
    (folder / "flight.ulg").write_bytes(ulog(FORMATS, flight()))
    return folder / "flight.ulg"


def kf_gins(folder):
    (folder / "imu.txt").write_text(inertial(100))
    (folder / "GNSS.txt").write_text(fixes(rows=10))
    return folder


LOGS = {kind: lambda folder, kind=kind: drive(kind, 3).write(folder) for kind in KINDS}
LOGS |= {"ulog": px4, "vectornav": write_vectornav, "kf-gins": kf_gins, "kitti-raw": write_kitti}


def cut(data, rng):
    return data[: rng.randrange(len(data))]


def flipped_bits(data, rng):
    out = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 30])):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def flipped_at_the_start(data, rng):
    out = bytearray(data)
    out[rng.randrange(min(len(out), 600))] = rng.randrange(256)
    return bytes(out)


def flipped_at_the_end(data, rng):
    out = bytearray(data)
    out[-1 - rng.randrange(min(len(out), 600))] = rng.randrange(256)
    return bytes(out)


def zeros(data, rng):
    first, count = rng.randrange(len(data)), rng.randrange(1, 4096)
    return data[:first] + bytes(len(data[first : first + count])) + data[first + count :]


def missing_block(data, rng):
    first = rng.randrange(len(data))
    return data[:first] + data[first + rng.randrange(1, 2000) :]


def repeated_block(data, rng):
    first = rng.randrange(len(data))
    return data[: first + 500] + data[first:]


def missing_line(data, rng):
    lines = data.split(b"\n")
    del lines[rng.randrange(len(lines))]
    return b"\n".join(lines)


def other_number(data, rng):
    lines = data.split(b"\n")
    row = rng.randrange(len(lines))
    cells = lines[row].replace(b",", b" ").split()
    if cells:
        lines[row] = lines[row].replace(rng.choice(cells), rng.choice([b"NaN", b"", b"1e999", b"-1", b"x", b"0"]), 1)
    return b"\n".join(lines)


def empty(data, rng):
    return b""


KINDS_OF_FAULT = (cut, flipped_bits, flipped_at_the_start, flipped_at_the_end, zeros, missing_block, repeated_block)
KINDS_OF_FAULT += (missing_line, other_number, empty)


@pytest.mark.slow
@pytest.mark.parametrize("log", LOGS)
def test_damaged_logs(tmp_path, log):
    source = LOGS[log](tmp_path / "good") if (tmp_path / "good").mkdir() is None else None
    good = source.parent if source.is_file() else source
    inside = source.relative_to(good)
    rng, outcomes, unnamed = random.Random(13), {"read": 0, "refused": 0}, []
    for i in range(MUTANTS):
        folder = tmp_path / "mutant" / good.name
        shutil.copytree(good, folder)
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        file = rng.choice(files)
        fault = KINDS_OF_FAULT[i % len(KINDS_OF_FAULT)]
        if i % 17 == 16:
            file.unlink()
        else:
            file.write_bytes(fault(file.read_bytes(), rng))
        try:
            session = readers.read(folder / inside)
            assert session.streams()
            outcomes["read"] += 1
        except SessionError as error:
            outcomes["refused"] += 1
            unnamed += [] if str(tmp_path) in str(error) else [f"{fault.__name__} of {file.name}: {error}"]
        shutil.rmtree(tmp_path / "mutant")
    assert min(outcomes.values()) > 0, outcomes
    assert not unnamed
