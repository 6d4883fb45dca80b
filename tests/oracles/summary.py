"""Figures of `summary.csv` straight from rows of `detections.parquet`, one by one: nothing is counted together."""

from __future__ import annotations

import numpy as np
import pandas as pd

from copem_replay.metrics.survival import cumulative_incidence, quantile_time, quantile_with_never, restricted_mean

CODES = {"object_left": 2, "ego_left": 0, "log_end": 0}


def figures(rows: pd.DataFrame, horizon_s: float, prefix: str = "") -> dict[str, float | None]:
    """Of one configuration; `prefix`: `conflict_` for the second event."""
    to, known = ("to_conflict" if prefix else "to"), rows[f"{prefix}detected"].to_numpy(dtype=bool)
    time_s = rows[f"time_{to}_detection_s"].to_numpy(dtype=float)
    looked_s = (rows["ended_s"] - rows["onset_s"]).to_numpy(dtype=float)
    ending = np.where(known, 1, [CODES[reason] for reason in rows["ended_by"]])
    incidence = cumulative_incidence(np.round(np.where(known, time_s, looked_s), 9), ending)
    away_m = rows[f"distance_at_{prefix}detection_m"].to_numpy(dtype=float)
    placed = ~known | ~np.isnan(away_m)
    found = {
        f"{prefix}detected_share": known.mean(),
        f"{prefix}ttd_median_s": quantile_time(*incidence, 0.5),
        f"{prefix}ttd_p95_s": quantile_time(*incidence, 0.95),
        f"{prefix}ttd_rmst_s": restricted_mean(*incidence, horizon_s),
    }
    if not prefix:
        found |= unknown(rows, horizon_s)
    for name, q in (("dad_median_m", 0.5), ("dad_p5_m", 0.05)):
        if placed.any() and (not prefix or q == 0.5):
            found[prefix + name] = quantile_with_never(away_m[placed], known[placed], q)
    return found


def unknown(rows: pd.DataFrame, horizon_s: float) -> dict[str, float | None]:
    """How long objects are unknown, row by row, and what became of those that are never detected."""
    unknown_s, to_horizon_s, left, still_there = 0.0, 0.0, 0, 0
    for row in rows.itertuples():
        until_s = min(row.detection_s, row.ended_s) if row.detected else row.ended_s
        unknown_s += max(until_s - row.onset_s, 0.0)
        to_horizon_s += min(max(until_s - row.onset_s, 0.0), horizon_s)
        left += not row.detected and CODES[row.ended_by] == 2
        still_there += not row.detected and CODES[row.ended_by] == 0
    sums = {"unknown_s": unknown_s, "unknown_to_horizon_s": to_horizon_s, "left_undetected_share": left,
            "open_share": still_there}  # fmt: skip
    return {name: total / len(rows) for name, total in sums.items()}
