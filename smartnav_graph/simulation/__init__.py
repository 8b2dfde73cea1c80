"""Simulated sessions with exact truth, and faults for real ones."""
