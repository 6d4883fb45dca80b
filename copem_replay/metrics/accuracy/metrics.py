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
    return _root(_ratio(of.looks["square_m2"], of.looks["placed"]))


def position_rmse_captured_m(of: Total) -> float | None:
    """Against the truth at the instant the entry tells of."""
    return _root(_ratio(of.looks["square_then_m2"], of.looks["pairs"]))


def velocity_rmse_mps(of: Total) -> float | None:
    """Against the truth when the list is available."""
    return _root(_ratio(of.looks["velocity_square_m2ps2"], of.looks["placed"]))


def bias_east_m(of: Total) -> float | None:
    """Mean error, entry minus truth when the list is available."""
    return _ratio(of.looks["east_m"], of.looks["placed"])


def bias_north_m(of: Total) -> float | None:
    """Mean error, entry minus truth when the list is available."""
    return _ratio(of.looks["north_m"], of.looks["placed"])


def age_s(of: Total) -> float | None:
    """Mean over pairs."""
    return _ratio(of.looks["age_s"], of.looks["pairs"])


def nees(of: Total) -> float | None:
    """Mean over pairs; `nees_expected` is right."""
    return _ratio(of.looks["nees"], of.looks["pairs"])


def nees_expected(of: Total) -> float | None:
    """What it is on average where covariances are true: 2, less what the gate cuts off."""
    return _ratio(of.looks["nees_expected"], of.looks["pairs"])


def nees_low(of: Total) -> float | None:
    """Lower limit of the mean of as many independent samples as rows have pairs, 95 %; uncut χ²₂ₙ(0.025) / n."""
    return _limit(of, 0.025)


def nees_high(of: Total) -> float | None:
    """Upper limit."""
    return _limit(of, 0.975)


def _limit(of: Total, level: float) -> float | None:
    """Of the gamma distribution that has the mean and the variance of that mean of samples, as far as the gate lets."""
    from scipy.special import gammaincinv

    mean, square = nees_expected(of), _ratio(of.looks["nees_square_expected"], of.looks["pairs"])
    if mean is None or square is None:
        return None
    shape = of.matched_rows * mean**2 / (square - mean**2)
    return mean * float(gammaincinv(shape, level)) / shape


def beyond_gate_share(of: Total) -> float | None:
    """Of errors as the covariances of pairs have them, how many the gate lets not through; mean over pairs."""
    return _ratio(of.looks["beyond_gate"], of.looks["pairs"])


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


def stale_ghosts_per_min(of: Total) -> float | None:
    """Of these the ones that were about some object at the instant they tell of."""
    return _ratio(60 * of.runs["stale_ghosts"], of.runs["time_s"])


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
        gospa_m, gospa_localisation_m, gospa_missed_m, gospa_false_m, ospa_m, ghosts_per_min,
        stale_ghosts_per_min, duplicates_per_min, nees, nees_expected, nees_low, nees_high, beyond_gate_share,
        existence_error, identity_switches, mtl_s,
    )
}  # fmt: skip
"""Columns of the summary by name."""
