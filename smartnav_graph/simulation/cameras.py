"""What a camera on an exact motion sees of a scene: images, matches between them, tracks through them.

    (X, Y, Z) = cam_R_nav (point - nav_t_cam)
    pixel     = Camera.pixels(X / Z, Y / Z) + noise
    nav_R_cam = nav_R_body body_R_cam,  nav_t_cam = nav_t_body + nav_R_body body_t

Noise is added to the pixels, as a detector makes it, and taken through the camera's model to undistorted normalised
coordinates. A frame stamped t shows the time t + `Camera.time_offset_s` + `clock_s` in its first row, and `readout_s`
later in its last. The session holds the camera and the mount of the model; `boresight_deg` and `clock_s` are errors
unknown to it. Extra column `truth_inlier`: 1 where both ends of a match, or the observation of a track, are the
projection of one point of the scene and noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Mask, Times
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import exp, rotate_back
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Mount
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import Images, Matches, Tracks
from smartnav_graph.simulation.scenes import Scene
from smartnav_graph.simulation.trajectory import Trajectory

Range = tuple[float, float]

# Optical axes (x right, y down, z forward) of a camera that looks along +y of a body with z up.
LOOKING_AHEAD = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
# The camera of the thesis' phone (3264 x 2448) read out at 640 x 480, and where it is in the phone.
PHONE_CAMERA = Camera(
    width=3264,
    height=2448,
    fx=2935.64,
    fy=2944.08,
    cx=1619.0,
    cy=1234.0,
    distortion=(0.228, -0.973, -2.32e-4, -1.29e-3, 0.951),
    noise_px=0.7,
).resized(640, 480)
ON_PHONE = Mount(body_t=(0.02, 0.05, -0.01), body_R=LOOKING_AHEAD)
# Times a rolling shutter's row is found again at the pose of its time: 1 rad/s and 30 ms move it by 1 % of itself.
_ROW_PASSES = 3


@dataclass(frozen=True)
class Faults:
    """Faults of features beside noise.

    outliers : share of wrong ones, drawn anew for every pair or frame between the two; moving : share of a pair's
    features on an object that moves, by `moving_px` all together; lost : share of a frame's tracks that end in it
    glitches : (s, px), in the frame next to that time every feature is off by so much in one
    direction; blind : (start s, length s) without any features, as in the dark
    """

    outliers: Range = (0.0, 0.0)
    moving: Range = (0.0, 0.0)
    moving_px: Range = (5.0, 40.0)
    lost: float = 0.0
    glitches: tuple[tuple[float, float], ...] = ()
    blind: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        shares = (*self.outliers, *self.moving, self.lost)
        ordered = self.outliers[0] <= self.outliers[1] and self.moving[0] <= self.moving[1]
        if not (ordered and min(shares) >= 0.0 and max(*shares, self.outliers[1] + self.moving[1]) < 1.0):
            raise ConfigError("camera", f"outliers, moving and lost {shares}", "shares from 0 to below 1")


@dataclass(frozen=True)
class PictureModel:
    """How pictures are taken.

    texels_per_m : fineness of the textures; exposure_s : 0 for no blur, else the mean of `blur_steps` pictures;
    noise : sigma of a pixel in grey levels of 255; contrast : of the textures, 1 uses all grey levels
    """

    texels_per_m: float = 160.0
    exposure_s: float = 0.0
    blur_steps: int = 8
    noise: float = 2.0
    contrast: float = 0.8

    def __post_init__(self) -> None:
        if not (self.texels_per_m > 0 and self.exposure_s >= 0 and self.noise >= 0 and 0 < self.contrast <= 1):
            raise ConfigError("pictures", f"{self}", "texels and contrast (up to 1) > 0, the rest >= 0")
        if self.blur_steps < 2:
            raise ConfigError("pictures", f"blur_steps = {self.blur_steps}", "at least 2")


@dataclass(frozen=True, kw_only=True)
class SimulatedCamera:
    """A camera and what is kept of its images.

    camera, mount : as in the session; rate_hz : of images; scene : new for each seed
    count : fewest and most features of a pair (matches) or a frame (tracks); pairs : spans between the images of a
    pair, () for no matches; tracked : tracks too; pictures : rendered ones
    range_m : nearest (depth) and farthest point that is seen
    boresight_deg : the true axes are body_R_cam Exp(boresight), degrees about the optical axes; clock_s : a frame
    shows a time so much later than the session assumes
    """

    camera: Camera
    scene: Callable[[np.random.Generator], Scene]
    mount: Mount = Mount(body_R=LOOKING_AHEAD)
    name: str = "cam0"
    rate_hz: float = 10.0
    count: tuple[int, int] = (20, 60)
    pairs: tuple[int, ...] = ()
    tracked: bool = False
    pictures: PictureModel | None = None
    range_m: Range = (0.3, 15.0)
    faults: Faults = Faults()
    boresight_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clock_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.count[0] <= self.count[1]:
            raise ConfigError("camera", f"count {self.count}", "0 < fewest <= most")
        if min(self.pairs, default=1) < 1:
            raise ConfigError("camera", f"pairs {self.pairs}", "spans of at least one image")

    @property
    def offset_s(self) -> float:
        """True time of a frame's first row less its stamp."""
        return self.camera.time_offset_s + self.clock_s

    def poses(self, trajectory: Trajectory, t: Floats) -> tuple[Floats, Floats]:
        """True nav_R_cam (n, 3, 3) and nav_t_cam (n, 3) at times (n,) s."""
        body = trajectory.sample(np.clip(t, 0.0, trajectory.duration))
        turn = exp(np.radians(self.boresight_deg))
        rotation = body.nav_R_body @ np.asarray(self.mount.body_R) @ turn
        return rotation, body.nav_t_body + body.nav_R_body @ np.asarray(self.mount.body_t)


