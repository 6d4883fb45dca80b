"""Words under and in figures: how many rows, which runs, how many lists a second; names that fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.text import counted
from copem_replay.metrics.intervals import FEWEST_CLUSTERS

if TYPE_CHECKING:
    from copem_replay.results.read import Results

_LONGEST_NAME = 26
"""Letters of a configuration's name, at most (chosen)."""


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Names that are not too long: with the middle left out, where they still differ then."""
    half = _LONGEST_NAME // 2
    short = {name: name if len(name) <= _LONGEST_NAME else f"{name[:half]}…{name[-half + 1 :]}" for name in names}
    return short if len(set(short.values())) == len(short) else {name: name for name in names}


def study(results: Results, names: Sequence[str]) -> str:
    """Which results these are, wherever they lie, and how many rows each configuration has."""
    known = results.known[results.known["configuration"].isin(list(names))]
    things = known.groupby(["log", "object_id"]).ngroups
    logs = known["log"].nunique()
    where = f" in {counted(logs, 'log')}" if logs > 1 else ""
    rows = known["runs"].sum() / max(known["configuration"].nunique(), 1)
    return (
        f"{counted(results.experiment.runs, 'run')} of {counted(things, 'object')}{where}, "
        f"n = {rows:.0f} per configuration, seed {results.experiment.seed}"
    )


def list_rates(rows: pd.DataFrame, names: Sequence[str]) -> str:
    """Fused lists per second of configurations, those that are alike together; `rows` as in `summary.csv`."""
    by_rate: dict[str, list[str]] = {}
    for name, short in short_names(names).items():
        rates = rows.loc[rows["configuration"] == name, "list_rate_hz"].dropna()
        if len(rates):
            low, high = f"{rates.min():.3g}", f"{rates.max():.3g}"
            by_rate.setdefault(low if low == high else f"{low} to {high}", []).append(short)
    if not by_rate:
        return ""
    if len(by_rate) == 1:
        return f"{next(iter(by_rate))} fused lists per second"
    return "Fused lists per second: " + "; ".join(f"{rate} ({', '.join(of)})" for rate, of in by_rate.items())


def percent(share: float) -> str:
    """`85 %`, `99.8 %`: 100 and 0 only where it is all or nothing."""
    if np.isnan(share):
        return "–"
    if 0 < share < 0.0005 or 0.9995 < share < 1:
        return "< 0.1 %" if share < 0.5 else "> 99.9 %"
    return f"{100 * share:.1f} %" if 0 < share < 0.01 or 0.99 < share < 1 else f"{100 * share:.0f} %"


def per_cent(share: float) -> str:
    """`84.4`, `100`, `> 99.9`: a share in per cent to three significant digits; 100 and 0 only for all and nothing."""
    if np.isnan(share):
        return "–"
    if 0 < share < 0.0005 or 0.9995 <= share < 1:
        return "< 0.1" if share < 0.5 else "> 99.9"
    return plain(100 * share)


def plain(value: float) -> str:
    """A number to three significant digits, from 1000 on a whole one; smaller than 10⁻⁹ is 0."""
    return "0" if abs(value) < 1e-9 else f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}".replace("-", "−")


def few_in_words(results: Results) -> str:
    """How many there are of what would be resampled, where these are too few: `2 objects`."""
    known = results.known
    logs, things = known["log"].nunique(), known.groupby(["log", "object_id"]).ngroups
    if max(logs, things) >= FEWEST_CLUSTERS:
        return ""
    if things == 1:
        return f"{counted(results.experiment.runs, 'run')} of one object"
    return counted(things, "object") + (f" in {counted(logs, 'log')}" if logs > 1 else "")
