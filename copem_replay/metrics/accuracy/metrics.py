"""The figures made of the statistics of `metrics/accuracy/statistics.py`, where each is defined. None: there is nothing to make it of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from copem_replay.metrics.accuracy.statistics import Total


def _ratio(sums: float, count: float) -> float | None:
    """The mean; None: there is nothing to average."""
    return float(sums) / float(count) if count > 0 else None


def _root(mean: float | None, power: float = 2.0) -> float | None:
    return None if mean is None else float(mean ** (1.0 / power))


def position_rmse_m(of: Total) -> float | None:
    """Against the truth when the list is available."""
    return _root(_ratio(of.looks["square_m2"], of.looks["pairs"]))


def position_rmse_captured_m(of: Total) -> float | None:
    """Against the truth at capture."""
    return _root(_ratio(of.looks["square_captured_m2"], of.looks["pairs_captured"]))


def velocity_rmse_mps(of: Total) -> float | None:
    """Against the truth when the list is available."""
    return _root(_ratio(of.looks["velocity_square_m2ps2"], of.looks["pairs"]))


def bias_east_m(of: Total) -> float | None:
    """Mean error, entry minus truth."""
    return _ratio(of.looks["east_m"], of.looks["pairs"])


def bias_north_m(of: Total) -> float | None:
    """Mean error, entry minus truth."""
    return _ratio(of.looks["north_m"], of.looks["pairs"])


def age_s(of: Total) -> float | None:
    """Mean over pairs."""
    return _ratio(of.looks["age_s"], of.looks["pairs"])


def nees(of: Total) -> float | None:
    """Mean over pairs; 2 is right."""
    return _ratio(of.looks["nees"], of.looks["pairs"])


def nees_low(of: Total) -> float | None:
    """Lower limit of the mean of as many independent samples as rows have pairs, 95 %: χ²₂ₙ(0.025) / n."""
    return _chi_squared(of.matched_rows, 0.025)


def nees_high(of: Total) -> float | None:
    """Upper limit: χ²₂ₙ(0.975) / n."""
    return _chi_squared(of.matched_rows, 0.975)


def _chi_squared(n: int, level: float) -> float | None:
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(n, level)) / n if n else None


def identity_switches(of: Total) -> float | None:
    """Mean over looks and runs that have a match with a track."""
    return _ratio(of.looks["switches"], of.tracked_rows)


def mtl_s(of: Total) -> float | None:
    """Mean over looks and runs."""
    return _ratio(of.looks["mtl_s"], of.rows)


def _gospa(of: Total, sums: float) -> float | None:
    return _root(_ratio(sums, of.runs["lists_looked"]), of.settings.power)


def gospa_m(of: Total) -> float | None:
    """Mean over lists of GOSPAᵖ, to the power 1/p: the p-th powers of its three parts add up to its own."""
    parts = sum(of.looks[f"gospa_{part}"] for part in ("localisation", "missed", "false"))
    return _gospa(of, parts)


def gospa_localisation_m(of: Total) -> float | None:
    """The part of the pairs."""
    return _gospa(of, of.looks["gospa_localisation"])


def gospa_missed_m(of: Total) -> float | None:
    """The part of the misses."""
    return _gospa(of, of.looks["gospa_missed"])


def gospa_false_m(of: Total) -> float | None:
    """The part of the false entries."""
    return _gospa(of, of.looks["gospa_false"])


def ospa_m(of: Total) -> float | None:
    """Mean over lists."""
    return _ratio(of.runs["ospa_m"], of.runs["lists_looked"])


def ghosts_per_min(of: Total) -> float | None:
    """Entries, so that a ghost counts in each list it is in."""
    return _ratio(60 * of.runs["ghosts"], of.runs["time_s"])


def duplicates_per_min(of: Total) -> float | None:
    """Entries, as ghosts; of measured objects, looked at or not."""
    return _ratio(60 * of.runs["duplicates"], of.runs["time_s"])


def existence_error(of: Total) -> float | None:
    """Expected calibration error, 0 … 1."""
    bins = of.by_existence
    return _ratio(np.abs(bins["with_object"] - bins["existence"]).sum(), bins["entries"].sum())


FIGURES: dict[str, Callable[[Total], float | None]] = {
    figure.__name__: figure
    for figure in (
        position_rmse_m, position_rmse_captured_m, bias_east_m, bias_north_m, velocity_rmse_mps, age_s,
        gospa_m, gospa_localisation_m, gospa_missed_m, gospa_false_m, ospa_m, ghosts_per_min, duplicates_per_min,
        nees, nees_low, nees_high, existence_error, identity_switches, mtl_s,
    )
}  # fmt: skip
"""Columns of the summary by name."""
