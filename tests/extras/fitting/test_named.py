"""Names of estimates, and which of them another gate moves."""

from __future__ import annotations

from copem_replay.extras.fitting.estimate import Estimate
from copem_replay.extras.fitting.fit import find_moved


def _at(value: float, half: float = 0.1) -> dict[str, dict[str, Estimate]]:
    return {"rest": {"share": Estimate(value, value - half, value + half, n=100, n_effective=50.0)}}


def test_another_gate_moves_what_it_takes_out_of_its_interval() -> None:
    assert find_moved(_at(0.5), {2.25: _at(0.55), 3.75: _at(0.7)}) == [
        "share: 0.5 (95 %: 0.4 … 0.6, n 100, effective 50), but 0.7 with a gate of 3.75 m"
    ]


def test_what_differs_by_rounding_alone_is_not_moved() -> None:
    """An existence that is the same in every entry has an interval without width."""
    assert find_moved(_at(0.9, 0.0), {2.25: _at(0.9 * (1 + 1e-12), 0.0)}) == []
    assert len(find_moved(_at(0.9, 0.0), {2.25: _at(0.9 * (1 + 1e-6), 0.0)})) == 1
