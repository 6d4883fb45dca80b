"""Messages of several streams in one, in order of log time."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence

from mcap.records import Message


def merged(streams: Sequence[tuple[int, Callable[[], Iterator[Message]]]]) -> Iterator[Message]:
    """Messages of several streams, each in order of log time, in one: (when it begins, how it is opened)."""
    waiting: list[tuple[int, int, Message | None]] = [(start, k, None) for k, (start, _) in enumerate(streams)]
    heapq.heapify(waiting)
    running: dict[int, Iterator[Message]] = {}
    while waiting:
        _, k, message = waiting[0]
        if message is None:
            running[k] = streams[k][1]()
        else:
            yield message
        if (following := next(running[k], None)) is None:
            heapq.heappop(waiting)
            del running[k]
        else:
            heapq.heapreplace(waiting, (following.log_time, k, following))
