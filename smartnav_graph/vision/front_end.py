"""Front end: pictures of a session -> matches of pairs, or tracks, in undistorted normalised coordinates.

Pictures are opened, checked and searched for points in parallel on all processors (OpenCV releases Python's lock, so
threads suffice); the order of the results is that of the pictures for any number of threads.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import deque
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, Future
from dataclasses import asdict, dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.core.timebase import NS
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import Matches, Tracks
from smartnav_graph.vision import features, images, matching
from smartnav_graph.vision.features import Features
from smartnav_graph.vision.images import OpenedPicture, Picture
from smartnav_graph.vision.matching import Pairing
from smartnav_graph.vision.parallel import ordered, threads
from smartnav_graph.vision.tracking import Gyro, Tracker

KLT = "klt"
POINTS, TRACKS = 1500, 300
RATE_HZ = 4.0


@dataclass(frozen=True)
class FrontEndConfig:
    """Kind and number of features, and which pairs are matched.

    features : ``klt`` for tracks, else one of `features.KINDS`, for matches; policy : one of `matching.POLICIES`
    count : points of a picture at most; 0 is 1500, or 300 tracks
    spans : pictures between the two of a pair; neighbours are always matched, wider pairs up to `longest_s` apart
    rate_hz : pictures a second at most, 0 for all; None is 4 for matches, all for tracks
    """

    features: str = "orb"
    policy: str = "ratio"
    count: int = 0
    spans: tuple[int, ...] = (1, 2, 4, 8)
    longest_s: float = 2.0
    rate_hz: float | None = None

    def __post_init__(self) -> None:
        if self.features != KLT and self.features not in features.KINDS:
            features.require(self.features)
        if self.policy not in matching.POLICIES:
            raise ConfigError("--policy", repr(self.policy), f"one of {', '.join(matching.POLICIES)}")
        if self.features == KLT and self.policy != "ratio":
            raise ConfigError("--policy", f"{self.policy!r} with tracks", "matches of descriptors", "leave it out")
        if not self.spans or min(self.spans) < 1:
            raise ConfigError("--spans", repr(self.spans), "whole numbers >= 1, as 1,2,4")
        numbers = {"--count": self.count, "--longest": self.longest_s, "--rate": self.rate_hz or 0.0}
        for option, value in numbers.items():
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(option, f"{value}", "a number >= 0")

    @property
    def tracks(self) -> bool:
        """Whether it makes tracks, not matches."""
        return self.features == KLT

    @property
    def points(self) -> int:
        """Points of a picture at most."""
        return self.count or (TRACKS if self.tracks else POINTS)

    @property
    def rate(self) -> float:
        """Pictures a second at most; 0 for all."""
        return self.rate_hz if self.rate_hz is not None else 0.0 if self.tracks else RATE_HZ


@dataclass(frozen=True)
class FrontEndReport:
    """Counts of pictures, pairs, matches and tracks.

    pictures : of the session; thinned : left out to keep the rate; used : the rest without the skipped, which are
    counted by reason, `first` naming a file of each; longest_break_s : between used pictures
    pairs, empty_pairs (without a match), matches, median_matches of a pair; tracks, median_track_length in pictures,
    lost_at_once (corners not found again), blind (steps that the gyroscope did not predict)
    ms_picture, ms_pair : processor time of points and descriptors, and of matching; seconds : total
    """

    features: str
    policy: str
    pictures: int
    thinned: int
    used: int
    skipped: Mapping[str, int]
    first: Mapping[str, str]
    longest_break_s: float
    pairs: int = 0
    empty_pairs: int = 0
    matches: int = 0
    median_matches: float = 0.0
    tracks: int = 0
    median_track_length: float = 0.0
    lost_at_once: int = 0
    blind: int = 0
    ms_picture: float = 0.0
    ms_pair: float = 0.0
    seconds: float = 0.0

    @property
    def left_out(self) -> str:
        """How many pictures were skipped, why, and one of each."""
        return "; ".join(f"{n} {reason} (first: {self.first[reason]})" for reason, n in self.skipped.items()) or "none"

    def to_text(self) -> str:
        """A few lines for people."""
        lines = [
            f"pictures: {self.used} of {self.pictures} used, {self.thinned} left out to keep the rate; "
            f"longest break {self.longest_break_s:.2f} s",
            f"skipped: {self.left_out}",
        ]
        if self.tracks:
            lines += [
                f"tracks: {self.tracks}, median length {self.median_track_length:g} pictures; "
                f"{self.lost_at_once} corners not found again; {self.blind} steps without a gyroscope",
                f"time: {self.ms_picture:.1f} ms a picture",
            ]
        if self.pairs:
            lines += [
                f"pairs: {self.pairs}, {self.empty_pairs} without a match; {self.matches} matches, "
                f"median {self.median_matches:g} a pair",
                f"time: {self.ms_picture:.1f} ms a picture, {self.ms_pair:.1f} ms a pair",
            ]
        return "\n".join(lines)


@dataclass(frozen=True)
class FrontEndResult:
    """Matches or tracks, and the report on the pictures; `computed` is False if they were read from the session."""

    matches: Matches | None
    tracks: Tracks | None
    report: FrontEndReport
    computed: bool = True


def run_front_end(
    session: Session, config: FrontEndConfig | None = None, *, workers: int = 0, progress: Progress = silent
) -> FrontEndResult:
    """Matches or tracks of a session's pictures.

    Parameters
    ----------
    session : with images and calibrated cameras; tracks are predicted with the gyroscope, if there is one
    workers : number of threads; 0: one a processor
    progress : called with stage, done, total

    Raises
    ------
    ConfigError
        Features that the installed OpenCV lacks.
    SessionError
        No pictures, none that can be used, or nothing found in them.
    """
    config = config or FrontEndConfig()
    if not config.tracks:
        features.require(config.features)
    begin = time.perf_counter()
    job = _Job(session, config, progress)
    with threads(workers) as executor:
        found = job.tracks(executor) if config.tracks else job.matches(executor)
    return replace(found, report=replace(found.report, seconds=round(time.perf_counter() - begin, 3)))


class _Points(NamedTuple):
    """A picture with its points, if it is usable, and the processor time, s."""

    picture: Picture
    seen: OpenedPicture
    points: Features | None
    cpu_s: float


class _Pair(NamedTuple):
    first: Picture
    second: Picture
    pairing: Pairing
    points: tuple[Features, Features]
    cpu_s: float


@dataclass
class _Job:
    """One run of the front end."""

    session: Session
    config: FrontEndConfig
    progress: Progress
    used: list[Picture] = field(default_factory=list)
    skipped: list[tuple[str, str]] = field(default_factory=list)
    cpu_s: float = 0.0

    def __post_init__(self) -> None:
        self.listed = images.pictures(self.session)
        present = [picture for picture in self.listed if picture.path.is_file()]
        self.skipped += [(images.MISSING, picture.file) for picture in self.listed if not picture.path.is_file()]
        self.selected = images.limit_rate(present, self.config.rate)
        calibration = self.session.calibration
        self.cameras: Mapping[str, Camera] = {} if calibration is None else calibration.cameras
        self.thinned = len(present) - len(self.selected)
        self.checker = images.PictureChecker()

    def checked(self, found: Iterator[_Points]) -> Iterator[_Points]:
        """The usable pictures; the others are added to `skipped`."""
        for done, one in enumerate(found, 1):
            fault = self.checker.fault(one.picture, one.seen)
            self.progress("pictures", done, len(self.selected))
            self.cpu_s += one.cpu_s
            if fault:
                self.skipped.append((fault, one.picture.file))
                continue
            self.used.append(one.picture)
            yield one
        if not self.used:
            raise self._no_result("no picture can be used")

    def with_points(self, picture: Picture) -> _Points:
        """Points of a picture; its pixels are dropped."""
        camera = self.cameras.get(picture.camera)
        seen = images.open_picture(picture, camera)
        if seen.gray is None or camera is None:
            return _Points(picture, seen, None, 0.0)
        begin = time.thread_time()
        points = features.extract(seen.gray, camera, self.config.features, self.config.points)
        return _Points(picture, replace(seen, gray=None), points, time.thread_time() - begin)

    def matches(self, executor: Executor) -> FrontEndResult:
        """Matches of the pairs given by the spans."""
        pending: list[Future[_Pair]] = []
        recent: dict[str, deque[tuple[Picture, Features]]] = {}
        for picture, _, points, _ in self.checked(ordered(executor, self.with_points, self.selected)):
            assert points is not None  # those without were skipped
            line = recent.setdefault(picture.camera, deque(maxlen=max(self.config.spans)))
            for span in self.config.spans:
                if span <= len(line) and self._near(line[-span][0], picture, span):
                    pending.append(executor.submit(self._paired, *line[-span], picture, points))
            line.append((picture, points))
        found = [future.result() for future in pending]
        counts = [len(pair.pairing.first) for pair in found]
        if not sum(counts):
            raise self._no_result(f"no match in {len(found)} pairs of pictures")
        report = replace(
            self._report(),
            pairs=len(found),
            empty_pairs=counts.count(0),
            matches=sum(counts),
            median_matches=float(np.median(counts)),
            ms_pair=round(1e3 * sum(pair.cpu_s for pair in found) / len(found), 3),
        )
        return FrontEndResult(_as_matches(found), None, report)

    def _near(self, first: Picture, second: Picture, span: int) -> bool:
        return span == 1 or second.t_ns - first.t_ns <= self.config.longest_s * NS

    def _paired(self, first: Picture, one: Features, second: Picture, other: Features) -> _Pair:
        begin = time.thread_time()
        pairing = matching.pair(one.descriptors, other.descriptors, self.config.policy)
        return _Pair(first, second, pairing, (one, other), time.thread_time() - begin)

    def tracks(self, executor: Executor) -> FrontEndResult:
        """Corners followed through the pictures of each camera."""
        imu = self.session.imu
        gyro = None if imu is None or len(imu) < 2 else Gyro.of(imu)
        ids = itertools.count()
        trackers: dict[str, Tracker] = {}
        seen: list[tuple[Picture, NDArray[np.int64], NDArray[np.float64]]] = []
        for picture, opened, _, _ in self.checked(ordered(executor, self._opened, self.selected)):
            assert opened.gray is not None  # those without were skipped
            if picture.camera not in trackers:
                body_R_cam = np.array(self.session.mount(picture.camera).body_R)
                camera = self.cameras[picture.camera]
                trackers[picture.camera] = Tracker(camera, body_R_cam, gyro, self.config.points, ids)
            begin = time.thread_time()
            seen.append((picture, *trackers[picture.camera].step(opened.gray, picture.t_ns)))
            self.cpu_s += time.thread_time() - begin
        stream, length = _as_tracks(seen, self.cameras)
        if not len(stream):
            raise self._no_result("no corner was found again")
        again = length[length > 1]
        report = replace(
            self._report(),
            tracks=len(again),
            median_track_length=float(np.median(again)),
            lost_at_once=int((length == 1).sum()),
            blind=sum(tracker.blind for tracker in trackers.values()),
        )
        return FrontEndResult(None, stream, report)

    def _opened(self, picture: Picture) -> _Points:
        return _Points(picture, images.open_picture(picture, self.cameras.get(picture.camera)), None, 0.0)

    def _report(self) -> FrontEndReport:
        reasons = [reason for reason, _ in self.skipped]
        return FrontEndReport(
            features=self.config.features,
            policy=self.config.policy,
            pictures=len(self.listed),
            thinned=self.thinned,
            used=len(self.used),
            skipped={reason: reasons.count(reason) for reason in images.REASONS if reason in reasons},
            first=dict(reversed(self.skipped)),
            longest_break_s=round(images.longest_break_s(self.listed, self.used), 3),
            ms_picture=round(1e3 * self.cpu_s / max(len(self.used), 1), 3),
        )

    def _no_result(self, found: str) -> SessionError:
        fault = f"{found} of {len(self.listed)}; skipped: {self._report().left_out}"
        remedy = "give sharp pictures with texture, and [cameras] in calibration.toml"
        return SessionError(self.session.path or "session", fault, "pictures of a calibrated camera", remedy)


def _as_matches(found: list[_Pair]) -> Matches:
    """One row a match, by the time of the first picture, then of the second."""
    found = sorted(found, key=lambda pair: (pair.first.t_ns, pair.second.t_ns))
    counts = [len(pair.pairing.first) for pair in found]

    def repeated(values: list[int]) -> NDArray[np.int64]:
        return np.repeat(np.array(values, dtype=np.int64), counts)

    return Matches(
        t_ns=repeated([pair.first.t_ns for pair in found]),
        t_1_ns=repeated([pair.second.t_ns for pair in found]),
        image_id_0=repeated([pair.first.image_id for pair in found]),
        image_id_1=repeated([pair.second.image_id for pair in found]),
        xy0_n=np.concatenate([pair.points[0].xy_n[pair.pairing.first] for pair in found]),
        xy1_n=np.concatenate([pair.points[1].xy_n[pair.pairing.second] for pair in found]),
        score=np.concatenate([pair.pairing.score for pair in found]),
    )


def _as_tracks(
    seen: list[tuple[Picture, NDArray[np.int64], NDArray[np.float64]]], cameras: Mapping[str, Camera]
) -> tuple[Tracks, NDArray[np.intp]]:
    """One row an observation of corners seen at least twice; number (n,) of observations of each corner."""
    counts = [len(ids) for _, ids, _ in seen]
    track = np.concatenate([ids for _, ids, _ in seen])
    stream = Tracks(
        t_ns=np.repeat([picture.t_ns for picture, _, _ in seen], counts),
        image_id=np.repeat([picture.image_id for picture, _, _ in seen], counts),
        track_id=track,
        xy_n=np.concatenate([cameras[picture.camera].normalised(px) for picture, _, px in seen]),
        xy_px=np.concatenate([px for _, _, px in seen]),
    )
    length = np.bincount(track)
    return stream.take(length[track] > 1), length


def result_options(config: FrontEndConfig) -> dict[str, object]:
    """The options that the result depends on, as plain values."""
    options = asdict(config) | {"count": config.points, "rate_hz": config.rate, "spans": list(config.spans)}
    unused = ("policy", "spans", "longest_s") if config.tracks else ()
    return {name: value for name, value in options.items() if name not in unused}
