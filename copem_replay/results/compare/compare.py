"""Compare: configurations with a baseline, on the same logs, objects and runs, within or across results folders."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.results.compare.bootstrap import Draws, Whose
from copem_replay.results.compare.comparable import check_comparable
from copem_replay.results.compare.configuration_data import ConfigurationData, side_of
from copem_replay.results.compare.equal_ghosts import notes_on_equal_ghosts, why_not
from copem_replay.results.compare.ideals import notes_on_outputs
from copem_replay.results.compare.inputs import read_folders
from copem_replay.results.compare.labels import Named, chosen, named
from copem_replay.results.compare.limits import limits
from copem_replay.results.compare.metrics import Regret, Setting, own_rate, regrets
from copem_replay.results.compare.notes import (
    note_on_measuring,
    notes_on_folders,
    notes_on_instants,
    notes_on_pairs,
    notes_on_rows,
)
from copem_replay.results.compare.paired_statistics import mcnemar
from copem_replay.results.compare.pairing import Grid, grid_of
from copem_replay.results.compare.same_drive import check_names, notes_on_differences, renamed

if TYPE_CHECKING:
    from copem_replay.results.read import Results

ALL = "all"
"""What stands for the log in figures of all logs."""
ALL_LOGS = -1
"""And for its number."""
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
    grid = grid_of(read)
    against, *others = chosen(named(read), configurations, baseline)
    check_names(against, others, renames)
    used = list(dict.fromkeys(one.results for one in (against, *others)))
    second = side_of(against, grid)
    setting = _setting(read, second, false_positives_per_min)
    draws = Draws(read[0].provenance.seed)
    rows: list[dict[str, object]] = []
    sides: list[ConfigurationData] = []
    reasons: dict[str, str | None] = {}
    for one in others:
        first = side_of(one, grid)
        _check_same_episodes(one, first, against, second, grid)
        sides.append(first)
        cells = np.flatnonzero(first.there & second.there)
        pair = Whose(grid.log_of[cells], grid.object_of[cells], grid.run_of[cells])
        reasons[one.label] = why_not(
            first, second, setting.false_positives_per_min, asked=false_positives_per_min is not None,
            truth=against.configuration in against.results.truth,
        )  # fmt: skip
        mine = setting if reasons[one.label] is None else replace(setting, false_positives_per_min=None)
        for regret in regrets(first, second, grid, mine, metrics):
            names = {"configuration": one.label, "baseline": against.label, "metric": regret.metric}
            fixed = _fixed(regret.metric, one, against)
            rows += (row | names for row in _rows(regret, pair, grid, draws, fixed=fixed))
    # All logs first, then log by log; configurations and metrics stay in their order.
    rows = [row for log in (ALL_LOGS, *range(len(grid.logs))) for row in rows if row["log_ix"] == log]
    table = pd.DataFrame(rows, columns=list(COLUMNS)).astype(COLUMNS)
    return Comparison(
        table=table,
        baseline=against.label,
        configurations=tuple(one.label for one in others),
        horizon_s=setting.horizon_s,
        false_positives_per_min=setting.false_positives_per_min,
        notes=(
            *notes_on_folders(used),
            *notes_on_differences(used, renames),
            *notes_on_pairs(against.label, second.there, {side.label: side.there for side in sides}),
            *note_on_measuring(against, others),
            *notes_on_outputs(against, others),
            *notes_on_instants(second, sides, grid.logs),
            *notes_on_equal_ghosts(reasons),
            *notes_on_rows(table, setting.false_positives_per_min),
        ),
    )


def _setting(folders: Sequence[Results], baseline: ConfigurationData, false_positives_per_min: float | None) -> Setting:
    """What holds for all pairs; the longest episode is that of any folder."""
    measure = folders[0].provenance.measure
    horizon_s = measure["horizon_s"]
    if horizon_s is None:
        used_s = [one.provenance.horizon_used_s for one in folders if one.provenance.horizon_used_s is not None]
        horizon_s = max(used_s) if used_s else float(np.nanmax(baseline.ended_s - baseline.onset_s))
    if false_positives_per_min is None and baseline.ghosts is not None:
        false_positives_per_min = own_rate(baseline.ghosts)
    return Setting(float(horizon_s), float(measure["gospa"]["power"]), false_positives_per_min)


def _check_same_episodes(
    one: Named, first: ConfigurationData, against: Named, second: ConfigurationData, grid: Grid
) -> None:
    """Raise InputError where an object is not looked at from and until the same time: no pair then is one."""
    if one.results is against.results:
        return
    both = first.there & second.there
    for what in ("onset_s", "ended_s"):
        found, expected = getattr(first, what), getattr(second, what)
        other = np.flatnonzero(both & (np.abs(found - expected) > 1e-9 * SAME_INSTANT_NS))
        if len(other):
            log, _, name = grid.objects[grid.object_of[other[0]]].partition("\n")
            raise InputError(
                f"{one.results.folder}: log {log}: object {name}: expected {what} {expected[other[0]]:g} as in "
                f"{against.results.folder}, found {found[other[0]]:g}: not the same ego, recording or units"
            )


def _fixed(metric: str, *sides: Named) -> bool:
    """Whether a metric is the same in every run, with all of them."""
    if metric == "pass_share":
        return all(side.results.fixed.passes(side.configuration) for side in sides)
    return all(side.results.fixed.known(side.configuration) for side in sides)


def _rows(regret: Regret, pair: Whose, grid: Grid, draws: Draws, *, fixed: bool) -> Iterator[dict[str, object]]:
    """A row of all logs, then, where there are several, one for each.

    `pair`: all rows that both sides have. `fixed`: the metric is the same in every run.
    """
    yield _row(regret, pair, grid, draws, fixed=fixed) | {"log": ALL, "log_ix": ALL_LOGS}
    for k, name in enumerate(grid.logs if len(grid.logs) > 1 else ()):
        of_log = replace(regret, figure=regret.figure.take(regret.figure.whose.log_ix == k))
        yield _row(of_log, pair.take(pair.log_ix == k), grid, draws, fixed=fixed) | {"log": name, "log_ix": k}


def _row(regret: Regret, pair: Whose, grid: Grid, draws: Draws, *, fixed: bool) -> dict[str, object]:
    figure = regret.figure
    value, other, difference = figure.values()
    row: dict[str, object] = {"value": _number(value), "baseline_value": _number(other), "n": int(figure.n.sum())}
    row["difference"] = _number(difference)
    row |= limits(figure, difference, pair, grid, draws, fixed=fixed)
    if figure.only is not None:
        only = figure.only.sum(axis=0)
        row |= {"only_configuration": int(only[0]), "only_baseline": int(only[1])}
        row["p_value"] = mcnemar(int(only[0]), int(only[1])) if len(figure.only) else None
    if regret.kept is not None:
        for name, kept in zip(("", "baseline_"), regret.kept, strict=True):
            row[f"{name}existence"], row[f"{name}ghosts_kept_per_min"] = kept.existence, kept.false_positives_per_min
    return row


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
