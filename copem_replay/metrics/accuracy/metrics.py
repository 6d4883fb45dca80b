"""The metrics of accuracy, from the sums of `metrics/accuracy/statistics.py`, which defines them. None: no sample."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np

from copem_replay.metrics.metric import Compared, Metric, compared_metric, divide_or_none

if TYPE_CHECKING:
    from copem_replay.metrics.accuracy.statistics import AccuracyTotal


def _mean(name: str, over: str = "placed") -> Callable[[AccuracyTotal], float | None]:
    """Of a sum over episodes, the mean over pairs: all, or those `placed` when the list is available."""
    return lambda total: divide_or_none(total.episodes[name], total.episodes[over])


def _root_mean(name: str, over: str = "placed") -> Callable[[AccuracyTotal], float | None]:
    """The square root of such a mean."""
    return lambda total: _power_mean(_mean(name, over)(total))


def _power_mean(mean: float | None, power: float = 2.0) -> float | None:
    return None if mean is None else float(mean ** (1.0 / power))


def _per_minute(name: str) -> Callable[[AccuracyTotal], float | None]:
    return lambda total: divide_or_none(60 * total.runs[name], total.runs["time_s"])


def _gospa(*parts: str) -> Callable[[AccuracyTotal], float | None]:
    """Mean over lists of parts of GOSPAᵖ, to the power 1/p: the p-th powers of its three parts add up to its own."""

    def value(total: AccuracyTotal) -> float | None:
        sums = sum(total.episodes[f"gospa_{part}"] for part in parts)
        return _power_mean(divide_or_none(sums, total.runs["lists_looked"]), total.settings.power)

    return value


def _nees_limit(level: float) -> Callable[[AccuracyTotal], float | None]:
    """A metric: the quantile at `level` of the mean NEES of n independent rows; without a gate that is χ²₂ₙ / n. It is
    that of the gamma distribution with the mean and variance of the mean NEES within the gate.
    """

    def value(total: AccuracyTotal) -> float | None:
        from scipy.special import gammaincinv

        mean, square = (_mean(name, "pairs")(total) for name in ("nees_expected", "nees_square_expected"))
        if mean is None or square is None:
            return None
        shape = total.matched_rows * mean**2 / (square - mean**2)
        return mean * float(gammaincinv(shape, level)) / shape

    return value


def beyond_gate_share(total: AccuracyTotal) -> float | None:
    """Share of errors beyond the gate, were they distributed as the covariances claim; mean over pairs."""
    return _mean("beyond_gate", "pairs")(total)


def _existence_ece(total: AccuracyTotal) -> float | None:
    """Expected calibration error, 0 … 1."""
    bins = total.by_existence
    return divide_or_none(np.abs(bins["with_object"] - bins["existence"]).sum(), bins["entries"].sum())


_TOTAL = attrgetter("accuracy")
"""The statistics of all metrics here; None where the experiment does not ask for accuracy."""
_HELD = ("accuracy.parquet", "instants.parquet")

ACCURACY = (
    Metric("position_rmse_m", _TOTAL, _root_mean("square_m2"), -1,
           "root mean square error of positions against the truth when the list is available", "accuracy",
           "position error (RMSE), m"),
    Metric("position_rmse_captured_m", _TOTAL, _root_mean("square_then_m2", "pairs"), -1,
           "the same at the instant the entry tells of", "accuracy", "position error at capture (RMSE), m"),
    Metric("bias_east_m", _TOTAL, _mean("east_m"), 0, "mean easting error, entry minus truth"),
    Metric("bias_north_m", _TOTAL, _mean("north_m"), 0, "mean northing error, entry minus truth"),
    Metric("velocity_rmse_mps", _TOTAL, _root_mean("velocity_square_m2ps2"), -1,
           "root mean square error of velocities", "accuracy",
           "velocity error (RMSE), m/s"),
    Metric("age_of_information_s", _TOTAL, _mean("age_of_information_s", "pairs"), -1,
           "how old entries are: available minus captured, mean", "accuracy", "age of information, s"),
    compared_metric("position_rmse_held_m", -1, "lists", "position error of the newest list (RMSE), m",
                    Compared("position error of the newest list at the frames of the truth, where both list the object",
                             "held errors", _HELD)),
    Metric("gospa_m", _TOTAL, _gospa("localisation", "missed", "false"), -1,
           "GOSPA of the lists: position errors, misses and false entries in one number", "lists", "GOSPA, m"),
    compared_metric("gospa_held_m", -1, "lists", "GOSPA of the newest list, m",
                    Compared("GOSPA of the newest list at the frames of the truth", "held GOSPA", _HELD)),
    Metric("gospa_localisation_m", _TOTAL, _gospa("localisation"), -1, "part of GOSPA from position errors of pairs"),
    Metric("gospa_missed_m", _TOTAL, _gospa("missed"), -1, "part of GOSPA from missed objects"),
    Metric("gospa_false_m", _TOTAL, _gospa("false"), -1, "part of GOSPA from false entries"),
    Metric("ospa_m", _TOTAL, lambda of: divide_or_none(of.runs["ospa_m"], of.runs["lists_looked"]), -1,
           "OSPA of the lists, mean"),
    Metric("false_positives_per_min", _TOTAL, _per_minute("ghosts"), -1,
           "entries about nobody, per minute of log", "lists", "false positives per minute",
           Compared("entries about nobody, per minute", "ghosts", ("lists.parquet",))),
    Metric("stale_false_positives_per_min", _TOTAL, _per_minute("stale_ghosts"), -1,
           "entries about somebody who is elsewhere now, per minute of log: no false positives", "lists",
           "stale entries per minute"),
    Metric("duplicates_per_min", _TOTAL, _per_minute("duplicates"), -1,
           "second entries at an object, per minute of log", "lists"),
    Metric("nees", _TOTAL, _mean("nees", "pairs"), 0,
           "squared error by claimed covariance: more than expected where covariances are too small", "accuracy",
           "NEES"),
    Metric("nees_expected", _TOTAL, _mean("nees_expected", "pairs"), 0,
           "nees if covariances are true: 2, minus what the gate cuts off", "accuracy", "NEES expected"),
    Metric("nees_low", _TOTAL, _nees_limit(0.025), 0, "lower limit of nees if covariances are true, 95 %"),
    Metric("nees_high", _TOTAL, _nees_limit(0.975), 0, "upper limit of nees if covariances are true, 95 %"),
    Metric("beyond_gate_share", _TOTAL, beyond_gate_share, 0,
           "share of errors, distributed as claimed, that would fall outside the gate"),
    Metric("existence_ece", _TOTAL, _existence_ece, -1, "expected calibration error of the claimed existence"),
    Metric("identity_switches", _TOTAL, lambda of: divide_or_none(of.episodes["switches"], of.tracked_rows), -1,
           "matches by another track than the object's last one, mean per object and run"),
    Metric("longest_gap_s", _TOTAL, lambda of: divide_or_none(of.episodes["longest_gap_s"], of.rows), -1,
           "longest time after the onset for which no entry is where the object is now, mean", "lists"),
)  # fmt: skip
"""The metrics, in the order of their columns."""
