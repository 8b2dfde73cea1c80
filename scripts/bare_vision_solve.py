"""The baseline of solving image pairs: the same graph with one CustomFactor a pair in GTSAM's own Levenberg-Marquardt.

    python scripts/bare_vision_solve.py make FOLDER     the session: a trolley of 20 min, 50 matches a pair, 1.54 Hz
    python scripts/bare_vision_solve.py solve FOLDER    one JSON line: processor seconds of the optimiser alone

The graph is that of the last pass of a batch run (matches settled, pairs compressed); it starts from inertial data and
standstills alone, as the batch run does.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace

import gtsam

import smartnav_graph as sn
from smartnav_graph.core.progress import silent
from smartnav_graph.estimate.passes import causal_start, solve_passes
from smartnav_graph.estimate.problem import prepare
from smartnav_graph.estimate.run import initialise
from smartnav_graph.graph.states import KEYFRAME_LETTERS, key
from smartnav_graph.simulation.scenarios import SCENARIOS
from smartnav_graph.smoothers.estimate import Estimate
from smartnav_graph.smoothers.minimise import SolveConfig, minimise
from smartnav_graph.smoothers.whole_graph import WholeGraph, custom_factor, session_prior

SCENARIO, PERIOD_S, MATCHES = "trolley-20min", 0.65, 50


def make(folder: str) -> None:
    scenario = SCENARIOS[SCENARIO]
    camera = replace(scenario.camera, rate_hz=1.0 / PERIOD_S, count=(MATCHES, MATCHES), pairs=(1,))
    sn.save(replace(scenario, camera=camera)(0), folder, force=True)


def solve(folder: str) -> dict[str, float]:
    config = sn.Config()
    problem = prepare(sn.load(folder), config)
    initial = initialise(problem)
    start, pass_state = causal_start(problem, problem.windows, initial.prior, initial.pass_state, silent)
    found, _, _ = solve_passes(problem, problem.windows, initial.prior, pass_state, initial_values=start)
    graph, held = gtsam.NonlinearFactorGraph(), {}
    for _, factor in found.factors:
        graph.push_back(factor)
    pairs = 0
    for block in found.blocks:
        for row in (k for k, used in enumerate(block.used) if used):
            graph.push_back(custom_factor(block, row, held))
            pairs += 1
    values = gtsam.Values(start)
    for builder in problem.builders:
        for state in builder.camera_model.states().values() if builder.name == "image_pairs" else ():
            graph.push_back(session_prior(state))
            values.insert(state.key, state.initial)
    ours = vectorised(found, values)
    begin = time.process_time()
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values)
    end = optimiser.optimize()
    seconds = time.process_time() - begin
    assert abs(graph.error(end) - found.cost) < 0.05 * found.cost + 10.0, (graph.error(end), found.cost)
    result = {"seconds": seconds, "iterations": optimiser.iterations(), "pairs": pairs, "cost": graph.error(end)}
    return result | {"vectorised_seconds": ours, "times_faster": seconds / ours}


def vectorised(found: Estimate, start: gtsam.Values) -> float:
    """Processor seconds of our own optimiser on the same graph from the same start."""
    factors = [factor for _, factor in found.factors]
    states = [state for state in found.session.values() if not state.held]
    factors += [
        gtsam.PriorFactorVector(s.key, s.prior_mean, gtsam.noiseModel.Diagonal.Sigmas(s.prior_sigma)) for s in states
    ]
    order = gtsam.Ordering()
    for index in found.indices:
        for letter in KEYFRAME_LETTERS:
            order.push_back(key(letter, index))
    for state in states:
        order.push_back(state.key)
    begin = time.process_time()
    solve = minimise(WholeGraph(factors, found.blocks, {}), start, order, SolveConfig())
    seconds = time.process_time() - begin
    assert abs(solve.cost - found.cost) < 0.05 * found.cost + 10.0, (solve.cost, found.cost)
    return seconds


if __name__ == "__main__":
    if sys.argv[1] == "make":
        make(sys.argv[2])
    else:
        print(json.dumps(solve(sys.argv[2])))
