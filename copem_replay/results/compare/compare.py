"""Compare: configurations with a baseline, on the same logs, objects and runs, within or across results folders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.results.compare.all_logs import AllLogs
from copem_replay.results.compare.bootstrap import Draws, Names, resampled_over
from copem_replay.results.compare.comparable import check_comparable
from copem_replay.results.compare.configuration_data import ConfigurationData, rows_of, side_of
from copem_replay.results.compare.equal_ghosts import ghost_totals, kept_by, notes_on_equal_ghosts, why_not
from copem_replay.results.compare.ideals import notes_on_outputs
from copem_replay.results.compare.inputs import read_folders
from copem_replay.results.compare.labels import Named, chosen, named
from copem_replay.results.compare.limits import limits
from copem_replay.results.compare.metrics import Regret, Setting, regrets
from copem_replay.results.compare.notes import (
    note_on_measuring,
    notes_on_folders,
    notes_on_instants,
    notes_on_pairs,
    notes_on_rows,
)
from copem_replay.results.compare.paired_statistics import mcnemar
from copem_replay.results.compare.pairing import Grid, grid_of, number
from copem_replay.results.compare.same_drive import check_names, notes_on_differences, renamed

if TYPE_CHECKING:
    from copem_replay.results.read import Results

ALL = "all"
"""What stands for the log in figures of all logs."""
COLUMNS = {
    "log": "object",
    "configuration": "object",
    "baseline": "object",
    "metric": "object",
    "value": "float64",
    "baseline_value": "float64",
    "difference": "float64",
    "low": "float64",
    "high": "float64",
    "interval": "object",
    "interval_over": "object",
    "n": "int64",
    "p_value": "float64",
    "only_configuration": "Int64",
    "only_baseline": "Int64",
    "existence": "float64",
    "baseline_existence": "float64",
    "ghosts_kept_per_min": "float64",
    "baseline_ghosts_kept_per_min": "float64",
}
"""Columns of a comparison, and as what pandas has them."""


@dataclass(frozen=True)
class Comparison:
    """Differences to a baseline: a row per log (`all`, and each where there are several), configuration and metric.

    Columns of `table` as in COLUMNS, missing where there is none; times are up to `horizon_s`, those at equal ghosts at
    `false_positives_per_min`. `notes`: what has to be said, a line each.

    >>> comparison = cr.compare("out/tc016d", baseline="PEM")
    >>> comparison.baseline, comparison.configurations
    ('PEM', ('GT', 'coPEM:0s', 'coPEM:0.5s', 'coPEM:1s', 'coPEM:1.5s'))
    """

    table: pd.DataFrame
    baseline: str
    configurations: tuple[str, ...]
    horizon_s: float
    false_positives_per_min: float | None
    notes: tuple[str, ...]

    @property
    def overall(self) -> pd.DataFrame:
        """The rows of all logs."""
        return self.table.drop_duplicates(["configuration", "metric"])  # they come first, and a log may be named `all`


def compare(
    folders: Sequence[Path | Results],
    *,
    configurations: Sequence[str] | None = None,
    baseline: str | None = None,
    false_positives_per_min: float | None = None,
    metrics: Sequence[str] | None = None,
) -> Comparison:
    """Compare configurations (None: all) with a baseline (None: `ideal`), pair by pair, in some metrics (None: all).

    `false_positives_per_min`: at which times to detection are compared once more; None: as many as the baseline has.
    Raises InputError, a line for every reason why something cannot be read or compared.
    """
    if false_positives_per_min is not None and not 0 <= false_positives_per_min < math.inf:
        raise InputError(
            f"--false-positives-per-min: expected a number of at least 0, found {false_positives_per_min:g}"
        )
    read = read_folders(folders)
    check_comparable(read)
    read, renames = renamed(read)
    against, *others = chosen(named(read), configurations, baseline)
    check_names(against, others, renames)
    used = list(dict.fromkeys(one.results for one in (against, *others)))
    logs, runs = [log.name for log in read[0].provenance.logs], min(folder.provenance.runs for folder in read)
    totals = ghost_totals((against, *others), logs, runs)
    asked = false_positives_per_min
    if asked is None and against in totals:
        false_positives_per_min = totals[against].per_min
    reasons, settings = {}, {}
    setting = Setting(_horizon_s(read, against, logs), float(read[0].provenance.measure["gospa"]["power"]))
    for one in others:
        both = totals.get(one), totals.get(against)
        truth = against.configuration in against.results.truth
        why = why_not(*both, false_positives_per_min, asked=asked is not None, truth=truth)
        kept = None if why is not None else kept_by(*both, false_positives_per_min)
        reasons[one.label], settings[one] = why, replace(setting, kept=kept)
    names, draws = Names(logs, [], runs), Draws(read[0].provenance.seed)
    pairs = {one: AllLogs() for one in others}
    rows: list[dict[str, object]] = []
    for k, log in enumerate(logs):
        tables = {results: results.rows_of(log) for results in used}
        grid = grid_of(k, (of["detections.parquet"] for of in tables.values()), runs, len(names.objects))
        names.objects.extend(f"{log}\n{name}" for name in grid.objects)
        second = side_of(against, tables[against.results], grid)
        for one, pair in pairs.items():
            first = side_of(one, tables[one.results], grid)
            _check_same_episodes(one, first, against, second, log, grid)
            found = list(regrets(first, second, grid, settings[one], metrics))
            pair.add(first, second, found, grid, more=len(logs) > 1)
            if len(logs) > 1:
                over = resampled_over(pair.objects[-1:])
                rows += [{"log": log, **_row(of, one, against, over, names, draws)} for of in found]
    overall = [
        {"log": ALL, **_row(of, one, against, resampled_over(pair.objects), names, draws)}
        for one, pair in pairs.items()
        for of in pair.regrets()
    ]
    table = pd.DataFrame([*overall, *rows], columns=list(COLUMNS)).astype(COLUMNS)
    return Comparison(
        table=table,
        baseline=against.label,
        configurations=tuple(one.label for one in others),
        horizon_s=setting.horizon_s,
        false_positives_per_min=false_positives_per_min,
        notes=(
            *notes_on_folders(used),
            *notes_on_differences(used, renames),
            *notes_on_pairs(against, pairs),
            *note_on_measuring(against, others),
            *notes_on_outputs(against, others),
            *notes_on_instants(against, pairs, logs),
            *notes_on_equal_ghosts(reasons),
            *notes_on_rows(table, false_positives_per_min),
        ),
    )


def _horizon_s(folders: Sequence[Results], against: Named, logs: Sequence[str]) -> float:
    """The longest episode is that of any folder."""
    horizon_s = folders[0].provenance.measure["horizon_s"]
    used_s = [one.provenance.horizon_used_s for one in folders if one.provenance.horizon_used_s is not None]
    if horizon_s is None and not used_s:
        for log in logs:
            rows = rows_of(against, against.results.rows_of(log, "detections.parquet"))["detections.parquet"]
            used_s += (number(rows["ended_s"]) - number(rows["onset_s"])).tolist()
    return float(np.nanmax(used_s) if horizon_s is None else horizon_s)


def _check_same_episodes(
    one: Named, first: ConfigurationData, against: Named, second: ConfigurationData, log: str, grid: Grid
) -> None:
    """Raise InputError where an object is not looked at from and until the same time: no pair then is one."""
    if one.results is against.results:
        return
    both = first.there & second.there
    for what in ("onset_s", "ended_s"):
        found, expected = getattr(first, what), getattr(second, what)
        other = np.flatnonzero(both & (np.abs(found - expected) > 1e-9 * SAME_INSTANT_NS))
        if len(other):
            name = grid.objects[other[0] // grid.runs]
            raise InputError(
                f"{one.results.folder}: log {log}: object {name}: expected {what} {expected[other[0]]:g} as in "
                f"{against.results.folder}, found {found[other[0]]:g}: not the same ego, recording or units"
            )


def _fixed(metric: str, *sides: Named) -> bool:
    """Whether a metric is the same in every run, with all of them."""
    if metric == "pass_share":
        return all(side.results.fixed.passes(side.configuration) for side in sides)
    return all(side.results.fixed.known(side.configuration) for side in sides)


def _row(regret: Regret, one: Named, against: Named, over: str, names: Names, draws: Draws) -> dict[str, object]:
    """Of a log, or of all. `over`: what is resampled."""
    figure = regret.figure
    value, other, difference = figure.values()
    row: dict[str, object] = {"configuration": one.label, "baseline": against.label, "metric": regret.metric}
    row |= {"value": _number(value), "baseline_value": _number(other), "n": int(figure.items["n"].sum())}
    row["difference"] = _number(difference)
    row |= limits(figure, difference, over, names, draws, fixed=_fixed(regret.metric, one, against))
    if "only" in figure.items.columns:
        only = figure.items["only"].sum(axis=0)
        row |= {"only_configuration": int(only[0]), "only_baseline": int(only[1])}
        row["p_value"] = mcnemar(int(only[0]), int(only[1])) if len(figure.items["n"]) else None
    if regret.kept is not None:
        for name, kept in zip(("", "baseline_"), regret.kept, strict=True):
            row[f"{name}existence"], row[f"{name}ghosts_kept_per_min"] = kept.existence, kept.false_positives_per_min
    return row


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
