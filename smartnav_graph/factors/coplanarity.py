"""Coplanarity of matched rays: the motion between two images, without any point in space.

A pair joins when the trajectory without images is found. Its matches are tested by the rotation of the
inertial data, then at the smoothed states, then once more before they are compressed. They are never tested by the
fit of the pair itself: a tracker that slipped as a whole fits well. Where most pairs are inconsistent with the inertial
solution, that is too inaccurate to test them, and none is used: images never make a trajectory worse.

Source: Longuet-Higgins (1981), A computer algorithm for reconstructing a scene from two projections, Nature 293; the
factor in a graph after Indelman, Roberts, Beall, Dellaert (2012), Incremental light bundle adjustment, BMVC.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import exp, rotate
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.camera import BodyRates, CameraModel, Motion, make_camera_model, seen_from
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.coplanar_rows import COLUMNS, CompressedRows, PairRows, Relative, Rig
from smartnav_graph.graph.keyframes import KeyframeConfig
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import Builder, FactorBatch, GraphUpdate, RowModel
from smartnav_graph.graph.windows import Window
from smartnav_graph.session.session import Session
from smartnav_graph.vision.gating import gate
from smartnav_graph.vision.pairs import Pairs, pairs_of_matches, pairs_of_tracks

# Sigma of the rotation between two images, rad and rad/s: remaining bias and noise of the gyro.
TURN_SIGMA, TURN_DRIFT = float(np.radians(0.1)), float(np.radians(0.05))
# Sigma (rad) of the direction of a baseline beside the noise of its matches, among the noise scales of a pass.
SHARED = "image_direction"
# The builder that replaces pairs once they are settled and its own tracks are tested.
SMART = "smart"
# Share of its matches that a pair must keep.
LEAST_SHARE = 0.5
# Tests until matches are settled: by the rotation, at states found with images, again and compressed.
COMPRESSED = 3
# Sigma of the velocity in a replay, as a share of it and m/s, from which on a pair is not used.
OPEN_SHARE, LEAST_OPEN = 0.5, 0.5
# Degrees of freedom of the relative pose of a pair.
POSE_DOF = 5
LEAST_MATCHES = 6  # of a pair
LOSS_SCALE = 2.0  # of the Cauchy loss of a match, sigmas
# Sigma (rad) of the direction in a replay, where nothing shows yet what it is.
CAUSAL_SHARED = float(np.radians(0.4))


@dataclass(frozen=True)
class CoplanarityConfig:
    """enabled : use the matches; rate_hz : most images of tracks per second; spans : images apart that tracks are
    paired at; least_parallax : parallax of a pair (median after the rotation is taken out), in sigmas: noise
    alone makes 1.7; boresight_sigma_deg : prior of the camera's attitude in the body as a state (zero: known;
    none given: that of the calibration); time_offset_sigma : prior of the camera's clock offset as a state, s
    (zero: known; none given: that of the calibration); focal_sigma : prior of its focal length as a state, a ratio
    (likewise); row_time : points are taken at the time when the row they
    lie in was read, where the camera's readout is known.
    """

    enabled: bool = True
    rate_hz: float = 4.0
    spans: tuple[int, ...] = (1, 2, 4, 8)
    least_parallax: float = 3.0
    boresight_sigma_deg: float | None = None
    time_offset_sigma: float | None = None
    focal_sigma: float | None = None
    row_time: bool = True

    def __post_init__(self) -> None:
        if not (self.rate_hz > 0 and self.spans and min(self.spans) >= 1):
            found = f"rate_hz = {self.rate_hz}, spans = {self.spans}"
            raise ConfigError("config [image_pairs]", found, "> 0, whole numbers >= 1")
        sigmas = (self.boresight_sigma_deg, self.time_offset_sigma, self.focal_sigma)
        if not min(self.least_parallax, *(sigma or 0.0 for sigma in sigmas)) >= 0:
            raise ConfigError("config [image_pairs]", f"{self}", "parallax and sigmas >= 0")

    def camera_model(self, context: FactorContext) -> CameraModel:
        """The camera of a session with these options."""
        return make_camera_model(
            context, self.boresight_sigma_deg, self.time_offset_sigma, self.focal_sigma, self.row_time
        )


# Why a pair is not used, in words.
REASONS = (
    "in use",
    "outside the span",
    "too few matches",
    "insufficient baseline",
    "inconsistent with the other sensors",
    "observations are in shorter pairs",
)
IN_USE, OUTSIDE, FEW, STILL, CONTRARY, COPIED = range(len(REASONS))


@dataclass(frozen=True)
class PairSelection:
    """Which image pairs and matches are used, and the motion they were selected with.

    pairs : as they were in the first row of each image, by the motion found; use (n, k) : matches, padded
    rate (k, 3) rad/s : of the body from the images' keyframe stamps to the clock offset found; motion : of it
    verdict (n,) : what became of each pair, places in `REASONS`; refused : why none is used, in words
    poses : relative poses of the pairs where their matches were selected; focal : correction of the focal length there,
    which the coordinates of the pairs have
    """

    pairs: Pairs
    use: Mask
    rate: Floats
    motion: Motion
    verdict: NDArray[np.intp]
    refused: str = ""
    poses: Relative | None = None
    focal: float = 0.0


@dataclass
class CoplanarityBuilder(Builder):
    """Adds the pairs that end at a keyframe.

    seen : pairs as they were matched; image_ns (k,) : keyframe stamps of the images, by the clock offset that is known
    sigma : of a match, normalised
    """

    seen: Pairs
    image_ns: NDArray[np.int64]
    rates: BodyRates
    camera_model: CameraModel
    sigma: float
    merge_ns: int
    config: CoplanarityConfig = field(default_factory=CoplanarityConfig)
    note: str = ""
    name: str = "image_pairs"
    stage: int = 1
    _causal: PairSelection | None = None
    _keyframe: dict[int, int] = field(default_factory=dict)
    _turn: dict[int, Floats] = field(default_factory=dict)
    _now: Floats = field(default_factory=lambda: np.eye(3))
    _made: tuple[tuple[object, ...], RowModel] | None = None

    def _none_selected(self) -> PairSelection:
        """Before anything was tested."""
        rate, motion = np.zeros((len(self.image_ns), 3)), Motion.unknown(len(self.image_ns))
        verdict = np.full(len(self.seen), OUTSIDE, dtype=np.intp)
        return PairSelection(self.seen, self.seen.there.copy(), rate, motion, verdict)

    def selection(self, pass_state: PassState) -> PairSelection:
        """The selection in a pass: that of the pass before, in replay the one under way."""
        if self._causal is not None and pass_state.causal:
            return self._causal
        found = pass_state.selections.get(self.name)
        return found if isinstance(found, PairSelection) else self._none_selected()

    @property
    def rig(self) -> Rig:
        """The camera in the body."""
        return self.camera_model.rig

    # --- one window ---

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """The pairs whose second image is at the window's end."""
        if pass_state.causal:
            self._causal = self._causal or replace(self._none_selected(), use=np.zeros_like(self.seen.there))
            if previous is not None:
                self._carry(window, previous)
        image = self._image_at(window.t1_ns)
        if image is None:
            return
        self._keyframe[image], self._turn[image] = window.index, self._now
        ending = self._ending(image)
        if self._causal is not None and pass_state.causal:
            self._see_now(self._causal.rate, self._causal.motion, image, update)
            if not _unknown_speed(previous):
                self._select_now(self._causal, self._model(pass_state), ending)
        self._add_pairs(update, ending, pass_state)

    def renew(self, update: GraphUpdate, pass_state: PassState) -> None:
        """The pairs of an update once more, as selected since; of all updates of a pass, in order."""
        image = self._image_at(update.t_ns)
        if image is not None:
            self._keyframe[image] = update.index
            update.blocks = [block for block in update.blocks if block.sensor != self.name]
            self._add_pairs(update, self._ending(image), pass_state)
            update.hold(pass_state.fixed_states)

    def _ending(self, image: int) -> NDArray[np.intp]:
        first, last = np.searchsorted(self.seen.images[:, 1], [image, image + 1])
        return np.array([k for k in range(first, last) if int(self.seen.images[k, 0]) in self._keyframe], dtype=np.intp)

    def _add_pairs(self, update: GraphUpdate, ending: NDArray[np.intp], pass_state: PassState) -> None:
        if self.replaced(pass_state):
            return
        selection = self.selection(pass_state)
        verdict = selection.verdict
        ending = ending[(verdict[ending] == IN_USE) | (verdict[ending] == CONTRARY)]
        if not len(ending):
            return
        model, used = self._model(pass_state), tuple((verdict[ending] == IN_USE).tolist())
        states = self.camera_model.states()
        keys, data = [], np.empty((len(ending), COLUMNS))
        for row, pair in enumerate(ending):
            images = [int(i) for i in self.seen.images[pair]]
            own = iter([key("X", self._keyframe[i]) for i in images])
            speed = iter([key("V", self._keyframe[i]) for i in images])
            of = {"X": own, "V": speed}
            keys.append(tuple(next(of[a]) if a in of else update.use(states[a]) for a in self.rig.letters))
            data[row] = [pair, *selection.rate[images].ravel()]
        update.blocks.append(
            FactorBatch(self.name, model, keys, data, update.t_ns, rows=tuple(ending.tolist()), used=used)
        )

    def replaced(self, pass_state: PassState) -> bool:
        """Whether tracks replace the pairs in a pass."""
        return pass_state.tests(SMART) > 0 and not pass_state.causal

    def begin(self) -> CoplanarityBuilder:
        return replace(self, _causal=None, _keyframe={}, _turn={}, _now=np.eye(3), _made=None)

    def end(self, pass_state: PassState) -> PassState:
        if self._causal is None:
            return pass_state
        return replace(pass_state, selections={**pass_state.selections, self.name: self._causal})

    def _carry(self, window: Window, previous: State) -> None:
        for turn in exp((window.gyro - previous.bias.gyroscope()) * window.dt[:, None]):
            self._now = self._now @ turn

    def _image_at(self, t_ns: int) -> int | None:
        near = int(np.searchsorted(self.image_ns, t_ns - self.merge_ns))
        found = near < len(self.image_ns) and abs(int(self.image_ns[near]) - t_ns) <= self.merge_ns
        return near if found else None

    def _model(self, pass_state: PassState) -> RowModel:
        """The row model of a pass: made again where the selection or the noise changed."""
        scales = pass_state.scale(self.name), pass_state.noise_scales.get(SHARED, 0.0)
        by = (self.selection(pass_state), pass_state.tests(self.name), scales)
        if self._made is None or self._made[0][0] is not by[0] or self._made[0][1:] != by[1:]:
            self._made = (by, self._new_model(pass_state))
        return self._made[1]

    def _new_model(self, pass_state: PassState) -> RowModel:
        sigma, selection = self.sigma * pass_state.scale(self.name), self.selection(pass_state)
        shared = pass_state.noise_scales.get(SHARED, 0.0)
        if pass_state.tests(self.name) == COMPRESSED and selection.poses is not None:
            matched = selection.pairs, self.rig, sigma, selection.use, LOSS_SCALE
            return CompressedRows(*matched, selection.poses, focal=selection.focal, shared=shared)
        shared = CAUSAL_SHARED if pass_state.causal else 0.0
        return PairRows(
            selection.pairs, self.rig, sigma, selection.use, LOSS_SCALE, focal=selection.focal, shared=shared
        )

    # --- when rows were seen ---

    def with_motion(self, before: PairSelection, offset_s: float, focal: float, motion: Motion) -> PairSelection:
        """A selection with the motion found at the images, clock offset and correction of the focal length of the
        camera."""
        rate = self.rates.mean(self.image_ns, offset_s) - motion.gyro_bias
        seen = replace(self.seen, x0=(1.0 + focal) * self.seen.x0, x1=(1.0 + focal) * self.seen.x1)
        pairs = self._at_once(seen, offset_s, rate, motion)
        return replace(before, rate=rate, motion=motion, pairs=pairs, focal=focal)

    def _see_now(self, rate: Floats, motion: Motion, image: int, update: GraphUpdate) -> None:
        """Rate and motion at one image of a replay, by prediction."""
        bias = update.bias.gyroscope()
        rate[image] = self.rates.mean(self.image_ns[image : image + 1], 0.0)[0] - bias
        motion.nav_R_body[image] = update.predicted.attitude().matrix()
        motion.nav_v_body[image], motion.gyro_bias[image] = update.predicted.velocity(), bias

    def _at_once(self, pairs: Pairs, offset_s: float, rate: Floats, motion: Motion) -> Pairs:
        """Pairs as they would be had all rows of an image been read at once with its first.

        A ray seen d later turns with the camera, x' ~ Exp(w d) x~, and its camera has gone on by v d: pairs whose rows
        lie at d0, d1 have a baseline of t + c0_R_nav (v1 d1 - v0 d0).
        """
        if self.camera_model.readout_s == 0:
            return pairs
        stamps, speed = self.image_ns + round(offset_s * NS), self.camera_model.velocity(motion, rate)
        xy, way = [], []
        for x, place in zip((pairs.x0, pairs.x1), pairs.images[pairs.pair].T, strict=True):
            delay = self.camera_model.delay(x)
            xy.append(seen_from(x, self.camera_model.turns(self.rates, stamps[place], delay, motion.gyro_bias[place])))
            way.append(speed[place] * delay[:, None])
        first = motion.nav_R_body[pairs.images[pairs.pair, 0]] @ self.camera_model.body_R_cam
        return replace(pairs, x0=xy[0], x1=xy[1], shift=rotate(first.transpose(0, 2, 1), way[1] - way[0]))

    # --- which matches ---

    def used_matches(self, pass_state: PassState) -> Mask:
        """Mask (m,) of the matches in use in a pass."""
        return np.asarray(self.seen.flat(self.selection(pass_state).use), dtype=bool)

    def _select_now(self, selection: PairSelection, model: RowModel, ending: NDArray[np.intp]) -> None:
        """Select matches of new pairs by the rotation since their first image."""
        assert isinstance(model, PairRows)
        if not len(ending):
            return
        C = self.camera_model.body_R_cam
        turns = [self._turn[int(i)].T @ self._turn[int(j)] for i, j in self.seen.images[ending]]
        some = self._at_once(self.seen.of(ending), 0.0, selection.rate, selection.motion)
        if some.shift is not None:
            model.see(ending, some)
        use, selection.verdict[ending] = self.by_turn(some, C.T @ np.array(turns) @ C)
        model.use[ending, : use.shape[1]] = use

    def by_turn(self, pairs: Pairs, R: Floats) -> tuple[Mask, NDArray[np.intp]]:
        """Matches consistent with the rotation (padded), and the verdict on each pair."""
        sigma = np.hypot(self.sigma, TURN_SIGMA + TURN_DRIFT * pairs.length_s)
        found = gate(pairs, R, sigma)
        return found.inliers, self.verdict_by_count(pairs, found.inliers, found.parallax)

    def verdict_by_count(self, pairs: Pairs, use: Mask, parallax: Floats) -> NDArray[np.intp]:
        """Verdict (n,) by the matches in use (n, k) and the median parallax (n,) rad."""
        kept = use.sum(axis=1)
        share = kept / np.maximum(pairs.count, 1)
        few = (pairs.count < LEAST_MATCHES) | ((share >= LEAST_SHARE) & (kept < LEAST_MATCHES))
        still, contrary = parallax < self.config.least_parallax * self.sigma, share < LEAST_SHARE
        return np.select([few, still, contrary], [FEW, STILL, CONTRARY], IN_USE).astype(np.intp)


