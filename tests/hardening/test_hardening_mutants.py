"""Faulty inputs: read, or refused by a message with file and place; no traceback, no end of the process."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import mutants


def check(count, seed):
    faults, counts = mutants.judged(count, seed, list(mutants.BASES))
    assert faults == []
    assert [text for text in counts if text.startswith("silent: ")] == []  # read with other values, and nothing said
    assert counts["refused"] > count / 4 and counts["read"] > count / 20
    assert counts["refused, place named"] >= 0.95 * counts["refused, with a place to name"]


def test_a_few_mutants_of_every_input():
    check(2 * len(mutants.BASES), 0)


@pytest.mark.slow
def test_two_thousand_mutants():
    check(2000, 1)
