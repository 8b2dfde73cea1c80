"""Pose fixes from a map: a COLMAP reconstruction that contains images of the session.

The poses of a reconstruction (`cam_from_world`, a spelling confined to this module) are turned into poses of the body
through the camera's mount. Its scale and frame are estimated from known positions: fixes, surveyed points, or a
solution without the map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from smartnav_graph.core.arrays import Floats, Mask, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.session.streams import Images, PoseFix
from smartnav_graph.vision.similarity import Similarity, fit_similarity

if TYPE_CHECKING:
    import pycolmap


SOURCE = "colmap"
EXAMPLES = 3  # names in an error message
LONGEST_GAP_S = 2.0  # between two known positions, to interpolate them
LEAST_SIGMA_M, LEAST_SIGMA_DEG = 0.01, 0.1  # floors of the sigmas, which come from the residuals at known positions


class KnownPositions(NamedTuple):
    """Positions known without the map, of the point body_t (3,) m of the body: t_ns (k,) ascending, nav_t (k, 3) m;
    interpolated between two that are at most `LONGEST_GAP_S` apart."""

    t_ns: Times
    nav_t: Floats
    body_t: tuple[float, float, float] = (0.0, 0.0, 0.0)


def own_fixes(session: Session) -> KnownPositions:
    """Known positions of a session from its GNSS fixes, at the antenna.

    Raises
    ------
    SessionError
        There are none.
    """
    if session.gnss is None:
        remedy = "smooth it without the map, and give that run (--known RUN)"
        raise SessionError(session.path or "session", "has no gnss fixes to align a map", "known positions", remedy)
    return KnownPositions(session.gnss.t_ns, session.nav_position(session.gnss), body_t=session.mount("gnss").body_t)


@dataclass(frozen=True)
class MapFixes:
    """Pose fixes and the similarity from the map to nav.

    counts : images of the map that are ``used``, ``aligned`` (of them, with a known position), ``unregistered``
        (without a pose), ``unknown`` (no image of the session has their name)
    """

    fixes: PoseFix
    similarity: Similarity
    counts: Mapping[str, int]


def map_pose_fixes(
    reconstruction: str | Path | pycolmap.Reconstruction, session: Session, known: KnownPositions
) -> MapFixes:
    """Poses of the body from the poses of the session's images in a reconstruction.

    Parameters
    ----------
    reconstruction : of pycolmap, or the folder with its files
    session : with images, mounts and time offsets of the cameras
    known : positions that determine scale and frame

    Returns
    -------
    MapFixes; rows in time order, one for each image of the session in the map.

    Raises
    ------
    SessionError
        No such reconstruction; the session has no images, or a mount of pose fixes; no image of the map is the
        session's.
    SolverError
        Too few images have a known position, or these lie on a line.
    """
    where = "reconstruction" if not isinstance(reconstruction, str | Path) else str(reconstruction)
    if session.mount("pose_fixes") != Mount():
        fault = "session.toml places a sensor of pose fixes"
        raise SessionError(session.path or "session", fault, "fixes of the body itself", "remove [sensors.pose_fixes]")
    if session.images is None:
        raise SessionError(session.path or "session", "no images", "an images stream", "import the pictures")
    opened = _open(reconstruction)
    registered = _registered(opened)
    rows = _rows(registered, session.images, where)
    poses = _poses(registered, rows, session)
    placed, there = _known_positions(known, poses.t_ns)
    lever = poses.lever - poses.map_R_body @ np.array(known.body_t)
    found = fit_similarity(poses.centres[there], lever[there], placed[there], where)
    counts = {"used": len(rows), "aligned": int(there.sum()), "unknown": len(registered) - len(rows)}
    counts["unregistered"] = len(opened.images) - len(registered)
    turns = Rotation.from_matrix(found.nav_R_map @ poses.map_R_body).as_quat(canonical=True)
    fixes = PoseFix(
        t_ns=poses.t_ns,
        enu=found.positions(poses.centres, poses.lever),
        sigma=np.full((len(rows), 3), max(found.sigma, LEAST_SIGMA_M)),
        quat=np.roll(turns, 1, axis=1),
        sigma_rot=np.tile(np.hypot(found.rotation_sigma, np.radians(LEAST_SIGMA_DEG)), (len(rows), 1)),
        source=np.full(len(rows), SOURCE, dtype=object),
    )
    return MapFixes(fixes, found, counts)


def _open(reconstruction: str | Path | pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    if not isinstance(reconstruction, str | Path):
        return reconstruction
    import pycolmap

    try:
        return pycolmap.Reconstruction(str(reconstruction))
    except (ValueError, RuntimeError, OSError) as error:
        reason = str(error).split("] ", 1)[-1]
        expected = "a folder with cameras, images and points3D (.bin or .txt)"
        raise SessionError(reconstruction, f"cannot be read ({reason})", expected) from error


def _registered(reconstruction: pycolmap.Reconstruction) -> dict[str, Floats]:
    """map_T_cam (4, 4) of the images that have a pose, by name."""
    images = [image for image in reconstruction.images.values() if image.has_pose]
    poses = [image.cam_from_world().inverse().matrix() for image in images]
    return {image.name: np.vstack([pose, [0.0, 0.0, 0.0, 1.0]]) for image, pose in zip(images, poses, strict=True)}


def _rows(registered: Mapping[str, Floats], images: Images, where: str) -> dict[str, int]:
    """Row of the session's image of each name, in time order: the same path, or the only file of that name."""
    paths = {str(file): row for row, file in enumerate(images.file)}
    last = Counter(Path(path).name for path in paths)
    names = {Path(path).name: row for path, row in paths.items() if last[Path(path).name] == 1}
    found = {name: paths.get(name, names.get(Path(name).name, -1)) for name in registered}
    unknown = sorted(name for name, row in found.items() if row < 0)
    if len(unknown) == len(found):
        problem = f"none of its {len(found)} registered images is the session's"
        problem += f" (such as {', '.join(unknown[:EXAMPLES])})" if unknown else ""
        raise SessionError(where, problem, f"names such as {', '.join(list(paths)[:EXAMPLES])}", "name the files alike")
    rows = {name: row for name, row in found.items() if row >= 0}
    return dict(sorted(rows.items(), key=lambda item: images.t_ns[item[1]]))


