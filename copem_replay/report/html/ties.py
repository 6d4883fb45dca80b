"""Who knew at the same times as the best, and why differences have no interval."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.core.text import counted
from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.metrics.intervals import FEWEST_CLUSTERS

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_SAME_S = SAME_INSTANT_NS * 1e-9


def as_soon_as_the_best(study: Study) -> tuple[str, ...]:
    """The best and all other contenders that knew of the same objects in the same runs, of each at the same time."""
    keys = ["log", "object_id", "run"]
    times = study.results.table.set_index([*keys, "configuration"])["detection_s"].unstack("configuration")
    best = times[study.best]

    def same(name: str) -> bool:
        return bool((((times[name] - best).abs() <= _SAME_S) | (times[name].isna() & best.isna())).all())

    return tuple(name for name in study.contenders if name == study.best or same(name))


def at_once(study: Study) -> bool:
    """Whether the best knew of every object, in every run, at its onset."""
    rows = study.results.table[study.results.table["configuration"] == study.best]
    return bool((rows["time_to_detection_s"].abs() <= _SAME_S).all())


def no_interval(study: Study, rows: pd.DataFrame) -> str:
    """`2 objects, so no interval`: of differences without one, as the comparison says it, or by what there is."""
    said = [str(why) for why in rows["interval"].dropna().unique() if why] if "interval" in rows else []
    why = " and ".join(said) or _few(study)
    return f"{why}, so no interval" if why else "no interval"


def _few(study: Study) -> str:
    """How many there are of what would be resampled, where these are too few."""
    table = study.results.table
    logs, things = table["log"].nunique(), table.groupby(["log", "object_id"]).ngroups
    if max(logs, things) >= FEWEST_CLUSTERS:
        return ""
    if things == 1:
        return f"{counted(study.results.experiment.runs, 'run')} of one object"
    return counted(things, "object") + (f" in {counted(logs, 'log')}" if logs > 1 else "")
