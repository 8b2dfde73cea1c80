"""All factors of a solved graph, linearised at the solution: collected, written and read back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import gtsam
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.factors import builder_of
from smartnav_graph.graph.states import STATES, letters_of
from smartnav_graph.graph.update import FactorId
from smartnav_graph.graph.windows import Window
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.redundancy import CALIBRATION
from smartnav_graph.smoothers.whole_graph import Snapshot, StackedFactors

Names = NDArray[np.uint64]

FACTORS, KEYFRAMES = "influence.parquet", "keyframes.parquet"


class Group(NamedTuple):
    """Factors of one shape: t_ns (g,), row (g,) of a stream or -1, keys (g, k), whitened [J b] (g, m, width + 1)."""

    sensor: str
    t_ns: Times
    row: NDArray[np.int64]
    keys: Names
    augmented: Floats


@dataclass(frozen=True)
class Keyframes:
    """index (n,) in the keys, t_ns (n,), kind (n,) of the window before (see `graph.Window`), nav_R_body (n, 3, 3)."""

    index: NDArray[np.int64]
    t_ns: Times
    kind: NDArray[np.object_]
    nav_R_body: Floats

    def __len__(self) -> int:
        return len(self.index)

    def nearest(self, t_ns: int) -> int:
        """Row of the keyframe nearest in time."""
        return int(np.abs(self.t_ns - t_ns).argmin())


@dataclass(frozen=True)
class Influence:
    """All factors of a solved graph and its keyframes; poses on GTSAM's tangent (rotation, translation; body axes)."""

    groups: Sequence[Group]
    keyframes: Keyframes

    @classmethod
    def of(cls, estimate: Estimate, windows: Iterable[Window]) -> Influence:
        """Of an estimate and the windows before its keyframes."""
        kinds = {window.index: window.kind for window in windows}
        index = np.array(estimate.indices, dtype=np.int64)
        kind = np.array([kinds[i] for i in estimate.indices], dtype=object)
        keyframes = Keyframes(index, estimate.t_ns, kind, estimate.states()[0])
        sensors = sorted({block.sensor for block in estimate.blocks})
        stacks = [_of_stack(stack, estimate.snapshot) for sensor in sensors for stack in estimate.stacks(sensor)]
        found = [*_native(estimate), *stacks, *_priors(estimate)]
        return cls([group for group in found if len(group.t_ns)], keyframes)

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """Names of the builders whose factors make the graph, and `CALIBRATION`; sorted."""
        return tuple(sorted({builder_of(group.sensor) for group in self.groups}))

    def write(self, folder: Path) -> None:
        """influence.parquet, a row a factor: sensor, t_ns, row, keys, values of [J b] row by row; keyframes.parquet."""
        groups = self.groups
        columns = {
            "sensor": pa.array([group.sensor for group in groups for _ in group.t_ns]).dictionary_encode(),
            "t_ns": np.concatenate([group.t_ns for group in groups]),
            "row": np.concatenate([group.row for group in groups]),
            "keys": _lists([group.keys for group in groups]),
            "values": _lists([group.augmented for group in groups]),
        }
        pq.write_table(pa.table(columns), folder / FACTORS, compression="zstd")
        at = self.keyframes
        quaternions = Rotation.from_matrix(at.nav_R_body).as_quat(canonical=True)
        turns = dict(zip(("qx", "qy", "qz", "qw"), quaternions.T, strict=True))
        table = {"keyframe": at.index, "t_ns": at.t_ns, "kind": pa.array(at.kind.tolist()), **turns}
        pq.write_table(pa.table(table), folder / KEYFRAMES)

    @classmethod
    def read(cls, folder: Path) -> Influence:
        """What `write` wrote.

        Raises
        ------
        OSError, pyarrow.ArrowException, KeyError, ValueError
            Missing or unreadable files.
        """
        table = pq.read_table(folder / KEYFRAMES)
        quaternions = np.stack([table.column(name).to_numpy() for name in ("qx", "qy", "qz", "qw")], axis=1)
        index, t_ns = (table.column(name).to_numpy() for name in ("keyframe", "t_ns"))
        kind = np.array(table.column("kind").to_pylist(), dtype=object)
        keyframes = Keyframes(index, t_ns, kind, Rotation.from_quat(quaternions).as_matrix())
        return cls(list(_grouped(pq.read_table(folder / FACTORS).combine_chunks())), keyframes)


