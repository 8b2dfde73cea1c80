"""A made-up session with its solution, written as a recording, and recordings read back."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from smartnav_graph.core.frames import LocalFrame, Origin
from smartnav_graph.core.timebase import NS
from smartnav_graph.estimate.result.diagnostics import Diagnostics, FactorGraphLayout, Updates
from smartnav_graph.graph.solution import Residuals, Solution
from smartnav_graph.output.rerun_log import write_recording
from smartnav_graph.session.session import Device, Session
from smartnav_graph.session.streams import ControlPoint, GnssFix, Imu, Reference, StaticPeriod

T0 = 1_777_629_600 * NS  # 2026-05-01 10:00:00 UTC


ORIGIN = Origin(48.1, 11.5, 520.0)


N = 40


REJECTED_ROWS = [7, 30]


OUTAGE = (12, 20)


def stamps(seconds):
    return T0 + np.rint(np.asarray(seconds) * NS).astype(np.int64)


def truth(t):
    return np.stack([200 * np.sin(0.1 * t), 120 * np.sin(0.2 * t), 5 + np.sin(0.3 * t)], axis=-1)


def make_session(**changes):
    rng = np.random.default_rng(1)
    t = np.concatenate([np.arange(0, 25, 0.02), np.arange(26.5, N, 0.02)])
    imu = Imu(t_ns=stamps(t), gyro=rng.normal(size=(len(t), 3)), accel=rng.normal(9.81, 1.0, (len(t), 3)))
    seconds = np.array([s for s in range(N) if not OUTAGE[0] <= s < OUTAGE[1]], dtype=float)
    lla = LocalFrame(ORIGIN).lla_from_nav(truth(seconds))
    fixes = GnssFix(t_ns=stamps(seconds), lla=lla)
    control = ControlPoint(t_ns=stamps([1.0]), enu=truth(np.array([1.0])), point_id=np.array(["P1"], dtype=object))
    still = StaticPeriod(t_ns=stamps([0.0]), t_end_ns=stamps([3.0]))
    reference = Reference(t_ns=stamps(np.arange(N)), enu=truth(np.arange(N)))
    session = Session(
        device=Device(name="test car"),
        clock_epoch="unix",
        origin=ORIGIN,
        imu=imu,
        gnss=fixes,
        control=control,
        static=still,
        reference=reference,
    )
    return session.replace(**changes)


def make_solution(**changes):
    rng = np.random.default_rng(2)
    seconds = np.arange(N, dtype=float)
    root = rng.normal(size=(N, 15, 15)) * 0.1
    fixes = make_session().gnss.t_ns
    used = np.ones(len(fixes), dtype=bool)
    used[REJECTED_ROWS] = False
    residuals = Residuals(
        t_ns=np.repeat(fixes, 3),
        sensor=np.array(["gnss"] * 3 * len(fixes), dtype=object),
        axis=np.tile([0, 1, 2], len(fixes)),
        whitened=rng.normal(size=3 * len(fixes)),
        weight=np.ones(3 * len(fixes)),
        used=np.repeat(used, 3),
    )
    solution = Solution(
        t_ns=stamps(seconds),
        nav_R_body=Rotation.random(N, random_state=3).as_matrix(),
        nav_t_body=truth(seconds) + 0.1,
        nav_v_body=rng.normal(size=(N, 3)),
        accel_bias=rng.normal(size=(N, 3)) * 0.1,
        gyro_bias=rng.normal(size=(N, 3)) * 0.01,
        covariance=root @ root.transpose(0, 2, 1),
        t0_ns=T0,
        origin=ORIGIN,
        residuals=residuals,
    )
    return dataclasses.replace(solution, **changes)


EVALUATION = SimpleNamespace(
    t_ns=stamps(np.arange(N)),
    error_enu_m=np.linspace(-1, 1, 3 * N).reshape(N, 3),
    sigma_enu=np.linspace(0.5, 1, 3 * N).reshape(N, 3),
    rotation_error_deg=np.linspace(0, 2, N),
)


SUMMARY = {
    "gaps": [{"start_s": 24.98, "length_s": 1.52, "kind": "missing"}],
    "warnings": ["gnss: sigmas missing"],
    "initialisation": {"sentence": "started while moving", "heading_deg": 12.5},
}


NO_WIRING = FactorGraphLayout(*(np.zeros(0, dtype=kind) for kind in (np.str_, np.int64, np.str_, np.int64)))


def updates(**changes):
    t = make_solution().t_ns
    rows = {
        "t_ns": t,
        "solved": np.arange(N),
        "relinearised": 2 * np.arange(N),
        "doubted": (np.arange(N) % 10 == 0).astype(np.int64),
        "corrected": np.linspace(0.0, 1.0, N),
        "latency_ms": np.linspace(1.0, 2.0, N),
        "edge": np.concatenate([[0], np.cumsum(np.minimum(np.arange(N) + 1, 3))]),
    }
    windows = [np.arange(max(0, k - 2), k + 1) for k in range(N)]
    place = np.concatenate(windows)
    rows["past_ns"] = t[place]
    rows["past"] = make_solution().nav_t_body[place] + np.repeat(np.arange(N), [len(w) for w in windows])[:, None]
    followed = np.column_stack([np.linspace(0.0, 0.06, N), np.linspace(0.2, 0.002, N)])
    return Updates(**(rows | {"states": {"gnss_time_offset_s": followed}} | changes))


def replayed(**changes):
    return Diagnostics(make_solution().t_ns, NO_WIRING, updates=updates(**changes))


def write(path, **changes):
    arguments = {
        "session": make_session(),
        "solution": make_solution(),
        "evaluation": EVALUATION,
        "summary": SUMMARY,
        "report_markdown": "# Report",
    }
    write_recording(path, **(arguments | changes))
    return Recording(path)


class Recording:
    """Chunks of a file by entity."""

    def __init__(self, path):
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        self.identity = reader.recordings()[0].recording_id
        self.application = reader.recordings()[0].application_id
        self.chunks = list(reader.stream())
        self.blueprint = [chunk for entry in reader.blueprints() for chunk in reader.stream(store=entry)]

    @property
    def paths(self):
        return {str(chunk.entity_path) for chunk in self.chunks}

    def batches(self, path, component, static=False):
        for chunk in self.chunks:
            if str(chunk.entity_path) == path and chunk.is_static == static:
                batch = chunk.to_record_batch()
                if component in batch.schema.names:
                    yield batch

    def rows(self, path, component, static=False):
        return [row for batch in self.batches(path, component, static) for row in batch.column(component).to_pylist()]

    def values(self, path, component, static=False):
        return np.array(self.rows(path, component, static))

    def texts(self, path, component):
        return [row[0] for row in self.rows(path, component)]

    def index(self, path, component, timeline):
        columns = [batch.column(timeline).cast("int64").to_numpy() for batch in self.batches(path, component)]
        return np.concatenate(columns)

    def view_names(self):
        names = []
        for chunk in self.blueprint:
            batch = chunk.to_record_batch()
            if "ViewBlueprint:display_name" in batch.schema.names:
                names += [row[0] for row in batch.column("ViewBlueprint:display_name").to_pylist()]
        return names
