"""Which measurements determine the state at one epoch, and how much; what lies near it; in figures and in sentences.

The state is that of the nearest keyframe, given all data; the figures are those of `evaluation.influence`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import pyarrow as pa

from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.core.timebase import ns_from_seconds
from smartnav_graph.evaluation.influence import FACTORS, KEYFRAMES, Influence, influence_of_keyframe
from smartnav_graph.graph.solution import POS
from smartnav_graph.output.explain.figures import Explanation
from smartnav_graph.output.explain.nearby import Nearby, nearby
from smartnav_graph.output.explain.sentences import sentences, variance_table
from smartnav_graph.output.run_folder import StoredRun, unreadable

__all__ = ["Explained", "Explanation", "explain"]


@dataclass(frozen=True)
class Explained:
    """Figures, surroundings and sentences."""

    figures: Explanation
    near: Nearby
    sentences: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """All of it as plain values."""
        return {**self.figures.to_dict(), "near": asdict(self.near), "sentences": list(self.sentences)}

    def to_text(self) -> str:
        """The sentences, then tables."""
        return "\n".join(self.sentences) + "\n" + variance_table(self.figures)


def explain(run: StoredRun, at_s: float | None = None) -> Explained:
    """What determines the state of a run `at_s` seconds after time zero; by default at the largest horizontal sigma.

    Raises
    ------
    ConfigError
        `at_s` is outside the run.
    SessionError
        The run's folder lacks the stored linear system.
    SolverError
        The stored system does not determine that keyframe.
    """
    influence = _read(run)
    asked = None if at_s is None else _checked(run, at_s)
    place = influence.keyframes.nearest(_least_certain(run) if asked is None else asked)
    figures = Explanation(run, influence, influence_of_keyframe(influence, place), asked)
    near = nearby(run, figures.keyframe.measurements, figures.seconds(figures.t_ns))
    return Explained(figures, near, tuple(sentences(figures, near)))


def _read(run: StoredRun) -> Influence:
    """The linear system stored with a run."""
    for name in (FACTORS, KEYFRAMES):
        if not (run.path / name).is_file():
            raise SessionError(run.path, f"holds no {name}", "a run with its linear system", "smooth the session again")
    try:
        return Influence.read(run.path)
    except (OSError, KeyError, ValueError, pa.ArrowException) as error:
        raise unreadable(run.path / FACTORS, error) from error


def _checked(run: StoredRun, at_s: float) -> int:
    """Stamp of a time inside the run."""
    seconds = run.solution.seconds
    if not seconds[0] <= at_s <= seconds[-1]:
        inside = f"{seconds[0]:.3f} to {seconds[-1]:.3f} s, the time span of the run"
        raise ConfigError("--at", f"{at_s:g} s", inside, "seconds count from the session's start")
    return int(run.solution.t0_ns + ns_from_seconds(at_s))


def _least_certain(run: StoredRun) -> int:
    """Stamp of the largest horizontal sigma."""
    variance = np.diagonal(run.solution.covariance, axis1=1, axis2=2)[:, POS][:, :2].sum(axis=1)
    return int(run.solution.t_ns[variance.argmax()])
