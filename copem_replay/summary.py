"""Summary: one row per configuration, over all logs, runs and measured objects.

Shares, times and distances are defined in statistics.py; times are cumulative incidences with departure competing, so
an object that left undetected counts as never detected, and only the end of the ego or of the log censors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from copem_replay.chance import Address, Dice, object_words
from copem_replay.statistics import (
    CENSORED,
    DETECTED,
    LEFT,
    bootstrap_share,
    cumulative_incidence,
    quantile_time,
    quantile_with_never,
    restricted_mean,
    wilson,
)

RESAMPLES = 2000
"""Bootstrap resamples (chosen)."""
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
) -> tuple[pd.DataFrame, list[str]]:
    """The rows of `summary.csv`, and what has to be said about them."""
    notes: list[str] = []
    over, cluster = _clusters(table)
    if over is None and len(table):
        notes.append(
            f"no interval of the detected share: fewer than {FEWEST_CLUSTERS} logs and fewer than {FEWEST_CLUSTERS} "
            "measured objects, and more runs do not tell about other traffic"
        )
    groups = table.groupby("configuration", sort=False)
    rows = []
    for name in configurations:
        part = groups.get_group(name) if name in groups.groups else table.iloc[:0]
        row: dict[str, object] = {"configuration": name, "n": len(part), "list_rate_hz": list_rate_hz[name]}
        rows.append(row | _of_one(part, over, cluster.loc[part.index], seed, horizon_s))
    return pd.DataFrame(rows), notes


def _clusters(table: pd.DataFrame) -> tuple[str | None, pd.Series]:
    """What is resampled whole (None: nothing), and the cluster of each row."""
    log, thing = table["log"].astype(str), table["log"].astype(str) + "\n" + table["object_id"].astype(str)
    if thing.nunique() == 1:
        return "runs", thing
    if log.nunique() >= FEWEST_CLUSTERS:
        return "logs", log
    return ("objects" if thing.nunique() >= FEWEST_CLUSTERS else None), thing


def _of_one(
    part: pd.DataFrame, over: str | None, cluster: pd.Series, seed: int, horizon_s: float | None
) -> dict[str, object]:
    detected = part["detected"].to_numpy(dtype=bool)
    low, high = _interval(detected, over, cluster, seed) if len(part) else (None, None)
    left = (part["ended_by"] == "object_left").to_numpy()
    ending = np.where(detected, DETECTED, np.where(left, LEFT, CENSORED))
    looked_s = (part["ended_s"] - part["onset_s"]).to_numpy(dtype=float)
    time_s = np.where(detected, part["time_to_detection_s"].to_numpy(dtype=float), looked_s)
    distance_m = part["distance_at_detection_m"].to_numpy(dtype=float)
    placed = ~detected | ~np.isnan(distance_m)  # detected during a gap of the truth: no distance to rank
    row: dict[str, object] = {
        "detected_share": detected.mean() if len(part) else None,
        "detected_share_low": low,
        "detected_share_high": high,
        "interval": {"runs": "wilson", None: None}.get(over, "bootstrap") if len(part) else None,
        "interval_over": over if len(part) else None,
    }
    if not len(part):
        return row | dict.fromkeys(
            ("ttd_median_s", "ttd_p95_s", "ttd_rmst_s", "ttd_rmst_horizon_s", "dad_median_m", "dad_p5_m")
        )
    times, incidence = cumulative_incidence(time_s, ending)
    return row | {
        "ttd_median_s": quantile_time(times, incidence, 0.5),
        "ttd_p95_s": quantile_time(times, incidence, 0.95),
        "ttd_rmst_s": restricted_mean(times, incidence, horizon_s) if horizon_s is not None else None,
        "ttd_rmst_horizon_s": horizon_s,
        "dad_median_m": quantile_with_never(distance_m[placed], detected[placed], 0.5) if placed.any() else None,
        "dad_p5_m": quantile_with_never(distance_m[placed], detected[placed], 0.05) if placed.any() else None,
    }


def _interval(
    detected: np.ndarray, over: str | None, cluster: pd.Series, seed: int
) -> tuple[float | None, float | None]:
    if over is None:
        return None, None
    if over == "runs":
        return wilson(int(detected.sum()), len(detected))
    counted = pd.Series(detected).groupby(cluster.to_numpy(), sort=True).agg(["sum", "count"])
    names = [str(name) for name in counted.index]
    # Addressed by the clusters' names: every configuration resamples the same logs or objects.
    zeros = np.zeros(len(names), dtype=np.int64)
    address = Address(("",), zeros, object_words(names), zeros)
    uniform = Dice(seed, "summary").uniform("bootstrap", address, np.arange(RESAMPLES))
    return bootstrap_share(
        counted["sum"].to_numpy(dtype=float), counted["count"].to_numpy(dtype=float), uniform=uniform
    )
