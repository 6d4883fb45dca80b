"""One number of a fitted model: what was estimated, how sure that is, and from how much; or why it cannot be told."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """`value` with its 95 % interval, from `n` observations that are worth `n_effective` independent ones.

    `why`: set where the data do not tell the number; then `value` is what is used in its place, and `low` and `high`
    are what the data leave open (NaN: anything). `chosen`: nobody asked the data for it.

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
        spread = f"95 %: {self.low:.3g} … {self.high:.3g}, n {self.n}, effective {self.n_effective:.3g}"
        return f"{self.value:.3g} ({spread})"
