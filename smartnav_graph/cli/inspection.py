"""Commands that look into runs: what determined a state, and how two runs differ."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smartnav_graph.cli.options import Command, RunPath, Switch
from smartnav_graph.cli.text import statistics_line
from smartnav_graph.run_folder import plain, read_run


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
        from smartnav_graph.explain import explain

        found = explain(read_run(self.run_path), self.at)
        print(json.dumps(plain(found.to_dict()), allow_nan=False) if self.json else found.to_text())


@dataclass(frozen=True, kw_only=True)
class Compare(Command):
    """A run against another: how far apart they are, how their sigmas differ, and what was asked of each.

    Example: smartnav compare kitti-run kitti-replay
    """

    first: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN1")]
    """Run folder."""
    second: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN2")]
    """Run folder."""
    json: Switch = False
    """Print JSON, and nothing else, on stdout."""

    def run(self) -> None:
        from smartnav_graph.evaluation.compare import compare
        from smartnav_graph.run_folder import config_differences

        found = compare(read_run(self.first).solution, read_run(self.second).solution)
        options = config_differences(self.first, self.second)
        if self.json:
            print(json.dumps(plain({**found.to_dict(), "config": options}), allow_nan=False))
            return
        print(f"{found.epochs} common epochs of {self.first} and {self.second}")
        for name, unit in (("position", "m"), ("rotation", "deg"), ("velocity", "m/s")):
            print(statistics_line(name, unit, found.to_dict()[f"{name}_{unit.replace('/', '_')}"]))
        print(
            f"sigma       median ratio second / first: position {found.sigma_ratio['position']:.3f}, "
            f"rotation {found.sigma_ratio['rotation']:.3f}, velocity {found.sigma_ratio['velocity']:.3f}"
        )
        for key, (one, other) in options.items():
            print(f"config      {key}: {one} | {other}")
