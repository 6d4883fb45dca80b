"""Tables as plain text: nothing wrapped, nothing cut off, for terminals and pipes alike."""

from __future__ import annotations

import pandas as pd


def summary_text(summary: pd.DataFrame) -> str:
    """The summary for a terminal: the columns of `summary.csv`, an interval in one cell, what is common below."""
    shown = summary.drop(columns=["interval", "interval_over", "ttd_rmst_horizon_s"])
    low, high = shown.pop("detected_share_low"), shown.pop("detected_share_high")
    interval = [f"[{_cell(a)}, {_cell(b)}]" if pd.notna(a) else "–" for a, b in zip(low, high, strict=True)]
    shown.insert(shown.columns.get_loc("detected_share") + 1, "95 %", interval)
    lines = [as_text(shown)]
    over = summary["interval_over"].dropna()
    if len(over):
        lines.append(f"95 %: {summary['interval'].dropna().iloc[0]} interval over {over.iloc[0]}")
    horizon = summary["ttd_rmst_horizon_s"].dropna()
    if len(horizon):
        lines.append(
            f"ttd_rmst_s: mean time to detection, never detected counting as {_cell(float(horizon.iloc[0]))} s"
        )
    return "\n".join(lines)


def as_text(table: pd.DataFrame) -> str:
    """A table with aligned columns; numbers to four significant digits, nulls as a dash."""
    cells = [[_cell(value) for value in row] for row in table.itertuples(index=False)]
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


def _cell(value: object) -> str:
    if value is None or value is pd.NA or value != value:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
