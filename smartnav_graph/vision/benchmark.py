"""Quality of features over a session with known camera poses: the table of the SmartNav thesis, and ours.

A match is true if its Sampson distance from the epipolar geometry of the reference is at most `TOLERANCE_PX`. If the
baseline is so short that a point `DEPTH_M` away moves by less, the epipolar line has no meaning: then the match is
compared with its prediction by the rotation alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.progress import Progress, silent, under
from smartnav_graph.core.so3 import from_quaternion, rotate, slerp
from smartnav_graph.core.timebase import NS, interpolate
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Matches
from smartnav_graph.vision.epipolar import rays, sampson
from smartnav_graph.vision.front_end import FrontEndConfig, run_front_end

TOLERANCE_PX = 1.5
DEPTH_M = 3.0
# True matches that make a pair useful.
USEFUL = 5


class Published(NamedTuple):
    """A row of the thesis' table: share of true matches, share of pairs with at least five, seconds."""

    true_rate: float
    useful_pairs: float
    seconds: float


THESIS = {
    "fast+freak": Published(0.6864, 0.9444, 0.6),
    "star+brief": Published(0.9782, 0.4444, 0.3),
    "gftt+freak": Published(0.7120, 0.9444, 0.7),
    "orb": Published(0.8499, 0.6111, 1.0),
    "brisk": Published(0.5383, 0.9444, 3.3),
    "mser+freak": Published(0.8469, 0.5556, 0.7),
}


@dataclass(frozen=True)
class Score:
    """One kind of features on one session.

    pairs : with a reference, of them unscored_pairs without; rotation_pairs : scored by rotation alone
    true_rate : true matches of all; useful_pairs : share of pairs with at least five true matches
    median_matches, median_true : of a pair; ms_picture, ms_pair : processor time
    """

    features: str
    policy: str
    pairs: int
    unscored_pairs: int
    rotation_pairs: int
    matches: int
    true_rate: float
    useful_pairs: float
    median_matches: float
    median_true: float
    ms_picture: float
    ms_pair: float
    skipped: Mapping[str, int]

    def to_dict(self) -> dict[str, object]:
        """Plain values, with the row of the thesis."""
        published = THESIS.get(self.features)
        return asdict(self) | {"thesis": None if published is None else published._asdict()}


