"""Phones under motion capture (Tyrex, Inria): one folder per recording, text files of one sensor each.

Michel, Geneves, Fourati, Layaida (2017), On attitude estimation with smartphones, PerCom. Phone axes: x right, y top,
z out of the screen.

=================  =========================  ===========================================================
                   Android                    iOS
=================  =========================  ===========================================================
marked by          record.properties          description.txt (BootTime)
stamps             s since the log began      s since the phone was booted, kept
accelerometer      m/s^2                      g, with the opposite sign: times -9.80665
gyroscope          rad/s, as read, then the   rad/s, as read
                   system's bias: subtracted
magnetometer       uT, the same               uT, as read (offsets of hundreds of uT)
own attitude       rotation-vector: x y z w   attitude: w x y z, zero of heading unknown
=================  =========================  ===========================================================

The truth, ``qualisys/<recording>.mat`` two folders up, is optical: frame k is taken k / rate - alignment after the log
began, on the phone's clock; ``timeAlignment.txt`` holds the alignment. Attitude and position are those of the marker
body, a few degrees and centimetres from the phone's.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.frames import STANDARD_GRAVITY
from smartnav_graph.core.so3 import from_quaternion, quaternion, slerp
from smartnav_graph.core.timebase import interpolate, nearest, ns_from_seconds, ns_from_text
from smartnav_graph.readers.matlab import read_mat
from smartnav_graph.readers.source import Reader, build_session, inertial_columns, vector_columns
from smartnav_graph.readers.text import first_lines, read_bytes, read_text
from smartnav_graph.session.session import Device, Session

GRAVITY = 9.8056  # m/s^2, normal gravity at the hall near Grenoble (45.22 deg north, 250 m)
SAME_STAMP_NS = 10_000  # stamps closer than this count as one: readings change less in between than they are resolved


@dataclass(frozen=True)
class System:
    """How a phone's operating system writes its logs.

    accel_unit : m/s^2 of one unit of the accelerometer log, its sign that of specific force; bias : whether readings
    are followed by the system's estimate of their bias; attitude : file and order of the quaternion's columns
    """

    mark: str
    accel_unit: float
    bias: bool
    attitude: str
    quaternion: tuple[str, ...]
    epoch: str


ANDROID = System("record.properties", 1.0, True, "rotation-vector", ("qx", "qy", "qz", "qw", "accuracy"), "unknown")
IOS = System("description.txt", -STANDARD_GRAVITY, False, "attitude", ("qw", "qx", "qy", "qz"), "boot")
_BIAS = ("bias_x", "bias_y", "bias_z")


def _file(folder: Path, name: str) -> Path | None:
    """The plain or gzip-ed text file of a sensor."""
    files = (folder / f"{name}.txt", folder / f"{name}.txt.gz")
    return next((file for file in files if file.is_file()), None)


def _system(folder: Path) -> System | None:
    if _file(folder, "accelerometer") is None or _file(folder, "gyroscope") is None:
        return None
    return next((system for system in (ANDROID, IOS) if (folder / system.mark).is_file()), None)


def _matches(source: str) -> bool:
    try:
        return _system(Path(source)) is not None
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return False


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    folder = Path(source)
    system = _system(folder)
    if system is None:
        raise SessionError(
            folder,
            "holds no recording of this format",
            f"accelerometer.txt, gyroscope.txt (or .gz) and {ANDROID.mark} or {IOS.mark}",
            "give the folder of one recording",
        )
    imu, dropped = _imu(folder, system)
    tables = {"imu": (folder, imu)}
    if _file(folder, "magnetometer") is not None:
        t_ns, field, bias = _vectors(folder, "magnetometer", system.bias)
        columns = {"t_ns": t_ns} | vector_columns("mag_{}_ut", field)
        columns |= {} if bias is None else vector_columns("system_bias_{}_ut", bias)
        tables["magnetometer"] = (folder, columns)
    truth = folder.absolute().parent.parent / "qualisys" / f"{folder.absolute().name}.mat"
    if truth.is_file():
        columns, lost = _truth(truth, folder, system)
        tables["reference"] = (
            truth,
            columns | _own_attitude(folder, system, np.asarray(columns["t_ns"], dtype=np.int64)),
        )
        dropped |= {"reference": {"of frames without markers dropped": lost}} if lost else {}
    session = build_session(
        tables,
        repairs,
        device=Device(name=_device(folder), vehicle="foot"),
        clock_epoch=system.epoch,
        gravity_m_s2=GRAVITY,
    )
    names = {*dropped, *session.dropped}
    return session.replace(dropped={name: {**session.dropped.get(name, {}), **dropped.get(name, {})} for name in names})


def _vectors(folder: Path, name: str, biased: bool) -> tuple[Times, Floats, Floats | None]:
    """Stamps (n,), readings (n, 3) less the system's first bias, and its biases (n, 3), None where none are written.

    The first for all rows: a bias that the system changes during the recording would be a step in the readings.
    """
    axes = ("x", "y", "z")
    file = _file(folder, name)
    if file is None:
        raise SessionError(folder / f"{name}.txt", "is missing", "a text file, or the same with .gz")
    table = read_text(file, names=("t", *axes, *(_BIAS if biased else ())))
    rows = table.floats(*axes)
    bias = table.floats(*_BIAS) if biased else None
    return table.times("t"), rows if bias is None else rows - bias[0], bias


def _imu(folder: Path, system: System) -> tuple[Table, dict[str, dict[str, int]]]:
    """Columns of both sensors on the gyro's stamps, and what that did to the rows."""
    t_ns, gyro, bias = _vectors(folder, "gyroscope", system.bias)
    at_ns, accel, _ = _vectors(folder, "accelerometer", False)
    both = (t_ns >= at_ns[0]) & (t_ns <= at_ns[-1])
    if not both.any():
        raise SessionError(folder, "gyroscope and accelerometer have no time in common", "stamps on one clock")
    t_ns = t_ns[both]
    outside = (at_ns < t_ns[0]) | (at_ns > t_ns[-1])
    apart = np.abs(at_ns[nearest(t_ns, at_ns)] - t_ns) > SAME_STAMP_NS
    counts = {
        "of the gyro outside the accelerometer's span dropped": int((~both).sum()),
        "of the accelerometer outside the gyro's span dropped": int(outside.sum()),
        "with the acceleration interpolated to the gyro's stamp": int(apart.sum()),
    }
    columns = inertial_columns(t_ns, gyro[both], system.accel_unit * interpolate(t_ns, at_ns, accel))
    columns |= {} if bias is None else vector_columns("system_bias_{}_rad_s", bias[both])
    changes = {reason: count for reason, count in counts.items() if count}
    return columns, {"imu": changes} if changes else {}