class Projection(NamedTuple):
    """Points of the scene (k,) that a frame shows, and where, exactly: pixels (k, 2)."""

    rows: Indices
    xy_px: Floats


def take(
    model: SimulatedCamera, trajectory: Trajectory, t_ns: Times, t: Floats, scene: Scene, rng: np.random.Generator
) -> dict[str, Stream | None]:
    """Images at the stamps t_ns (n,), at times t (n,) s of the trajectory, and the features in them, by stream."""
    images = _images(model, t_ns)
    if not (model.pairs or model.tracked):
        return {"images": images}
    views = [project(model, trajectory, scene, float(at)) for at in t]
    jumps = _jumps(model, t, rng)
    blind = _blind(model, t)
    views = [Projection(v.rows[:0], v.xy_px[:0]) if dark else v for v, dark in zip(views, blind, strict=True)]
    matches = _matches(model, views, jumps, t_ns, rng) if model.pairs else None
    tracks = _tracks(model, views, jumps, t_ns, rng) if model.tracked else None
    return {"images": images, "matches": matches, "tracks": tracks}


def file_name(image_id: int) -> str:
    """Name of a picture in the session's images folder."""
    return f"{image_id:06d}.png"


def _images(model: SimulatedCamera, t_ns: Times) -> Images:
    ids = np.arange(len(t_ns))
    files = [file_name(i) if model.pictures else "" for i in range(len(ids))]
    exposure, readout = model.pictures.exposure_s if model.pictures else 0.0, model.camera.readout_s
    return Images(
        t_ns=t_ns,
        image_id=ids,
        file=np.array(files, dtype=object),
        camera=np.full(len(ids), model.name, dtype=object),
        exposure_ns=np.full(len(ids), round(NS * exposure)) if exposure else None,
        readout_ns=np.full(len(ids), round(NS * readout)) if readout else None,
    )


def project(model: SimulatedCamera, trajectory: Trajectory, scene: Scene, t: float) -> Projection:
    """What the frame stamped `t` s shows, exactly."""
    camera = model.camera
    begin = t + model.offset_s
    (R,), (centre,) = model.poses(trajectory, np.array([begin + camera.readout_s / 2]))
    rows = scene.seen_from(centre, _in_sight(model, R, centre, scene))
    points = scene.points[rows]
    xy = camera.pixels(_flat((points - centre) @ R))
    for _ in range(_ROW_PASSES if camera.readout_s > 0 else 0):
        at = begin + camera.readout_s * xy[:, 1] / (camera.height - 1)
        rotation, centres = model.poses(trajectory, at)
        xy = camera.pixels(_flat(rotate_back(rotation, points - centres)))
    inside = ((xy >= 0.0) & (xy <= [camera.width - 1, camera.height - 1])).all(axis=1)
    return Projection(rows[inside], xy[inside])


def _flat(points: Floats) -> Floats:
    """Normalised coordinates (n, 2) of points (n, 3) in optical axes."""
    return np.asarray(points[:, :2] / points[:, 2:])


def _in_sight(model: SimulatedCamera, R: Floats, centre: Floats, scene: Scene) -> Indices:
    """Points in front, within range, and not far beyond the corners of the image, where distortion would fold them in.

    The margin allows for motion during the readout of a rolling shutter.
    """
    camera = model.camera
    corners = np.array([[x, y] for x in (0, camera.width - 1) for y in (0, camera.height - 1)], dtype=np.float64)
    widest = 1.1 * np.abs(camera.normalised(corners)).max(axis=0)
    near, far = model.range_m
    rows = scene.near(centre, far)
    seen = (scene.points[rows] - centre) @ R
    inside = (seen[:, 2] > near) & (np.abs(seen[:, :2]) < widest * seen[:, 2:]).all(axis=1)
    return np.asarray(rows[inside], dtype=np.intp)


def _jumps(model: SimulatedCamera, t: Floats, rng: np.random.Generator) -> Floats:
    """Glitches (n, 2) px, by which all features of a frame are off."""
    jumps = np.zeros((len(t), 2))
    for at, size in model.faults.glitches:
        angle = rng.uniform(0.0, 2 * np.pi)
        jumps[int(np.argmin(np.abs(t - at)))] = size * np.array([np.cos(angle), np.sin(angle)])
    return jumps