def _unknown_speed(state: State | None) -> bool:
    """Whether a replay does not know speed and heading yet: pairs would fit a motion of any length and direction."""
    if state is None or state.covariance is None:
        return False
    sigma = float(np.sqrt(np.trace(state.covariance[6:9, 6:9])))
    return sigma > max(OPEN_SHARE * float(np.linalg.norm(state.nav.velocity())), LEAST_OPEN)


def pairs_of(session: Session, config: CoplanarityConfig, *, smart: bool = False) -> Pairs | None:
    """Image pairs of a session: as they were matched, else along tracks; None where images are not to be used, neither
    by pairs nor (`smart`) by tracks, which need the images of the pairs."""
    if not (config.enabled or smart):
        return None
    if session.matches is not None:
        return pairs_of_matches(session.matches)
    return None if session.tracks is None else pairs_of_tracks(session.tracks, config.rate_hz, config.spans)


def build(context: FactorContext) -> CoplanarityBuilder | None:
    """The builder of a session's image pairs."""
    pairs, config = context.pairs, context.options(CoplanarityConfig)
    if pairs is None or not len(pairs) or not config.enabled:
        return None
    camera_model = config.camera_model(context)
    return CoplanarityBuilder(
        pairs,
        context.image_ns,
        BodyRates(context.session.require_imu()),
        camera_model,
        sigma=camera_model.camera.noise,
        merge_ns=round(context.options(KeyframeConfig).merge_s * NS),
        config=config,
    )
