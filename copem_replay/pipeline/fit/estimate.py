"""One number of a fitted model: what was estimated, how sure that is, and from how much; or why it cannot be told."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Note = Callable[[Any, str], Any]
"""A value of a key, with words about it, as it is to be written."""


PER_ROW = "per row"
"""Metadata of a field that has a value for each row of the data: none of the numbers that are reported."""


def plain(value: Any, words: str) -> Any:
    """The value alone."""
    return value


def digits(value: float, count: int = 4) -> float:
    """To so many significant digits: no interval tells more."""
    return float(f"{value:.{count}g}")


@dataclass(frozen=True)
class Estimate:
    """`value` with its 95 % interval, from `n` observations that are worth `n_effective` independent ones.

    `n_effective` NaN: it is not known. `why`: set where the data do not tell the number; then `value` is what is used
    in its place, and `low` and `high` are what the data leave open (NaN: anything). `chosen`: set, not estimated.

    >>> Estimate(0.9, 0.85, 0.94, n=400, n_effective=120.0).words()
    '0.9 (95 %: 0.85 … 0.94, n 400, effective 120)'
    >>> Estimate(1.0, why="no miss in 161 lists").words()
    'not identifiable: no miss in 161 lists'
    """

    value: float
    low: float = float("nan")
    high: float = float("nan")
    n: int = 0
    n_effective: float = 0.0
    why: str | None = None
    chosen: bool = False

    def words(self) -> str:
        """As the files and the report say it."""
        if self.why is not None:
            return f"not identifiable: {self.why}"
        if self.chosen:
            return "chosen"
        effective = "" if math.isnan(self.n_effective) else f", effective {self.n_effective:.3g}"
        return f"{self.value:.3g} (95 %: {self.low:.3g} … {self.high:.3g}, n {self.n}{effective})"
