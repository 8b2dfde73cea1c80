"""The command that matches points in images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from smartnav_graph.cli.options import Reporting, SourceName, Switch, Text

FilePath = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]


@dataclass(frozen=True, kw_only=True)
class Match(Reporting):
    """Match points in the images of a session, or track them; the result is stored in the session, and a second call
    with the same options reads it again.

    With --benchmark nothing is written: matches are compared with the poses of the session's reference, or of
    --reference. With --map the session gets pose fixes instead: those of its images in a COLMAP model, whose scale and
    frame are estimated from known positions.

    Example: smartnav match lund --features sift
    """

    session: SourceName
    """Session folder; with --benchmark also a log of a known format."""
    features: Annotated[Text, tyro.conf.arg(metavar="NAME")] = None
    """orb (default), sift, akaze, brisk, fast+freak, star+brief, gftt+freak, mser+freak, or klt for tracks; with
    --benchmark several, separated by commas, all that the installed OpenCV has by default."""
    policy: Literal["ratio", "thesis"] = "ratio"
    """Matching rule: mutual nearest neighbours with Lowe's ratio test, or the 15 best as in the thesis of 2012."""
    count: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Most points in an image; 0 is 1500, or 300 tracks."""
    spans: Annotated[Text, tyro.conf.arg(metavar="N,N,...")] = None
    """Distances between the two images of a pair, in images; by default 1,2,4,8, with --benchmark 1."""
    longest: Annotated[float, tyro.conf.arg(metavar="S")] = 2.0
    """Longest time between the images of a pair that are not consecutive, seconds."""
    rate: Annotated[float | None, tyro.conf.arg(metavar="HZ")] = None
    """Most images per second, 0 for all; by default 4, for tracks and with --benchmark all."""
    benchmark: Switch = False
    """Print correct matches, useful pairs and times, with those of the thesis."""
    reference: FilePath = None
    """For --benchmark: true poses, in a format of `smartnav evaluate`."""
    from_file: FilePath = None
    """Read matches from a match file of 2012 instead of computing them."""
    to_file: FilePath = None
    """Write the session's matches as a match file of 2012 instead of computing them."""
    map: Annotated[Path | None, tyro.conf.arg(metavar="MODEL")] = None
    """Make pose fixes from this COLMAP model (the folder with cameras, images, points3D) in which images of the session
    are registered by file name, as in `smartnav match walk --map sparse/0 --known walk-run`."""
    known: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """The run whose positions align the model; by default the GNSS fixes."""
    camera: Annotated[Text, tyro.conf.arg(metavar="NAME")] = None
    """The camera of a match file, if the session has several."""
    workers: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Number of parallel processes; 0 for one on each processor."""
    force: Switch = False
    """Replace an older result."""

    def run(self) -> None:
        from smartnav_graph.cli.match_tasks import execute

        execute(self)
