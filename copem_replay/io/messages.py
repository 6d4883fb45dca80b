"""All messages of some channels at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from copem_replay.core.text import counted
from copem_replay.io.log import Log
from copem_replay.io.schemas.decoded import LAST_NS


@dataclass(frozen=True)
class Messages:
    """Payloads of channels, by their numbers: in the order read, with the times they were logged."""

    payloads: Mapping[int, list[bytes]]
    log_time_ns: Mapping[int, list[int]]
    skipped: int = 0  # messages that were logged at a time that cannot be

    def notes(self) -> tuple[str, ...]:
        """Say what was skipped."""
        return (f"{counted(self.skipped, 'message')} logged at an impossible time: skipped",) if self.skipped else ()


def gathered(log: Log, numbers: frozenset[int]) -> Messages:
    """All messages of some channels. Raises BrokenIndexError."""
    payloads: dict[int, list[bytes]] = {number: [] for number in numbers}
    times: dict[int, list[int]] = {number: [] for number in numbers}
    skipped = 0
    for number, log_time_ns, payload in log.payloads(numbers):
        if log_time_ns > LAST_NS:
            skipped += 1
            continue
        payloads[number].append(payload)
        times[number].append(log_time_ns)
    return Messages(payloads, times, skipped)
