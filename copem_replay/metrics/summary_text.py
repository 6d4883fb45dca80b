"""Tables as plain text: nothing wrapped, nothing cut off, for terminals and pipes alike."""

from __future__ import annotations

import pandas as pd

from copem_replay.core.text import interval_words
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.summary_metrics import METRIC, METRICS


def summary_text(summary: pd.DataFrame) -> str:
    """The summary for a terminal: what was known and when, then what braking would have made of it."""
    lines = [_part(summary, "summary", "detected_share")]
    lines += intervals_said(summary, "interval")
    horizon = summary["ttd_rmst_horizon_s"].dropna()
    if len(horizon):
        lines.append(f"ttd_rmst_s: mean time to detection, never detected counting as {cell(float(horizon.iloc[0]))} s")
    if "conflict_detected_share" in summary:
        lines += ["", _part(summary, "conflict")]
        lines.append("conflict_*: the same of the first list that implies a collision")
    if "pass_share" in summary and summary["n_conflict"].any():
        lines += ["", _part(summary, "braking", "pass_share")]
        lines += intervals_said(summary, "pass_interval")
        lines.append(
            "pass_share: of those in conflict, how many the declared driver, braking when it knew, stays clear of"
        )
    own = [name for name in summary if name not in ("configuration", *METRIC)]
    if own:
        lines += ["", as_text(summary[["configuration", *own]])]
    return "\n".join(lines)


def _part(summary: pd.DataFrame, part: str, share: str = "") -> str:
    """The columns of a part; the limits of its share beside it."""
    names = ["configuration", *(metric.name for metric in METRICS if metric.part == part and metric.name in summary)]
    if share:
        summary = summary.assign(**{"95 %": _intervals(summary, share)})
        names.insert(names.index(share) + 1, "95 %")
    return as_text(summary[names])


def _intervals(summary: pd.DataFrame, of: str) -> list[str]:
    limits = zip(summary[f"{of}_low"], summary[f"{of}_high"], strict=True)
    return [f"[{cell(low)}, {cell(high)}]" if pd.notna(low) else "–" for low, high in limits]


def intervals_said(summary: pd.DataFrame, name: str) -> list[str]:
    """Of which kind the limits are that the column `name` tells of, and which rows have none as nothing is drawn."""
    there = summary.dropna(subset=f"{name}_over").drop_duplicates([name, f"{name}_over"])
    kinds = [interval_words(*of) for of in there[[name, f"{name}_over"]].itertuples(index=False)]
    lines = [f"95 %: {'; '.join(kinds)}"] if kinds else []
    same = summary.loc[summary[name] == NOTHING_DRAWN, "configuration"]
    if len(same):
        lines.append(f"no 95 % of {', '.join(same)}: nothing drawn, every run is the same")
    return lines


def as_text(table: pd.DataFrame) -> str:
    """A table with aligned columns; numbers to four significant digits, nulls as a dash."""
    cells = [[cell(value) for value in row] for row in table.itertuples(index=False)]
    columns = list(zip(list(table.columns), *cells, strict=True))
    widths = [max(len(text) for text in column) for column in columns]
    left = [not pd.api.types.is_numeric_dtype(table[name]) for name in table.columns]
    left[0] = True
    lines = []
    for row in zip(*columns, strict=True):
        aligned = [
            text.ljust(width) if to_left else text.rjust(width)
            for text, width, to_left in zip(row, widths, left, strict=True)
        ]
        lines.append("  ".join(aligned).rstrip())
    return "\n".join(lines)


def cell(value: object) -> str:
    """A number to four significant digits, a null as a dash, anything else as it is."""
    if value is None or value is pd.NA or value != value:
        return "–"
    if not isinstance(value, float):
        return str(value)
    return "0" if abs(value) < 1e-12 else f"{value:.4g}"