def _number(path: Path, pattern: str, expected: str) -> str:
    found = re.search(pattern, read_bytes(path).decode("utf-8", errors="replace"))
    if found is None:
        raise SessionError(path, "holds no such number", expected)
    return found[1]


def _device(folder: Path) -> str:
    text = "\n".join(first_lines(folder / ANDROID.mark, 20))
    words = (re.search(rf"^{name}\s*=\s*(.+)$", text, re.MULTILINE) for name in ("Manufacturer", "Model"))
    return " ".join(word[1].strip() for word in words if word) or "iPhone"


def _truth(path: Path, folder: Path, system: System) -> tuple[Table, int]:
    """Columns of the optical frames on the phone's clock, and how many without markers were left out."""
    positions, rotations, rate = _rigid_body(path)
    aligned = _number(folder / "timeAlignment.txt", r"(\S+)", "t_truth - t_phone, seconds")
    begin = "0"  # of the log, on the phone's clock
    if system is IOS:
        begin = _number(folder / IOS.mark, r"BootTime\s*=\s*(\S+)", "BootTime = seconds")
    t_ns = ns_from_text(begin) - ns_from_text(aligned) + ns_from_seconds(np.arange(positions.shape[1]) / rate)
    seen = np.isfinite(positions).all(axis=0) & np.isfinite(rotations).all(axis=0)
    # matrices are written column by column
    nav_R_body = rotations.T.reshape(-1, 3, 3).transpose(0, 2, 1)[seen]
    columns = {"t_ns": t_ns[seen]} | vector_columns("{}_m", positions.T[seen] / 1000.0, "enu")
    return columns | vector_columns("q{}", quaternion(nav_R_body), "wxyz"), int((~seen).sum())


def _rigid_body(path: Path) -> tuple[Floats, Floats, float]:
    """Positions (3, n) mm, rotation matrices (9, n), frames per second; the name of the only variable varies."""
    variables = read_mat(path)
    try:
        capture = next(iter(variables.values()))[0, 0]
        body, rate = capture["RigidBodies"][0, 0], float(capture["FrameRate"].item())
        # bodies x rows x frames where MATLAB wrote it; there is one body
        positions, rotations = (np.atleast_3d(body[name].T).T[0] * 1.0 for name in ("Positions", "Rotations"))
    except (StopIteration, IndexError, KeyError, ValueError, TypeError) as error:
        raise SessionError(
            path, f"holds no rigid body ({error})", "RigidBodies and FrameRate of one capture"
        ) from error
    if positions.shape[0] != 3 or rotations.shape != (9, positions.shape[1]):
        raise SessionError(path, f"positions {positions.shape}, rotations {rotations.shape}", "(3, n) and (9, n)")
    return positions, rotations, rate


def _own_attitude(folder: Path, system: System, t_ns: Times) -> Table:
    """The system's own attitude at the frames, kept beside the truth for comparison; not a number outside its span."""
    file = _file(folder, system.attitude)
    if file is None:
        return {}
    table = read_text(file, names=("t", *system.quaternion))
    at_ns = table.times("t")
    inside = (t_ns >= at_ns[0]) & (t_ns <= at_ns[-1])
    rows = np.full((len(t_ns), 4), np.nan)
    rows[inside] = quaternion(slerp(t_ns[inside], at_ns, from_quaternion(table.floats("qw", "qx", "qy", "qz"))))
    return vector_columns("system_q{}", rows, "wxyz")


READER = Reader(
    name="tyrex",
    summary="phone under motion capture (Tyrex): IMU, magnetometer, optical pose",
    recognised_by="a folder with accelerometer.txt, gyroscope.txt and record.properties or description.txt",
    matches=_matches,
    read_source=_read,
)
