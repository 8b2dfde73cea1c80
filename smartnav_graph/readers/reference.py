"""Reference trajectories of foreign formats -> `Reference`, recognised by content.

==================  ===============================================================================================
TUM                 t x y z qx qy qz qw, blank separated, seconds as decimal text
EuRoC               comma separated, heading #time...: ns, p, q (w first)[, v[, gyro bias, accel bias]]
KITTI poses         12 numbers a row (camera 0 in its first frame); needs `times` and `body_T_ref`
CSV                 a heading that names time, x, y, z (or e_m, n_m, u_m) and, if there, qw, qx, qy, qz
session             a folder with reference.parquet, or that file
log                 a folder or archive of a known format with ground truth: EuRoC, TUM-VI, KITTI, ...
ROS bag             Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or Path; BAG#/topic
==================  ===============================================================================================
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import ConfigError, SessionError, warn
from smartnav_graph.core.files import read_table, read_toml
from smartnav_graph.core.so3 import from_quaternion, quaternion
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.archive import is_archive
from smartnav_graph.readers.robotics.ros_poses import is_bag, pose_columns_of_bag
from smartnav_graph.readers.source import vector_columns
from smartnav_graph.readers.text import TextTable, first_lines, read_text
from smartnav_graph.session.folder import build_stream
from smartnav_graph.session.streams import Reference

QUATERNION = ("qw", "qx", "qy", "qz")
_POSITION = ("x", "y", "z")
_EUROC = (
    *("t", *_POSITION, *QUATERNION, "vx", "vy", "vz"),
    *("gyro_bias_x", "gyro_bias_y", "gyro_bias_z", "accel_bias_x", "accel_bias_y", "accel_bias_z"),
)
_TIME_UNITS = {"t": NS, "t_s": NS, "time": NS, "timestamp": NS, "t_ns": 1, "time_ns": 1, "timestamp_ns": 1}
_CUT = 30.0  # steps of the others
_LARGEST_S = 1e10  # the year 2286: a larger reading is not in seconds


def load_reference(
    path: str | Path, *, times: str | Path | None = None, body_T_ref: str | Path | None = None
) -> Reference:
    """The reference trajectory in a file or session folder.

    Parameters
    ----------
    path : the reference, see the table above
    times : KITTI poses only: one time in seconds per row; its clock starts at 0, so the offset to the session's clock
        must be given (or searched) where the two are compared
    body_T_ref : TOML with one 4x4 matrix ``body_T_<name>``: the pose, in body axes, of the frame whose poses the file
        holds. The result is the body's pose, nav_T_body = nav_T_ref * inv(body_T_ref). KITTI poses are camera poses
        in the first camera's frame; with the first body axes as nav they become
        nav_T_body = body_T_ref * T_ref * inv(body_T_ref).

    Returns
    -------
    Reference : `enu` (n, 3) m; `quat` (n, 4) w x y z of nav_R_body, velocity m/s in nav axes and biases where known

    Raises
    ------
    SessionError
        Missing or unreadable file, unknown format, no number, times out of order, quaternion not of unit norm.
    ConfigError
        `times` or `body_T_ref` is missing where needed, or given where it does not apply.
    """
    path = Path(path)
    if is_bag(path):
        file, columns = path, pose_columns_of_bag(path)
    elif _is_log(path):
        file, columns = path, _of_log(path)
    elif path.is_dir() or path.suffix == ".parquet":
        file = path / "reference.parquet" if path.is_dir() else path
        columns = read_table(file)
    else:
        file, lines = path, first_lines(path)
        if lines and _is_numbers(lines[0], 12):
            return _built(file, _kitti(file, times, body_T_ref))
        columns = _columns(file, lines)
    if times is not None:
        raise ConfigError("--times", f"is given, but {file} has times of its own", "KITTI poses", "leave it out")
    _check_unit(file, columns)
    return _built(file, columns if body_T_ref is None else _of_body(file, columns, load_transform(body_T_ref)))


def load_trajectory(
    path: str | Path, *, times: str | Path | None = None, body_T_ref: str | Path | None = None
) -> Reference:
    """A trajectory of another program, to be compared: as `load_reference`, where `times` and `body_T_ref` count for
    KITTI poses only."""
    is_text = Path(path).is_file() and not is_bag(path) and not is_archive(Path(path))
    lines = first_lines(Path(path)) if is_text else []
    is_kitti = bool(lines) and _is_numbers(lines[0], 12)
    return load_reference(path, times=times, body_T_ref=body_T_ref) if is_kitti else load_reference(path)


def _is_log(path: Path) -> bool:
    """Whether it is an archive, or the folder of a log of another program."""
    from smartnav_graph.readers import known_readers

    if is_archive(path):
        return True
    ours = any((path / name).is_file() for name in ("reference.parquet", "session.toml"))
    return path.is_dir() and not ours and any(reader.matches(str(path)) for reader in known_readers().values())


def _of_log(path: Path) -> Table:
    """The ground truth of a log."""
    from smartnav_graph import readers

    found = readers.load(path).reference
    if found is None:
        rule = "a log with ground truth, such as a EuRoC or KITTI folder"
        raise SessionError(path, "holds no reference trajectory", rule, "give the file of the trajectory itself")
    return found.columns()


def _columns(path: Path, lines: list[str]) -> Table:
    if _is_euroc(lines):
        return euroc_columns(path)
    if _is_tum(lines):
        table = read_text(path, names=("t", *_POSITION, "qx", "qy", "qz", "qw"))
        return _pose_columns(table, table.times("t"))
    table = read_text(path)
    time = next((name.lower() for name in table.cells if name.lower() in _TIME_UNITS), None)
    if time is None:
        raise SessionError(
            path,
            f"is no known reference format; it begins with {lines[0][:60]!r}" if lines else "is empty",
            "TUM, EuRoC or KITTI poses, or a CSV whose heading names t, x, y, z",
            f"name the time column {', '.join(_TIME_UNITS)}",
        )
    return _named(table, time)


def _is_numbers(line: str, count: int) -> bool:
    try:
        return len([float(cell) for cell in line.split()]) == count
    except ValueError:
        return False


def _is_tum(lines: list[str]) -> bool:
    return any(_is_numbers(line, 8) for line in lines) and all(
        line.startswith("#") or _is_numbers(line, 8) for line in lines
    )


def _is_euroc(lines: list[str]) -> bool:
    heading = lines[0].lower() if lines else ""
    return heading.startswith("#time") and heading.count(",") + 1 in (8, 11, 17)


def euroc_columns(path: Path) -> Table:
    """File columns of a EuRoC ground-truth CSV: time in ns, position, quaternion w first, velocity, biases."""
    width = first_lines(path, 1)[0].count(",") + 1 if first_lines(path, 1) else len(_EUROC)
    table = read_text(path, names=_EUROC[:width])
    columns = _pose_columns(table, table.times("t", unit_ns=1))
    if width > 8:
        columns |= vector_columns("v{}_m_s", table.floats("vx", "vy", "vz"), "enu")
    if width > 11:
        for name, unit in (("gyro_bias", "rad_s"), ("accel_bias", "m_s2")):
            columns |= vector_columns(f"{name}_{{}}_{unit}", table.floats(*(f"{name}_{axis}" for axis in "xyz")))
    return columns


def _pose_columns(table: TextTable, t_ns: Times) -> Table:
    position = vector_columns("{}_m", table.floats(*_POSITION), "enu")
    return {"t_ns": t_ns} | position | {name: table.floats(name) for name in QUATERNION}


def _named(table: TextTable, time: str) -> Table:
    lower = TextTable(table.path, {name.lower(): cells for name, cells in table.cells.items()})
    wanted = ("e_m", "n_m", "u_m") if "e_m" in lower.cells else _POSITION
    lower.require(wanted)
    if _TIME_UNITS[time] == NS and np.abs(lower.floats(time)).max() > _LARGEST_S:
        found = f"{time} begins with {lower.texts(time)[0]}"
        raise SessionError(table.path, found, "seconds", "call the column t_ns if it counts nanoseconds")
    known = {name for spec in Reference.specs() for name in spec.metadata["columns"]} - {"t_ns", "e_m", "n_m", "u_m"}
    columns = {"t_ns": lower.times(time, _TIME_UNITS[time])} | vector_columns("{}_m", lower.floats(*wanted), "enu")
    return columns | {name: lower.floats(name) for name in lower.cells if name in known and not lower.is_empty(name)}


def _kitti(path: Path, times: str | Path | None, body_T_ref: str | Path | None) -> Table:
    for option, value, what in (
        ("--times", times, "a file with one time in seconds per row"),
        ("--body-T-ref", body_T_ref, "a TOML file with body_T_cam, the camera's pose in the body"),
    ):
        if value is None:
            raise ConfigError(path, "holds KITTI poses, which lack it", what, f"give {option}")
    assert times is not None and body_T_ref is not None
    rows = read_text(path, names=[f"p{i}" for i in range(12)])
    clock = read_text(Path(times), names=["t"])
    if len(rows) != len(clock):
        raise SessionError(
            times, f"has {len(clock)} rows", f"{len(rows)}, as many as {path}", "give the file beside it"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.floats(*rows.cells).reshape(-1, 3, 4)
    _check_rotations(path, poses)
    body_T_cam = load_transform(body_T_ref)
    return {"t_ns": clock.times("t")} | _columns_of(body_T_cam @ poses @ np.linalg.inv(body_T_cam))


def _of_body(path: Path, columns: Table, body_T_ref: Floats) -> Table:
    """The body's poses from those of a frame fixed to it. Velocity and biases of that frame are left out."""
    if "qw" not in columns:
        raise ConfigError("--body-T-ref", f"is given, but {path} has no attitude", "qw, qx, qy, qz", "leave it out")
    poses = np.zeros((len(columns["t_ns"]), 4, 4))
    poses[:, :3, :3] = from_quaternion(_stack(columns, *QUATERNION))
    poses[:, :3, 3], poses[:, 3, 3] = _stack(columns, "e_m", "n_m", "u_m"), 1.0
    return {"t_ns": columns["t_ns"]} | _columns_of(poses @ np.linalg.inv(body_T_ref))


