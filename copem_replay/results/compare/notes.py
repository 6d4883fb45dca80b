"""What has to be said of a comparison: what was left out, and why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from copem_replay.core.text import counted
from copem_replay.metrics.intervals import FEWEST_CLUSTERS
from copem_replay.results.compare.labels import Named
from copem_replay.results.tables import OPTIONAL

if TYPE_CHECKING:
    from copem_replay.results.compare.all_logs import AllLogs
    from copem_replay.results.read import Results

_NEEDED = {
    "position_rmse_m": {"accuracy.parquet", "instants.parquet"},
    "gospa_m": {"accuracy.parquet", "instants.parquet"},
    "false_positives_per_min": {"lists.parquet"},
    "ttd_rmst_s_equal_ghosts": {"lists.parquet", "thresholds.parquet"},
}


def notes_on_folders(folders: Sequence[Results]) -> Iterator[str]:
    """What folders do not have, or have more of than others."""
    runs = {str(folder.folder): folder.provenance.runs for folder in folders}
    if len(set(runs.values())) > 1:
        has = ", ".join(f"{path} {count}" for path, count in runs.items())
        yield f"other numbers of runs ({has}): the first {min(runs.values())} are compared"
    for folder in folders:
        missing = [name for name in OPTIONAL if name not in folder.by_log]
        metrics = [metric for metric, files in _NEEDED.items() if files & set(missing)]
        if metrics:
            yield (
                f"{folder.folder}: no {', '.join(missing)} (without accuracy, or of "
                f"an older version): not compared: {', '.join(metrics)}"
            )
    with_braking = [folder for folder in folders if folder.provenance.braking is not None]
    if with_braking and len(with_braking) < len(folders):
        without = ", ".join(str(folder.folder) for folder in folders if folder.provenance.braking is None)
        yield f"{without}: no braking: pass_share is compared only among those that have it"


def notes_on_pairs(baseline: Named, pairs: Mapping[Named, AllLogs]) -> Iterator[str]:
    """Rows without a partner."""
    for one, pair in pairs.items():
        counts = np.sum(pair.alone, axis=0).tolist()
        for (one_side, other), count in zip(((one, baseline), (baseline, one)), counts, strict=True):
            if count:
                yield f"{counted(count, 'row')} of {one_side.label} left out: {other.label} has no such object"


def notes_on_instants(baseline: Named, pairs: Mapping[Named, AllLogs], logs: Sequence[str]) -> Iterator[str]:
    """Lists that have no list of the other configuration at the same instant."""
    alike: dict[tuple[int, int, int, str], list[str]] = {}
    for one, pair in pairs.items():
        shared, mine, theirs = np.sum(pair.instants, axis=0).tolist() if pair.instants else (0, 0, 0)
        if shared < max(mine, theirs):
            none = ", ".join(log for log, counts in zip(logs, pair.instants, strict=True) if counts[0] == 0)
            alike.setdefault((shared, mine, theirs, none if len(logs) > 1 else ""), []).append(one.label)
    for (number, mine, theirs, none), labels in alike.items():
        lacking = f"; none in {none}" if none else ""
        yield (
            f"{', '.join(labels)}: position_rmse_m and gospa_m are over the {counted(number, 'instant')} that both "
            f"have, of {mine} and the {theirs} of {baseline.label}{lacking}"
        )


def note_on_measuring(baseline: Named, others: Sequence[Named]) -> Iterator[str]:
    """Configurations that detect by truth id where the others have to be matched."""
    by_id = [one for one in (baseline, *others) if one.configuration in one.results.by_truth_id]
    if by_id and len(by_id) <= len(others):
        yield (
            f"{', '.join(one.label for one in by_id)}: detected by truth id, the others by match within the gate "
            "(`match: {always: true}` matches all alike)"
        )


def notes_on_rows(table: pd.DataFrame, asked: float | None) -> Iterator[str]:
    """Intervals that there are not, and ghosts fewer than `asked` per minute."""
    overall = table.drop_duplicates(["configuration", "metric"])
    without = overall[overall["difference"].notna() & overall["interval"].isna()]
    with_interval = set(overall.loc[overall["interval_over"].notna(), "configuration"])
    nameless = (without["metric"] == "false_positives_per_min") & without["configuration"].isin(with_interval)
    if nameless.any():
        yield (
            "no interval of false_positives_per_min: without accuracy.parquet it is not known which object a ghost is "
            "nearest to"
        )
    without = without[~nameless]
    if len(without):
        metrics = ", ".join(dict.fromkeys(without["metric"]))
        yield (
            f"no interval of {metrics}: neither {FEWEST_CLUSTERS} logs, nor {FEWEST_CLUSTERS} measured objects, nor "
            f"{FEWEST_CLUSTERS} runs of a single one; more runs of several say nothing about other traffic"
        )
    ghosts = overall[overall["metric"] == "ttd_rmst_s_equal_ghosts"]
    fewer = ghosts[ghosts["ghosts_kept_per_min"] < asked * (1 - 1e-9)] if asked is not None else ghosts[:0]
    for row in fewer.itertuples():
        yield (
            f"{row.configuration}: all its entries make only {row.ghosts_kept_per_min:.4g} ghosts per minute: its "
            "ttd_rmst_s_equal_ghosts is at that rate"
        )
