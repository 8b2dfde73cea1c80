"""What `smartnav match` does: matches, tracks, comparison of features, match files, fixes of a map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.table import Table

from smartnav_graph import readers
from smartnav_graph.cli.options import names
from smartnav_graph.core.errors import CalibrationError, ConfigError, SessionError
from smartnav_graph.output.progress import progress
from smartnav_graph.output.run_folder import read_run
from smartnav_graph.readers import match_file
from smartnav_graph.readers.reference import load_reference
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Session
from smartnav_graph.vision import benchmark as scores
from smartnav_graph.vision import features as kinds
from smartnav_graph.vision import match_store
from smartnav_graph.vision.benchmark import Published, Score
from smartnav_graph.vision.front_end import FrontEndConfig
from smartnav_graph.vision.map import SOURCE, KnownPositions, map_pose_fixes, own_fixes

if TYPE_CHECKING:
    from smartnav_graph.cli.match import Match


def execute(command: Match) -> None:
    """What the options ask for."""
    asked = {"--from-file": command.from_file, "--to-file": command.to_file, "--map": command.map}
    given = [name for name, path in asked.items() if path is not None]
    if len(given) > 1:
        raise ConfigError(given[1], f"is given with {given[0]}", "one of them", "call twice")
    if command.known is not None and command.map is None:
        raise ConfigError("--known", "is given without --map", "a model to align", "add --map MODEL")
    if command.reference is not None and not command.benchmark:
        raise ConfigError("--reference", "is given without --benchmark", "a comparison", "add --benchmark")
    if command.benchmark:
        _benchmark(command)
    elif command.map is not None:
        _map(command, command.map)
    elif command.from_file is not None:
        _from_file(command, command.from_file)
    elif command.to_file is not None:
        _to_file(command, command.to_file)
    else:
        _match(command)


def _match(command: Match) -> None:
    config = _config(command, command.features or "orb", "1,2,4,8", command.rate)
    with progress(command.quiet) as show:
        found = match_store.match(command.session, config, force=command.force, workers=command.workers, progress=show)
    name = "tracks" if config.tracks else "matches"
    where = f"{Path(command.session) / name}.parquet{'' if found.computed else ', read from an earlier call'}"
    figures = {"computed": found.computed} | asdict(found.report)
    command.report(figures, f"{found.report.to_text()}\n{name}: {where}")


def _benchmark(command: Match) -> None:
    asked = names(command.features) or tuple(kinds.available())
    config = _config(command, asked[0], "1", command.rate or 0.0)
    session = readers.load(command.session)
    if command.reference is not None:
        session = session.replace(reference=load_reference(command.reference))
    with progress(command.quiet) as show:
        found = scores.compare_features(session, asked, config, workers=command.workers, progress=show)
    if command.json:
        command.report([one.to_dict() for one in found], "")
    else:
        print_scores(found, all_known=command.features is None)


def _from_file(command: Match, path: Path) -> None:
    folder = Path(command.session)
    session = session_folder.load(folder)
    match_store.refuse_existing_stream(folder, "matches", command.force)
    name, camera = _one_camera(command, session)
    rows = match_file.read_match_file(path)
    assert session.images is not None  # the camera took some
    matches, lost = match_file.to_matches(rows, session.images, name, camera)
    report = {"from_file": str(path), "rows": len(rows.t0_ns), "matches": len(matches), "rows_without_images": lost}
    match_store.store(folder, matches, {"from_file": path.name, "camera": name}, report)
    counts = f"{path}: {len(rows.t0_ns)} rows, {len(matches)} matches, {lost} rows without two images"
    command.report(report, f"{counts}\nmatches: {folder / 'matches.parquet'}")


def _to_file(command: Match, path: Path) -> None:
    session = session_folder.load(command.session)
    name, camera = _one_camera(command, session)
    if session.images is None or session.matches is None:
        raise SessionError(command.session, "has no matches", "matches.parquet", "make them with `smartnav match`")
    mine = session.images.image_id[session.images.camera == name]
    matches = session.matches.take(match_file.of_images(session.matches, mine))
    match_file.write_match_file(matches, path, camera, force=command.force)
    command.report({"to_file": str(path), "matches": len(matches)}, f"{path}: {len(matches)} matches of {name}")


def _map(command: Match, path: Path) -> None:
    folder = Path(command.session)
    session = session_folder.load(folder)
    match_store.refuse_existing_stream(folder, "pose_fixes", command.force)
    refuse_foreign_fixes(folder, session)
    known = own_fixes(session) if command.known is None else _known(command.known, session)
    found = map_pose_fixes(path, session, known)
    report = {**found.counts, "metres_a_unit": found.similarity.scale, "sigma_m": float(found.similarity.sigma)}
    report["turn_sigma_deg"] = float(np.degrees(found.similarity.rotation_sigma).max())
    match_store.store(folder, found.fixes, {"map": str(path), "known": str(command.known or "gnss")}, report)
    command.report(report, f"{map_text(path, report)}\npose fixes: {folder / 'pose_fixes.parquet'}")


def _known(path: Path, session: Session) -> KnownPositions:
    """Positions of a run in the session's frame."""
    run = read_run(path)
    if run.solution.origin != session.origin:
        found = f"has the origin {run.solution.origin}"
        raise SessionError(path, found, f"that of the session, {session.origin}", "smooth this session")
    return KnownPositions(run.solution.t_ns, run.solution.nav_t_body)


