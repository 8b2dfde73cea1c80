"""Camera against IMU: clock offset and its drift, turn and position of the camera in the body, rolling shutter.

From any recording with tracks or matches in which the device was turned about more than one axis; see `turns`. The
position needs accelerations, too, which give the motion its length; see `lever_arm`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from smartnav_graph.calibrate.lever_arm import lever_arm
from smartnav_graph.calibrate.result import CalibrationResult, Chart, Series
from smartnav_graph.calibrate.turn_start import TurnProblem, TurnState
from smartnav_graph.calibrate.turns import GyroAlignment, align_to_gyro, usable_pairs
from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError, ConfigError, SmartnavError
from smartnav_graph.core.so3 import log
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.calibration.pieces import Residual, Value
from smartnav_graph.session.session import Session
from smartnav_graph.vision.pairs import Pairs, pairs_of_matches, pairs_of_tracks

WHERE = "calibrate camera-imu"
RATE_HZ = 10.0  # of the images of tracks
LENGTH_S = (0.15, 1.2)  # of pairs of matches
LEAST_RATE = 0.05  # rad/s, root mean square about the mean of the rates
OPEN_DEG, OPEN_M = 1.0, 0.015  # sigmas of a turn and of a position from which they are refused
ARM_LENGTH_S = (0.2, 0.5)  # of pairs of tracks for the position
MOVING = "move it by 0.3 m and more while it turns, to all sides, for half a minute"
LEAST_SIGMA_S, LEAST_SIGMA_DEG = 1e-4, 0.01  # in calibration.toml: images and inertial data have other errors
TURNING = "turn the device by 30 deg and more about all of its axes, back and forth, for half a minute"
MATCHING = "run smartnav match SESSION --features klt before"


@dataclass(frozen=True, kw_only=True)
class CameraImuOptions:
    """Clock, turn and readout of a camera against the gyroscope, with or without a board: a recording with tracks or
    matches of half a minute or more, in which the device is turned about all axes."""

    camera: str = ""
    """Name of the camera; by default the one that has images or a calibration."""
    span: float = 0.5
    """Time between the two images of a pair of tracks, s; pairs of twice that time are used, too."""


def fit(sources: Sequence[Session], options: CameraImuOptions) -> CalibrationResult:
    """Align a camera with the gyroscope.

    Raises
    ------
    CalibrationError
        No matches, no calibrated camera, too little rotation, or a clock that the recording does not show.
    """
    if options.span <= 0:
        raise ConfigError("--span", f"{options.span} s", "> 0")
    if len(sources) != 1:
        raise CalibrationError(WHERE, f"{len(sources)} recordings", "one: clocks differ between recordings")
    session = sources[0]
    name, camera = _camera(session, options.camera)
    imu = session.require_imu()
    spread = float(np.sqrt((imu.gyro - imu.gyro.mean(axis=0)).var(axis=0).sum()))
    if spread < LEAST_RATE:
        raise CalibrationError(WHERE, f"rates of {spread:.3f} rad/s (RMS)", f"at least {LEAST_RATE}", TURNING)
    pairs = _pairs(session, (options.span, 2 * options.span))
    try:
        found = align_to_gyro(pairs, imu, camera.noise, camera=camera)
    except SmartnavError as error:
        raise CalibrationError(WHERE, error.found, error.expected, f"{error.remedy}; {TURNING}") from error
    return _result(session, name, camera, found, _position(session, camera, found))


def _position(session: Session, camera: Camera, found: GyroAlignment) -> tuple[Floats, Floats] | None:
    """Of the camera in the body (3,) m, with covariance."""
    imu = session.require_imu()
    problem = TurnProblem(usable_pairs(_pairs(session, ARM_LENGTH_S), imu), imu, camera)
    state = TurnState(found.offset_s, found.drift, found.body_R_cam, found.gyro_bias, found.readout_s)
    return lever_arm(problem, state, found.noise, session.gravity)


def _camera(session: Session, asked: str) -> tuple[str, Camera]:
    cameras = {} if session.calibration is None else session.calibration.cameras
    images = session.images
    names = list(cameras) if images is None else list(dict.fromkeys(images.camera.astype(str)))
    name = asked or next((name for name in names if name in cameras), "")
    if name not in cameras:
        found = f"camera {name or ', '.join(names) or 'of no name'} without calibration"
        remedy = "run smartnav calibrate camera, then smartnav calibrate apply"
        raise CalibrationError(session.path or WHERE, found, "its focal length and distortion", remedy)
    return name, cameras[name]


def _pairs(session: Session, spans_s: tuple[float, float]) -> Pairs:
    if session.tracks is not None:
        stamps = np.unique(session.tracks.t_ns)
        rate = min(RATE_HZ, 1e9 / float(np.median(np.diff(stamps)))) if len(stamps) > 1 else RATE_HZ
        return pairs_of_tracks(session.tracks, rate, tuple({max(1, round(span * rate)) for span in spans_s}))
    if session.matches is None:
        raise CalibrationError(session.path or WHERE, "no tracks and no matches", "one of them", MATCHING)
    pairs = pairs_of_matches(session.matches)
    rows = np.flatnonzero((pairs.length_s >= LENGTH_S[0]) & (pairs.length_s <= LENGTH_S[1]))
    return pairs.of(rows.astype(np.intp))


def _result(
    session: Session, name: str, camera: Camera, found: GyroAlignment, position: tuple[Floats, Floats] | None
) -> CalibrationResult:
    values = {
        f"{name}_time_offset": Value(found.offset_s, float(found.sigma("offset")[0]), "s"),
        f"{name}_time_offset_drift": Value(found.drift, float(found.sigma("drift")[0]), "s/s"),
        f"{name}_readout": Value(found.readout_s, float(found.sigma("readout")[0]), "s"),
    }
    if "readout" in found.terms:
        middle = found.offset_s + found.readout_s / 2
        values[f"{name}_time_offset_middle_row"] = Value(middle, found.middle_sigma_s, "s")
    refused = _record_position(name, position, values)
    turn = np.degrees(log(np.asarray(session.mount(name).body_R).T @ found.body_R_cam))
    whole = np.degrees(log(found.body_R_cam))
    for axis, angle, all_of_it, sigma in zip("xyz", turn, whole, np.degrees(found.sigma("boresight")), strict=True):
        values[f"{name}_turn_from_mount_{axis}"] = Value(float(angle), float(sigma), "deg")
        values[f"{name}_rotation_vector_{axis}"] = Value(float(all_of_it), float(sigma), "deg")
        if sigma > OPEN_DEG:
            refused[f"{name}_turn_{axis}"] = f"sigma of {sigma:.1f} deg about this axis of the camera; {TURNING}"
    for axis, bias, sigma in zip("xyz", found.gyro_bias, found.sigma("bias"), strict=True):
        values[f"gyro_bias_{axis}"] = Value(float(bias), float(sigma), "rad/s")
    for term, unit in (("drift", "no drift above three sigmas"), ("readout", "no readout above three sigmas")):
        if term not in found.terms:
            key = f"{name}_time_offset_drift" if term == "drift" else f"{name}_{term}"
            del values[key]
            refused[key] = f"not significant: {unit} in this recording"
    noise = Residual(found.noise * camera.focal, len(found.sound), "px")
    return CalibrationResult(
        values,
        {f"{name}_matches": noise},
        refused,
        _warnings(found),
        _change(session, name, found, None if f"{name}_position" in refused else position),
        charts=(_chart(found),),
    )


def _record_position(name: str, position: tuple[Floats, Floats] | None, values: dict[str, Value]) -> dict[str, str]:
    """The position among the values; the refusal where it is open."""
    if position is None:
        return {f"{name}_position": f"the recording is too short, or its pairs too few; {MOVING}"}
    place, sigmas = position[0], np.sqrt(np.diag(position[1]))
    for axis, value, sigma in zip("xyz", place, sigmas, strict=True):
        values[f"{name}_position_{axis}"] = Value(float(value), float(sigma), "m")
    if sigmas.max() <= OPEN_M:
        return {}
    return {f"{name}_position": f"sigma of {sigmas.max():.2g} m: not used; {MOVING}, or measure it"}


def _warnings(found: GyroAlignment) -> tuple[str, ...]:
    texts = []
    sound = float(found.sound.mean())
    if sound < 0.8:
        texts.append(f"{1 - sound:.0%} of the image pairs disagree with the gyroscope: check matches and intrinsics.")
    if "drift" in found.terms:
        texts.append(
            f"The clock of the camera drifts by {1e3 * found.drift:.2f} ms/s; time_offset_s is that of the middle of "
            "this recording."
        )
    return tuple(texts)


def _change(
    session: Session, name: str, found: GyroAlignment, position: tuple[Floats, Floats] | None
) -> Callable[[Calibration], Calibration]:
    """Puts clock, readout and axes into the camera, where their sigmas are small enough; the position where the session
    has no mount of it, which was measured better."""

    def change(calibration: Calibration) -> Calibration:
        known = {} if session.calibration is None else session.calibration.cameras
        camera = calibration.cameras.get(name, known[name])
        sigma_s = max(float(found.sigma("offset")[0]), float(np.std(found.blocks[:, 1])), LEAST_SIGMA_S)
        camera = replace(camera, time_offset_s=found.offset_s, time_offset_sigma_s=sigma_s)
        if "readout" in found.terms:
            camera = replace(camera, readout_s=max(found.readout_s, 0.0))
        sigma = float(np.degrees(found.sigma("boresight")).max())
        if sigma <= OPEN_DEG:
            axes = tuple(found.body_R_cam.ravel().tolist())
            camera = replace(camera, body_R=axes, boresight_sigma_deg=max(sigma, LEAST_SIGMA_DEG))
        if position is not None and name not in session.sensors:
            camera = replace(camera, body_t=tuple(position[0].tolist()))
        return replace(calibration, cameras={**calibration.cameras, name: camera})

    return change


def _chart(found: GyroAlignment) -> Chart:
    t, offset = found.blocks[:, 0], 1e3 * found.blocks[:, 1]
    band = 1.96e3 * found.block_sigma
    series = (
        Series("95 % of each", t, offset - band, "band", upper=offset + band),
        Series("offset of a part of the recording", t, offset, "dots"),
    )
    note = "Scatter beyond the bands: a clock that varies, or errors of images and gyroscope that are not independent."
    return Chart("Clock offset", "Time since the first image [s]", "Offset [ms]", series, note=note)
