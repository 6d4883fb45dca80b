"""Which configurations detect at the same times as the best, and why differences have no interval."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.intervals import clusters
from copem_replay.report.figures.captions import few_in_words
from copem_replay.results.compare.limits import ALL_ALIKE

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study

_SAME_S = SAME_INSTANT_NS * 1e-9


def as_soon_as_the_best(study: Study) -> tuple[str, ...]:
    """The best and all other contenders that detect the same objects in the same runs, each at the same time."""
    keys = ["log", "object_id", "run"]
    times = study.results.table.set_index([*keys, "configuration"])["detection_s"].unstack("configuration")
    best = times[study.best]

    def same(name: str) -> bool:
        return bool((((times[name] - best).abs() <= _SAME_S) | (times[name].isna() & best.isna())).all())

    return tuple(name for name in study.contenders if name == study.best or same(name))


def at_once(study: Study) -> bool:
    """Whether the best detects every object, in every run, at its onset."""
    rows = study.results.table[study.results.table["configuration"] == study.best]
    return bool((rows["time_to_detection_s"].abs() <= _SAME_S).all())


def why_no_interval(study: Study, rows: pd.DataFrame) -> str:
    """`2 objects`, `each is the same in every run`: why differences to the best have none."""
    over = clusters(study.results.table)[0]
    kinds = list(rows["interval"].dropna().unique()) if "interval" in rows else []
    said = []
    if ALL_ALIKE in kinds:
        said.append(f"each is the same in every {over[:-1] if over else 'object'}")
    if NOTHING_DRAWN in kinds:
        said.append("nothing is drawn, every run is the same")
    if not said:
        said.append(few_in_words(study.results) or "too few of what is resampled")
    return " or ".join(said)