@dataclass(frozen=True)
class CameraPoses:
    """Poses of the cameras at times: nav_R_cam (n, 3, 3), nav_t_cam (n, 3), and which are `known` (n,)."""

    nav_R_cam: Floats
    nav_t_cam: Floats
    known: Mask

    @classmethod
    def at(cls, session: Session, camera: str, t_ns: NDArray[np.int64]) -> CameraPoses:
        """Of the reference, the camera's mount and its clock.

        Raises
        ------
        SessionError
            No reference, or none with attitude.
        """
        reference = session.reference
        if reference is None or reference.quat is None or len(reference) < 2:
            where, remedy = session.path or "session", "import a log with poses, or give --reference FILE"
            raise SessionError(where, "has no reference with attitude", "reference.parquet with qw, qx, qy, qz", remedy)
        offset = 0 if session.calibration is None else session.calibration.cameras[camera].time_offset_s
        times = np.asarray(t_ns + round(offset * NS), dtype=np.int64)
        known = (times >= reference.t_ns[0]) & (times <= reference.t_ns[-1])
        R = slerp(times, reference.t_ns, from_quaternion(reference.quat))
        t = interpolate(times, reference.t_ns, reference.enu)
        mount = session.mount(camera)
        return cls(R @ np.array(mount.body_R), t + R @ np.array(mount.body_t), known)

    def relative(self, first: NDArray[np.intp], second: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """c0_R_c1 (m, 3, 3) and c0_t_c1 (m, 3) of pairs of rows."""
        back = self.nav_R_cam[first].transpose(0, 2, 1)
        apart = self.nav_t_cam[second] - self.nav_t_cam[first]
        return back @ self.nav_R_cam[second], rotate(back, apart)


def true_matches(R: Floats, t: Floats, x0: Floats, x1: Floats, focal_px: float) -> tuple[Mask, Mask]:
    """Which matches agree with known poses, and which of them were tested by the rotation alone.

    Parameters
    ----------
    R (m, 3, 3), t (m, 3) m : c0_R_c1, c0_t_c1 of each match; x0, x1 (m, 2) undistorted normalised
    focal_px : pixels a unit of these
    """
    weak = np.linalg.norm(t, axis=1) * focal_px / DEPTH_M < TOLERANCE_PX
    safe = np.where(weak[:, None], [0.0, 0.0, 1.0], t)
    epipolar = np.abs(sampson(R, safe, x0[:, None], x1[:, None]).residual[:, 0])
    ahead = rotate(R, rays(x1))
    predicted = ahead[:, :2] / np.where(np.abs(ahead[:, 2:]) > 1e-9, ahead[:, 2:], np.nan)
    error = np.linalg.norm(predicted - x0, axis=1)
    return np.where(weak, error, epipolar) * focal_px <= TOLERANCE_PX, weak


def score_features(session: Session, config: FrontEndConfig, *, workers: int = 0, progress: Progress = silent) -> Score:
    """Match the session's pictures and compare with its reference.

    Raises
    ------
    ConfigError
        The features are tracks.
    SessionError
        As `CameraPoses.at` and `front_end.run_front_end`; or no pair has a reference.
    """
    if config.tracks:
        raise ConfigError("--features", f"{config.features} in a benchmark of descriptors", "detector and descriptor")
    CameraPoses.at(session, *_any_camera(session))  # before the work is done
    found = run_front_end(session, config, workers=workers, progress=progress)
    assert found.matches is not None
    good, weak, known = _classified(session, found.matches)
    both = np.stack([found.matches.image_id_0, found.matches.image_id_1], axis=1)
    pair = np.unique(both, axis=0, return_inverse=True)[1].ravel()
    scored = np.unique(pair[known])
    if not len(scored):
        where = session.path or "session"
        raise SessionError(where, "no pair of pictures has a reference", "poses at the times of the pictures")
    total = np.bincount(pair[known])[scored]
    true = np.bincount(pair[known], weights=good[known])[scored]
    report = found.report
    return Score(
        features=config.features,
        policy=config.policy,
        pairs=len(scored) + report.empty_pairs,
        unscored_pairs=len(np.unique(pair)) - len(scored),
        rotation_pairs=len(np.unique(pair[known & weak])),
        matches=int(known.sum()),
        true_rate=float(true.sum() / total.sum()),
        useful_pairs=float((true >= USEFUL).sum() / (len(scored) + report.empty_pairs)),
        median_matches=float(np.median([*total, *[0] * report.empty_pairs])),
        median_true=float(np.median([*true, *[0] * report.empty_pairs])),
        ms_picture=report.ms_picture,
        ms_pair=report.ms_pair,
        skipped=dict(report.skipped),
    )


def _any_camera(session: Session) -> tuple[str, NDArray[np.int64]]:
    if session.images is None or not len(session.images):
        raise SessionError(session.path or "session", "has no images", "images.parquet with pictures")
    cameras: Mapping[str, Camera] = {} if session.calibration is None else session.calibration.cameras
    there = [name for name in sorted(set(session.images.camera)) if name in cameras]
    if not there:
        remedy = "add [cameras] to calibration.toml"
        raise SessionError(session.path or "session", "no calibrated camera took its images", "one", remedy)
    return there[0], session.images.t_ns[:1]


def _classified(session: Session, matches: Matches) -> tuple[Mask, Mask, Mask]:
    """Masks (m,): true, tested by rotation alone, with a reference."""
    assert session.images is not None and session.calibration is not None
    names = dict(zip(session.images.image_id.tolist(), session.images.camera.tolist(), strict=True))
    camera = np.array([names[i] for i in matches.image_id_0.tolist()], dtype=object)
    good, weak, known = (np.zeros(len(matches), dtype=bool) for _ in range(3))
    for name in sorted(set(camera)):
        rows = np.flatnonzero(camera == name)
        poses = CameraPoses.at(session, name, np.concatenate([matches.t_ns[rows], matches.t_1_ns[rows]]))
        first = np.arange(len(rows))
        R, t = poses.relative(first, first + len(rows))
        focal = session.calibration.cameras[name].focal
        good[rows], weak[rows] = true_matches(R, t, matches.xy0_n[rows], matches.xy1_n[rows], focal)
        known[rows] = poses.known[: len(rows)] & poses.known[len(rows) :]
    return good, weak, known


def compare_features(
    session: Session,
    names: Sequence[str],
    config: FrontEndConfig,
    *,
    workers: int = 0,
    progress: Progress = silent,
) -> list[Score]:
    """`score_features` of several kinds of features, with the same options otherwise."""
    kinds = {name: replace(config, features=name) for name in names}
    return [
        score_features(session, kind, workers=workers, progress=under(name, progress)) for name, kind in kinds.items()
    ]
