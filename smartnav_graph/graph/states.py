"""The states of the graph: their kinds, keys and scopes."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats


@dataclass(frozen=True)
class StateKind:
    """One row of the state table.

    scope : ``keyframe`` (one a keyframe), ``chain`` (one a keyframe, where its sensor has it), ``session`` (one)
    damping_scale (dim,) : step that a damping of one holds the state to
    relinearize_threshold (dim,) : step that moves its linearisation point in replay
    fixable : held at its prior mean where the data do not determine it; otherwise its prior counts as a measurement
    """

    letter: str
    name: str
    dim: int
    scope: str
    damping_scale: Floats
    relinearize_threshold: Floats
    fixable: bool = True


def _kind(
    letter: str, name: str, scope: str, damping_scale: Sequence[float], relinearize_threshold: Sequence[float]
) -> StateKind:
    return StateKind(letter, name, len(damping_scale), scope, np.array(damping_scale), np.array(relinearize_threshold))


# Only rotations, biases and what multiplies them make the factors nonlinear.
STATES: dict[str, StateKind] = {
    kind.letter: kind
    for kind in (
        _kind("X", "pose", "keyframe", [0.3] * 3 + [100.0] * 3, [0.005] * 3 + [0.1] * 3),
        _kind("V", "velocity", "keyframe", [10.0] * 3, [0.1] * 3),
        _kind("B", "imu bias", "keyframe", [0.3] * 3 + [0.02] * 3, [0.01] * 3 + [0.001] * 3),
        _kind("C", "gnss correlated error", "chain", [10.0] * 3, [1.0] * 3),
        _kind("D", "barometer bias", "chain", [10.0], [1.0]),
        _kind("G", "gap error", "chain", [1.0] * 3 + [0.3] * 3, [0.03] * 3 + [0.01] * 3),
        _kind("T", "time offset", "session", [0.3], [0.01]),
        _kind("O", "height offset", "session", [10.0], [1.0]),
        _kind("L", "lever arm", "session", [1.0] * 3, [0.05] * 3),
        _kind("A", "mount rotation", "session", [0.3] * 3, [0.01] * 3),
        _kind("I", "focal length", "session", [0.1], [0.003]),
        _kind("M", "vehicle mount", "session", [0.3] * 2 + [1.0] * 4 + [0.1] * 2, [0.01] * 2 + [0.1] * 4 + [1e-3] * 2),
        _kind("W", "wheel scale and delay", "session", [0.1, 0.3], [0.005, 0.01]),
        _kind("H", "hard iron", "session", [100.0] * 3, [1.0] * 3),
        _kind("F", "magnetic field strength", "session", [30.0] * 2, [1.0] * 2),
        _kind("U", "floor height", "session", [1.0], [0.1]),
        _kind("K", "step factor", "session", [0.3] * 2, [0.02] * 2),
        StateKind("R", "range bias", 1, "session", np.array([1.0]), np.array([0.1]), fixable=False),
        _kind("S", "inertial scale and misalignment", "session", [0.03] * 18, [0.003] * 18),
    )
}
KEYFRAME_LETTERS = tuple(kind.letter for kind in STATES.values() if kind.scope == "keyframe")


def kind_of(name: int) -> StateKind:
    """Row of the state table behind a GTSAM key."""
    return STATES[chr(gtsam.symbolChr(name))]


# A GTSAM key holds its letter in the highest byte, its index below.
_LETTER_AT = np.uint64(56)


def letters_of(names: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Letter of each key, as its character's number."""
    return (names >> _LETTER_AT).astype(np.uint8)


def indices_of(names: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Index of each key."""
    return (names & ((np.uint64(1) << _LETTER_AT) - np.uint64(1))).astype(np.int64)


_DIMS = np.zeros(256, dtype=np.intp)
_DIMS[[ord(letter) for letter in STATES]] = [kind.dim for kind in STATES.values()]


def dims_of(names: NDArray[np.uint64]) -> NDArray[np.intp]:
    """Dimension of the state behind each key."""
    return np.asarray(_DIMS[letters_of(names)])


def damping_scales(names: NDArray[np.uint64]) -> Floats:
    """Damping scales of states, one behind the other; names : their keys, sorted."""
    letters, counts = np.unique(letters_of(names), return_counts=True)
    return np.concatenate(
        [np.tile(STATES[chr(letter)].damping_scale, count) for letter, count in zip(letters, counts, strict=True)]
    )


@lru_cache(maxsize=1 << 18)
def key(letter: str, index: int) -> int:
    """GTSAM key of a state."""
    return int(gtsam.symbol(letter, index))


@lru_cache(maxsize=1 << 16)
def session_key(letter: str, sensor: str, instance: str = "") -> int:
    """GTSAM key of a session state. Its index is a digest of sensor and instance, of all bits that a key has for it:
    the same in every run, and different for different names (`GraphUpdate.use` checks it)."""
    digest = hashlib.blake2b(f"{sensor}\0{instance}".encode(), digest_size=7).digest()
    return key(letter, int.from_bytes(digest))


@dataclass(frozen=True)
class SessionState:
    """One state for the whole session, with its prior.

    sensor, instance : whose it is; a sensor may have many of a kind, such as a bias for each of its anchors
    name : as in summary.json, with its unit (``gnss_time_offset_s``); initial (d,), sigma (d,) of the prior
    """

    letter: str
    sensor: str
    name: str
    initial: Floats
    sigma: Floats
    instance: str = ""

    @property
    def key(self) -> int:
        """Its GTSAM key."""
        return session_key(self.letter, self.sensor, self.instance)


@dataclass(frozen=True)
class State:
    """Estimate at one keyframe: `nav` (gtsam.NavState) and `bias` (gtsam.imuBias.ConstantBias).

    covariance : (15, 15) as in `Solution`, where a smoother knows it while it runs
    """

    index: int
    t_ns: int
    nav: gtsam.NavState
    bias: gtsam.imuBias.ConstantBias
    covariance: Floats | None = None

    @classmethod
    def of(cls, index: int, t_ns: int, nav: tuple[Floats, Floats, Floats], bias: Floats) -> State:
        """Of nav_R_body (3, 3), nav_t_body (3,), nav_v_body (3,) and the biases (6,)."""
        R, p, v = nav
        pose = gtsam.Pose3(gtsam.Rot3(R), p)
        return cls(index, t_ns, gtsam.NavState(pose, v), gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
