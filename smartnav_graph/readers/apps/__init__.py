"""Exports of logger apps and small recorders, one module a format."""
