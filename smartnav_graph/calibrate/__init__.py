"""Calibration from recordings: each kind is one module and one row of `KINDS`.

A module has ``fit(sources, options) -> CalibrationResult`` and the dataclass of its options, whose fields are the
options of ``smartnav calibrate KIND``. What the data do not support is not fitted but refused by name.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from smartnav_graph.calibrate.result import CalibrationResult
from smartnav_graph.core.errors import CalibrationError
from smartnav_graph.core.files import replacing
from smartnav_graph.core.timebase import NS, utc_from_gps
from smartnav_graph.session.calibration.model import Calibration, calibration_toml, load_calibration
from smartnav_graph.session.calibration.pieces import Piece
from smartnav_graph.session.session import Session

Fit = Callable[[Sequence[Session] | Sequence[Path], object], CalibrationResult]


@dataclass(frozen=True)
class CalibrationKind:
    """A kind of calibration: its module here, its class of options, one line of help, an example of its use.

    paths : it reads files or folders itself (images), no sessions
    """

    module: str
    options: str
    summary: str
    example: str
    paths: bool = False

    def options_class(self) -> type:
        """The dataclass of the options."""
        found: type = getattr(self._module(), self.options)
        return found

    def fit(self) -> Fit:
        """``fit(sources, options)`` of the module."""
        found: Fit = self._module().fit  # type: ignore[attr-defined]
        return found

    def _module(self) -> object:
        return importlib.import_module(f"smartnav_graph.calibrate.{self.module}")


KINDS: dict[str, CalibrationKind] = {
    "camera": CalibrationKind(
        "camera",
        "CameraOptions",
        "camera from pictures of a chessboard, asymmetric circles or a ChArUco board",
        "smartnav calibrate camera pictures/ --board chessboard:9x6:0.025 --out calibration.toml --report camera.html",
        paths=True,
    ),
    "stereo": CalibrationKind(
        "stereo",
        "StereoOptions",
        "two cameras and their relative pose from pairs of pictures of a board",
        "smartnav calibrate stereo left/ right/ --board chessboard:9x6:0.025 --out calibration.toml",
        paths=True,
    ),
    "camera-imu": CalibrationKind(
        "camera_imu",
        "CameraImuOptions",
        "clock, turn and rolling shutter of a camera against the gyroscope",
        "smartnav calibrate camera-imu walk --out calibration.toml --report camera-imu.html",
    ),
    "accelerometer": CalibrationKind(
        "accelerometer",
        "AccelerometerOptions",
        "bias, scale and misalignment by rests in several attitudes",
        "smartnav calibrate accelerometer rests --out calibration.toml",
    ),
    "gyro": CalibrationKind(
        "gyro",
        "GyroOptions",
        "scale and misalignment by turns between rests",
        "smartnav calibrate gyro turns --turn-deg 360 --out calibration.toml",
    ),
    "imu": CalibrationKind(
        "imu",
        "GyroOptions",
        "accelerometer and gyro by one recording of rests and turns",
        "smartnav calibrate imu rests-and-turns --out calibration.toml --report imu.html",
    ),
    "magnetometer": CalibrationKind(
        "magnetometer",
        "MagnetometerOptions",
        "hard and soft iron, strength, turn to the accelerometer",
        "smartnav calibrate magnetometer turns --out calibration.toml",
    ),
    "clock": CalibrationKind(
        "clock",
        "ClockOptions",
        "rate and jitter of samples; offset and drift between two clocks",
        "smartnav calibrate clock session --claimed-hz 100 --out calibration.toml",
    ),
    "axes": CalibrationKind(
        "axes",
        "AxesOptions",
        "permutation, signs and small angles of a device's axes, by a reference IMU or known turns",
        "smartnav calibrate axes phone reference --out calibration.toml",
    ),
    "static": CalibrationKind(
        "static",
        "StaticOptions",
        "sensors at rest: temperature, drift, noise, Allan deviation",
        "smartnav calibrate static six-hours --out calibration.toml --report static.html",
    ),
}


def date_of(sessions: Sequence[Session] | Sequence[Path]) -> str:
    """Date (UTC) of the first recording whose clock is a date, else of today."""
    for session in sessions:
        if isinstance(session, Session) and session.clock_epoch in ("unix", "gps"):
            gps = session.clock_epoch == "gps"
            unix_ns = int(utc_from_gps(np.array(session.t0_ns))) if gps else session.t0_ns
            return datetime.fromtimestamp(unix_ns / NS, UTC).date().isoformat()
    return datetime.now(UTC).date().isoformat()


def calibrate_into(
    out: Path, kind: str, sources: Sequence[str], options: object = None, *, force: bool = False
) -> tuple[CalibrationResult, Piece]:
    """Calibrate by recordings, and add what is found to the calibration.toml `out`: the result, and its record.

    Parameters
    ----------
    out : the file; other pieces in it stay as they are
    kind : a name of `KINDS`
    sources : session folders or logs; files or folders of images where the kind reads those
    options : of the kind; its defaults by default
    force : replace a piece of the same kind

    Raises
    ------
    CalibrationError
        The recordings do not support the calibration, or the file has this piece already, or is no calibration.toml.
    """
    from smartnav_graph import readers

    row, known = KINDS[kind], Calibration()
    if out.exists():
        known = load_calibration(out)
    if kind in known.pieces and not force:
        found = f"has the piece {kind!r} of {known.pieces[kind].date} already"
        raise CalibrationError(out, found, "a file without it", "choose another --out, or add --force to replace it")
    given: list[Session] | list[Path] = [Path(s) for s in sources] if row.paths else [readers.load(s) for s in sources]
    result = row.fit()(given, row.options_class()() if options is None else options)
    calibration = result.merged(known, kind, date_of(given), [Path(source).name for source in sources])
    with replacing(out) as new:
        new.write_text(calibration_toml(calibration), encoding="utf-8")
    return result, calibration.pieces[kind]
