"""Exports of logger apps and small recorders, one module a format."""

from __future__ import annotations

from smartnav_graph.readers.apps import (
    flysight,
    gnss_logger,
    gopro,
    matlab_mobile,
    phyphox,
    sensor_logger,
    sensorlog,
    wide,
)
from smartnav_graph.readers.source import Reader

APP_READERS: tuple[Reader, ...] = (
    sensor_logger.READER,
    phyphox.READER,
    sensorlog.READER,
    *wide.READERS.values(),
    gnss_logger.READER,
    gopro.READER,
    flysight.READER,
    matlab_mobile.READER,
)