def pose_columns(path: Path, poses: Floats) -> Table:
    """File columns of the body's poses (n, 3, 4) or (n, 4, 4) in nav.

    Raises
    ------
    SessionError
        A row's 3x3 part is no rotation.
    """
    _check_rotations(path, poses)
    return _columns_of(poses)


def _columns_of(poses: Floats) -> Table:
    quat = vector_columns("q{}", quaternion(poses[:, :3, :3]), "wxyz")
    return vector_columns("{}_m", poses[:, :3, 3], "enu") | quat


def _stack(columns: Table, *names: str) -> Floats:
    return np.stack([np.asarray(columns[name], dtype=np.float64) for name in names], axis=-1)


def load_transform(path: str | Path) -> Floats:
    """The only 4x4 rigid transform of a TOML file, its key ``body_T_<frame>``.

    Raises
    ------
    SessionError
        Missing or unreadable file, no such key, or no rotation and translation.
    """
    raw = read_toml(Path(path), SessionError, "a TOML file with a key body_T_<frame>, four rows of four")
    keys = [key for key in raw if key.startswith("body_T_")]
    try:
        matrix = np.array(raw[keys[0]], dtype=np.float64)
    except (IndexError, ValueError, TypeError):
        matrix = np.zeros(0)
    if len(keys) != 1 or matrix.shape != (4, 4):
        found = f"holds {', '.join(raw) or 'nothing'}"
        raise SessionError(path, found, "one key body_T_<frame> with four rows of four numbers")
    if not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise SessionError(path, f"{keys[0]} has the last row {matrix[3].tolist()}", "0, 0, 0, 1")
    _check_rotations(Path(path), matrix[None])
    return matrix