def _one_camera(command: Match, session: Session) -> tuple[str, Camera]:
    """The given camera, or the only one with images."""
    there = [] if session.images is None else sorted(set(session.images.camera))
    cameras = {} if session.calibration is None else session.calibration.cameras
    name = command.camera or (there[0] if len(there) == 1 else "")
    if name not in there:
        raise ConfigError("--camera", repr(name), f"one with images: {', '.join(there) or 'there is none'}")
    if name not in cameras:
        where = Path(command.session) / "calibration.toml"
        raise CalibrationError(where, f"has no camera {name}", f"[cameras.{name}]", "add fx, fy, cx, cy")
    return name, cameras[name]


def _config(command: Match, features: str, spans: str, rate_hz: float | None) -> FrontEndConfig:
    text = command.spans or spans
    try:
        numbers = tuple(int(part) for part in names(text))
    except ValueError as error:
        raise ConfigError("--spans", repr(text), "whole numbers separated by commas, as 1,2,4") from error
    return FrontEndConfig(features, command.policy, command.count, numbers, command.longest, rate_hz)


def refuse_foreign_fixes(folder: Path, session: Session) -> None:
    """Raise where the session has pose fixes of another source than a model, which --force would lose."""
    fixes = session.pose_fixes
    sources = set() if fixes is None else {"unknown source"} if fixes.source is None else set(fixes.source)
    if sources - {SOURCE}:
        found = f"contains pose fixes of {', '.join(sorted(map(str, sources - {SOURCE})))}, which --force would lose"
        raise SessionError(
            folder / "pose_fixes.parquet", found, "none, or those of a model", "use a copy of the session"
        )


def map_text(path: Path, report: Mapping[str, object]) -> str:
    """The images of a model and the quality of its alignment, as text."""
    return (
        f"{path}: {report['used']} images of the session, {report['aligned']} of them with a known position; "
        f"{report['unknown']} other images, {report['unregistered']} without pose\n"
        f"one unit of the model is {report['metres_a_unit']:.5g} m; residuals of the known positions "
        f"{report['sigma_m']:.3g} m in each coordinate, sigma of the axes {report['turn_sigma_deg']:.2g} deg"
    )


def print_scores(found: Sequence[Score], *, all_known: bool) -> None:
    """A table of our figures and those of the thesis; features that OpenCV lacks have only the latter."""
    table = Table(title=f"policy {found[0].policy}, {found[0].pairs} pairs", title_justify="left")
    table.add_column("features")
    for heading in ("true", ">= 5 true", "matches", "ms / image", "ms / pair", "thesis true", ">= 5 true", "s"):
        table.add_column(heading, justify="right")
    for one in found:
        ours = (f"{one.true_rate:.2%}", f"{one.useful_pairs:.2%}", f"{one.median_matches:g}")
        times = (f"{one.ms_picture:.1f}", f"{one.ms_pair:.1f}")
        table.add_row(one.features, *ours, *times, *_published(scores.THESIS.get(one.features)))
    for name in [name for name in kinds.KINDS if all_known and name not in {one.features for one in found}]:
        table.add_row(name, *["-"] * 5, *_published(scores.THESIS.get(name)))
    Console(width=120).print(table)
    print(
        f"true: within {scores.TOLERANCE_PX} px of the known geometry; >= 5 true: share of pairs with five true matches"
    )
    print("thesis: the same for other images, and seconds, as published in 2012")
    if len(table.rows) > len(found):
        print("-: not in the installed build of OpenCV (see scripts/reproduce_features)")
    if found[0].skipped:
        print("skipped: " + ", ".join(f"{n} {reason}" for reason, n in found[0].skipped.items()))
    if found[0].unscored_pairs or found[0].rotation_pairs:
        print(f"pairs without a reference: {found[0].unscored_pairs}; with rotation only: {found[0].rotation_pairs}")


def _published(row: Published | None) -> tuple[str, ...]:
    return ("", "", "") if row is None else (f"{row.true_rate:.2%}", f"{row.useful_pairs:.2%}", f"{row.seconds:g}")
