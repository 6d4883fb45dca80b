"""A cloud of values over time as lines: its running quartiles, and no line where there are no values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from copem_replay.core.tracks import Float, Int

WINDOW_NS, STEP_NS = 1_000_000_000, 250_000_000
"""What is taken together, and how often (chosen: ten lists of 10 Hz; a change of a second is seen)."""
QUARTILES = (0.25, 0.5, 0.75)
"""Shares of the values that lie below each line."""
GAP_NS = 500_000_000
"""A line breaks where its rows are farther apart (half a window: a row has a value that near)."""


@dataclass(frozen=True)
class Running:
    """At instants (K,): the quartiles of the values around each, (K, 3), the median in the middle."""

    elapsed_ns: Int
    quartiles: Float


@dataclass(frozen=True)
class Broken:
    """Lines with their breaks, as rows (R,): `values` of those that have any, one after the other, and `counts`."""

    elapsed_ns: Int
    values: Float
    counts: Int


def running(elapsed_ns: Int, values: Float) -> Running:
    """Quartiles of the values (P,) within half of `WINDOW_NS`; at multiples of `STEP_NS`, where there are any.

    `elapsed_ns`: ascending. Between two values a quartile is interpolated linearly, as NumPy's quantiles are.
    """
    if not len(values):
        return Running(np.empty(0, dtype=np.int64), np.empty((0, len(QUARTILES))))
    steps = np.arange(-(-elapsed_ns[0] // STEP_NS), elapsed_ns[-1] // STEP_NS + 1) * STEP_NS
    steps = steps if len(steps) else elapsed_ns[:1]
    begin = np.searchsorted(elapsed_ns, steps - WINDOW_NS // 2)
    count = np.searchsorted(elapsed_ns, steps + WINDOW_NS // 2, side="right") - begin
    steps, begin, count = (of[count > 0] for of in (steps, begin, count))
    slots = np.arange(count.max(initial=0))
    there = slots < count[:, None]
    window = np.where(there, values[np.minimum(begin[:, None] + slots, len(values) - 1)], np.inf)
    window.sort(axis=1)
    row, place = np.arange(len(steps))[:, None], np.array(QUARTILES) * (count - 1)[:, None]
    lower = np.floor(place).astype(np.int64)
    low, high = window[row, lower], window[row, np.minimum(lower + 1, count[:, None] - 1)]
    return Running(steps, low + (place - lower) * (high - low))


def break_lines(elapsed_ns: Int, values: Float, *, steps: bool = False) -> Broken:
    """Lines through values (K, n), n at each instant, with an empty row `GAP_NS` after each row that has none so near.

    The viewer breaks a line at an empty row; NaN would do, too, but no two recordings with NaN compare equal. `steps`:
    a value holds until the next one, so that before a break it is repeated.
    """
    ends = np.flatnonzero(np.diff(elapsed_ns) > GAP_NS)
    empty_ns, held = elapsed_ns[ends] + GAP_NS, ends[: len(ends) if steps else 0]
    times = np.concatenate([elapsed_ns, empty_ns[: len(held)] - 1, empty_ns])
    rows = np.concatenate([np.arange(len(elapsed_ns)), held, np.full(len(ends), -1)])
    order = np.argsort(times, kind="stable")
    rows = rows[order]
    lines = values.shape[1]
    return Broken(times[order], values[rows[rows >= 0]].ravel(), np.where(rows >= 0, lines, 0))