def _blind(model: SimulatedCamera, t: Floats) -> Mask:
    blind = np.zeros(len(t), dtype=bool)
    for start, length in model.faults.blind:
        blind |= (t >= start) & (t < start + length)
    return blind


def _noisy(model: SimulatedCamera, xy_px: Floats, rng: np.random.Generator) -> Floats:
    return np.asarray(xy_px + model.camera.noise_px * rng.standard_normal(xy_px.shape))


def _matches(
    model: SimulatedCamera, views: Sequence[Projection], jumps: Floats, t_ns: Times, rng: np.random.Generator
) -> Matches | None:
    """Matches of images whose numbers differ by one of `pairs`."""
    found = [
        (i, i + span, *pair)
        for i in range(len(views))
        for span in model.pairs
        if i + span < len(views) and len((pair := _pair(model, views[i], views[i + span], rng))[0])
    ]
    if not found:
        return None
    first, second = (np.concatenate([np.full(len(row[2]), row[k]) for row in found]) for k in (0, 1))
    xy0, xy1 = (np.concatenate([row[k] for row in found]) for k in (2, 3))
    good = np.concatenate([row[4] for row in found]) & ~jumps[first].any(axis=1) & ~jumps[second].any(axis=1)
    return Matches(
        t_ns=t_ns[first],
        image_id_0=first,
        image_id_1=second,
        t_1_ns=t_ns[second],
        xy0_n=model.camera.normalised(_noisy(model, xy0, rng) + jumps[first]),
        xy1_n=model.camera.normalised(_noisy(model, xy1, rng) + jumps[second]),
        extra={"truth_inlier": good.astype(np.int64)},
    )


def _pair(
    model: SimulatedCamera, one: Projection, other: Projection, rng: np.random.Generator
) -> tuple[Floats, Floats, Mask]:
    """Pixels (m, 2) in both images and whether they are the same point: a wrong match takes another point of the
    second image."""
    common, i, j = np.intersect1d(one.rows, other.rows, return_indices=True)
    count = min(int(rng.integers(model.count[0], model.count[1] + 1)), len(common))
    wrong = round(float(rng.uniform(*model.faults.outliers)) * count)
    chosen = rng.permutation(len(common))[:count]
    i, j, good = i[chosen], j[chosen], np.arange(count) >= wrong
    if (others := len(other.rows) - 1) > 0:
        j[:wrong] = (j[:wrong] + 1 + rng.integers(others, size=wrong)) % (others + 1)
    xy1 = other.xy_px[j]
    if model.faults.moving[1] > 0.0:
        moved = slice(wrong, wrong + round(float(rng.uniform(*model.faults.moving)) * count))
        angle = rng.uniform(-0.2, 0.2) + np.pi * rng.integers(2)  # along the road, mostly sideways in the image
        xy1[moved] += rng.uniform(*model.faults.moving_px) * np.array([np.cos(angle), np.sin(angle)])
        good[moved] = False
    return one.xy_px[i], xy1, good


def _tracks(
    model: SimulatedCamera, views: Sequence[Projection], jumps: Floats, t_ns: Times, rng: np.random.Generator
) -> Tracks | None:
    """Tracks that end where their point is lost or not visible; new ones fill the frame to its number."""
    seen = list(_followed(model, views, rng))
    image = np.repeat(np.arange(len(views)), [len(ids) for ids, _ in seen])
    if not len(image):
        return None
    xy = _noisy(model, np.concatenate([px for _, px in seen]), rng) + jumps[image]
    good = ~jumps[image].any(axis=1)
    share = rng.uniform(*model.faults.outliers, size=len(views))
    wrong = rng.random(len(image)) < share[image]
    xy[wrong] = rng.uniform([0.0, 0.0], [model.camera.width, model.camera.height], (int(wrong.sum()), 2))
    return Tracks(
        t_ns=t_ns[image],
        image_id=image,
        track_id=np.concatenate([ids for ids, _ in seen]),
        xy_n=model.camera.normalised(xy),
        xy_px=xy,
        extra={"truth_inlier": (good & ~wrong).astype(np.int64)},
    )


def _followed(
    model: SimulatedCamera, views: Sequence[Projection], rng: np.random.Generator
) -> Iterator[tuple[Indices, Floats]]:
    """Track numbers (k,) and exact pixels (k, 2) in each frame."""
    points, ids, fresh = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp), 0
    for shown in views:
        kept = np.isin(points, shown.rows) & (rng.random(len(points)) >= model.faults.lost)
        points, ids = points[kept], ids[kept]
        wanted = int(rng.integers(model.count[0], model.count[1] + 1)) - len(points)
        others = rng.permutation(np.setdiff1d(shown.rows, points))[: max(wanted, 0)]
        points = np.concatenate([points, others])
        ids = np.concatenate([ids, np.arange(fresh, fresh + len(others))])
        fresh += len(others)
        yield ids, shown.xy_px[np.searchsorted(shown.rows, points)]
