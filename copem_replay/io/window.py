"""A window of log time: the part of a recording that is read, with a margin for poses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from copem_replay.io.channel import Channel
from copem_replay.io.schemas.poses import is_pose, is_static

Span = tuple[int, int]
"""First and last log time in ns, both included."""
WindowSeconds = tuple[float | None, float | None] | None
"""From, to, in seconds since the first message of the truth was logged; None: from the beginning, to the end."""
ALWAYS: Span = (0, 2**64 - 1)
POSE_MARGIN_NS = 2_000_000_000
"""Margin to both sides of the window in which poses are read: they are interpolated, and may be logged later than they
are stamped. Longer where a longer gap is interpolated over."""


@dataclass(frozen=True)
class Window:
    """Messages logged from one instant to another, both included."""

    from_ns: int = ALWAYS[0]
    to_ns: int = ALWAYS[1]
    margin_ns: int = POSE_MARGIN_NS

    def span(self, channel: Channel) -> Span:
        """The log time that is read of a channel: with a margin of poses, without limits of static transforms."""
        if not is_pose(channel):
            return self.from_ns, self.to_ns
        if is_static(channel):
            return ALWAYS
        return self.from_ns - self.margin_ns, self.to_ns + self.margin_ns


def is_kept(spans: Mapping[int, Span], number: int, log_time_ns: int) -> bool:
    """Whether a message of channel `number` is read; none of a channel that is not in `spans`."""
    first, last = spans.get(number, (1, 0))
    return first <= log_time_ns <= last


def has_overlap(spans: Iterable[Span], start_ns: int, end_ns: int) -> bool:
    """Whether any of `spans` has an instant from `start_ns` to `end_ns`, both included."""
    return any(first <= end_ns and start_ns <= last for first, last in spans)


def describe_window(from_s: float | None, to_s: float | None) -> str:
    """`10 – 20 s`, `from 10 s on`, `up to 20 s`."""
    if from_s is not None and to_s is not None:
        return f"{from_s:.10g} – {to_s:.10g} s"
    return f"from {from_s:.10g} s on" if from_s is not None else f"up to {to_s:.10g} s"
