"""States of the session: clock offsets and the like, over a replay and as they were found in the end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from smartnav_graph.estimate.result.diagnostics import Updates
from smartnav_graph.output.report.constants import constants
from smartnav_graph.output.rerun_log import colours
from smartnav_graph.output.rerun_log.recorder import Recorder
from smartnav_graph.output.rerun_log.signals import log_bands

CLOCK = "_time_offset_s"


def log_states(
    recorder: Recorder, states: Mapping[str, Any], updates: Updates | None, start_ns: int, end_ns: int
) -> None:
    """Clock offsets with their bands at /clock/<sensor>, and a table of all states at /states.

    In a replay a clock offset is drawn as each update has it, and its final value at /clock/<sensor>/found.
    """
    import rerun as rr

    for name in clocks(states):
        value, sigma = float(states[name]["value"]), float(states[name]["sigma"] or 0.0)
        path = f"/clock/{name.removesuffix(CLOCK)}"
        followed = None if updates is None else updates.states.get(name)
        if updates is not None and followed is not None:
            known = np.isfinite(followed[:, 0])
            t_ns, followed = updates.t_ns[known], np.nan_to_num(followed[known])
            log_bands(recorder, path, t_ns, followed[:, :1], followed[:, 1:], ["offset"], "s")
            settled = followed[len(followed) // 10 :]  # the prior at the start would dwarf what is found
            low, high = (settled[:, 0] + times * settled[:, 1] for times in (-3.0, 3.0))
            recorder.widen(path, low, high)
            path += "/found"
        times, constant = np.array([start_ns, end_ns], dtype=np.int64), np.full((2, 1), value)
        log_bands(recorder, path, times, constant, np.full((2, 1), sigma), ["found"], "s", colors=[colours.WITHHELD])
    if states:
        recorder.static("/states", rr.TextDocument(table(states), media_type="text/markdown"))


def clocks(states: Mapping[str, Any]) -> list[str]:
    """Names of the clock offsets among the states of a summary."""
    return [name for name in states if name.endswith(CLOCK) and isinstance(states[name]["value"], float | int)]


def table(states: Mapping[str, Any]) -> str:
    """The states of a summary as Markdown tables, in the words and units of the report."""
    tables = [found.markdown() for _, found in constants({"states": states})]
    return "\n\n".join(["# States of the session", *tables]) + "\n"
