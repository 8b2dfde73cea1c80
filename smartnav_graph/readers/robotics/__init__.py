"""Logs of robots, flight controllers and inertial navigation units."""
