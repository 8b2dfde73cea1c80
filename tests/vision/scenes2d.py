"""Pictures of a textured plane, made where they are needed, and sessions of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.calibration.model import Calibration
from smartnav_graph.session.folder import load, save
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Images, Imu

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
PERIOD_NS = 250_000_000


def texture(seed: int = 0, size: int = 900, grain: float = 1.5) -> np.ndarray:
    """Grey levels (size, size): noise at two scales."""
    rng = np.random.default_rng(seed)
    out = np.zeros((size, size), np.float32)
    for sigma, weight in ((grain, 1.0), (4 * grain, 0.7)):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        out += weight * layer / layer.std()
    return np.clip(128 + 45 * out, 0, 255).astype(np.uint8)


def seen(plane: np.ndarray, H: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """The picture (h, w) in which plane pixel p appears at H p."""
    return cv2.warpPerspective(plane, H, (camera.width, camera.height), flags=cv2.INTER_LINEAR)


def moved(H: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) that the homography takes xy (n, 2) to."""
    return cv2.perspectiveTransform(np.asarray(xy, np.float64)[:, None], H)[:, 0]


def centred(plane: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """Homography that puts the middle of the plane into the middle of the picture."""
    h, w = plane.shape
    return np.array([[1, 0, (camera.width - w) / 2], [0, 1, (camera.height - h) / 2], [0, 0, 1.0]])


def turning(c1_R_c0: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
    """K R K^-1: where the pixels go when the camera turns."""
    return camera.matrix @ c1_R_c0 @ np.linalg.inv(camera.matrix)


def session_of(
    pictures: list[Any], folder: Path, camera: Camera = CAMERA, imu: Imu | None = None, **changes: Any
) -> Session:
    """A session folder of pictures (arrays; bytes as they are; None: no file), 0.25 s apart."""
    source = folder.parent / f"{folder.name}-pictures"
    source.mkdir(parents=True)
    files = [f"{i:03d}.png" for i in range(len(pictures))]
    for file, picture in zip(files, pictures, strict=True):
        if isinstance(picture, bytes):
            (source / file).write_bytes(picture)
        elif picture is not None:
            cv2.imwrite(str(source / file), picture)
    images = Images(
        t_ns=np.arange(len(files)) * PERIOD_NS,
        image_id=np.arange(len(files)) + 10,
        file=np.array(files, dtype=object),
        camera=np.full(len(files), "cam0", dtype=object),
    )
    calibration = Calibration(cameras={"cam0": camera})
    session = Session(images=images, calibration=calibration, imu=imu, pictures=source).replace(**changes)
    save(session, folder)
    return load(folder)


def png(picture: np.ndarray) -> bytes:
    return cv2.imencode(".png", picture)[1].tobytes()


def jpeg(picture: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", picture)[1].tobytes()
