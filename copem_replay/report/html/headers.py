"""What columns are called on the page, and how their numbers read: three significant digits, shares in per cent."""

from __future__ import annotations

from collections.abc import Sequence

from copem_replay.report.figures.captions import per_cent, plain
from copem_replay.results.compare.tables import NOTHING

_HEADERS = {
    "n": "rows",
    "list_rate_hz": "fused lists per second",
    "detected_share": "detected, %",
    "ttd_median_s": "median time to detection, s",
    "ttd_p95_s": "95 % detected by, s",
    "ttd_rmst_s": "mean time to detection, s",
    "ttd_rmst_s_equal_ghosts": "mean time at equal false positives, s",
    "dad_median_m": "median distance at detection, m",
    "dad_p5_m": "95 % detected beyond, m",
    "conflict_detected_share": "collision foreseen, %",
    "conflict_ttd_median_s": "median time until foreseen, s",
    "conflict_ttd_p95_s": "95 % foreseen by, s",
    "conflict_ttd_rmst_s": "mean time until foreseen, s",
    "conflict_dad_median_m": "median distance when foreseen, m",
    "n_conflict": "rows in conflict",
    "pass_share": "passes, %",
    "pass_share_exact": "passes without a draw, %",
    "position_rmse_m": "position error (RMSE), m",
    "position_rmse_captured_m": "position error at capture (RMSE), m",
    "velocity_rmse_mps": "velocity error (RMSE), m/s",
    "age_of_information_s": "age of information, s",
    "nees": "NEES",
    "nees_expected": "NEES expected",
    "gospa_m": "GOSPA, m",
    "false_positives_per_min": "false positives per minute",
    "stale_false_positives_per_min": "stale ones of these per minute",
    "duplicates_per_min": "duplicates per minute",
    "longest_gap_s": "longest gap, s",
}
_UNITS = {
    "_per_min": " per minute", "_share": ", %", "_mps2": ", m/s²", "_mps": ", m/s", "_deg": ", °", "_hz": ", Hz",
    "_m": ", m", "_s": ", s",
}  # fmt: skip
"""Of names without a header of their own: what the end of a name says."""
FIRST = ("ttd_rmst_s", "ttd_median_s", "ttd_p95_s", "detected_share")
"""Columns in front of all others of their table: a narrow screen shows them first."""


def header(name: str) -> str:
    """A column with its unit: `mean time to detection, s`."""
    if name in _HEADERS:
        return _HEADERS[name]
    for end, unit in _UNITS.items():
        if name.endswith(end) and len(name) > len(end):
            return name.removesuffix(end).replace("_", " ") + unit
    return name.replace("_", " ")


def without_unit(name: str) -> str:
    """The same in a sentence."""
    return header(name).partition(", ")[0]


def is_share(name: str) -> bool:
    """Whether a column is shown in per cent."""
    return header(name).endswith(", %")


def in_order(names: Sequence[str]) -> list[str]:
    """Columns as they are shown: times first."""
    return sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))


def number(name: str, value: float) -> str:
    """A value of a column; NaN as a dash."""
    if value != value:
        return "–"
    return per_cent(value) if is_share(name) else plain(value)


def difference_header(name: str) -> str:
    """A column of differences: shares are in percentage points."""
    return header(name).removesuffix(", %") + ", percentage points" if is_share(name) else header(name)


def difference(name: str, value: float) -> str:
    """A limit of a difference, in the unit of its column."""
    return plain(value * (100 if is_share(name) else 1))


def signed_difference(name: str, value: float) -> str:
    """A difference with its sign."""
    if abs(value) < NOTHING:
        return "±0"
    return ("+" if value > 0 else "") + difference(name, value)
