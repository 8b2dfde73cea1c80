"""Text from a log cannot steer a terminal."""

import pytest

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.text import inert


@pytest.mark.parametrize("mark", ["\x1b", "\x9b", "\r", "\x07", "\u202e", "\x7f", "\udcff"])
def test_marks_that_steer_a_terminal_are_written_out(mark):
    assert mark not in inert(f"a{mark}b") and mark not in str(SessionError(f"a{mark}.csv", "is missing"))


def test_other_text_stays():
    assert inert("Weg über 5 °C\n\tжук") == "Weg über 5 °C\n\tжук"
