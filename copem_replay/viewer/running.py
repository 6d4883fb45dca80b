"""A cloud of values over time as a line with its band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Float, Int

WINDOW_NS, STEP_NS = 1_000_000_000, 250_000_000
"""What is taken together, and how often (chosen: ten lists of 10 Hz; a change of a second is seen)."""
BAND = (0.25, 0.75)
"""Shares of the values below the band and below its upper end: half of them are in it."""


@dataclass(frozen=True)
class Running:
    """At instants (K,): the median of the values around each, and half the width of the band."""

    elapsed_ns: Int
    median: Float
    half: Float


def running(elapsed_ns: Int, values: Float) -> Running:
    """Median and band of the values (P,) within half of `WINDOW_NS`; at multiples of `STEP_NS`, where there are any.

    `elapsed_ns`: ascending. A value alone has no band. Quantiles are values, or the mean of two for the median.
    """
    if not len(values):
        nothing = np.empty(0)
        return Running(np.empty(0, dtype=np.int64), nothing, nothing)
    steps = np.arange(-(-elapsed_ns[0] // STEP_NS), elapsed_ns[-1] // STEP_NS + 1) * STEP_NS
    steps = steps if len(steps) else elapsed_ns[:1]
    begin = np.searchsorted(elapsed_ns, steps - WINDOW_NS // 2)
    count = np.searchsorted(elapsed_ns, steps + WINDOW_NS // 2, side="right") - begin
    steps, begin, count = (of[count > 0] for of in (steps, begin, count))
    slots = np.arange(count.max(initial=0))
    there = slots < count[:, None]
    window = np.where(there, values[np.minimum(begin[:, None] + slots, len(values) - 1)], np.inf)
    window.sort(axis=1)
    row = np.arange(len(steps))
    median = (window[row, (count - 1) // 2] + window[row, count // 2]) / 2
    low, high = (window[row, np.rint(share * (count - 1)).astype(np.int64)] for share in BAND)
    return Running(steps, median, (high - low) / 2)