def _check_rotations(path: Path, poses: Floats) -> None:
    R = poses[:, :3, :3]
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero(~(error < 1e-3) | ~(np.linalg.det(R) > 0))
    if len(bad):
        row = int(bad[0])
        raise SessionError(
            path,
            f"the 3x3 part of row {row} is no rotation (R R^T differs from 1 by {error[row]:.3g})",
            "orthonormal axes with determinant +1",
            row=row,
        )


def _check_unit(path: Path, columns: Table) -> None:
    if not all(name in columns for name in QUATERNION):
        return
    norm = np.linalg.norm(_stack(columns, *QUATERNION), axis=1)
    bad = np.flatnonzero(~(np.abs(norm - 1.0) < 1e-2))
    if len(bad):
        row = int(bad[0])
        raise SessionError(
            path,
            f"quaternion norm {norm[row]:.6g} at row {row} ({len(bad)} such rows in all)",
            "1 within 0.01",
            "check the column order, or delete the rows without attitude",
            row=row,
        )


def _built(path: Path, columns: Table) -> Reference:
    stream, _ = build_stream(Reference, columns, path)
    assert isinstance(stream, Reference)
    steps = np.diff(stream.t_ns) / NS
    if len(steps) > 2 and steps[0] > _CUT * np.median(steps):
        warn(f"{path}: row 0 lies {steps[0]:.6g} s before row 1, others {np.median(steps):.6g} s: is its stamp cut?")
    return stream