def _native(estimate: Estimate) -> Iterator[Group]:
    """Native factors, linearised in one call, grouped by sensor and shape."""
    graph = gtsam.NonlinearFactorGraph()
    for _, factor in estimate.factors:
        graph.push_back(factor)
    linear = graph.linearize(estimate.values)
    found: dict[tuple[object, ...], list[tuple[FactorId, list[int], Floats]]] = {}
    for i, (tag, _) in enumerate(estimate.factors):
        factor = linear.at(i)
        if factor is None:  # no information at these values
            continue
        keys, augmented = factor.keys(), factor.augmentedJacobian()
        shape = (tag.sensor, letters_of(np.array(keys, dtype=np.uint64)).tobytes(), augmented.shape)
        found.setdefault(shape, []).append((tag, keys, augmented))
    for items in found.values():
        tags = [tag for tag, _, _ in items]
        yield _group(tags[0].sensor, tags, [keys for _, keys, _ in items], np.array([rows for _, _, rows in items]))


def _group(sensor: str, tags: Sequence[FactorId], keys: Sequence[Sequence[int]], augmented: Floats) -> Group:
    t_ns = np.array([tag.t_ns for tag in tags], dtype=np.int64)
    row = np.array([tag.row for tag in tags], dtype=np.int64)
    return Group(sensor, t_ns, row, np.array(keys, dtype=np.uint64), augmented)


def _of_stack(stack: StackedFactors, snapshot: Snapshot) -> Group:
    """The used rows of a stack under their loss, without fixed states."""
    residual, jacobians = stack.linearize(snapshot)
    free = [i for i, name in enumerate(stack.keys[0]) if name not in stack.held]
    rows = np.concatenate([*(jacobians[i] for i in free), -residual[:, :, None]], axis=2)
    rows *= np.sqrt(stack.weight(residual))[:, None, None]
    keys = np.array(stack.keys, dtype=np.uint64)[:, free]
    used = stack.used
    return Group(stack.sensor, stack.t_ns[used], stack.rows[used].astype(np.int64), keys[used], rows[used])


def _priors(estimate: Estimate) -> Iterator[Group]:
    """Priors of the session states that are estimated."""
    for state in estimate.session.values():
        if not state.held:
            rows = np.column_stack([np.eye(len(state.value)), state.prior_mean - state.value])
            tag = FactorId(CALIBRATION, int(estimate.t_ns[0]))
            yield _group(CALIBRATION, [tag], [[state.key]], (rows / state.prior_sigma[:, None])[None])


def _lists(arrays: Sequence[Names] | Sequence[Floats]) -> pa.ListArray:
    """One list a row of arrays (g, ...)."""
    sizes = np.concatenate([np.full(len(array), array[0].size) for array in arrays])
    offsets = np.concatenate([[0], np.cumsum(sizes)])
    flat = np.concatenate([array.ravel() for array in arrays])
    return pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), pa.array(flat))


def _grouped(table: pa.Table) -> Iterator[Group]:
    """Rows of influence.parquet by sensor and shape."""
    sensor = table.column("sensor").to_numpy()
    t_ns, row = (table.column(name).to_numpy() for name in ("t_ns", "row"))
    keys, values = (_rows_of(table.column(name)) for name in ("keys", "values"))
    found: dict[tuple[str, bytes, int], list[int]] = {}
    for i, (names, numbers) in enumerate(zip(keys, values, strict=True)):
        found.setdefault((sensor[i], letters_of(names).tobytes(), len(numbers)), []).append(i)
    for (name, kinds, _), rows in found.items():
        width = sum(STATES[chr(kind)].dim for kind in kinds) + 1
        augmented = np.array([values[i] for i in rows]).reshape(len(rows), -1, width)
        yield Group(name, t_ns[rows], row[rows], np.array([keys[i] for i in rows], dtype=np.uint64), augmented)


def _rows_of(column: pa.ChunkedArray) -> list[NDArray[Any]]:
    """The lists of a column."""
    lists = column.combine_chunks()
    flat, offsets = lists.values.to_numpy(), lists.offsets.to_numpy()
    return [flat[a:b] for a, b in pairwise(offsets.tolist())]
