"""The stretch between two keyframes, with its slice of every stream."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats


@dataclass(frozen=True)
class Window:
    """The stretch (t0, t1] that ends at keyframe `index`, with its slice of every stream.

    kind : ``first`` (t0 == t1, the first keyframe), ``normal``, ``gap`` (missing or bridged inertial data), ``static``
    dt (m,) s, accel (m, 3) m/s^2, gyro (m, 3) rad/s : inertial intervals, means over each interval, borders
    interpolated; the force is given in body axes at the interval's start
    rows : row indices of each absolute stream at t1 (`Stream.ABSOLUTE`); a builder selects those of others by time
    delayed : rows of an earlier time that became known in this window
    """

    index: int
    t0_ns: int
    t1_ns: int
    kind: str
    dt: Floats
    accel: Floats
    gyro: Floats
    rows: Mapping[str, NDArray[np.intp]] = field(default_factory=dict)
    delayed: Mapping[str, Sequence[DelayedRow]] = field(default_factory=dict)

    @property
    def length_s(self) -> float:
        """Length, s."""
        return (self.t1_ns - self.t0_ns) / 1e9


Value = TypeVar("Value")


class PerWindow(Generic[Value]):
    """What a builder computed of windows alone, kept from pass to pass."""

    def __init__(self) -> None:
        self._kept: dict[int, tuple[Window, Value]] = {}

    def of(self, window: Window, compute: Callable[[Window], Value]) -> Value:
        """The value of a window, computed the first time."""
        kept = self._kept.get(window.index)
        if kept is None or kept[0] is not window:
            kept = self._kept[window.index] = window, compute(window)
        return kept[1]


@dataclass(frozen=True)
class DelayedRow:
    """A row that arrived after the window of its measurement time `t_ns`, which is `window`."""

    row: int
    t_ns: int
    window: Window
