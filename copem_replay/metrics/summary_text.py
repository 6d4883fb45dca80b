"""Tables as plain text, nothing cut off: whole in a pipe, in blocks that fit on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from copem_replay.core.text import interval_words, wrapped
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.summary_metrics import METRIC, METRICS

_GAP = "  "
SETUP = ("n", "list_rate_hz", "n_conflict")
"""Columns that say what was measured, not what came out: once below the table where all configurations are alike."""


def summary_text(summary: pd.DataFrame, width: int | None = None) -> str:
    """The summary for a terminal: what was known and when, then what braking would have made of it.

    `width`: of the terminal, in characters; None: lines of any length.
    """
    lines = _part(summary, "summary", width, "detected_share")
    lines += intervals_said(summary, "interval")
    horizon = summary["ttd_rmst_horizon_s"].dropna()
    if len(horizon):
        lines.append(f"ttd_rmst_s: mean time to detection, never detected counting as {cell(float(horizon.iloc[0]))} s")
    if "conflict_detected_share" in summary:
        lines += ["", *_part(summary, "conflict", width)]
        lines.append("conflict_*: the same for the first list that implies a collision")
    if "pass_share" in summary and summary["n_conflict"].any():
        lines += ["", *_part(summary, "braking", width, "pass_share")]
        lines += intervals_said(summary, "pass_interval")
        lines.append("pass_share: share of conflicts that the configured driver avoids when braking after detection")
    if "output_latency_s" in summary:
        lines += ["", *_part(summary[summary["output_delay_s"].notna()], "output", width)]
        lines.append("output_latency_s: available − the stamp of the state; output_delay_s: that stamp − the state")
    own = [name for name in summary if name not in ("configuration", *METRIC)]
    if own:
        lines += ["", as_text(summary[["configuration", *own]], width)]
    return "\n".join(part for line in lines for part in (wrapped(line, width) if "\n" not in line else [line]))


def _part(summary: pd.DataFrame, part: str, width: int | None, share: str = "") -> list[str]:
    """The columns of a part, the limits of its share beside it; what all have alike said below."""
    names = ["configuration", *(metric.name for metric in METRICS if metric.part == part and metric.name in summary)]
    alike = {name: cell(summary[name].iloc[0]) for name in names if name in SETUP and _is_alike(summary[name])}
    names = [name for name in names if name not in alike]
    if share:
        summary = summary.assign(**{"95 %": _intervals(summary, share)})
        names.insert(names.index(share) + 1, "95 %")
    said = [f"all configurations: {', '.join(f'{name} {value}' for name, value in alike.items())}"] if alike else []
    return [as_text(summary[names], width), *said]


def _is_alike(column: pd.Series) -> bool:
    return len(column) > 1 and len({cell(value) for value in column}) == 1


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


def as_text(table: pd.DataFrame, width: int | None = None) -> str:
    """A table with aligned columns; numbers to four significant digits, nulls as a dash.

    Where it is wider than `width`, it comes in blocks: each has the first column, and as many others as fit.
    """
    cells = [[cell(value) for value in row] for row in table.itertuples(index=False)]
    columns: list[tuple[str, ...]] = list(zip(list(map(str, table.columns)), *cells, strict=True))
    first, *others = (
        _aligned(column, to_left=k == 0 or not pd.api.types.is_numeric_dtype(table[table.columns[k]]))
        for k, column in enumerate(columns)
    )
    if not others:
        return "\n".join(first)
    return "\n\n".join("\n".join(_block(first, block, width)) for block in _blocks(first, others, width))


def _aligned(column: Sequence[str], *, to_left: bool) -> list[str]:
    widest = max(map(len, column))
    return [text.ljust(widest) if to_left else text.rjust(widest) for text in column]


def _blocks(first: Sequence[str], others: Sequence[list[str]], width: int | None) -> list[list[list[str]]]:
    """The other columns in groups that fit beside the first one; one at least."""
    blocks: list[list[list[str]]] = []
    used = 0
    for column in others:
        size = len(_GAP) + len(column[0])
        if not blocks or (width is not None and used + size > width and blocks[-1]):
            blocks.append([])
            used = len(first[0])
        blocks[-1].append(column)
        used += size
    return blocks


def _block(first: Sequence[str], others: Sequence[list[str]], width: int | None) -> list[str]:
    """The lines of a block; of one that is too wide all the same the values under their names."""
    rows = [_GAP.join(row).rstrip() for row in zip(first, *others, strict=True)]
    if width is None or max(map(len, rows)) <= width:
        return rows
    return [line for row in zip(first, *others, strict=True) for line in (row[0].rstrip(), *_under(row[1:]))]


def _under(values: Sequence[str]) -> list[str]:
    return [f"  {value.strip()}" for value in values if value.strip()]


def cell(value: object) -> str:
    """A number to four significant digits, a null as a dash, anything else as it is."""
    if value is None or value is pd.NA or value != value:
        return "–"
    if not isinstance(value, float):
        return str(value)
    return "0" if abs(value) < 1e-12 else f"{value:.4g}"
