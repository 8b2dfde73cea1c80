"""The command for the drift between fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from smartnav_graph.cli.options import Reporting, SessionCommand, Switch, repairs
from smartnav_graph.core.errors import ConfigError, SessionError
from smartnav_graph.output.progress import progress
from smartnav_graph.output.text import Row, Table

if TYPE_CHECKING:
    from smartnav_graph.evaluation.intervals import FixesFromReference, Interval
    from smartnav_graph.session.session import Session
    from smartnav_graph.session.streams import Reference


@dataclass(frozen=True, kw_only=True)
class Intervals(SessionCommand, Reporting):
    """Drift between fixes (simulated outages): replay the session with a fix every few seconds, and compare the
    trajectory between the fixes with a reference: mean, 67 %, 95 % and RMS of the error.

    smoothed: all data; causal: past data only; causal_end: prediction before the next fix.

    Example: smartnav intervals walk --every 1,2,5 --reference walk --fixes-from-reference --fix-sigma 0.005,0.5
    """

    every: Annotated[str, tyro.conf.arg(metavar="S,S,...")]
    """Intervals between fixes, seconds."""
    reference: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """TUM, EuRoC ground truth, CSV with t, x, y, z named, or a session folder."""
    fixes_from_reference: Switch = False
    """Generate the fixes from the reference, with noise, instead of using the session's own."""
    fix_sigma: Annotated[str, tyro.conf.arg(metavar="M[,DEG]")] = "0.3,2"
    """Sigma of these fixes on each axis: position m, attitude deg (one number: no attitude)."""
    latency: Annotated[float, tyro.conf.arg(metavar="S")] = 0.0
    """Delay of these fixes, seconds (delayed measurements)."""
    seeds: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Number of noise realisations, seeds 0 to N - 1."""

    def run(self) -> None:
        from smartnav_graph import readers
        from smartnav_graph.evaluation.intervals import intervals

        session = readers.load(self.session, repairs=repairs(self.repair))
        reference = self._reference(session)
        every = numbers("--every", self.every)
        generated, config = self._generated() if self.fixes_from_reference else None, self.resolved()
        with progress(self.quiet) as show:
            rows = intervals(
                session, reference, every, generated=generated, seeds=self.seeds, config=config, progress=show
            )
            found = list(rows)
        self.report([row.to_dict() for row in found], intervals_text(found))

    def _reference(self, session: Session) -> Reference:
        """The reference; that of the session where both are the same log."""
        from smartnav_graph.readers.reference import load_reference

        folder = Path(self.session)
        if self.reference != folder or (folder / "reference.parquet").is_file():
            return load_reference(self.reference)
        if session.reference is None:
            raise SessionError(
                self.reference, "contains no reference", "a log with one, or a file", "give --reference FILE"
            )
        return session.reference

    def _generated(self) -> FixesFromReference:
        from smartnav_graph.evaluation.intervals import FixesFromReference

        if self.seeds < 1:
            raise ConfigError("--seeds", str(self.seeds), ">= 1")
        sigmas = numbers("--fix-sigma", self.fix_sigma)
        if len(sigmas) > 2:
            raise ConfigError("--fix-sigma", repr(self.fix_sigma), "metres, or metres and degrees, as 0.3,2")
        return FixesFromReference(sigmas[0], sigmas[1] if len(sigmas) == 2 else None, self.latency)


def numbers(option: str, text: str) -> list[float]:
    """The numbers of a comma separated list.

    Raises
    ------
    ConfigError
        The text is empty or contains something else.
    """
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or not np.isfinite(found).all():
        raise ConfigError(option, repr(text), "numbers separated by commas, as 1,2,5")
    return found


def intervals_text(found: Sequence[Interval]) -> str:
    """A table: one line for each interval and kind, figures averaged over the seeds."""
    names = ("mean_m", "p67_m", "p95_m", "rmse_m", "horizontal_mean_m")
    heading = ("kind", "every s", "seeds", "rows", "mean m", "67 % m", "95 % m", "RMS m", "mean 2-D m")
    table = []
    groups: dict[tuple[float, str], list[Interval]] = {}
    for row in found:
        groups.setdefault((row.every_s, row.kind), []).append(row)
    for (every, kind), rows in groups.items():
        figures = [[x for row in rows if (x := getattr(row, name)) is not None] for name in names]
        counts = (f"{every:g}", str(len(rows)), str(sum(row.n for row in rows)))
        table.append(Row((kind, *counts, *(f"{np.mean(x):.4f}" if x else "-" for x in figures))))
    return Table(heading, table).text()
