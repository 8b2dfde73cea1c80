"""EuRoC / ASL folders: ``imu0/data.csv``, ``cam*/data.csv`` with their ``sensor.yaml``, and the ground truth if there.
TUM-VI folders have the same files, the ground truth in ``mocap0``, and the cameras in ``dso/camchain.yaml`` (Kalibr).

Burri et al. (2016), The EuRoC micro aerial vehicle datasets. The body is the IMU: extrinsics T_BS of the cameras are
taken relative to the IMU's own. Their interior orientation goes into the calibration, where sensor.yaml has it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import CalibrationError, SessionError
from smartnav_graph.readers.axes import find_body_axes
from smartnav_graph.readers.kalibr import kalibr_cameras
from smartnav_graph.readers.reference import euroc_columns
from smartnav_graph.readers.source import Reader, build_session, inertial_columns, mount
from smartnav_graph.readers.text import read_bytes, read_text
from smartnav_graph.readers.text_lines import heading_of
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Device, Mount, Session

GRAVITY = 9.81
# The cameras are triggered by the clock of the IMU, and were calibrated with it to hundredths of a degree (Furgale et
# al. 2013, Kalibr): images of a flight determine their attitude less well.
calibrated = partial(Camera, boresight_sigma_deg=0.03, time_offset_sigma_s=0.002, focal_sigma=0.0)
GROUND_TRUTH = (Path("state_groundtruth_estimate0", "data.csv"), Path("mocap0", "data.csv"), Path("gt", "data.csv"))
CAMERA_CHAIN = (Path("dso", "camchain.yaml"), Path("camchain.yaml"), Path("calibration", "camchain.yaml"))

DEVICE = "EuRoC VI-Sensor ADIS16448"

# Names of distortion in sensor.yaml -> those of `calibration.camera`.
_MODELS = {"radial-tangential": "brown", "radtan": "brown", "equidistant": "fisheye"}
_COLUMNS = ("t", "gx", "gy", "gz", "ax", "ay", "az")
_HEADING = re.compile(r"\s*(?:(timestamp)|([wa])_RS_S_([xyz]))\b")
_T_BS = re.compile(r"^T_BS:.*?data:\s*\[([^\]]*)\]", re.DOTALL | re.MULTILINE)


def _root(source: str) -> Path | None:
    for folder in (Path(source), Path(source) / "mav0"):
        if (folder / "imu0" / "data.csv").is_file():
            return folder
    return None


def _order(path: Path) -> tuple[str, ...]:
    """The columns of imu0/data.csv as its heading has them, such as ``w_RS_S_x [rad s^-1]``; those of EuRoC else."""
    found = [_HEADING.match(name) for name in heading_of(path)]
    names = ["t" if m[1] else {"w": "g", "a": "a"}[m[2]] + m[3] for m in found if m]
    return tuple(names) if sorted(names) == sorted(_COLUMNS) and len(names) == len(found) else _COLUMNS


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    root = _root(source)
    if root is None:
        raise SessionError(source, "holds no imu0/data.csv", "an ASL folder (mav0)", "give the folder that holds imu0")
    imu = root / "imu0" / "data.csv"
    rows = read_text(imu, names=_order(imu))
    samples = inertial_columns(rows.ints("t"), rows.floats("gx", "gy", "gz"), rows.floats("ax", "ay", "az"))
    tables: dict[str, tuple[Path, Table]] = {"imu": (imu, samples)}
    cameras = sorted(file.parent.name for file in root.glob("cam*/data.csv"))
    if cameras:
        tables["images"] = (root / cameras[0] / "data.csv", _image_columns(root, cameras))
    for truth in (root / name for name in GROUND_TRUTH if (root / name).is_file()):
        tables.setdefault("reference", (truth, euroc_columns(truth)))
    if (root / "imu0" / "sensor.yaml").is_file():
        device, mounts, calibration = Device(DEVICE, "+z", "+x"), _mounts(root, cameras), _calibration(root, cameras)
    else:
        chains = [folder / file for folder in (root, root.parent) for file in CAMERA_CHAIN]
        mounts, calibration = kalibr_cameras(next((file for file in chains if file.is_file()), None), cameras)
        device = _device(samples, mounts)
    return build_session(
        tables,
        repairs,
        device=device,
        clock_epoch="unix",
        gravity_m_s2=GRAVITY,
        sensors=mounts,
        calibration=calibration,
        pictures=root,
    )


def _device(samples: Table, mounts: Mapping[str, Mount]) -> Device:
    """Up by gravity; forward the axis nearest to where the first camera looks, where its mount is known."""
    axes = find_body_axes(samples)
    forward = axes.forward
    if mounts:
        ahead = np.array(next(iter(mounts.values())).body_R)[:, 2] * (np.array(list("xyz")) != axes.up[1])
        axis = int(np.argmax(np.abs(ahead)))
        forward = f"{'+' if ahead[axis] > 0 else '-'}{'xyz'[axis]}"
    return Device(name="ASL folder", forward=forward, up=axes.up)


def _image_columns(root: Path, cameras: list[str]) -> Table:
    """One row per image of any camera, by time; file names are relative to the ASL folder."""
    t_ns: list[Times] = []
    files: list[str] = []
    names: list[str] = []
    for camera in cameras:
        table = read_text(root / camera / "data.csv", names=("t", "file"))
        t_ns.append(table.ints("t"))
        files += [f"{camera}/data/{file}" for file in table.texts("file")]
        names += [camera] * len(table)
    times = np.concatenate(t_ns)
    order = np.argsort(times, kind="stable")
    return {
        "t_ns": times[order],
        "image_id": np.arange(len(times)),
        "file": np.array(files, dtype=object)[order],
        "camera": np.array(names, dtype=object)[order],
    }


def _mounts(root: Path, cameras: list[str]) -> Mapping[str, Mount]:
    imu_T_base = np.linalg.inv(_extrinsics(root / "imu0" / "sensor.yaml"))
    poses = {camera: imu_T_base @ _extrinsics(root / camera / "sensor.yaml") for camera in cameras}
    return {camera: mount(pose[:3, 3], pose[:3, :3]) for camera, pose in poses.items()}


def _calibration(root: Path, names: list[str]) -> Calibration | None:
    """The cameras that sensor.yaml knows; None where it knows none."""
    found = {name: camera for name in names if (camera := _camera(root / name / "sensor.yaml")) is not None}
    return Calibration(device=DEVICE, cameras=found) if found else None


def _camera(path: Path) -> Camera | None:
    """Interior orientation of a sensor.yaml; None where it has none."""
    text = read_bytes(path).decode("utf-8", errors="replace")
    if "intrinsics:" not in text:
        return None
    lists = {name: _numbers(path, text, name) for name in ("intrinsics", "resolution", "distortion_coefficients")}
    named = re.search(r"^distortion_model:\s*(\S+)", text, re.MULTILINE)
    model = _MODELS.get(named[1] if named else "")
    try:
        if model is None:
            raise ValueError(f"distortion_model is {named[1] if named else 'missing'}")
        width, height = map(int, lists["resolution"])
        fx, fy, cx, cy = lists["intrinsics"]
        coefficients = tuple(lists["distortion_coefficients"])
        return calibrated(width, height, fx, fy, cx, cy, model, coefficients)
    except ValueError as error:
        expected = f"resolution (2), intrinsics (4) and a distortion_model of {', '.join(_MODELS)}"
        raise SessionError(path, f"describes no camera ({error})", expected) from error
    except CalibrationError as error:
        raise error.located(path) from error


def _numbers(path: Path, text: str, name: str) -> list[float]:
    found = re.search(rf"^{name}:\s*\[([^\]]*)\]", text, re.MULTILINE)
    try:
        return [float(cell) for cell in found[1].split(",")] if found else []
    except ValueError as error:
        raise SessionError(path, f"{name} is no list of numbers ({error})", f"{name}: [1, 2, ...]") from error


def _extrinsics(path: Path) -> Floats:
    found = _T_BS.search(read_bytes(path).decode("utf-8", errors="replace"))
    try:
        numbers = np.array(found[1].split(",") if found else [], dtype=np.float64)
        return numbers.reshape(4, 4)
    except ValueError as error:
        raise SessionError(path, "T_BS is missing or no matrix", "16 numbers under T_BS: data", str(error)) from error


READER = Reader(
    name="euroc",
    summary="EuRoC / ASL or TUM-VI folder: IMU, cameras, ground truth",
    recognised_by="a folder (or its mav0) with imu0/data.csv",
    matches=lambda source: _root(source) is not None,
    read_source=_read,
)
