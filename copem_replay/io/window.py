"""A window of log time: what of a recording is read, and for which of its channels that is more."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from copem_replay.core.errors import EmptyWindowError
from copem_replay.io.channel import Channel
from copem_replay.io.schemas.pose_schemas import is_pose

if TYPE_CHECKING:
    from copem_replay.io.log import Log

Span = tuple[int, int]
"""First and last log time in ns, both included."""
WindowSeconds = tuple[float | None, float | None] | None
"""From, to, in seconds since the first message of the truth was logged; None: from the beginning, to the end."""
ALWAYS: Span = (0, 2**64 - 1)
POSE_MARGIN_NS = 2_000_000_000
"""Poses are read so far beyond the window: they are interpolated, and may be logged later than they are stamped
(chosen: four times the longest gap that is interpolated over)."""
_NEAR_END_NS = 10_000_000_000
"""Where the last message is sought first (chosen)."""


@dataclass(frozen=True)
class Window:
    """Messages logged from one instant to another, both included."""

    from_ns: int = ALWAYS[0]
    to_ns: int = ALWAYS[1]

    def span(self, channel: Channel) -> Span:
        """What is read of a channel: poses with a margin, static transforms wholly."""
        if not is_pose(channel):
            return self.from_ns, self.to_ns
        if channel.topic.endswith("tf_static"):
            return ALWAYS
        return self.from_ns - POSE_MARGIN_NS, self.to_ns + POSE_MARGIN_NS


def kept(spans: Mapping[int, Span], number: int, log_time_ns: int) -> bool:
    """Whether a message is read."""
    first, last = spans.get(number, (1, 0))
    return first <= log_time_ns <= last


def overlap(spans: Iterable[Span], start_ns: int, end_ns: int) -> bool:
    """Whether any of `spans` has an instant between two."""
    return any(first <= end_ns and start_ns <= last for first, last in spans)


def cut_out(log: Log, topic: str, window_s: WindowSeconds) -> Log:
    """The log within a window that is given by the messages on the topic of its truth.

    Raises EmptyWindowError where none of them is in it, BrokenIndexError.
    """
    if window_s is None or window_s == (None, None) or log.window is not None:
        return log
    from_s, to_s = window_s
    numbers = frozenset(c.number for c in log.channels if c.topic == topic and c.messages)
    times_ns = (time_ns for _, time_ns, _ in log.payloads(numbers))
    first_ns = next(times_ns, None) if log.indexed else min(times_ns, default=None)
    if first_ns is None:  # all of them are lost, which is said elsewhere
        return log
    window = Window(
        ALWAYS[0] if from_s is None else first_ns + round(from_s * 1e9),
        ALWAYS[1] if to_s is None else first_ns + round(to_s * 1e9),
    )
    cut = log.within(window)
    if next(cut.payloads(numbers), None) is None:
        span_s = (_last_ns(log, numbers) - first_ns) * 1e-9
        raise EmptyWindowError(
            f"no message in the window {in_words(from_s, to_s)}; there are some from 0 to {span_s:.10g} s",
            path=log.path,
            topic=topic,
            key=("window_s",),
        )
    return cut


def _last_ns(log: Log, numbers: frozenset[int]) -> int:
    for since_ns in (log.end_ns - _NEAR_END_NS, ALWAYS[0]):
        times_ns = [time_ns for _, time_ns, _ in log.within(Window(since_ns)).payloads(numbers)]
        if times_ns:
            return max(times_ns)
    return log.start_ns


def window_notes(window_s: WindowSeconds) -> list[str]:
    """Say that only a window was read."""
    if window_s is None or window_s == (None, None):
        return []
    return [f"window {in_words(*window_s)} of the recording: seconds count from there"]


def in_words(from_s: float | None, to_s: float | None) -> str:
    """`10 – 20 s`, `from 10 s on`, `up to 20 s`."""
    if from_s is not None and to_s is not None:
        return f"{from_s:.10g} – {to_s:.10g} s"
    return f"from {from_s:.10g} s on" if from_s is not None else f"up to {to_s:.10g} s"
