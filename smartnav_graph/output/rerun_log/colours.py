"""Colours (red, green, blue) that can be distinguished on the dark and on the light background of the viewer."""

from __future__ import annotations

from smartnav_graph.factors import label_of
from smartnav_graph.factors.coplanarity import CONTRARY, IN_USE, REASONS
from smartnav_graph.output.summary_json import GAP_KINDS

AXES = [[235, 80, 80], [90, 200, 100], [90, 150, 255]]
ESTIMATE = [90, 160, 255]
CAUSAL = [225, 180, 20]
REFERENCE = [150, 150, 150]
FIX, POSE_FIX, CONTROL = (list(label_of(name).colour) for name in ("gnss", "pose_fixes", "control"))
REJECTED = [255, 60, 60]
WITHHELD = [190, 130, 255]
COVARIANCE = [255, 150, 40]
VELOCITY = [120, 230, 120]
BODY = [225, 70, 225]
QUIET = [110, 110, 110]
# Twelve hues for tracks, by their number.
TRACKS = [
    *([230, 80, 80], [240, 150, 60], [240, 210, 70], [170, 210, 80], [90, 200, 100], [70, 200, 170]),
    *([80, 200, 230], [90, 150, 255], [140, 120, 250], [200, 110, 240], [240, 110, 200], [200, 200, 200]),
]
CAMERA = [150, 150, 150]
WINDOW = [225, 70, 225]
GRID = [128, 128, 128, 70]
# States of the graph, by letter, and factors, by builder.
STATES = {"X": [90, 160, 255], "V": [120, 230, 120], "B": [255, 170, 60]}
MATCH, OUTLIER, UNUSED, NEUTRAL = [90, 220, 120], [255, 70, 70], [240, 180, 70], [150, 200, 255]


def of_builder(name: str) -> list[int]:
    """The colour of a builder's factors."""
    return list(label_of(name).colour)


GOOD, POOR, BAD, STANDSTILL = [60, 140, 80], [200, 130, 40], [210, 60, 60], [70, 110, 190]
_STATUS = {
    **dict.fromkeys(REASONS, POOR),
    **dict.fromkeys(("recorded", "fix", "moving", "accepted", REASONS[IN_USE]), GOOD),
    **dict.fromkeys((GAP_KINDS["missing"], "outage", "rejected", REASONS[CONTRARY]), BAD),
    GAP_KINDS["bridged"]: POOR,
    "standstill": STANDSTILL,
}


def of_status(value: str) -> list[int]:
    """The colour of a status on the time line."""
    return _STATUS.get(value, QUIET)


def of_axes(count: int) -> list[list[int]]:
    """Colours of the lines of one plot; a single line has that of the estimate."""
    return [ESTIMATE] if count == 1 else [AXES[k % 3] for k in range(count)]
