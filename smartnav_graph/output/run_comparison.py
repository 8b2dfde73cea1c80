"""Comparison of two runs: differences of their states, options, rejected rows and summary figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from smartnav_graph.evaluation.compare import MEASURES, Comparison, Measure, compare, figure_differences, rejected_sets
from smartnav_graph.output.run_folder import StoredRun, config_differences
from smartnav_graph.output.text import Row, Table

# Up to so many rows that only one run rejected are listed one by one.
FEW = 8
COLUMNS = ("RMS", "median", "95 %", "largest", "at s", "in sigmas", "sigma 2/1")
MEANING = (
    "in sigmas: the largest difference over the larger sigma of the two runs; "
    "sigma 2/1: median sigma of the second run over that of the first; differences of rounding are 0"
)


@dataclass(frozen=True)
class RunDifferences:
    """States, options (``section.field`` -> the value of each), rejected rows by sensor, figures of summary.json."""

    first: StoredRun
    second: StoredRun
    states: Comparison
    config: Mapping[str, tuple[object, object]]
    rejected: Mapping[str, Mapping[str, Any]]
    figures: Mapping[str, tuple[object, object]]

    def to_dict(self) -> dict[str, object]:
        """Every difference."""
        tables = {"config": self.config, "rejected": self.rejected, "figures": self.figures}
        return {"first": str(self.first.path), "second": str(self.second.path), **self.states.to_dict(), **tables}

    def to_text(self) -> str:
        """Tables in fixed width."""
        first, *rest = (table.text() for table in self._tables())
        rejected = ["\n".join(lines)] if (lines := list(self._rejected())) else []
        return "\n\n".join([f"{self._title()}\n\n{first}\n\n{MEANING}", *rest, *rejected])

    def to_markdown(self) -> str:
        """The same as Markdown."""
        first, *rest = (table.markdown() for table in self._tables())
        return "\n\n".join([self._title(), first, MEANING, *rest, *(f"- {line}" for line in self._rejected())])

    def _tables(self) -> Iterator[Table]:
        """Differences of the states, options that differ, figures that differ."""
        yield Table(("", *COLUMNS), [Row(self._row(measure)) for measure in MEASURES])
        for name in ("config", "figures"):
            rows = [Row((key, _shown(one), _shown(other))) for key, (one, other) in getattr(self, name).items()]
            if rows:
                yield Table((name, self.first.path.name, self.second.path.name), rows)

    def write_recording(self, path: Path, *, force: bool) -> None:
        """Both runs as one recording; see `rerun_log.comparison`."""
        from smartnav_graph.output.rerun_log.comparison import write_comparison

        write_comparison(
            path,
            self.first.solution,
            self.second.solution,
            self.states,
            names=(self.first.path.name, self.second.path.name),
            clock_epoch=self.first.clock_epoch,
            report_markdown=self.to_markdown(),
            force=force,
        )

    def _title(self) -> str:
        counts = [len(run.solution) for run in (self.first, self.second)]
        few = "; use the same --rate HZ for both to get more" if 2 * len(self.states) < min(counts) else ""
        common = f"{len(self.states)} common epochs (of {counts[0]} and {counts[1]}{few})"
        return f"{self.second.path} minus {self.first.path} at {common}"

    def _row(self, measure: Measure) -> tuple[str, ...]:
        one = self.states.statistics(measure)
        s = one.statistics
        figures = ["-" if value is None else f"{value:.4g}" for value in (s.rmse, s.p50, s.p95, s.max)]
        name = f"{measure.name.split('_')[0]}{' bias' if 'bias' in measure.name else ''} {measure.unit}"
        return (name, *figures, f"{one.largest_at_s:.2f}", f"{one.largest_sigmas:.2f}", f"{one.sigma_ratio:.3f}")

    def _rejected(self) -> Iterator[str]:
        for sensor, sets in self.rejected.items():
            only = [f"only in {which}: {_rows(sets[f'only_{which}'])}" for which in ("first", "second")]
            yield f"rejected {sensor}: in both {sets['both']}, {', '.join(only)}"


def compare_runs(first: StoredRun, second: StoredRun) -> RunDifferences:
    """The differences of two runs of one session.

    Raises
    ------
    SessionError
        They have no time in common.
    """
    return RunDifferences(
        first=first,
        second=second,
        states=compare(first.solution, second.solution),
        config=config_differences(first.path, second.path),
        rejected=rejected_sets(first.summary, second.summary),
        figures=figure_differences(first.summary, second.summary),
    )


def _rows(rows: list[int]) -> str:
    """The number of rows; few are listed."""
    return f"{len(rows)} (rows {', '.join(map(str, rows))})" if 0 < len(rows) <= FEW else str(len(rows))


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_shown, value))}]"
    return "-" if value is None else str(value)
