"""Tracks as points in space: every track one native smart factor on the poses of all keyframes that saw it.

    r_i = proj((nav_T_body_i body_T_cam)^-1 X) - x_i,   X the point of the track, eliminated in the factor itself

with x_i in undistorted normalised coordinates. Linearised, a track of l observations is 2 l - 3 rows on l poses: what
is left once the point is projected out of the null space of its derivatives. A point far away or seen under a small
angle would be no number, and a wrong observation has no loss of its own, so tracks join late and tested: when image
pairs have settled the trajectory (or inertial data and fixes alone, where pairs are not asked for), the points are
found at its states, and inconsistent ones are left out (`track_outliers`). From there on tracks replace the pairs,
which hold the same information.

Boresight and clock of the camera, found with the pairs, are held. The keyframe is at the stamp of the image; what
an observation made d later (clock, row of a rolling shutter) differs by at the point and motion found is taken off it.

Source: Carlone, Kira, Beall, Indelman, Dellaert (2014), Eliminating conditionally independent sets in factor graphs,
ICRA (SmartProjectionPoseFactor of GTSAM).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Mask
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.so3 import exp
from smartnav_graph.core.timebase import NS
from smartnav_graph.factors.camera import BodyRates, CameraModel
from smartnav_graph.factors.context import FactorContext
from smartnav_graph.factors.coplanarity import SMART, CoplanarityConfig
from smartnav_graph.graph.keyframes import KeyframeConfig
from smartnav_graph.graph.pass_state import PassState
from smartnav_graph.graph.states import State, key
from smartnav_graph.graph.update import Builder, FactorId, GraphUpdate
from smartnav_graph.graph.windows import Window
from smartnav_graph.vision.points import TrackObservations, observations_of_tracks

# A track needs so many observations: with two, the point leaves no more than a pair.
LEAST_SEEN = 3
# Unit of the factors' coordinates: GTSAM ends the search for a point at an absolute change of the squares by one.
FOCAL = 1e6
# Singular value of the triangulation below which a point has no place, normalised coordinates.
RANK = 1e-6
# Points are found again whenever a pose moves at all.
AGAIN = 1e-9


@dataclass(frozen=True)
class SmartConfig:
    """enabled : tracks as points in space, in place of image pairs once those are settled (batch, and the polish of a
    replay); most_seen : observations of one factor, longer tracks are split; least_parallax : angle between the first
    ray of a point and another, rad.
    """

    enabled: bool = False
    most_seen: int = 20
    least_parallax: float = 0.02

    def __post_init__(self) -> None:
        if not (self.most_seen >= LEAST_SEEN and self.least_parallax > 0):
            found = f"most_seen = {self.most_seen}, least_parallax = {self.least_parallax}"
            raise ConfigError("config [smart]", found, f"at least {LEAST_SEEN}, > 0")


# Why a track is not used, in words.
REASONS = (
    "in use",
    "outside the span",
    "too few observations",
    "insufficient parallax",
    "inconsistent with the other sensors",
)
IN_USE, OUTSIDE, FEW, FLAT, CONTRARY = range(len(REASONS))


@dataclass(frozen=True)
class TrackSelection:
    """Which tracks and observations are used.

    use (n, l) : observations; xy (n, l, 2) : what they are as seen at their keyframe; boresight (3,) rad, as held
    verdict (n,) : what became of each track, places in `REASONS`; refused : why none is used, in words
    """

    use: Mask
    xy: Floats
    boresight: Floats
    verdict: NDArray[np.intp]
    refused: str = ""


@dataclass
class SmartBuilder(Builder):
    """Adds a track at the keyframe that saw it last.

    image_ns (k,) : keyframe stamps of the images; sigma : of an observation, normalised
    """

    sightings: TrackObservations
    image_ns: NDArray[np.int64]
    rates: BodyRates
    camera_model: CameraModel
    sigma: float
    merge_ns: int
    config: SmartConfig = field(default_factory=SmartConfig)
    name: str = SMART
    stage: int = 1
    _keyframe: dict[int, int] = field(default_factory=dict)

    def begin(self) -> SmartBuilder:
        return replace(self, _keyframe={})

    def selection(self, pass_state: PassState) -> TrackSelection:
        """The selection in a pass."""
        found = pass_state.selections.get(self.name)
        if isinstance(found, TrackSelection):
            return found
        none = np.full(len(self.sightings), OUTSIDE, dtype=np.intp)
        return TrackSelection(self.sightings.there, self.sightings.xy, np.zeros(3), none)

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """The tracks that end at the window's end."""
        near = int(np.searchsorted(self.image_ns, window.t1_ns - self.merge_ns))
        if near == len(self.image_ns) or self.image_ns[near] > window.t1_ns + self.merge_ns:
            return
        self._keyframe[near] = window.index
        if not self.in_force(pass_state):
            return
        for state in self.camera_model.states().values():
            update.use(state)
        selection, (first, last) = self.selection(pass_state), np.searchsorted(self.sightings.last, [near, near + 1])
        for row in range(first, last):
            if selection.verdict[row] == IN_USE:
                update.add(FactorId(self.name, update.t_ns, row), self._factor(row, selection, pass_state))

    def in_force(self, pass_state: PassState) -> bool:
        """Whether tracks replace image pairs in a pass."""
        return pass_state.tests(self.name) > 0 and not pass_state.causal

    def _factor(self, row: int, selection: TrackSelection, pass_state: PassState) -> gtsam.NonlinearFactor:
        noise = gtsam.noiseModel.Isotropic.Sigma(2, FOCAL * self.sigma * pass_state.scale(self.name))
        body_T_cam = gtsam.Pose3(gtsam.Rot3(self.body_R_cam(selection)), self.camera_model.rig.body_t_cam)
        factor = gtsam.SmartProjectionPoseFactorCal3_S2(noise, _IDEAL, body_T_cam, _PARAMS)
        for place in np.flatnonzero(selection.use[row]):
            keyframe = self._keyframe[int(self.sightings.image[row, place])]
            factor.add(FOCAL * selection.xy[row, place], key("X", keyframe))
        return factor

    def body_R_cam(self, selection: TrackSelection) -> Floats:
        """With the boresight found."""
        return np.asarray(self.camera_model.rig.body_R_cam @ exp(selection.boresight[None])[0])


