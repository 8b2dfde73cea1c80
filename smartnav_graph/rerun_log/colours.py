"""Colours (red, green, blue) that stay apart on the viewer's dark ground."""

from __future__ import annotations

AXES = [[235, 80, 80], [90, 200, 100], [90, 150, 255]]
ESTIMATE = [90, 160, 255]
CAUSAL = [240, 225, 90]
REFERENCE = [200, 200, 200]
FIX = [80, 200, 120]
REJECTED = [255, 60, 60]
WITHHELD = [190, 130, 255]
POSE_FIX = [60, 210, 210]
CONTROL = [255, 130, 200]
COVARIANCE = [255, 150, 40]
VELOCITY = [120, 230, 120]
BODY = [255, 255, 255]
QUIET = [110, 110, 110]
# Twelve hues for tracks, told apart by number.
TRACKS = [
    *([230, 80, 80], [240, 150, 60], [240, 210, 70], [170, 210, 80], [90, 200, 100], [70, 200, 170]),
    *([80, 200, 230], [90, 150, 255], [140, 120, 250], [200, 110, 240], [240, 110, 200], [200, 200, 200]),
]
