"""The factor graph near each keyframe: the last few keyframes, their states, and the factors between them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from smartnav_graph.estimate.result.diagnostics import Diagnostics, FactorGraphLayout
from smartnav_graph.graph.states import STATES
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.recorder import Recorder

# Keyframes shown at a time, and epochs shown at most.
DEPTH = 4
MOST_EPOCHS = 500
# Distances, in points of the view: between keyframes, between states, of the first factor above a keyframe and beside
# it, of session states below it.
COLUMN, ROW, ABOVE, ASIDE, BELOW = 190.0, 75.0, -95.0, 60.0, 90.0
MARGIN = 60.0
EARLIER = "earlier"

State = tuple[str, int]


@dataclass
class GraphDrawing:
    """The graph at one epoch: nodes with label, place and colour; edges between them."""

    ids: list[str] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    places: list[tuple[float, float]] = field(default_factory=list)
    colors: list[list[int]] = field(default_factory=list)
    edges: list[tuple[str, str]] = field(default_factory=list)

    def node(self, name: str, label: str, place: tuple[float, float], color: list[int]) -> None:
        """Add a node with its label, place and colour."""
        self.ids.append(name)
        self.labels.append(label)
        self.places.append(place)
        self.colors.append(color)


def log_graph(recorder: Recorder, diagnostics: Diagnostics) -> None:
    """/graph: nodes and edges at evenly taken keyframes."""
    count = len(diagnostics.keyframe_ns)
    epochs = np.unique(np.linspace(0, count - 1, min(count, MOST_EPOCHS)).astype(int))
    pictures = list(_pictures(diagnostics.layout, epochs))
    if not any(picture.edges for picture in pictures):
        return
    times = diagnostics.keyframe_ns[epochs]
    places = np.array([place for picture in pictures for place in picture.places], dtype=np.float32)
    nodes = rr.GraphNodes.columns(
        node_ids=[name for picture in pictures for name in picture.ids],
        labels=[label for picture in pictures for label in picture.labels],
        positions=places,
        colors=np.array([color for picture in pictures for color in picture.colors], dtype=np.uint8),
    )
    edges = rr.GraphEdges.columns(edges=np.array([edge for picture in pictures for edge in picture.edges]))
    columns = [
        *nodes.partition([len(picture.ids) for picture in pictures]),
        *edges.partition([len(picture.edges) for picture in pictures]),
    ]
    recorder.rows("/graph", times, columns)
    recorder.bounds["/graph"] = np.stack([places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN])
    recorder.style("/graph", rr.GraphEdges.from_fields(graph_type="undirected"))


def _pictures(layout: FactorGraphLayout, epochs: NDArray[np.intp]) -> Iterator[GraphDrawing]:
    """The last DEPTH keyframes at each epoch."""
    touched, newest = _touched(layout)
    ending: dict[int, list[int]] = defaultdict(list)
    for factor, keyframe in enumerate(newest):
        ending[keyframe].append(factor)
    for epoch in epochs.tolist():
        first = max(0, epoch - DEPTH + 1)
        factors = [factor for keyframe in range(first, epoch + 1) for factor in ending[keyframe]]
        yield picture_of([(str(layout.sensor[f]), touched[f]) for f in factors], first)


def _touched(layout: FactorGraphLayout) -> tuple[list[list[State]], list[int]]:
    """States that each factor touches, and its newest keyframe; -1 where it touches session states alone."""
    touched: list[list[State]] = [[] for _ in layout.sensor]
    newest = [-1] * len(layout.sensor)
    for factor, letter, index in zip(
        layout.factor.tolist(), layout.letter.tolist(), layout.index.tolist(), strict=True
    ):
        touched[factor].append((letter, index))
        if STATES[letter].scope != "session":
            newest[factor] = max(newest[factor], index)
    return touched, newest


def picture_of(factors: Sequence[tuple[str, list[State]]], first: int) -> GraphDrawing:
    """Factors (builder, states) with the states they touch; keyframes before `first` are one node."""
    picture = GraphDrawing()
    states = sorted({state for _, touched in factors for state in touched}, key=_order)
    places: dict[State, tuple[float, float]] = {}
    for state in states:
        if _shared(state):
            at = (COLUMN * (1 + sum(_shared(other) for other in places)), BELOW + ROW * 3)
        elif state[1] >= first:
            at = (COLUMN * (state[1] - first), ROW * _rank(state[0]))
        else:
            continue
        places[state] = at
        picture.node(_name(state), _label(state), at, colours.STATES.get(state[0], colours.QUIET))
    if any(not _shared(state) and state[1] < first for state in states):
        picture.node(EARLIER, EARLIER, (-COLUMN, ROW), colours.QUIET)
    slots: dict[float, int] = defaultdict(int)
    for number, (sensor, touched) in enumerate(factors):
        _add_factor(picture, f"f{number}", sensor, touched, places, slots)
    return picture


def _add_factor(
    picture: GraphDrawing,
    name: str,
    sensor: str,
    touched: list[State],
    places: dict[State, tuple[float, float]],
    slots: dict[float, int],
) -> None:
    """An inertial factor between its keyframes, any other above its last one."""
    own = [places.get(state, (-COLUMN, ROW)) for state in touched if not _shared(state)]
    columns = sorted({x for x, _ in own}) or [0.0]
    if sensor.startswith("imu") and len(columns) == 2:
        at = (sum(columns) / 2, sum(y for _, y in own) / len(own))
    else:
        slots[columns[-1]] += 1
        at = (columns[-1] - ASIDE, ABOVE - 45.0 * (slots[columns[-1]] - 1))
    picture.node(name, sensor, at, colours.of_builder(sensor))
    picture.edges += [(name, end) for end in dict.fromkeys(_name(s) if s in places else EARLIER for s in touched)]


def _shared(state: State) -> bool:
    return STATES[state[0]].scope == "session"


def _order(state: State) -> tuple[bool, int, int, str]:
    return _shared(state), state[1], _rank(state[0]), state[0]


def _rank(letter: str) -> int:
    """Row of a keyframe's state: pose, velocity, bias, then those of the sensors."""
    return list(STATES).index(letter) if letter in "XVB" else 3


def _name(state: State) -> str:
    return f"{state[0].lower()}{state[1]}"


def _label(state: State) -> str:
    return STATES[state[0]].name if _shared(state) else f"{STATES[state[0]].name} {state[1]}"
