"""What a figure of single runs shows: whose run, which one, in which configurations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError

if TYPE_CHECKING:
    from copem_replay.results.read import Results

_COLUMNS = 4
"""Runs side by side unless configurations are named (chosen: the paper's)."""
_NAMED = 12
"""Ids named in an error (chosen)."""


@dataclass(frozen=True)
class Choice:
    """One object in one run of one log, in some configurations."""

    log: str
    object_id: str
    run: int
    configurations: tuple[str, ...]


def choose(
    results: Results,
    *,
    configurations: Sequence[str] | None = None,
    log: str | None = None,
    object_id: str | None = None,
    run: int | None = None,
) -> Choice:
    """What was asked for; by default the first object in conflict (else the first one), the run that is in the .rrd
    (else the first), and four configurations from worst to best.

    Raises InputError for what is not among the results.
    """
    rows, where = results.table, f"{results.folder}"
    for key, column, wanted in (("log", "log", log), ("object", "object_id", object_id)):
        if wanted is not None:
            known = list(dict.fromkeys(rows[column]))
            rows = rows[rows[column] == wanted]
            if not len(rows):
                there = ", ".join(map(str, known[:_NAMED])) + (", …" if len(known) > _NAMED else "")
                raise InputError(f"{where}: {key}: expected one of {there}; found {wanted!r}")
    named = results.chosen(configurations)
    first = rows[rows["conflict"]] if "conflict" in rows and rows["conflict"].any() else rows
    log, object_id = str(first["log"].iloc[0]), str(first["object_id"].iloc[0])
    rows = rows[(rows["log"] == log) & (rows["object_id"] == object_id)]
    if run is None:
        run = results.provenance.run_shown.get(log, int(rows["run"].min()))
    if run not in rows["run"].to_numpy():
        raise InputError(f"{where}: run: expected {rows['run'].min()} to {rows['run'].max()}, found {run}")
    return Choice(log, object_id, run, named if configurations else worst_to_best(rows, named))


def worst_to_best(rows: pd.DataFrame, names: Sequence[str]) -> tuple[str, ...]:
    """Four of the configurations: by the share of the rows that pass, then by the mean time to detection.

    Never detected counts as the longest episode.
    """
    longest_s = float((rows["ended_s"] - rows["onset_s"]).max())
    late_s = rows["time_to_detection_s"].fillna(longest_s).groupby(rows["configuration"]).mean()
    passes = pd.Series(0.0, index=late_s.index)
    if "conflict" in rows and rows["conflict"].any():
        passes = rows["braking_pass"].astype(float).groupby(rows["configuration"]).mean()
    # Of equals the first counts as the better one: by custom that is the truth.
    ranked = sorted(names, key=lambda name: (passes[name], -late_s[name], -names.index(name)))
    picked = np.unique(np.rint(np.linspace(0, len(ranked) - 1, min(_COLUMNS, len(ranked)))).astype(int))
    return tuple(ranked[k] for k in picked)
