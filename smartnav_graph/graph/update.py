"""What one window adds to the graph, and who adds it.

A builder reads one `Window` and adds to one `GraphUpdate`; a smoother takes updates and knows no sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats
from smartnav_graph.graph.pass_state import LAST_STAGE, PassState
from smartnav_graph.graph.states import KEYFRAME_LETTERS, STATES, SessionState, State, key
from smartnav_graph.graph.windows import Window


@dataclass(frozen=True)
class FactorId:
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
    """The measurements of rows, where each row has many: row (n,) of each, whitened residual (n, d), weight
    under the loss (n,) and whether it is in use (n,). A `RowModel` of such rows has a method of this name in lower
    case, with the arguments of `linearize`."""

    row: NDArray[np.intp]
    white: Floats
    weight: Floats
    used: NDArray[np.bool_]


@dataclass(frozen=True)
class FactorBatch:
    """m rows of one `RowModel` at one time: keys (m, k), data (m, q). One pass in batch and in a
    fixed lag, CustomFactors in iSAM2.

    rows : row of the stream behind each, -1 where there is none; used : False keeps a row out of the solve, its
    residual is still reported; loss : ``none``, ``huber`` or ``cauchy``, on the norm of each row over `loss_scale`
    """

    sensor: str
    model: RowModel
    keys: Sequence[tuple[int, ...]]
    data: Floats
    t_ns: int
    rows: Sequence[int] = ()
    used: Sequence[bool] = ()
    loss: str = "none"
    loss_scale: float = 1.0

    def __post_init__(self) -> None:
        if not self.rows:
            object.__setattr__(self, "rows", (-1,) * len(self.keys))
        if not self.used:
            object.__setattr__(self, "used", (True,) * len(self.keys))


@dataclass
class GraphUpdate:
    """What one window adds to the graph.

    predicted : state at t1 predicted by the inertial data; variance (3,) of its position m^2, where known
    predict : (nav, bias) at t0 -> nav at t1, for states that have changed since
    refresh : bias at t0 -> the inertial factor linearised there, None while the present one is good enough
    chain : initial values of the chain states at this keyframe; session : session states that something here touches;
    constants : those that are held, held : their values, by key
    """

    index: int
    t_ns: int
    t_s: float
    predicted: gtsam.NavState = None  # type: ignore[assignment]  # set by the first builder
    bias: gtsam.imuBias.ConstantBias = None  # type: ignore[assignment]
    variance: Floats | None = None
    predict: Callable[[gtsam.NavState, gtsam.imuBias.ConstantBias], gtsam.NavState] | None = None
    refresh: Callable[[gtsam.imuBias.ConstantBias], gtsam.NonlinearFactor | None] | None = None
    factors: list[tuple[FactorId, gtsam.NonlinearFactor]] = field(default_factory=list)
    blocks: list[FactorBatch] = field(default_factory=list)
    chain: dict[int, Floats] = field(default_factory=dict)
    session: dict[int, SessionState] = field(default_factory=dict)
    held: dict[int, Floats] = field(default_factory=dict)
    constants: dict[int, SessionState] = field(default_factory=dict)

    def use(self, state: SessionState) -> int:
        """Key of a session state that a factor of this update touches."""
        if self.session.setdefault(state.key, state).name != state.name:
            raise ValueError(f"{state.name} and {self.session[state.key].name} have the same key")
        self.session[state.key] = state
        return state.key

    def keys(self, letters: Sequence[str], index: int, states: Mapping[str, SessionState]) -> tuple[int, ...]:
        """Keys of the states that a row model touches: those of keyframe `index`, and session states by letter."""
        return tuple(
            self.use(states[letter]) if STATES[letter].scope == "session" else key(letter, index) for letter in letters
        )

    def hold(self, values: Mapping[str, Floats]) -> None:
        """Make constants of the session states named in `values`."""
        if not values:
            return
        self.constants |= {name: state for name, state in self.session.items() if state.name in values}
        self.held = {name: np.asarray(values[state.name]) for name, state in self.constants.items()}
        self.session = {name: state for name, state in self.session.items() if name not in self.held}

    def add(self, tag: FactorId, factor: gtsam.NonlinearFactor) -> None:
        """Add one native factor."""
        self.factors.append((tag, factor))

    def sensors(self) -> set[str]:
        """Names of what touches this update."""
        return {tag.sensor for tag, _ in self.factors} | {block.sensor for block in self.blocks}

    def refreshed(self, bias: gtsam.imuBias.ConstantBias) -> bool:
        """Replace the inertial factor by one linearised at `bias`, the present estimate at t0, if that matters."""
        factor = None if self.refresh is None else self.refresh(bias)
        if factor is None:
            return False
        self.factors = [(tag, factor if tag.sensor == "imu" else old) for tag, old in self.factors]
        return True

    def names(self) -> list[int]:
        """Keys of the states this update introduces."""
        return [key(letter, self.index) for letter in KEYFRAME_LETTERS] + list(self.chain)

    def values(self) -> gtsam.Values:
        """Initial values of the states this update introduces (gtsam.Values)."""
        values = gtsam.Values()
        values.insert(key("X", self.index), self.predicted.pose())
        values.insert(key("V", self.index), self.predicted.velocity())
        values.insert(key("B", self.index), self.bias)
        for name, value in self.chain.items():
            values.insert(name, value)
        return values


class Builder:
    """Adds the factors of one sensor to the graph. A subclass says more of itself than the defaults where it must.

    name : of its factors; stage : of the passes that it takes part in first (see `PassState`)
    lookahead_s : how far beyond the end of a window it reads; note : a warning for the run, empty for none
    causal : it decides by what is known at the end of a window where a batch run decides by the whole recording
    """

    name: str
    stage: int = 0
    lookahead_s: float = 0.0
    note: str = ""
    causal: bool = False

    def begin(self) -> Builder:
        """The builder of one pass. One that accumulates over windows gives a copy that has seen none: what a pass finds
        out is left to the next in `PassState` alone."""
        return self

    def add(self, update: GraphUpdate, window: Window, previous: State | None, pass_state: PassState) -> None:
        """Add this sensor's factors for `window`; `previous` is the latest state (None at the first keyframe)."""
        raise NotImplementedError

    def end(self, pass_state: PassState) -> PassState:
        """The state of a causal pass with what this builder, as `begin` gave it, selected in it."""
        return pass_state

    def has_second_stage(self, pass_state: PassState) -> bool:
        """Whether it adds more, or has noise to estimate, once the trajectory is found."""
        return self.stage == LAST_STAGE

    @property
    def gate_probability(self) -> float | None:
        """Share of good rows inside the outlier gate of its rows; None where no outliers are looked for."""
        return None

    @property
    def noise_groups(self) -> Mapping[str, float]:
        """Class-default sigmas that a run may estimate: by group, one for each axis of the residual."""
        return {}


Kind = TypeVar("Kind")


def one_of(builders: Iterable[Builder], kind: type[Kind]) -> Kind | None:
    """The builder of a kind, where there is one."""
    return next((builder for builder in builders if isinstance(builder, kind)), None)


def build_update(
    window: Window, previous: State | None, builders: Iterable[Builder], pass_state: PassState, t_origin_ns: int
) -> GraphUpdate:
    """The update of one window: every builder in turn."""
    update = GraphUpdate(window.index, window.t1_ns, (window.t1_ns - t_origin_ns) / 1e9)
    for builder in builders:
        if builder.stage <= pass_state.stage:
            builder.add(update, window, previous, pass_state)
    update.hold(pass_state.fixed_states)
    return update
