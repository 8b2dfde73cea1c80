"""What long work tells of itself while it goes on: the stage, how much of it is done, and of how much."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

# stage, done, total; a total of zero where nobody knows.
Progress = Callable[[str, int, int], None]
Item = TypeVar("Item")


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


def under(name: str, progress: Progress) -> Progress:
    """Progress whose stages stand under a name: those of one run among several."""
    return lambda stage, done, total: progress(f"{name}, {stage}", done, total)


def watched(stage: str, items: Sequence[Item], progress: Progress) -> Iterator[Item]:
    """The items one after the other; each is told when it is done."""
    progress(stage, 0, len(items))
    for done, item in enumerate(items, 1):
        yield item
        progress(stage, done, len(items))
