"""The metrics of accuracy, from the sums of `metrics/accuracy/statistics.py`, which defines them. None: no sample."""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.metrics.metric import Compared, Metric, compared_metric

if TYPE_CHECKING:
    from copem_replay.metrics.accuracy.statistics import AccuracyTotal


def _divide_sum(sums: float, count: float) -> float | None:
    """Sum by count; None for a count of 0."""
    return float(sums) / float(count) if count > 0 else None


def _power_mean(mean: float | None, power: float = 2.0) -> float | None:
    return None if mean is None else float(mean ** (1.0 / power))


def position_rmse_m(total: AccuracyTotal) -> float | None:
    """Root mean square position error in metres, against the truth when the list is available."""
    return _power_mean(_divide_sum(total.episodes["square_m2"], total.episodes["placed"]))


def position_rmse_captured_m(total: AccuracyTotal) -> float | None:
    """Root mean square position error in metres, against the truth at the instant the entry tells of."""
    return _power_mean(_divide_sum(total.episodes["square_then_m2"], total.episodes["pairs"]))


def velocity_rmse_mps(total: AccuracyTotal) -> float | None:
    """Root mean square velocity error in m/s, against the truth when the list is available."""
    return _power_mean(_divide_sum(total.episodes["velocity_square_m2ps2"], total.episodes["placed"]))


def bias_east_m(total: AccuracyTotal) -> float | None:
    """Mean easting error in metres, entry minus truth when the list is available."""
    return _divide_sum(total.episodes["east_m"], total.episodes["placed"])


def bias_north_m(total: AccuracyTotal) -> float | None:
    """Mean northing error in metres, entry minus truth when the list is available."""
    return _divide_sum(total.episodes["north_m"], total.episodes["placed"])


def age_of_information_s(total: AccuracyTotal) -> float | None:
    """Mean age of entries in seconds, over pairs."""
    return _divide_sum(total.episodes["age_of_information_s"], total.episodes["pairs"])


def mean_nees(total: AccuracyTotal) -> float | None:
    """Mean NEES over pairs; where covariances are true it is `nees_expected`."""
    return _divide_sum(total.episodes["nees"], total.episodes["pairs"])


def nees_expected(total: AccuracyTotal) -> float | None:
    """Mean NEES where covariances are true: 2, minus the part that the gate cuts off."""
    return _divide_sum(total.episodes["nees_expected"], total.episodes["pairs"])


def nees_low(total: AccuracyTotal) -> float | None:
    """Lower 95 % limit of the mean of n independent samples, n rows with a pair; without a gate χ²₂ₙ(0.025) / n."""
    return _nees_limit(total, 0.025)


def nees_high(total: AccuracyTotal) -> float | None:
    """Upper 95 % limit of the mean of n independent samples, n rows with a pair."""
    return _nees_limit(total, 0.975)


def _nees_limit(total: AccuracyTotal, level: float) -> float | None:
    """The quantile at `level` of the gamma distribution with the mean and variance of the mean NEES within the gate."""
    from scipy.special import gammaincinv

    mean, square = nees_expected(total), _divide_sum(total.episodes["nees_square_expected"], total.episodes["pairs"])
    if mean is None or square is None:
        return None
    shape = total.matched_rows * mean**2 / (square - mean**2)
    return mean * float(gammaincinv(shape, level)) / shape


def beyond_gate_share(total: AccuracyTotal) -> float | None:
    """Share of errors beyond the gate, were they distributed as the covariances claim; mean over pairs."""
    return _divide_sum(total.episodes["beyond_gate"], total.episodes["pairs"])


def identity_switches(total: AccuracyTotal) -> float | None:
    """Mean number of identity switches, over the episodes and runs with a pair that names a track."""
    return _divide_sum(total.episodes["switches"], total.tracked_rows)


def longest_gap_s(total: AccuracyTotal) -> float | None:
    """Mean of the longest time unknown in seconds, over episodes and runs."""
    return _divide_sum(total.episodes["longest_gap_s"], total.rows)


def _gospa_root(total: AccuracyTotal, sums: float) -> float | None:
    return _power_mean(_divide_sum(sums, total.runs["lists_looked"]), total.settings.power)


def gospa_m(total: AccuracyTotal) -> float | None:
    """Mean over lists of GOSPAᵖ, to the power 1/p: the p-th powers of its three parts add up to its own."""
    parts = sum(total.episodes[f"gospa_{part}"] for part in ("localisation", "missed", "false"))
    return _gospa_root(total, parts)


def gospa_localisation_m(total: AccuracyTotal) -> float | None:
    """The part of GOSPA from position errors of pairs, to the power 1/p, in metres."""
    return _gospa_root(total, total.episodes["gospa_localisation"])