class _BodyPoses(NamedTuple):
    """IMU times (n,), camera centres (n, 3) in map units, map_R_body (n, 3, 3), map_R_body body_t_cam (n, 3) m."""

    t_ns: Times
    centres: Floats
    map_R_body: Floats
    lever: Floats


def _poses(registered: Mapping[str, Floats], rows: Mapping[str, int], session: Session) -> _BodyPoses:
    """Poses of the session's images."""
    assert session.images is not None
    cameras = {} if session.calibration is None else session.calibration.cameras
    names = [str(session.images.camera[row]) for row in rows.values()]
    offset_ns = [round(cameras[name].time_offset_s * NS) if name in cameras else 0 for name in names]
    body_R_cam = np.array([session.mount(name).body_R for name in names])
    body_t_cam = np.array([session.mount(name).body_t for name in names])
    map_T_cam = np.array([registered[name] for name in rows])
    map_R_body = map_T_cam[:, :3, :3] @ body_R_cam.transpose(0, 2, 1)
    lever = (map_R_body @ body_t_cam[:, :, None])[:, :, 0]
    stamps = session.images.t_ns[list(rows.values())] + np.array(offset_ns, dtype=np.int64)
    return _BodyPoses(stamps, map_T_cam[:, :3, 3], map_R_body, lever)


def _known_positions(known: KnownPositions, t_ns: Times) -> tuple[Floats, Mask]:
    """Known positions (n, 3) at times (n,), and at which of these they are known."""
    at = np.asarray(known.t_ns, dtype=np.int64)
    if known.nav_t.shape != (len(at), 3) or not np.isfinite(known.nav_t).all() or (np.diff(at) <= 0).any():
        found = f"{len(at)} times and positions {known.nav_t.shape}"
        raise SessionError("known positions", found, "ascending times and (k, 3) finite metres")
    if len(at) == 0:
        return np.zeros((len(t_ns), 3)), np.zeros(len(t_ns), dtype=bool)
    after = np.searchsorted(at, t_ns)
    right, left = np.clip(after, 0, len(at) - 1), np.clip(after - 1, 0, len(at) - 1)
    there = (at[right] == t_ns) | (
        (after > 0) & (after < len(at)) & (at[right] - at[left] <= round(LONGEST_GAP_S * NS))
    )
    return interpolate(t_ns, at, known.nav_t), there
