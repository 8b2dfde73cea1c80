"""States of the session: clock offsets over time, and a table of all."""

from __future__ import annotations

import numpy as np
import rerun as rr

from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.output.report.session_states import CLOCK, tables
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.output.rerun_log.signals import log_bands
from smartnav_graph.output.summary_json import Summary, numbers_of


def log_states(recorder: Recorder, states: Summary, updates: Updates | None, start_ns: int, end_ns: int) -> None:
    """Clock offsets with their bands at /clock/<sensor>, and a table of all states at /states.

    In a replay a clock offset is drawn as estimated at each update, and its final value at /clock/<sensor>/final.
    """
    for name in clocks(states):
        known = numbers_of(states, name)
        value, sigma = known["value"], known.get("sigma", 0.0)
        path = f"/clock/{name.removesuffix(CLOCK)}"
        followed = None if updates is None else updates.states.get(name)
        if updates is not None and followed is not None:
            there = np.isfinite(followed[:, 0])
            t_ns, followed = updates.t_ns[there], np.nan_to_num(followed[there])
            log_bands(recorder, path, t_ns, followed[:, :1], followed[:, 1:], ["offset"], "s")
            settled = followed[len(followed) // 10 :]  # without the large prior sigma of the start
            low, high = (settled[:, 0] + times * settled[:, 1] for times in (-3.0, 3.0))
            recorder.widen(path, low, high)
            path += "/final"
        times, constant = np.array([start_ns, end_ns], dtype=np.int64), np.full((2, 1), value)
        log_bands(recorder, path, times, constant, np.full((2, 1), sigma), ["final"], "s", colors=[colours.WITHHELD])
    if states:
        recorder.static("/states", rr.TextDocument(states_markdown(states), media_type="text/markdown"))


def clocks(states: Summary) -> list[str]:
    """Names of the clock offsets among the states of a summary."""
    return [name for name in states if name.endswith(CLOCK) and "value" in numbers_of(states, name)]


def states_markdown(states: Summary) -> str:
    """The states of a summary as Markdown tables, as in the report."""
    parts = [found.markdown() for _, found in tables({"states": states})]
    return "\n\n".join(["# States of the session", *parts]) + "\n"
