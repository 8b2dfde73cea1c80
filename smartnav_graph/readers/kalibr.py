"""Cameras of a Kalibr camera chain (camchain.yaml): intrinsics, distortion, pose in the IMU.

Furgale, Rehder, Siegwart (2013), Unified temporal and spatial calibration for multi-sensor systems, IROS; the wiki of
Kalibr, "Yaml formats". T_cam_imu takes IMU axes to camera axes; timeshift_cam_imu: t_imu = t_cam + shift.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.errors import CalibrationError, SessionError
from smartnav_graph.readers.source import mount
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.session import Mount

_MODELS = {"radtan": "brown", "equidistant": "fisheye", "equi": "fisheye", "none": "brown"}


def kalibr_cameras(path: Path | None, names: list[str]) -> tuple[dict[str, Mount], Calibration | None]:
    """Mounts and interior orientation of the cameras of `names` that the chain has; none without a file.

    Raises
    ------
    SessionError
        The file is no camera chain.
    """
    if path is None:
        return {}, None
    mounts, cameras = {}, {}
    for name, camera in _cameras(path).items():
        if name not in names or not isinstance(camera, Mapping):
            continue
        try:
            body_T_cam = np.linalg.inv(_array(camera["T_cam_imu"], (4, 4)))
            (fx, fy, cx, cy), (width, height) = _array(camera["intrinsics"], (4,)), _array(camera["resolution"], (2,))
            distortion = tuple(float(value) for value in camera.get("distortion_coeffs", ()))
            model = _MODELS[str(camera.get("distortion_model", "none"))]
            shift = float(camera.get("timeshift_cam_imu", 0.0))
            cameras[name] = Camera(
                *(int(width), int(height), float(fx), float(fy), float(cx), float(cy), model, distortion),
                time_offset_s=shift,
                boresight_sigma_deg=0.1,
                time_offset_sigma_s=0.002,
                focal_sigma=0.0,
            )
        except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
            expected = "T_cam_imu, intrinsics (4), resolution (2), distortion_model radtan or equidistant"
            raise SessionError(path, f"{name} is no camera ({error})", expected) from error
        except CalibrationError as error:
            raise error.located(path) from error
        mounts[name] = mount(body_T_cam[:3, 3], body_T_cam[:3, :3])
    return mounts, Calibration(device="Kalibr", cameras=cameras) if cameras else None


def _cameras(path: Path) -> Mapping[str, object]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        found: object = YAML(typ="safe").load(path.read_text(encoding="utf-8", errors="replace"))
    except (OSError, YAMLError, ValueError) as error:
        raise SessionError(path, f"cannot be read ({error})", "a camera chain of Kalibr", "copy it again") from error
    if not isinstance(found, Mapping):
        raise SessionError(path, "is no camera chain", "cam0: ...", "copy it again")
    return found


def _array(values: object, shape: tuple[int, ...]) -> Floats:
    array = np.array(values, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"shape {array.shape} instead of {shape}")
    return array
