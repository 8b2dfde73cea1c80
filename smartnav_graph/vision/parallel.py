"""Pictures in parallel, with the results in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


@contextmanager
def threads(count: int = 0) -> Iterator[Executor]:
    """An executor in which OpenCV uses one thread a call; at the end of the block work not begun is cancelled."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    executor = ThreadPoolExecutor(count or usable)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)
        cv2.setNumThreads(before)


def ordered(
    executor: Executor, work: Callable[[Item], Result], items: Iterable[Item], ahead: int = 8
) -> Iterator[Result]:
    """Results in the order of the items, at most `ahead` of them pending."""
    pending: deque[Future[Result]] = deque()
    for item in items:
        pending.append(executor.submit(work, item))
        if len(pending) >= ahead:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()