def gospa_missed_m(total: AccuracyTotal) -> float | None:
    """The part of GOSPA from missed objects, to the power 1/p, in metres."""
    return _gospa_root(total, total.episodes["gospa_missed"])


def gospa_false_m(total: AccuracyTotal) -> float | None:
    """The part of GOSPA from false entries, to the power 1/p, in metres."""
    return _gospa_root(total, total.episodes["gospa_false"])


def ospa_m(total: AccuracyTotal) -> float | None:
    """Mean OSPA over lists, in metres."""
    return _divide_sum(total.runs["ospa_m"], total.runs["lists_looked"])


def false_positives_per_min(total: AccuracyTotal) -> float | None:
    """Ghost entries per minute; a ghost counts in each list it is in."""
    return _divide_sum(60 * total.runs["ghosts"], total.runs["time_s"])


def stale_false_positives_per_min(total: AccuracyTotal) -> float | None:
    """Ghost entries per minute that were about some object at the instant they tell of."""
    return _divide_sum(60 * total.runs["stale_ghosts"], total.runs["time_s"])


def duplicates_per_min(total: AccuracyTotal) -> float | None:
    """Duplicate entries of measured objects per minute, in lists looked at or not."""
    return _divide_sum(60 * total.runs["duplicates"], total.runs["time_s"])


def existence_ece(total: AccuracyTotal) -> float | None:
    """Expected calibration error, 0 … 1."""
    bins = total.by_existence
    return _divide_sum(np.abs(bins["with_object"] - bins["existence"]).sum(), bins["entries"].sum())


_TOTAL = attrgetter("accuracy")
"""The statistics of all metrics here; None where the experiment does not ask for accuracy."""
_HELD = ("accuracy.parquet", "instants.parquet")

ACCURACY = (
    Metric("position_rmse_m", _TOTAL, position_rmse_m, -1,
           "root mean square error of positions against the truth when the list is available", "accuracy",
           "position error (RMSE), m"),
    Metric("position_rmse_captured_m", _TOTAL, position_rmse_captured_m, -1,
           "the same at the instant the entry tells of", "accuracy", "position error at capture (RMSE), m"),
    Metric("bias_east_m", _TOTAL, bias_east_m, 0, "mean easting error, entry minus truth"),
    Metric("bias_north_m", _TOTAL, bias_north_m, 0, "mean northing error, entry minus truth"),
    Metric("velocity_rmse_mps", _TOTAL, velocity_rmse_mps, -1, "root mean square error of velocities", "accuracy",
           "velocity error (RMSE), m/s"),
    Metric("age_of_information_s", _TOTAL, age_of_information_s, -1,
           "how old entries are: available minus captured, mean", "accuracy", "age of information, s"),
    compared_metric("position_rmse_held_m", -1, "lists", "error of what is held (RMSE), m",
                    Compared("position error of what is held at the frames of the truth, where both list the object",
                             "held errors", _HELD)),
    Metric("gospa_m", _TOTAL, gospa_m, -1,
           "GOSPA of the lists: position errors, misses and false entries in one number", "lists", "GOSPA, m"),
    compared_metric("gospa_held_m", -1, "lists", "GOSPA of what is held, m",
                    Compared("GOSPA of what is held at the frames of the truth", "held GOSPA", _HELD)),
    Metric("gospa_localisation_m", _TOTAL, gospa_localisation_m, -1, "part of GOSPA from position errors of pairs"),
    Metric("gospa_missed_m", _TOTAL, gospa_missed_m, -1, "part of GOSPA from missed objects"),
    Metric("gospa_false_m", _TOTAL, gospa_false_m, -1, "part of GOSPA from false entries"),
    Metric("ospa_m", _TOTAL, ospa_m, -1, "OSPA of the lists, mean"),
    Metric("false_positives_per_min", _TOTAL, false_positives_per_min, -1,
           "entries at no object, per minute of log", "lists", "false positives per minute",
           Compared("entries at no object, per minute", "ghosts", ("lists.parquet",))),
    Metric("stale_false_positives_per_min", _TOTAL, stale_false_positives_per_min, -1,
           "false positives that were at an object at the instant they tell of, per minute", "lists",
           "stale ones of these per minute"),
    Metric("duplicates_per_min", _TOTAL, duplicates_per_min, -1,
           "second entries at an object, per minute of log", "lists"),
    Metric("nees", _TOTAL, mean_nees, 0,
           "squared error by claimed covariance: more than expected where covariances are too small", "accuracy",
           "NEES"),
    Metric("nees_expected", _TOTAL, nees_expected, 0,
           "nees if covariances are true: 2, minus what the gate cuts off", "accuracy", "NEES expected"),
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
"""The metrics, in the order of their columns."""
