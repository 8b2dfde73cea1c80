"""What determined the state at one instant: which measurements, how much, what is near; in figures and in words.

The state is that of the nearest keyframe, given all data; its figures are those of `influence`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.evaluation.influence import FACTORS, KEYFRAMES, Influence, influence_of_keyframe
from smartnav_graph.graph.solution import POS
from smartnav_graph.output.explain.figures import Explanation
from smartnav_graph.output.explain.nearby import Nearby, nearby
from smartnav_graph.output.explain.words import sentences, table
from smartnav_graph.output.run_folder import StoredRun

__all__ = ["Explained", "Explanation", "explain"]


@dataclass(frozen=True)
class Explained:
    """Figures, surroundings and sentences."""

    figures: Explanation
    near: Nearby
    sentences: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """All of it as plain values."""
        near: Mapping[str, Any] = asdict(self.near)
        return {**self.figures.to_dict(), "near": near, "sentences": list(self.sentences)}

    def to_text(self) -> str:
        """The sentences, and tables under them."""
        return "\n".join(self.sentences) + "\n" + table(self.figures)


def explain(run: StoredRun, at_s: float | None = None) -> Explained:
    """What determined the state of a run `at_s` seconds after time zero; by default where it is least certain.

    Raises
    ------
    ConfigError
        The run does not reach there.
    SessionError
        The run's folder lacks what an explanation needs.
    SolverError
        The stored system determines nothing there.
    """
    influence = _read(run)
    asked = None if at_s is None else _checked(run, at_s)
    place = influence.keyframes.nearest(_least_certain(run) if asked is None else asked)
    figures = Explanation(run, influence, influence_of_keyframe(influence, place), asked)
    near = nearby(run, figures.held.measurements, figures.seconds(figures.t_ns))
    return Explained(figures, near, tuple(sentences(figures, near)))


def _read(run: StoredRun) -> Influence:
    """The linear system that a run left in its folder."""
    for name in (FACTORS, KEYFRAMES):
        if not (run.path / name).is_file():
            raise SessionError(run.path, f"holds no {name}", "a run that can be explained", "smooth the session again")
    try:
        return Influence.read(run.path)
    except (OSError, KeyError, ValueError, pa.ArrowException) as error:
        where = run.path / FACTORS
        raise SessionError(
            where, f"cannot be read ({error})", "a table of a run", "smooth the session again"
        ) from error


def _checked(run: StoredRun, at_s: float) -> int:
    """Stamp of an instant inside the run."""
    seconds = run.solution.seconds
    if not seconds[0] <= at_s <= seconds[-1]:
        reach = f"{seconds[0]:.3f} to {seconds[-1]:.3f} s, where the run is"
        raise ConfigError("--at", f"{at_s:g} s", reach, "seconds count from the session's start")
    return int(run.solution.t0_ns + ns_from_seconds(at_s))


def _least_certain(run: StoredRun) -> int:
    """Stamp of the largest horizontal sigma."""
    variance = np.diagonal(run.solution.covariance, axis1=1, axis2=2)[:, POS][:, :2].sum(axis=1)
    return int(run.solution.t_ns[variance.argmax()])
