"""Progress of long work: the stage, how many items are done, and of how many."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

# stage, done, total; a total of zero where it is not known.
Progress = Callable[[str, int, int], None]
Item = TypeVar("Item")


def silent(stage: str, done: int, total: int) -> None:
    """Progress that is not shown."""


def under(name: str, progress: Progress) -> Progress:
    """Progress whose stages carry a name: those of one run among several."""
    return lambda stage, done, total: progress(f"{name}, {stage}", done, total)


def watched(stage: str, items: Sequence[Item], progress: Progress) -> Iterator[Item]:
    """The items one after the other; each is reported when it is done."""
    progress(stage, 0, len(items))
    for done, item in enumerate(items, 1):
        yield item
        progress(stage, done, len(items))
