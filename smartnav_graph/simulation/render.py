"""Pictures of a scene: textured faces, seen ray by ray, with rolling shutter, motion blur and sensor noise.

Every pixel looks along one ray, taken through the camera's distortion; the nearest face it meets gives its brightness.
With a rolling shutter each row has the pose of its time. Blur is the mean of pictures over the exposure, whose
middle is the time of the row. Textures are noise of several scales with sharp edges between patches, so that detectors
find corners near and far; they are drawn anew for each seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from smartnav_graph.core.arrays import Floats
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.simulation.cameras import PictureModel, SimulatedCamera, file_name
from smartnav_graph.simulation.scenes import Scene
from smartnav_graph.simulation.trajectory import Trajectory

Grey = NDArray[np.uint8]

# Metres across the patches of a texture, from a piece of furniture to the smallest print.
_SCALES_M = (1.2, 0.6, 0.3, 0.15, 0.08, 0.04, 0.02)
# Patches of these scales have sharp edges.
_SHARP = (0.6, 0.15)


class _Hit(NamedTuple):
    """The face (h, w) that each pixel sees, -1 for none, and where on it: shares (h, w) of u and v."""

    face: NDArray[np.int32]
    a: Floats
    b: Floats


@dataclass(frozen=True)
class Painted:
    """A scene whose faces have textures: grey levels 0 .. 1, rows along v, columns along u."""

    scene: Scene
    textures: Sequence[Floats]

    @classmethod
    def of(cls, scene: Scene, model: PictureModel, rng: np.random.Generator) -> Painted:
        """Textures for every face."""
        sides = (np.linalg.norm(edges, axis=1) for edges in (scene.v, scene.u))
        return cls(scene, [_texture((float(v), float(u)), model, rng) for v, u in zip(*sides, strict=True)])

    def shades(self, hit: _Hit) -> Floats:
        """Brightness (h, w) of what the pixels see."""
        out = np.full(hit.face.shape, 0.5)
        for f in np.unique(hit.face[hit.face >= 0]):
            here, texture = hit.face == f, self.textures[f]
            at = [hit.b[here] * (texture.shape[0] - 1), hit.a[here] * (texture.shape[1] - 1)]
            out[here] = map_coordinates(texture, at, order=1, mode="nearest")
        return out


def _texture(size_m: tuple[float, float], model: PictureModel, rng: np.random.Generator) -> Floats:
    import cv2

    rows, columns = (max(round(side * model.texels_per_m), 2) for side in size_m)
    total = np.zeros((rows, columns), dtype=np.float32)
    for scale in _SCALES_M:
        grid = rng.standard_normal([int(np.ceil(side / scale)) + 3 for side in size_m]).astype(np.float32)
        fine = cv2.resize(grid, None, fx=scale * model.texels_per_m, fy=scale * model.texels_per_m)[:rows, :columns]
        total += np.sign(fine) if scale in _SHARP else fine
    spread = total - total.mean()
    return np.asarray(np.clip(0.5 + 0.25 * model.contrast * spread / spread.std(), 0.0, 1.0))


def pixel_rays(camera: Camera) -> Floats:
    """Direction (h, w, 3) of every pixel's ray in optical axes, z = 1."""
    y, x = np.mgrid[: camera.height, : camera.width]
    flat = camera.normalised(np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64))
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1).reshape(camera.height, camera.width, 3)


def _cast(scene: Scene, centre: Floats, ray: Floats) -> _Hit:
    """What rays (h, w, 3) in nav axes meet first, each row from its own centre (h, 3)."""
    shape = ray.shape[:2]
    nearest, face = np.full(shape, np.inf), np.full(shape, -1, dtype=np.int32)
    a, b = np.zeros(shape), np.zeros(shape)
    for f, (corner, u, v, normal) in enumerate(zip(scene.corner, scene.u, scene.v, scene.normal, strict=True)):
        from_corner = centre - corner
        height = from_corner @ normal
        if not (height > 0.0).any():
            continue
        down, along_u, along_v = np.moveaxis(ray @ np.stack([-normal, u / (u @ u), v / (v @ v)], axis=1), -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            length = height[:, None] / down
            at_u = (from_corner @ u / (u @ u))[:, None] + length * along_u
            at_v = (from_corner @ v / (v @ v))[:, None] + length * along_v
        hit = (down > 0.0) & (length > 0.0) & (length < nearest)
        hit &= (at_u >= 0.0) & (at_u <= 1.0) & (at_v >= 0.0) & (at_v <= 1.0)
        nearest[hit], face[hit], a[hit], b[hit] = length[hit], f, at_u[hit], at_v[hit]
    return _Hit(face, a, b)


def picture(
    model: SimulatedCamera, trajectory: Trajectory, painted: Painted, ray: Floats, t: float, how: PictureModel
) -> Floats:
    """The frame stamped `t` s without noise: brightness (h, w), 0 .. 1; `ray` as `pixel_rays` gives it."""
    steps = how.blur_steps if how.exposure_s > 0 else 1
    within = (np.arange(steps) + 0.5) / steps - 0.5
    rows = t + model.offset_s + model.camera.readout_s * np.arange(model.camera.height) / (model.camera.height - 1)
    total = np.zeros(ray.shape[:2])
    for share in within:
        R, centre = model.poses(trajectory, rows + share * how.exposure_s)
        total += painted.shades(_cast(painted.scene, centre, ray @ np.swapaxes(R, 1, 2)))
    return total / steps


def render_pictures(
    model: SimulatedCamera,
    trajectory: Trajectory,
    painted: Painted,
    t: Floats,
    how: PictureModel,
    rng: np.random.Generator,
) -> Iterator[Grey]:
    """The frames stamped t (n,) s as the sensor gives them, (h, w) of 0 .. 255."""
    ray = pixel_rays(model.camera)
    for at in t:
        exact = 255.0 * picture(model, trajectory, painted, ray, float(at), how)
        yield np.clip(np.rint(exact + how.noise * rng.standard_normal(exact.shape)), 0, 255).astype(np.uint8)


def write_pictures(folder: Path, shots: Iterator[Grey], count: int, progress: Progress = silent) -> None:
    """`count` pictures as numbered PNG files."""
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    for image_id, shot in enumerate(shots):
        progress("rendering pictures", image_id, count)
        path = folder / file_name(image_id)
        if not cv2.imwrite(str(path), shot):
            raise OSError(0, "picture not written", str(path))
