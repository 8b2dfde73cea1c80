"""The command that compares a run with a reference."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from smartnav_graph.cli.options import Command, RunPath, Switch
from smartnav_graph.cli.progress import progress
from smartnav_graph.cli.text import print_json, statistics_line
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.evaluation import Evaluation, evaluate
from smartnav_graph.output.run_folder import read_run
from smartnav_graph.readers.reference import load_reference


@dataclass(frozen=True, kw_only=True)
class Evaluate(Command):
    """Compare a run with a reference trajectory: absolute and relative errors, percentiles, consistency (NEES).

    Example: smartnav evaluate walk-run --reference walk --align yaw --json
    """

    run_path: RunPath
    """Run folder."""
    reference: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """TUM, EuRoC ground truth, KITTI poses, CSV with t, x, y, z named, or a session folder."""
    times: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Times of KITTI poses."""
    body_T_ref: Annotated[Path | None, tyro.conf.arg(name="body-T-ref", metavar="FILE")] = None
    """TOML with the pose of the reference's frame in the body, a 4x4 matrix body_T_<name>."""
    align: Literal["none", "yaw", "se3", "sim3"] = "none"
    """Transformation to estimate before comparing."""
    solution: Literal["smoothed", "causal"] = "smoothed"
    """Solution of a replay."""
    time_offset: Annotated[str, tyro.conf.arg(metavar="S|auto")] = "0"
    """Added to the time stamps of the reference; auto estimates it."""
    json: Switch = False
    """Print JSON, and nothing else, on stdout."""

    def run(self) -> None:
        offset = _offset(self.time_offset)
        with progress(self.quiet) as show:
            show(f"reading {self.reference}", 0, 0)
            reference = load_reference(self.reference, times=self.times, body_T_ref=self.body_T_ref)
            solution = read_run(self.run_path).named(self.solution)
            show("comparing", 0, 0)
            found = evaluate(
                solution,
                reference,
                align=self.align,
                time_offset_s=offset,
                solution_name=self.solution,
                reference_name=str(self.reference),
            )
        if self.json:
            print_json(found.to_dict())
        else:
            print(evaluation_text(found))


def _offset(text: str) -> float | Literal["auto"]:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError as error:
        raise ConfigError("--time-offset", repr(text), "seconds, or auto") from error


def evaluation_text(found: Evaluation) -> str:
    """The figures of an evaluation as text."""
    rotation = None if found.rotation_deg is None else asdict(found.rotation_deg)
    lines = [
        f"{found.solution} against {found.reference}: {found.matched} epochs matched, {found.unmatched} outside; "
        f"alignment {found.align}, time offset {found.time_offset_s:.4f} s",
        statistics_line("position", "m", asdict(found.ape_m)),
        statistics_line("rotation", "deg", rotation),
    ]
    for row in found.rpe:
        if row.translation_m is not None:
            turn = "" if row.rotation_deg is None else f", {row.rotation_deg:.3f} deg"
            lines.append(f"over {row.delta_s:g} s{'':<4}{row.translation_m:.3f} m{turn} ({row.pairs} pairs)")
    nees = ", ".join(f"{k} {v:.2f}" for k, v in found.nees.items() if v is not None)
    lines += [f"NEES        {nees} (expected 3; yaw 1)"] if nees else []
    return "\n".join([*lines, *found.notes])
