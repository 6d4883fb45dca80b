"""What has to be said of a comparison: what was left out, and why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import pandas as pd

from copem_replay.compare.folders import OPTIONAL, Folder
from copem_replay.summary import FEWEST_CLUSTERS
from copem_replay.tracks import Bool
from copem_replay.wording import counted

_NEEDED = {
    "position_rmse_m": {"accuracy.parquet", "instants.parquet"},
    "gospa_m": {"accuracy.parquet", "instants.parquet"},
    "ghosts_per_min": {"lists.parquet"},
    "ttd_rmst_s_equal_ghosts": {"lists.parquet", "thresholds.parquet"},
}


def notes_on_folders(folders: Sequence[Folder]) -> Iterator[str]:
    """What folders do not have, or have more of than others."""
    runs = {str(folder.path): folder.runs for folder in folders}
    if len(set(runs.values())) > 1:
        has = ", ".join(f"{path} {count}" for path, count in runs.items())
        yield f"other numbers of runs ({has}): the first {min(runs.values())} are compared"
    for folder in folders:
        missing = [name for name in OPTIONAL if name not in folder.tables]
        metrics = [metric for metric, files in _NEEDED.items() if files & set(missing)]
        if metrics:
            yield (
                f"{folder.path}: no {', '.join(missing)} (without accuracy, or of an older version): not compared: "
                f"{', '.join(metrics)}"
            )
    with_braking = [folder for folder in folders if folder.braking is not None]
    if with_braking and len(with_braking) < len(folders):
        without = ", ".join(str(folder.path) for folder in folders if folder.braking is None)
        yield f"{without}: no braking: pass_share is compared only among those that have it"


def notes_on_pairs(baseline: str, baseline_there: Bool, there: Mapping[str, Bool]) -> Iterator[str]:
    """Rows without a partner."""
    for label, mine in there.items():
        for whose, count in ((label, (mine & ~baseline_there).sum()), (baseline, (baseline_there & ~mine).sum())):
            if count:
                other = baseline if whose is label else label
                yield f"{counted(int(count), 'row')} of {whose} left out: {other} has no such object"


def notes_on_rows(table: pd.DataFrame) -> Iterator[str]:
    """Intervals and thresholds that there are not."""
    overall = table.drop_duplicates(["configuration", "metric"])
    without = overall[overall["difference"].notna() & overall["interval_over"].isna()]
    if len(without):
        metrics = ", ".join(dict.fromkeys(without["metric"]))
        yield (
            f"no interval of {metrics}: neither {FEWEST_CLUSTERS} logs, nor {FEWEST_CLUSTERS} measured objects, nor "
            f"{FEWEST_CLUSTERS} runs of a single one; more runs of several do not tell about other traffic"
        )
    ghosts = overall[overall["metric"] == "ttd_rmst_s_equal_ghosts"]
    never = [*ghosts.loc[ghosts["existence"].isna(), "configuration"]]
    never += [*ghosts.loc[ghosts["baseline_existence"].isna(), "baseline"].unique()]
    for label in never:
        yield f"{label}: more ghosts than that at every threshold: no ttd_rmst_s_equal_ghosts"
