"""smartnav_graph: smoothed trajectories with covariance from recorded phone or MEMS sessions.

    import smartnav_graph as sn

    solution = sn.smooth(sn.load("kitti"))       # a session folder, or a log: sn.load("gtsam-kitti")
    solution.to_pandas()[["e_m", "n_m", "heading_deg", "sigma_heading_deg"]]

    run = sn.run(sn.load("kitti"), withhold=("gnss:every=10",))
    run.summary["withheld"]
    sn.write_run(run, "kitti-run")               # trajectory.csv, report.html, run.rrd ...

Conventions
-----------
**Frames.** *nav* is the local tangent plane, x east, y north, z up (ENU), at the session's origin (WGS84 latitude and
longitude in degrees, ellipsoidal height in metres); a session without origin is metric and local. *body* is the IMU's
own axes, never rotated: a phone has x right, y top, z out of the screen. The session says which body axes point forward
and up (``device.forward``, ``device.up``; a phone lying flat ``+y``, ``+z``), for heading, pitch and roll.
*cam* is OpenCV's optical frame: x right, y down, z forward.

**Names.** ``a_X_b`` is X of b expressed in a, so that neighbouring indices cancel: ``nav_T_cam = nav_T_body *
body_T_cam``; ``nav_R_body`` rotates body coordinates into nav, ``body_t_antenna`` is a lever arm in body axes.

**Accelerometers** measure specific force: at rest +9.81 m/s^2 on the axis that points up. Gravity is normal gravity at
the origin, unless the session has its own value.

**Time** is ``t_ns``, int64 nanoseconds of the source's own clock, one clock a session; seconds in options, reports and
`Solution.seconds` count from time zero, the first inertial sample.

**Units** are SI and radians; a suffix marks exceptions (``_deg``, ``_ns``, ``_hpa``, ``_ut``, ``_px``). Noise densities
are in unit/sqrt(Hz), random walks in unit*sqrt(Hz) per second.

**Angles.** Heading is clockwise from north, pitch positive with the forward axis up, roll positive with the
right side down; degrees.

**Covariance** is 15 x 15 in the order rotation, position, velocity (nav axes), accelerometer bias, gyroscope bias (body
axes). The rotation error is the nav vector theta of ``R_true = Exp(theta) R``: its third component is the error about
the vertical, whatever the attitude.

**Errors** of input and solver are `SmartnavError` and read
``<where>: <what was found>; expected <rule>; <what to do>``.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Unpack

    from smartnav_graph.core.errors import SmartnavError as SmartnavError
    from smartnav_graph.core.errors import SmartnavWarning as SmartnavWarning
    from smartnav_graph.core.frames import Origin as Origin
    from smartnav_graph.core.progress import Progress
    from smartnav_graph.estimate.config import Config as Config
    from smartnav_graph.estimate.config import RunOptions
    from smartnav_graph.estimate.run import Run as Run
    from smartnav_graph.evaluation import Evaluation as Evaluation
    from smartnav_graph.evaluation import evaluate as evaluate
    from smartnav_graph.graph.solution import Solution as Solution
    from smartnav_graph.output.run_folder import read_run as read_run
    from smartnav_graph.output.run_folder import write_run as write_run
    from smartnav_graph.readers import load as load
    from smartnav_graph.readers.join import join as join
    from smartnav_graph.readers.reference import load_reference as load_reference
    from smartnav_graph.session.calibration.model import Calibration as Calibration
    from smartnav_graph.session.folder import save as save
    from smartnav_graph.session.session import Device as Device
    from smartnav_graph.session.session import Mount as Mount
    from smartnav_graph.session.session import Session as Session
    from smartnav_graph.session.streams import Barometer as Barometer
    from smartnav_graph.session.streams import ControlPoint as ControlPoint
    from smartnav_graph.session.streams import GnssFix as GnssFix
    from smartnav_graph.session.streams import Images as Images
    from smartnav_graph.session.streams import Imu as Imu
    from smartnav_graph.session.streams import Magnetometer as Magnetometer
    from smartnav_graph.session.streams import Matches as Matches
    from smartnav_graph.session.streams import PoseFix as PoseFix
    from smartnav_graph.session.streams import Ranges as Ranges
    from smartnav_graph.session.streams import Reference as Reference
    from smartnav_graph.session.streams import StaticPeriod as StaticPeriod
    from smartnav_graph.session.streams import Temperature as Temperature
    from smartnav_graph.session.streams import Tracks as Tracks
    from smartnav_graph.session.streams import Velocity as Velocity
    from smartnav_graph.session.streams import WheelSpeed as WheelSpeed
    from smartnav_graph.simulation.scenarios import simulate as simulate

# module -> its public names, imported at first use, so that the package itself loads fast
_NAMES = {
    "core.errors": ("SmartnavError", "SmartnavWarning"),
    "core.frames": ("Origin",),
    "estimate.config": ("Config",),
    "estimate.run": ("Run",),
    "evaluation": ("Evaluation", "evaluate"),
    "graph.solution": ("Solution",),
    "output.run_folder": ("read_run", "write_run"),
    "readers": ("load",),
    "readers.join": ("join",),
    "readers.reference": ("load_reference",),
    "session.calibration.model": ("Calibration",),
    "session.folder": ("save",),
    "session.session": ("Device", "Mount", "Session"),
    "session.streams": (
        *("Barometer", "ControlPoint", "GnssFix", "Images", "Imu", "Magnetometer", "Matches", "PoseFix", "Ranges"),
        *("Reference", "StaticPeriod", "Temperature", "Tracks", "Velocity", "WheelSpeed"),
    ),
    "simulation.scenarios": ("simulate",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    *_MODULES,
    "replay",
    "run",
    "smooth",
]

if not TYPE_CHECKING:  # a name that is not there is an error of a type checker, too

    def __getattr__(name: str) -> object:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


def smooth(
    session: Session,
    config: Config | None = None,
    *,
    progress: bool | Progress = False,
    **options: Unpack[RunOptions],
) -> Solution:
    """The smoothed solution of a recorded session: all states with covariance, from all data.

    Parameters
    ----------
    session : of `load`, `Session.from_pandas`, `Session.from_arrays` or `simulate`
    config : all options; the defaults suit phones and MEMS loggers
    progress : True shows the stage on stderr, also in a notebook; or a function of stage, done and total
    options : fields of `smartnav_graph.estimate.config.RunConfig` that override it: vehicle, sensors, withhold,
        start_s, end_s, initial, rate, passes

    Raises
    ------
    SmartnavError
        Invalid input, or a problem that cannot be solved; the message says what to do.

    Warns
    -----
    SmartnavWarning
        A verdict that is not ``good``, with its reasons; data that are not used.
    """
    return run(session, config, progress=progress, **options).solution


def replay(
    session: Session,
    config: Config | None = None,
    *,
    progress: bool | Progress = False,
    **options: Unpack[RunOptions],
) -> Solution:
    """The causal solution: every keyframe from the data available at its time. Otherwise as `smooth`."""
    causal = run(session, config, causal=True, progress=progress, **options).causal
    assert causal is not None  # of a replay
    return causal


def run(
    session: Session,
    config: Config | None = None,
    *,
    causal: bool = False,
    progress: bool | Progress = False,
    **options: Unpack[RunOptions],
) -> Run:
    """All results of a run: solution, summary, errors at withheld measurements; of a replay (`causal`) both solutions.

    Parameters, errors and warnings as `smooth`.
    """
    import dataclasses

    from smartnav_graph.core.errors import ConfigError, InputTypeError, warn
    from smartnav_graph.estimate.config import Config, RunConfig, given_options
    from smartnav_graph.estimate.replay import replay
    from smartnav_graph.estimate.run import smooth
    from smartnav_graph.output.progress import progress as shown
    from smartnav_graph.output.summary_json import run_warnings
    from smartnav_graph.session.session import Session

    if not isinstance(session, Session):
        remedy = "sn.load(PATH) reads one, sn.Session.from_pandas(imu=..., gnss=...) and from_arrays build one"
        raise InputTypeError("session", f"is {type(session).__name__}", "a Session", remedy)
    if config is not None and not isinstance(config, Config):
        remedy = "smartnav_graph.estimate.config.load(FILE) reads a config.toml"
        raise InputTypeError("config", f"is {type(config).__name__}", "a Config", remedy)
    known = [field.name for field in dataclasses.fields(RunConfig)]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ConfigError("smooth", f"unknown option {', '.join(unknown)}", f"some of {', '.join(known)}")
    config = config or Config()
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, **given_options(options)))
    estimate = replay if causal else smooth
    if callable(progress):
        found = estimate(session, config, progress=progress)
    else:
        with shown(not progress, notebook=progress) as show:
            found = estimate(session, config, progress=show)
    for text in run_warnings(found.summary):
        warn(text)
    return found
