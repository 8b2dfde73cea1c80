"""Commands that inspect runs: explain a state, compare two runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smartnav_graph.cli.options import Command, RunPath, Switch
from smartnav_graph.cli.progress import progress
from smartnav_graph.cli.text import print_json
from smartnav_graph.core.files import refuse_existing
from smartnav_graph.output.run_folder import read_run


@dataclass(frozen=True, kw_only=True)
class Explain(Command):
    """Explain which measurements determine the state at one epoch: variance by source, what is not observable without
    a source, shift of the estimate by source, and the nearest data gap, rejection and standstill.

    Example: smartnav explain kitti-run --at 306
    """

    run_path: RunPath
    """Run folder."""
    at: Annotated[float | None, tyro.conf.arg(metavar="T")] = None
    """Time in seconds from the session's start; by default that of the largest position uncertainty."""
    json: Switch = False
    """Print JSON, and nothing else, on stdout."""

    def run(self) -> None:
        from smartnav_graph.output.explain import explain

        with progress(self.quiet) as show:
            show(f"reading {self.run_path}", 0, 0)
            found = explain(read_run(self.run_path), self.at)
        if self.json:
            print_json(found.to_dict())
        else:
            print(found.to_text())


@dataclass(frozen=True, kw_only=True)
class Compare(Command):
    """Compare a run with another run: differences of states and sigmas, options, rejected measurements and summary
    figures; as a table, and with --out as one recording for the Rerun viewer.

    Example: smartnav compare kitti-run kitti-replay --out both.rrd
    """

    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN1")]
    """Run folder."""
    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN2")]
    """Run folder."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write one recording (.rrd): both paths, and their differences over time."""
    force: Switch = False
    """Replace the file."""
    json: Switch = False
    """Print JSON, and nothing else, on stdout."""

    def run(self) -> None:
        from smartnav_graph.output.run_comparison import compare_runs

        if self.out is not None:
            refuse_existing(self.out, self.force)
        with progress(self.quiet) as show:
            show("comparing", 0, 0)
            found = compare_runs(read_run(self.first), read_run(self.second))
            if self.out is not None:
                show("writing the recording", 0, 0)
                found.write_recording(self.out, force=self.force)
        if self.json:
            print_json(found.to_dict())
            return
        print(found.to_text())
        if self.out is not None:
            print(f"recording: {self.out}")
