"""State keys and their scopes, the window between two keyframes, and the step that a window becomes.

The seam of the house: a builder reads one `Window` and adds to one `Step`; a smoother takes steps and knows no sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class StateKind:
    """One row of the state table.

    scope : ``keyframe`` (one a keyframe), ``chain`` (one a keyframe, where its sensor has it), ``session`` (one)
    trust (dim,) : step that a damping of one holds the state to
    moved (dim,) : step that moves its linearisation point in replay
    """

    letter: str
    name: str
    dim: int
    scope: str
    trust: Floats
    moved: Floats


def _kind(letter: str, name: str, scope: str, trust: Sequence[float], moved: Sequence[float]) -> StateKind:
    return StateKind(letter, name, len(trust), scope, np.array(trust), np.array(moved))


# Only rotations, biases and what multiplies them make the factors nonlinear.
STATES: dict[str, StateKind] = {
    kind.letter: kind
    for kind in (
        _kind("X", "pose", "keyframe", [0.3] * 3 + [100.0] * 3, [0.005] * 3 + [0.1] * 3),
        _kind("V", "velocity", "keyframe", [10.0] * 3, [0.1] * 3),
        _kind("B", "imu bias", "keyframe", [0.3] * 3 + [0.02] * 3, [0.01] * 3 + [0.001] * 3),
        _kind("C", "gnss correlated error", "chain", [10.0] * 3, [1.0] * 3),
        _kind("D", "barometer bias", "chain", [10.0], [1.0]),
        _kind("G", "straying in a gap", "chain", [1.0] * 3 + [0.3] * 3, [0.03] * 3 + [0.01] * 3),
        _kind("T", "time offset", "session", [0.3], [0.01]),
        _kind("L", "lever arm", "session", [1.0] * 3, [0.05] * 3),
        _kind("A", "mount rotation", "session", [0.3] * 3, [0.01] * 3),
        _kind("M", "vehicle mount", "session", [0.3] * 2 + [1.0] * 4 + [0.1] * 2, [0.01] * 2 + [0.1] * 4 + [1e-3] * 2),
        _kind("W", "wheel scale and delay", "session", [0.1, 0.3], [0.005, 0.01]),
        _kind("H", "hard iron", "session", [100.0] * 3, [1.0] * 3),
        _kind("F", "magnetic field strength", "session", [30.0] * 2, [1.0] * 2),
        _kind("U", "floor height", "session", [1.0], [0.1]),
        _kind("K", "step factor", "session", [0.3] * 2, [0.02] * 2),
        _kind("S", "inertial scale and misalignment", "session", [0.03] * 18, [0.003] * 18),
    )
}
KEYFRAME_LETTERS = tuple(kind.letter for kind in STATES.values() if kind.scope == "keyframe")
# A session state's index is its sensor's place here.
SENSORS = (
    *("imu", "gnss", "control", "pose_fixes", "velocity", "wheel", "vehicle", "magnetometer", "barometer", "steps"),
    *("images", "tracks", "matches", "static"),
)


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


@lru_cache(maxsize=1 << 18)
def key(letter: str, index: int) -> int:
    """GTSAM key of a state."""
    return int(gtsam.symbol(letter, index))


@dataclass(frozen=True)
class SessionState:
    """One state for the whole session, with its prior.

    name : as in summary.json, with its unit (``gnss_time_offset_s``); initial (d,), sigma (d,) of the prior
    """

    letter: str
    sensor: str
    name: str
    initial: Floats
    sigma: Floats

    @property
    def key(self) -> int:
        return key(self.letter, SENSORS.index(self.sensor))


@dataclass(frozen=True)
class State:
    """Estimate at one keyframe: `nav` (gtsam.NavState) and `bias` (gtsam.imuBias.ConstantBias).

    covariance : (15, 15) as in `Solution`, where a smoother knows it while it runs
    """

    index: int
    t_ns: int
    nav: Any
    bias: Any
    covariance: Floats | None = None

    @classmethod
    def of(cls, index: int, t_ns: int, nav: tuple[Floats, Floats, Floats], bias: Floats) -> State:
        """Of nav_R_body (3, 3), nav_t_body (3,), nav_v_body (3,) and the biases (6,)."""
        R, p, v = nav
        pose = gtsam.Pose3(gtsam.Rot3(R), p)
        return cls(index, t_ns, gtsam.NavState(pose, v), gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))


@dataclass(frozen=True)
class Window:
    """The stretch (t0, t1] that ends at keyframe `index`, with its slice of every stream.

    kind : ``first`` (t0 == t1, the first keyframe), ``normal``, ``gap`` (missing or bridged inertial data), ``static``
    dt (m,) s, accel (m, 3) m/s^2, gyro (m, 3) rad/s : inertial intervals, means over each interval, borders
    interpolated; the force is given in body axes at the interval's start
    rows : row indices of each aiding stream at t1
    late : rows that speak of an earlier time and became known in this window
    """

    index: int
    t0_ns: int
    t1_ns: int
    kind: str
    dt: Floats
    accel: Floats
    gyro: Floats
    rows: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)
    late: Mapping[str, Sequence[LateRow]] = field(default_factory=dict)

    @property
    def length_s(self) -> float:
        return (self.t1_ns - self.t0_ns) / 1e9


@dataclass(frozen=True)
class LateRow:
    """A row of a stream that arrived after the window it speaks of: `t_ns` lies in `window`."""

    row: int
    t_ns: int
    window: Window


@dataclass(frozen=True)
class Tag:
    """What a factor is: builder, time, row of its stream (-1 where it has none)."""

    sensor: str
    t_ns: int
    row: int = -1


class RowModel(Protocol):
    """Alike measurements of a kind that GTSAM lacks, linearised all at once.

    letters : kinds of the states a row touches, in the order of its keys
    """

    letters: tuple[str, ...]

    def linearize(self, states: Sequence[Floats], data: Floats) -> tuple[Floats, list[Floats]]:
        """Whitened residuals (m, d) and their Jacobians (m, d, n) by state, on GTSAM's tangents.

        Parameters
        ----------
        states : one array a letter: poses (m, 4, 4), vectors (m, n)
        data : (m, q) what each row holds
        """
        ...


class Measured(NamedTuple):
    """What rows consist of, where each stands for many measurements: row (n,) of each, whitened residual (n, d), weight
    under the loss (n,) and whether it is in use (n,). A `RowModel` of such rows has a method of this name in lower
    case, with the arguments of `linearize`."""

    row: NDArray[np.intp]
    white: Floats
    weight: Floats
    used: NDArray[np.bool_]


@dataclass(frozen=True)
class Block:
    """m rows of one `RowModel` at one time: keys (m, k), data (m, q). One pass in batch and in a
    fixed lag, CustomFactors in iSAM2.

    rows : row of the stream behind each, -1 where there is none; used : False keeps a row out of the solve, its
    residual is still reported; loss : ``none``, ``huber`` or ``cauchy``, on the norm of each row divided by `reach`
    """

    sensor: str
    model: RowModel
    keys: Sequence[tuple[int, ...]]
    data: Floats
    t_ns: int
    rows: Sequence[int] = ()
    used: Sequence[bool] = ()
    loss: str = "none"
    reach: float = 1.0

    def __post_init__(self) -> None:
        if not self.rows:
            object.__setattr__(self, "rows", (-1,) * len(self.keys))
        if not self.used:
            object.__setattr__(self, "used", (True,) * len(self.keys))


@dataclass
class Step:
    """What one window adds to the graph.

    predicted : state at t1 that the inertial data foretell; variance (3,) of its position m^2, where known
    foretell : (nav, bias) at t0 -> nav at t1, for states that have moved since
    refresh : bias at t0 -> the inertial factor linearised there, None while the present one is good enough
    chain : initial values of the chain states at this keyframe; session : session states that something here touches;
    constants : those that are held, held : their values, by key
    """

    index: int
    t_ns: int
    t_s: float
    predicted: Any = None
    bias: Any = None
    variance: Floats | None = None
    foretell: Callable[[Any, Any], Any] | None = None
    refresh: Callable[[Any], Any] | None = None
    factors: list[tuple[Tag, Any]] = field(default_factory=list)
    blocks: list[Block] = field(default_factory=list)
    chain: dict[int, Floats] = field(default_factory=dict)
    session: dict[int, SessionState] = field(default_factory=dict)
    held: dict[int, Floats] = field(default_factory=dict)
    constants: dict[int, SessionState] = field(default_factory=dict)

    def use(self, state: SessionState) -> int:
        """Key of a session state that a factor of this step touches."""
        self.session[state.key] = state
        return state.key

    def keys(self, letters: Sequence[str], index: int, states: Mapping[str, SessionState]) -> tuple[int, ...]:
        """Keys of the states that a row model touches: those of keyframe `index`, and session states by letter."""
        return tuple(
            self.use(states[letter]) if STATES[letter].scope == "session" else key(letter, index) for letter in letters
        )

    def hold(self, values: Mapping[str, Floats]) -> None:
        """Make constants of the session states named in `values`."""
        self.constants |= {name: state for name, state in self.session.items() if state.name in values}
        self.held = {name: np.asarray(values[state.name]) for name, state in self.constants.items()}
        self.session = {name: state for name, state in self.session.items() if name not in self.held}

    def add(self, tag: Tag, factor: Any) -> None:
        """Add one native factor."""
        self.factors.append((tag, factor))

    def sensors(self) -> set[str]:
        """Names of what touches this step."""
        return {tag.sensor for tag, _ in self.factors} | {block.sensor for block in self.blocks}

    def refreshed(self, bias: Any) -> bool:
        """Replace the inertial factor by one linearised at `bias`, the present estimate at t0, if that matters."""
        factor = None if self.refresh is None else self.refresh(bias)
        if factor is None:
            return False
        self.factors = [(tag, factor if tag.sensor == "imu" else old) for tag, old in self.factors]
        return True

    def names(self) -> list[int]:
        """Keys of the states this step introduces."""
        return [key(letter, self.index) for letter in KEYFRAME_LETTERS] + list(self.chain)

    def values(self) -> Any:
        """Initial values of the states this step introduces (gtsam.Values)."""
        values = gtsam.Values()
        values.insert(key("X", self.index), self.predicted.pose())
        values.insert(key("V", self.index), self.predicted.velocity())
        values.insert(key("B", self.index), self.bias)
        for name, value in self.chain.items():
            values.insert(name, value)
        return values


@dataclass(frozen=True)
class Memory:
    """What one pass teaches the next.

    noise_scales : factor on the class-default sigma by group name
    rejected : rows not used, by sensor
    correlated : sensors whose errors are known to wander, and get a Gauss-Markov state
    held : session states that stay at a value (d,), by name
    stage : 0 has what finds the trajectory (fixes, standstills), 1 also what needs it found first (vehicle
    constraints, time offsets, magnetometer, steps)
    settled : passes that a builder has spent on judging what it is made of
    weights : of rows between 0 and 1 while the loss is graduated, by sensor; control : how far from convex it is, or in
    the robust phase the least sigma (m) that a fix has under the loss
    phase : ``plain`` (least squares), ``robust`` (a redescending loss finds outliers), ``graduated`` (truncated least
    squares by and by, where asked for), ``gated`` (least squares without outliers), ``causal`` (replay: least squares,
    a redescending loss where a fix contradicts the prediction)
    """

    noise_scales: Mapping[str, float] = field(default_factory=dict)
    rejected: Mapping[str, frozenset[int]] = field(default_factory=dict)
    correlated: frozenset[str] = frozenset()
    held: Mapping[str, Floats] = field(default_factory=dict)
    stage: int = 0
    phase: str = "plain"
    settled: Mapping[str, int] = field(default_factory=dict)
    weights: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    control: float = 0.0

    def weight(self, sensor: str, row: int) -> float:
        """Weight of a row while the loss is graduated, 1 otherwise."""
        return self.weights.get(sensor, {}).get(row, 1.0)

    @property
    def narrowing(self) -> bool:
        """Whether a loss is still wider than the noise."""
        return self.phase == "robust" and self.control > 0.0

    def scale(self, group: str) -> float:
        return self.noise_scales.get(group, 1.0)

    def used(self, sensor: str, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Mask of the rows (m,) of a sensor that are not rejected."""
        return ~np.isin(rows, list(self.rejected.get(sensor, frozenset())))

    def is_rejected(self, sensor: str, row: int) -> bool:
        return row in self.rejected.get(sensor, frozenset())


LAST_STAGE = 1


class Builder(Protocol):
    """Adds the factors of one sensor to a step, from its `stage` on."""

    name: str
    stage: int

    def add(self, step: Step, window: Window, previous: State | None, memory: Memory) -> None:
        """Add this sensor's factors for `window`; `previous` is the latest state (None at the first keyframe)."""
        ...


Kind = TypeVar("Kind")


def one_of(builders: Iterable[Builder], kind: type[Kind]) -> Kind | None:
    """The builder of a kind, where there is one."""
    return next((builder for builder in builders if isinstance(builder, kind)), None)


def build_step(
    window: Window, previous: State | None, builders: Iterable[Builder], memory: Memory, t_origin_ns: int
) -> Step:
    """The step of one window: every builder in turn."""
    step = Step(window.index, window.t1_ns, (window.t1_ns - t_origin_ns) / 1e9)
    for builder in builders:
        if builder.stage <= memory.stage:
            builder.add(step, window, previous, memory)
    step.hold(memory.held)
    return step
