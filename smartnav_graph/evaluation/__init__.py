"""Accuracy and consistency of a solution against a reference: pure functions of the two."""

from smartnav_graph.evaluation.metrics import Evaluation, RelativeError, Statistics, evaluate

__all__ = ["Evaluation", "RelativeError", "Statistics", "evaluate"]