def _params() -> gtsam.SmartProjectionParams:
    """Rows by projection onto the null space, which QR takes as they are; a point that a candidate sends behind a
    camera counts as one at infinity, which costs, instead of nothing, which would pay."""
    modes = gtsam.LinearizationMode.JACOBIAN_SVD, gtsam.DegeneracyMode.HANDLE_INFINITY
    params = gtsam.SmartProjectionParams(*modes, False, False, AGAIN)
    params.setEnableEPI(True)
    params.setRankTolerance(FOCAL * RANK)
    return params


_IDEAL, _PARAMS = gtsam.Cal3_S2(FOCAL, FOCAL, 0.0, 0.0, 0.0), _params()


def build(context: FactorContext) -> SmartBuilder | None:
    """The builder of a session's tracks, where they are asked for.

    Raises
    ------
    ConfigError
        There are none, or nothing would use them.
    """
    config, pairs, tracks = context.options(SmartConfig), context.pairs, context.session.tracks
    if not config.enabled:
        return None
    if tracks is None or pairs is None:
        found = "enabled, but the session has no tracks"
        raise ConfigError("config [smart]", found, "tracks.parquet", "make them with `smartnav match --features klt`")
    if context.causal and not context.polished:
        found = "enabled in a replay without its polish"
        expected = "a batch run or a polish: a track is settled once all of it was seen"
        raise ConfigError("config [smart]", found, expected, "leave replay.polish on, or smart off")
    camera_model = context.options(CoplanarityConfig).camera_model(context)
    return SmartBuilder(
        observations_of_tracks(tracks, pairs.t_ns, config.most_seen),
        context.image_ns,
        BodyRates(context.session.require_imu()),
        camera_model,
        camera_model.camera.noise,
        round(context.options(KeyframeConfig).merge_s * NS),
        config,
    )
