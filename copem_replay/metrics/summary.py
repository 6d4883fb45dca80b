"""Summary: one row per configuration, over all logs, runs and measured objects.

Shares, times and distances are defined in metrics/survival.py; times are cumulative incidences with departure competing, so
an object that left undetected counts as never detected, and only the end of the ego or of the log censors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from copem_replay.core.tracks import Bool, Float
from copem_replay.metrics.accuracy.metrics import FIGURES, beyond_gate_share
from copem_replay.metrics.accuracy.statistics import Total
from copem_replay.metrics.braking.driver import UNRESOLVED
from copem_replay.metrics.end_reason import competes
from copem_replay.metrics.fixed import NOTHING_DRAWN, Fixed
from copem_replay.metrics.intervals import resamples, share_limits
from copem_replay.metrics.survival import (
    CENSORED,
    DETECTED,
    LEFT,
    cumulative_incidence,
    quantile_time,
    quantile_with_never,
    restricted_mean,
    wilson,
)

MUCH_BEYOND = 0.01
"""From this share of errors beyond the gate on it is said (chosen)."""
FEWEST_CLUSTERS = 5
"""Fewer logs or objects than this are not resampled (the contract's)."""


def horizon_s(table: pd.DataFrame, given_s: float | None) -> float | None:
    """The horizon of restricted means: as given, or the longest look at any measured object."""
    if given_s is not None:
        return given_s
    return float((table["ended_s"] - table["onset_s"]).max()) if len(table) else None


def summary(
    table: pd.DataFrame,
    configurations: Sequence[str],
    list_rate_hz: Mapping[str, float | None],
    *,
    seed: int,
    horizon_s: float | None,
    exact: pd.DataFrame | None = None,
    accuracy: Mapping[str, Total] | None = None,
    fixed: Fixed | None = None,
) -> tuple[pd.DataFrame, list[str]]:
    """The rows of `summary.csv`, and what has to be said about them.

    `exact`: the rows of `exact.parquet`. `accuracy`: by configuration the sums its figures are made of.
    `fixed`: what is the same in every run; None: nothing.
    """
    notes: list[str] = []
    fixed = fixed or Fixed()
    judged = table[table["conflict"]] if "conflict" in table else table.iloc[:0]
    for what, rows_of, whom in (("detected", table, "measured objects"), ("pass", judged, "objects in conflict")):
        if len(rows_of) and clusters(rows_of)[0] is None:
            notes.append(
                f"no interval of the {what} share: fewer than {FEWEST_CLUSTERS} logs and fewer than {FEWEST_CLUSTERS} "
                f"{whom}, and more runs do not tell about other traffic"
            )
    parts = _by_configuration(table)
    exactly = _by_configuration(exact) if exact is not None else {}
    rows = []
    notes += _beyond_the_gate(accuracy or {})
    for name in configurations:
        part = parts.get(name, table.iloc[:0])
        row: dict[str, object] = {"configuration": name, "n": len(part), "list_rate_hz": list_rate_hz[name]}
        row |= _of_one(part, seed, horizon_s, fixed=fixed.known(name))
        if "conflict_detected" in table:
            row |= _foreseen(part, horizon_s)
        if "conflict" in table:
            row |= _verdicts(part[part["conflict"]], seed, fixed=fixed.passes(name))
        if accuracy:
            row |= {figure: of(accuracy[name]) for figure, of in FIGURES.items()}
        if exact is not None:
            row |= _exactly(exactly.get(name, exact.iloc[:0]), horizon_s, len(part))
        rows.append(row)
    return pd.DataFrame(rows), notes


def _beyond_the_gate(accuracy: Mapping[str, Total]) -> list[str]:
    """Where covariances as large as claimed have some errors that the gate lets not through."""
    shares = {name: beyond_gate_share(of) or 0.0 for name, of in accuracy.items()}
    cut = {name: share for name, share in shares.items() if share >= MUCH_BEYOND}
    if not cut:
        return []
    gate_m = accuracy[next(iter(cut))].settings.gate_m
    said = ", ".join(f"{name} {share:.2g}" for name, share in cut.items())
    return [
        f"of errors as the claimed covariances have them this share is beyond the gate of {gate_m:g} m: {said}; it is "
        "in no RMSE and no NEES, which is nees_expected, not 2, where covariances are true (`measure.match.gate_m`)"
    ]


def _by_configuration(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(name): part for name, part in table.groupby("configuration", sort=False)}


def clusters(table: pd.DataFrame) -> tuple[str | None, pd.Series]:
    """What is resampled whole (`runs`, `logs`, `objects`; None: too few of either), and each row's cluster (n,)."""
    log = table["log"].astype(str)
    thing = log + "\n" + table["object_id"].astype(str)
    if thing.nunique() == 1:
        return "runs", table["run"].astype(str)
    if log.nunique() >= FEWEST_CLUSTERS:
        return "logs", log
    return ("objects" if thing.nunique() >= FEWEST_CLUSTERS else None), thing


_TIMES = ("ttd_p5_s", "ttd_median_s", "ttd_p95_s", "ttd_rmst_s", "ttd_rmst_horizon_s", "dad_median_m", "dad_p5_m")
_EXACT = ("detected_share", "ttd_p5_s", "ttd_median_s", "ttd_p95_s", "ttd_rmst_s", "dad_median_m", "dad_p5_m")


def _of_one(part: pd.DataFrame, seed: int, horizon_s: float | None, *, fixed: bool) -> dict[str, object]:
    detected = part["detected"].to_numpy(dtype=bool)
    kind, over, low, high = _interval(part, detected, seed, fixed=fixed)
    row: dict[str, object] = {
        "detected_share": detected.mean() if len(part) else None,
        "detected_share_low": low,
        "detected_share_high": high,
        "interval": kind,
        "interval_over": over,
    }
    return row | _times(part, detected, horizon_s)


def _times(
    part: pd.DataFrame, detected: Bool, horizon_s: float | None, weight: Float | None = None, least: float = 1e-12
) -> dict[str, float | None]:
    """Quantiles and mean of the time to detection, quantiles of the distance; rows count by `weight (n,)`."""
    if not len(part):
        return dict.fromkeys(_TIMES)
    ending = np.where(detected, DETECTED, np.where(competes(part["ended_by"]), LEFT, CENSORED))
    looked_s = (part["ended_s"] - part["onset_s"]).to_numpy(dtype=float)
    # To a nanosecond: of equal times detections come first, and 1 − 0.8 is less than 0.2 − 0.
    time_s = np.round(np.where(detected, part["time_to_detection_s"].to_numpy(dtype=float), looked_s), 9)
    times, incidence = cumulative_incidence(time_s, ending, weight, least=least)
    distance_m = part["distance_at_detection_m"].to_numpy(dtype=float)
    placed = ~detected | ~np.isnan(distance_m)  # detected during a gap of the truth: no distance to rank
    ranked = (distance_m[placed], detected[placed])
    by = None if weight is None else weight[placed]
    some = placed.any()
    return {
        "ttd_p5_s": quantile_time(times, incidence, 0.05),
        "ttd_median_s": quantile_time(times, incidence, 0.5),
        "ttd_p95_s": quantile_time(times, incidence, 0.95),
        "ttd_rmst_s": restricted_mean(times, incidence, horizon_s) if horizon_s is not None else None,
        "ttd_rmst_horizon_s": horizon_s,
        "dad_median_m": quantile_with_never(*ranked, 0.5, by) if some else None,
        "dad_p5_m": quantile_with_never(*ranked, 0.05, by) if some else None,
    }


def _foreseen(part: pd.DataFrame, horizon_s: float | None) -> dict[str, object]:
    """The same of the second event: that what is believed implies a collision."""
    known = {
        "detected": part["conflict_detected"],
        "time_to_detection_s": part["time_to_conflict_detection_s"],
        "distance_at_detection_m": part["distance_at_conflict_detection_m"],
    }
    detected = known["detected"].to_numpy(dtype=bool)
    times = _times(part.assign(**known), detected, horizon_s)
    return {
        "conflict_detected_share": detected.mean() if len(part) else None,
        **{f"conflict_{name}": times[name] for name in ("ttd_median_s", "ttd_p95_s", "ttd_rmst_s", "dad_median_m")},
    }


def _verdicts(part: pd.DataFrame, seed: int, *, fixed: bool) -> dict[str, object]:
    """The share of the rows in conflict that pass."""
    passed = part["braking_pass"].to_numpy(dtype=bool)
    kind, over, low, high = _interval(part, passed, seed, fixed=fixed)
    return {
        "n_conflict": len(part),
        "pass_share": passed.mean() if len(part) else None,
        "pass_share_low": low,
        "pass_share_high": high,
        "pass_interval": kind,
        "pass_interval_over": over,
    }


def _exactly(part: pd.DataFrame, horizon_s: float | None, n: int) -> dict[str, float | None]:
    """What the runs tend to, of `exact.parquet`: every look counts the same, its rows by their probability.

    Among `n` rows less than one is nobody: with censoring, a look that is still open with probability 10⁻⁹ would
    otherwise stand for all that were censored before.
    """
    result: dict[str, float | None] = dict.fromkeys(_EXACT)
    missed = _missed(part[part["detection_s"].isna()])
    if len(part):
        part = part[part["probability"] > 0]
        weight = part["probability"].to_numpy(dtype=float)
        detected = part["detection_s"].notna().to_numpy()
        result = {"detected_share": weight[detected].sum() / weight.sum()}
        result |= _times(part, detected, horizon_s, weight, 1 / n)
    row = {f"{name}_exact": result[name] for name in _EXACT} | missed
    if "conflict" in part:
        judged = part[part["conflict"]]
        weight = judged["probability"].to_numpy(dtype=float)
        passes = judged["pass_probability"].to_numpy(dtype=float)
        row["pass_share_exact"] = float(weight @ passes / weight.sum()) if len(judged) else None
        row["fail_share_exact"] = _failed(judged) if len(judged) else None
    return row


def _missed(never: pd.DataFrame) -> dict[str, float | None]:
    """How probably a look misses its object, from the rows of `exact.parquet` for never: one per look.

    In logarithms; the derivative by the log-odds of detection is that of the mean, so looks count by their share of it.
    """
    names = ("miss_log10", "miss_log10_half_odds")
    if not never["miss_log10"].notna().any():
        return dict.fromkeys((*names, "miss_per_logit"))
    shares: dict[str, Float] = {}
    row: dict[str, float | None] = {}
    for name in names:
        log10 = never[name].fillna(-np.inf).to_numpy(dtype=float)
        shares[name] = np.power(10.0, log10 - log10.max())
        row[name] = float(log10.max() + np.log10(shares[name].mean()))
    weight, slope = shares["miss_log10"], never["miss_per_logit"].fillna(0.0).to_numpy(dtype=float)
    return row | {"miss_per_logit": float(weight @ slope / weight.sum())}


def _failed(judged: pd.DataFrame) -> float | None:
    """The share that fails; None where what is too rare to be resolved may be most of it."""
    weight = judged["probability"].to_numpy(dtype=float)
    fails = judged["fail_probability"].to_numpy(dtype=float)
    share = float(weight @ np.nan_to_num(fails) / weight.sum())
    return None if share < UNRESOLVED and np.isnan(fails).any() else share


def _interval(
    part: pd.DataFrame, success: Bool, seed: int, *, fixed: bool
) -> tuple[str | None, str | None, float | None, float | None]:
    """Of which kind the limits of the share of successes are, what is resampled whole, and the limits.

    `fixed`: the successes are the same in every run.
    """
    over, cluster = clusters(part)
    if over is None or not len(part):
        return None, None, None, None
    if over == "runs":
        if fixed:
            return NOTHING_DRAWN, None, None, None
        return "wilson", over, *wilson(int(success.sum()), len(success))
    counted = pd.Series(success).groupby(cluster.to_numpy(), sort=True).agg(["sum", "count"])
    # Addressed by the clusters' names: every configuration resamples the same logs or objects.
    resampled = resamples([str(name) for name in counted.index], seed)
    kind, low, high = share_limits(
        counted["sum"].to_numpy(dtype=float), counted["count"].to_numpy(dtype=float), resampled
    )
    return kind, over, low, high
