"""Which configurations detect at the same times as the best, and why differences have no interval."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import pandas as pd

from copem_replay.core.tracks import SAME_INSTANT_NS
from copem_replay.metrics.fixed import NOTHING_DRAWN
from copem_replay.metrics.intervals import clusters
from copem_replay.report.figures.captions import few_in_words
from copem_replay.report.figures.selection import by_run
from copem_replay.results.compare.limits import ALL_ALIKE

if TYPE_CHECKING:
    from copem_replay.report.html.study import Study
    from copem_replay.results.read import Results

_SAME_S = SAME_INSTANT_NS * 1e-9


def as_soon_as(best: str, names: Sequence[str], results: Results) -> tuple[str, ...]:
    """Those that detect the same objects in the same runs as the best, each at the same time, and the best itself."""
    same = dict.fromkeys(names, True)
    for times_s in by_run(results, "detection_s"):
        of_best = times_s[best]
        for name in same:
            alike = ((times_s[name] - of_best).abs() <= _SAME_S) | (times_s[name].isna() & of_best.isna())
            same[name] &= name == best or bool(alike.all())
    return tuple(name for name in names if same[name])


def at_once(study: Study) -> bool:
    """Whether the best detects every object, in every run, at its onset."""
    known = study.results.known
    return bool((known.loc[known["configuration"] == study.best, "time_to_detection_s"].abs() <= _SAME_S).all())


def why_no_interval(study: Study, rows: pd.DataFrame) -> str:
    """`2 objects`, `each is the same in every run`: why differences to the best have none."""
    over = clusters(study.results.known)[0]
    kinds = list(rows["interval"].dropna().unique()) if "interval" in rows else []
    said = []
    if ALL_ALIKE in kinds:
        said.append(f"each is the same in every {over[:-1] if over else 'object'}")
    if NOTHING_DRAWN in kinds:
        said.append("nothing is drawn, every run is the same")
    if not said:
        said.append(few_in_words(study.results) or "too few of what is resampled")
    return " or ".join(said)
