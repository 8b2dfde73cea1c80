"""How well a solution agrees with a reference, and whether it knows how well: pure functions of the two."""

from smartnav_graph.evaluation.metrics import Evaluation, RelativeError, Statistics, evaluate

__all__ = ["Evaluation", "RelativeError", "Statistics", "evaluate"]
