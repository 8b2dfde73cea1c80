"""Commands that look into runs: what determined a state, and how two runs differ."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smartnav_graph.cli.options import Command, RunPath, Switch
from smartnav_graph.cli.progress import progress
from smartnav_graph.core.files import refuse_existing
from smartnav_graph.output.run_folder import plain, read_run


@dataclass(frozen=True, kw_only=True)
class Explain(Command):
    """What determined the state at one instant: whose uncertainty it has, what pulls at it, what it rests on, and the
    nearest gap, rejection and standstill.

    Example: smartnav explain kitti-run --at 306
    """

    run_path: RunPath
    """Run folder."""
    at: Annotated[float | None, tyro.conf.arg(metavar="T")] = None
    """The instant, seconds from the session's start; by default where the position is least certain."""
    json: Switch = False
    """Print JSON, and nothing else, on stdout."""

    def run(self) -> None:
        from smartnav_graph.output.explain import explain

        with progress(self.quiet) as show:
            show(f"looking into {self.run_path}", 0, 0)
            found = explain(read_run(self.run_path), self.at)
        print(json.dumps(plain(found.to_dict()), allow_nan=False) if self.json else found.to_text())


@dataclass(frozen=True, kw_only=True)
class Compare(Command):
    """A run against another: how far apart they are and where, how their sigmas differ, what was asked of each, what
    each rejected, and the figures that differ; as a table, and with --out as one recording for the Rerun viewer.

    Example: smartnav compare kitti-run kitti-replay --out both.rrd
    """

    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN1")]
    """Run folder."""
    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN2")]
    """Run folder."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write both as one recording (.rrd): both paths, their differences along time."""
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
            print(json.dumps(plain(found.to_dict()), allow_nan=False))
            return
        print(found.to_text())
        if self.out is not None:
            print(f"recording: {self.out}")
