"""Age of a stack's own output: of configurations that are `recorded`, and of no others."""

from __future__ import annotations

from dataclasses import dataclass, fields

from copem_replay.metrics.metric import Given, Metric


@dataclass(frozen=True)
class OutputTimes:
    """Sums (s) over the lists of a stack that become available while a log lasts, and over how many lists each is.

    `latency_s`: available − the stamp of the state, where the messages say both; `delay_s`: how long before that stamp
    the state was so, as the experiment has it; `input_age_s`: available − the newest capture of an input by then.
    """

    latency_s: float = 0.0
    with_latency: int = 0
    delay_s: float = 0.0
    with_delay: int = 0
    input_age_s: float = 0.0
    with_input: int = 0

    def __add__(self, other: OutputTimes) -> OutputTimes:
        return OutputTimes(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(OutputTimes)))


def _times(given: Given) -> OutputTimes | None:
    return given.output


def _mean(total_s: float, lists: int) -> float | None:
    return total_s / lists if lists else None


OUTPUT = (
    Metric("output_latency_s", _times, lambda of: _mean(of.latency_s, of.with_latency), -1,
           "a stack's lists: available − the stamp of the state, mean; a dash: not in the messages", "output"),
    Metric("output_delay_s", _times, lambda of: _mean(of.delay_s, of.with_delay), -1,
           "a stack's lists: that stamp − the instant of the state, by `delay_s` of the experiment", "output"),
    Metric("input_age_s", _times, lambda of: _mean(of.input_age_s, of.with_input), -1,
           "available − the newest capture of an input that had arrived: its age, not a latency", "output"),
)  # fmt: skip
"""Columns of `summary.csv` where a configuration is recorded."""
