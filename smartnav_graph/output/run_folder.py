"""The folder a run leaves behind, and reading it back.

trajectory.csv, causal.csv (replay), solution.parquet, causal.parquet (replay), residuals.parquet, withheld.parquet,
imu.parquet (as used: corrected, gaps bridged), keyframes.parquet, influence.parquet (the linear system at the solution,
see `evaluation.influence`), summary.json,
config.toml, calibration.toml, report.html and its tables (report.json, control_points.csv, rejected.csv,
settings.csv), run.rrd, latency.rrd (replay, opened with run.rrd): all of them, or nothing.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from smartnav_graph.core import figures
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import read_table, refuse_existing, refuse_foreign, replacing, write_table
from smartnav_graph.core.frames import ELLIPSOIDAL, Origin
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.estimate import config as config_model
from smartnav_graph.estimate.both_ways import BothWays
from smartnav_graph.estimate.result.summary import run_facts
from smartnav_graph.estimate.run import Run
from smartnav_graph.evaluation import Evaluation
from smartnav_graph.evaluation.influence import Influence
from smartnav_graph.graph import solution as solution_model
from smartnav_graph.graph.solution import Residuals, Solution
from smartnav_graph.output.export import write_trajectory_csv
from smartnav_graph.output.summary_json import Summary, as_float, numbers_of, plain, table_of, text_of
from smartnav_graph.session.calibration import model as calibration_model
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import ControlPoint, Imu

Columns = dict[str, NDArray[np.generic]]

SUMMARY, IMU = "summary.json", "imu.parquet"
# Parts of a summary that differ between equal runs.
UNSTEADY = ("timings_s", "real_time_factor", "peak_memory_mb", "update_ms")


@dataclass(frozen=True)
class StoredRun(Summarised):
    """A run read back: the smoothed states, the causal ones of a replay, and the table of summary.json."""

    path: Path
    solution: Solution
    summary: Summary
    causal: Solution | None = None

    def facts(self) -> dict[str, str]:
        """Folder, verdict, mode, size, uncertainty, errors at withheld rows."""
        return {"path": str(self.path), **run_facts(self.summary)}

    def plot_residuals(self) -> figures.AxesList:
        """As `Run.plot_residuals`."""
        return self.solution.residuals.plot(self.solution.t0_ns)

    @property
    def clock_epoch(self) -> str:
        """What zero of the clock is; ``unknown`` where the run does not say it."""
        return text_of(table_of(self.summary, "session"), "clock_epoch") or "unknown"

    def named(self, name: str) -> Solution:
        """The ``smoothed`` or the ``causal`` solution.

        Raises
        ------
        SessionError
            The causal one of a batch run.
        """
        if name == "smoothed":
            return self.solution
        if self.causal is None:
            raise SessionError(self.path, "has no causal solution", "a replayed run", "make one with `smartnav replay`")
        return self.causal


def check_out(path: str | Path, force: bool) -> None:
    """Check that a run may be written to `path`: it does not exist, or `force` is given and it is an older run.

    Raises
    ------
    SessionError
        The path is taken.
    """
    refuse_existing(Path(path), force)
    refuse_foreign(path, SUMMARY)


def write_run(
    run: Run,
    path: str | Path,
    *,
    force: bool = False,
    report: bool = True,
    recording: bool = True,
    evaluation: Evaluation | None = None,
    ways: BothWays | None = None,
    load_s: float = 0.0,
    progress: Progress = silent,
) -> Summary:
    """Write the folder of a run, all or nothing.

    Parameters
    ----------
    run : what `estimate.smooth` or `estimate.replay` gave
    force : replace an older run; a folder that is no run is never replaced
    report, recording : write report.html, run.rrd
    evaluation : comparison with a reference, shown in both and written to summary.json
    ways : the filter forward and backward, shown in the report
    load_s : seconds that reading the session took
    progress : called with what is being written

    Returns
    -------
    The table of summary.json.

    Raises
    ------
    SessionError
        The path is taken, or the system refuses to write; an older run is untouched.
    """
    check_out(path, force)
    begin = time.perf_counter()
    summary: dict[str, object] = dict(run.summary)
    summary["session"] = {**table_of(summary, "session"), **_session_key(run)}
    if evaluation is not None:
        summary["evaluation"] = evaluation.to_dict()
    summary["timings_s"] = {"load": round(load_s, 4), **table_of(summary, "timings_s")}
    with replacing(path, force=force) as folder:
        try:
            folder.mkdir()
            progress("writing tables", 0, 0)
            _write_tables(run, folder)
            (folder / "config.toml").write_text(config_model.dumps(run.problem.config), encoding="utf-8")
            calibration = calibration_model.calibration_toml(run.problem.calibration)
            (folder / "calibration.toml").write_text(calibration, encoding="utf-8")
            views = {"report": report, "recording": recording}
            _write_views(run, folder, _plain_table(summary), evaluation, views, progress, ways)
            written = _plain_table(_timed(summary, load_s, time.perf_counter() - begin))
            text = json.dumps(written, indent=2, ensure_ascii=False, allow_nan=False)
            (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")
        except SessionError as error:  # raised for a file inside: name the run, not the temporary folder
            raise error.located(path) from error
    return written


def _plain_table(summary: Summary) -> Summary:
    return {key: plain(value) for key, value in summary.items()}


def _session_key(run: Run) -> dict[str, object]:
    """What reading the states back needs of the session."""
    solution, session = run.solution, run.session
    return {
        "source": None if session.path is None else str(session.path),
        "clock_epoch": session.clock_epoch,
        "heights": solution.heights,
        "t0_ns": solution.t0_ns,
        "forward": solution.forward,
        "up": solution.up,
        "gravity_m_s2": solution.gravity,
        "origin": None if solution.origin is None else dataclasses.asdict(solution.origin),
    }


def _timed(summary: Summary, load_s: float, write_s: float) -> Summary:
    """With loading and writing in the timings, the total and the real-time factor."""
    timings = numbers_of(summary, "timings_s")
    total = timings.pop("total", 0.0) + load_s + write_s
    timings |= {"write": round(write_s, 4), "total": round(total, 4)}
    duration = as_float(summary.get("duration_s")) or 0.0
    return {**summary, "timings_s": timings, "real_time_factor": round(duration / max(total, 1e-9), 2)}


def _write_tables(run: Run, folder: Path) -> None:
    states = {"trajectory": ("solution", run.solution)}
    if run.causal is not None:
        states["causal"] = ("causal", run.causal)
    for text, (table, solution) in states.items():
        write_trajectory_csv(solution, folder / f"{text}.csv")
        write_table(solution.all_columns(), folder / f"{table}.parquet")
    write_table(residual_columns(run.solution.residuals), folder / "residuals.parquet")
    write_table(carrying_columns(run), folder / IMU)
    rows = withheld_columns(run)
    if rows:
        write_table(rows, folder / "withheld.parquet")
    if run.estimate is not None:
        Influence.of(run.estimate, run.problem.windows).write(folder)


def carrying_columns(run: Run) -> Columns:
    """The columns of imu.parquet: the inertial data that carry the states from epoch to epoch."""
    imu, (start, end) = run.problem.imu, run.solution.t_ns[[0, -1]]
    first, last = np.searchsorted(imu.t_ns, start, side="right") - 1, np.searchsorted(imu.t_ns, end) + 1
    return Imu(t_ns=imu.t_ns, gyro=imu.gyro, accel=imu.accel).take(slice(max(first, 0), last)).columns()


def residual_columns(residuals: Residuals) -> Columns:
    """The columns of residuals.parquet."""
    return {
        "t_ns": residuals.t_ns,
        "sensor": np.asarray(residuals.sensor, dtype=str),
        "axis": residuals.axis,
        "residual": residuals.whitened,
        "weight": residuals.weight,
        "used": residuals.used,
    }


def withheld_columns(run: Run) -> Columns:
    """The columns of withheld.parquet: predicted minus recorded, metres, and the names of control points; empty without
    withheld rows."""
    if not run.withheld:
        return {}
    names = [np.full(len(rows.t_ns), name) for name, rows in run.withheld.items()]
    error = np.concatenate([rows.error for rows in run.withheld.values()])
    t_ns = np.concatenate([rows.t_ns for rows in run.withheld.values()])
    errors = dict(zip(("de_m", "dn_m", "du_m"), error.T, strict=True))
    columns = {"t_ns": t_ns, "sensor": np.concatenate(names)} | errors
    points = run.problem.withheld.get("control")
    if isinstance(points, ControlPoint) and "control" in run.withheld:
        ids = dict(zip(points.t_ns.tolist(), map(str, points.point_id), strict=True))
        is_point = (columns["sensor"] == "control").tolist()
        columns["point_id"] = np.array(
            [ids[t] if own else "" for t, own in zip(t_ns.tolist(), is_point, strict=True)], dtype=object
        )
    return columns


def recorded(run: Run) -> Session:
    """The session of a run, its withheld rows inside the run put back in their places."""
    whole: dict[str, Stream] = {}
    start, end = run.solution.t_ns[[0, -1]]
    for name, withheld in run.problem.withheld.items():
        rows = withheld.take((withheld.t_ns >= start) & (withheld.t_ns <= end))
        used = run.session.streams().get(name)
        parts = [rows.columns()] if used is None else [used.columns(), rows.columns()]
        table = {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}
        order = np.argsort(table["t_ns"], kind="stable")
        whole[name] = type(rows).from_columns({column: values[order] for column, values in table.items()})
    return run.session.replace(**whole)


def _write_views(
    run: Run,
    folder: Path,
    summary: Summary,
    evaluation: Evaluation | None,
    views: Mapping[str, bool],
    progress: Progress,
    ways: BothWays | None,
) -> None:
    from smartnav_graph.output.report import report_markdown, write_report
    from smartnav_graph.output.report.tables import write_tables
    from smartnav_graph.output.rerun_log import write_latency, write_recording

    session, updates = recorded(run), None if run.diagnostics is None else run.diagnostics.updates
    if views["recording"]:
        progress("writing the recording", 0, 0)
        # a summary without its timings: equal runs give equal recordings
        steady = {key: value for key, value in summary.items() if key not in UNSTEADY}
        identity = write_recording(
            folder / "run.rrd",
            session=session,
            solution=run.solution,
            summary=summary,
            evaluation=evaluation,
            causal=run.causal,
            diagnostics=run.diagnostics,
            report_markdown=report_markdown(steady, evaluation),
        )
        if run.diagnostics is not None and updates is not None:
            write_latency(folder / "latency.rrd", session=run.session, diagnostics=run.diagnostics, identity=identity)
    if views["report"]:
        progress("writing the report", 0, 0)
        write_report(
            folder / "report.html",
            session=session,
            solution=run.solution,
            summary=summary,
            evaluation=evaluation,
            causal=run.causal,
            withheld=run.withheld,
            updates=updates,
            config=run.problem.config,
            ways=ways,
        )
        write_tables(folder, session=session, solution=run.solution, summary=summary, config=run.problem.config)


def read_run(path: str | Path) -> StoredRun:
    """The run that a folder holds.

    Raises
    ------
    SessionError
        It is no run folder, or a file in it cannot be read.
    """
    path = Path(path)
    if not (path / SUMMARY).is_file():
        found = f"holds no {SUMMARY}" if path.is_dir() else "is no folder"
        raise SessionError(path, found, "a run folder", "make one with `smartnav smooth`")
    try:
        summary: dict[str, object] = json.loads((path / SUMMARY).read_text(encoding="utf-8"))
        frame = _frame(table_of(summary, "session"), path / IMU)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SessionError(
            path / SUMMARY, f"cannot be read ({error!r})", "the summary of a run", "smooth the session again"
        ) from error
    causal = path / "causal.parquet"
    return StoredRun(
        path=path,
        solution=_read_states(path / "solution.parquet", frame, _read_residuals(path / "residuals.parquet")),
        summary=summary,
        causal=_read_states(causal, frame) if causal.is_file() else None,
    )


def _frame(session: Mapping[str, Any], imu: Path) -> dict[str, Any]:
    """What a solution needs of the session it was estimated from, and its inertial data, which an older run has not."""
    origin = None if session["origin"] is None else Origin(**session["origin"])
    found: dict[str, Any] = {"t0_ns": int(session["t0_ns"]), "origin": origin}
    found["clock_epoch"] = text_of(session, "clock_epoch") or "unknown"
    found["heights"] = text_of(session, "heights") or ELLIPSOIDAL
    if imu.is_file():
        found |= {"imu": Imu.from_columns(read_table(imu)), "gravity": float(session["gravity_m_s2"])}
    return found | {key: str(session[key]) for key in ("forward", "up")}


def _read_states(path: Path, frame: Mapping[str, Any], residuals: Residuals | None = None) -> Solution:
    try:
        return solution_model.from_columns(solution_model.read(path), residuals=residuals, **frame)
    except (OSError, KeyError, pa.ArrowException) as error:
        raise unreadable(path, error) from error


def _read_residuals(path: Path) -> Residuals:
    try:
        columns = solution_model.read(path)
        renamed = {("whitened" if name == "residual" else name): column for name, column in columns.items()}
        return Residuals(**renamed)
    except (OSError, TypeError, pa.ArrowException) as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: Exception) -> SessionError:
    """The error of a table of a run that cannot be read."""
    return SessionError(path, f"cannot be read ({error})", "a table of a run", "smooth the session again")


def config_differences(first: str | Path, second: str | Path) -> dict[str, tuple[object, object]]:
    """Options that differ between two runs: ``section.field`` -> both values, None where it is not set."""

    def flat(path: str | Path) -> dict[str, object]:
        table = dataclasses.asdict(config_model.load(Path(path) / "config.toml"))
        return {f"{section}.{name}": value for section, fields in table.items() for name, value in fields.items()}

    one, other = flat(first), flat(second)
    return {key: (one[key], other[key]) for key in one if one[key] != other[key]}
