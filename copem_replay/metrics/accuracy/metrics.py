"""The metrics made of the statistics of `metrics/accuracy/statistics.py`, where each is defined.

None: there is nothing to make it of.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.metrics.metric import Metric

if TYPE_CHECKING:
    from copem_replay.metrics.accuracy.statistics import Total


def _ratio(sums: float, count: float) -> float | None:
    """The mean; None: there is nothing to average."""
    return float(sums) / float(count) if count > 0 else None


def _root(mean: float | None, power: float = 2.0) -> float | None:
    return None if mean is None else float(mean ** (1.0 / power))


def position_rmse_m(of: Total) -> float | None:
    """Against the truth when the list is available."""
    return _root(_ratio(of.episodes["square_m2"], of.episodes["placed"]))


def position_rmse_captured_m(of: Total) -> float | None:
    """Against the truth at the instant the entry tells of."""
    return _root(_ratio(of.episodes["square_then_m2"], of.episodes["pairs"]))


def velocity_rmse_mps(of: Total) -> float | None:
    """Against the truth when the list is available."""
    return _root(_ratio(of.episodes["velocity_square_m2ps2"], of.episodes["placed"]))


def bias_east_m(of: Total) -> float | None:
    """Mean error, entry minus truth when the list is available."""
    return _ratio(of.episodes["east_m"], of.episodes["placed"])


def bias_north_m(of: Total) -> float | None:
    """Mean error, entry minus truth when the list is available."""
    return _ratio(of.episodes["north_m"], of.episodes["placed"])


def age_of_information_s(of: Total) -> float | None:
    """Mean over pairs."""
    return _ratio(of.episodes["age_of_information_s"], of.episodes["pairs"])


def nees(of: Total) -> float | None:
    """Mean over pairs; `nees_expected` is right."""
    return _ratio(of.episodes["nees"], of.episodes["pairs"])


def nees_expected(of: Total) -> float | None:
    """What it is on average where covariances are true: 2, less what the gate cuts off."""
    return _ratio(of.episodes["nees_expected"], of.episodes["pairs"])


def nees_low(of: Total) -> float | None:
    """Lower limit of the mean of as many independent samples as rows have pairs, 95 %; uncut χ²₂ₙ(0.025) / n."""
    return _limit(of, 0.025)


def nees_high(of: Total) -> float | None:
    """Upper limit."""
    return _limit(of, 0.975)


def _limit(of: Total, level: float) -> float | None:
    """Of the gamma distribution that has the mean and the variance of that mean of samples, as far as the gate lets."""
    from scipy.special import gammaincinv

    mean, square = nees_expected(of), _ratio(of.episodes["nees_square_expected"], of.episodes["pairs"])
    if mean is None or square is None:
        return None
    shape = of.matched_rows * mean**2 / (square - mean**2)
    return mean * float(gammaincinv(shape, level)) / shape


def beyond_gate_share(of: Total) -> float | None:
    """Of errors as the covariances of pairs have them, how many the gate lets not through; mean over pairs."""
    return _ratio(of.episodes["beyond_gate"], of.episodes["pairs"])


def identity_switches(of: Total) -> float | None:
    """Mean over episodes and runs that have a match with a track."""
    return _ratio(of.episodes["switches"], of.tracked_rows)


def longest_gap_s(of: Total) -> float | None:
    """Mean over episodes and runs."""
    return _ratio(of.episodes["longest_gap_s"], of.rows)


def _gospa(of: Total, sums: float) -> float | None:
    return _root(_ratio(sums, of.runs["lists_looked"]), of.settings.power)


def gospa_m(of: Total) -> float | None:
    """Mean over lists of GOSPAᵖ, to the power 1/p: the p-th powers of its three parts add up to its own."""
    parts = sum(of.episodes[f"gospa_{part}"] for part in ("localisation", "missed", "false"))
    return _gospa(of, parts)


def gospa_localisation_m(of: Total) -> float | None:
    """The part of the pairs."""
    return _gospa(of, of.episodes["gospa_localisation"])


def gospa_missed_m(of: Total) -> float | None:
    """The part of the misses."""
    return _gospa(of, of.episodes["gospa_missed"])


def gospa_false_m(of: Total) -> float | None:
    """The part of the false entries."""
    return _gospa(of, of.episodes["gospa_false"])


def ospa_m(of: Total) -> float | None:
    """Mean over lists."""
    return _ratio(of.runs["ospa_m"], of.runs["lists_looked"])


def false_positives_per_min(of: Total) -> float | None:
    """Entries, so that a ghost counts in each list it is in."""
    return _ratio(60 * of.runs["ghosts"], of.runs["time_s"])


def stale_false_positives_per_min(of: Total) -> float | None:
    """Of these the ones that were about some object at the instant they tell of."""
    return _ratio(60 * of.runs["stale_ghosts"], of.runs["time_s"])


def duplicates_per_min(of: Total) -> float | None:
    """Entries, as ghosts; of measured objects, looked at or not."""
    return _ratio(60 * of.runs["duplicates"], of.runs["time_s"])


def existence_ece(of: Total) -> float | None:
    """Expected calibration error, 0 … 1."""
    bins = of.by_existence
    return _ratio(np.abs(bins["with_object"] - bins["existence"]).sum(), bins["entries"].sum())


_TOTAL = attrgetter("accuracy")
"""The sums that all of them are made of; None where the experiment asks for no accuracy."""

ACCURACY = (
    Metric("position_rmse_m", _TOTAL, position_rmse_m, -1,
           "root mean square error of positions against the truth when the list is available", "accuracy",
           "position error, over lists that both have"),
    Metric("position_rmse_captured_m", _TOTAL, position_rmse_captured_m, -1,
           "the same at the instant the entry tells of", "accuracy"),
    Metric("bias_east_m", _TOTAL, bias_east_m, 0, "mean easting error, entry minus truth"),
    Metric("bias_north_m", _TOTAL, bias_north_m, 0, "mean northing error, entry minus truth"),
    Metric("velocity_rmse_mps", _TOTAL, velocity_rmse_mps, -1, "root mean square error of velocities", "accuracy"),
    Metric("age_of_information_s", _TOTAL, age_of_information_s, -1,
           "how old entries are: available minus captured, mean", "accuracy"),
    Metric("gospa_m", _TOTAL, gospa_m, -1,
           "GOSPA of the lists: position errors, misses and false entries in one number", "lists",
           "GOSPA, over lists that both have"),
    Metric("gospa_localisation_m", _TOTAL, gospa_localisation_m, -1, "part of GOSPA from position errors of pairs"),
    Metric("gospa_missed_m", _TOTAL, gospa_missed_m, -1, "part of GOSPA from missed objects"),
    Metric("gospa_false_m", _TOTAL, gospa_false_m, -1, "part of GOSPA from false entries"),
    Metric("ospa_m", _TOTAL, ospa_m, -1, "OSPA of the lists, mean"),
    Metric("false_positives_per_min", _TOTAL, false_positives_per_min, -1,
           "entries at no object, per minute of log", "lists", "entries at no object, per minute"),
    Metric("stale_false_positives_per_min", _TOTAL, stale_false_positives_per_min, -1,
           "false positives that were at an object at the instant they tell of, per minute", "lists"),
    Metric("duplicates_per_min", _TOTAL, duplicates_per_min, -1,
           "second entries at an object, per minute of log", "lists"),
    Metric("nees", _TOTAL, nees, 0,
           "squared error by claimed covariance: more than expected where covariances are too small", "accuracy"),
    Metric("nees_expected", _TOTAL, nees_expected, 0,
           "nees if covariances are true: 2, minus what the gate cuts off", "accuracy"),
    Metric("nees_low", _TOTAL, nees_low, 0, "lower limit of nees if covariances are true, 95 %"),
    Metric("nees_high", _TOTAL, nees_high, 0, "upper limit of nees if covariances are true, 95 %"),
    Metric("beyond_gate_share", _TOTAL, beyond_gate_share, 0,
           "share of errors, distributed as claimed, that would fall outside the gate"),
    Metric("existence_ece", _TOTAL, existence_ece, -1, "expected calibration error of the claimed existence"),
    Metric("identity_switches", _TOTAL, identity_switches, -1,
           "matches by another track than the object's last one, mean per object and run"),
    Metric("longest_gap_s", _TOTAL, longest_gap_s, -1,
           "longest time for which an object is unknown after its onset, mean", "lists"),
)  # fmt: skip
"""The metrics of accuracy, in the order of the columns."""
