"""Data of a report: results, provenance, their comparison with the baseline, and ties with the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from copem_replay.core.errors import InputError, unknown_name_message
from copem_replay.core.tracks import SAME_INSTANT_S
from copem_replay.metrics.limits import ALL_ALIKE, CLUSTERS, NOTHING_DRAWN, find_clusters
from copem_replay.report.figures.selection import pivot_by_run
from copem_replay.report.figures.style import (
    RANKED_BY,
    Appearance,
    check_summary,
    choose_appearances,
    explain_no_intervals,
    find_contenders,
    sort_soonest_first,
)
from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.judge import judge_own_criteria
from copem_replay.results.read import Results, read_results
from copem_replay.results.slices import summarise_slices
from copem_replay.results.verdicts import Judgement, find_verdicts


def find_ties(best: str, names: Sequence[str], results: Results) -> tuple[str, ...]:
    """The best, and all of `names` that detect the same objects at the same times in the same runs."""
    tied = dict.fromkeys(names, True)
    for times_s in pivot_by_run(results, "detection_s"):
        best_s = times_s[best]
        for name in tied:
            equal = ((times_s[name] - best_s).abs() <= SAME_INSTANT_S) | (times_s[name].isna() & best_s.isna())
            tied[name] &= name == best or bool(equal.all())
    return tuple(name for name in names if tied[name])


def detects_at_onset(study: ReportData) -> bool:
    """Whether the best detects every object at its onset in every run."""
    known = study.results.known
    return bool((known.loc[known["configuration"] == study.best, "time_to_detection_s"].abs() <= SAME_INSTANT_S).all())


def explain_missing_interval(study: ReportData, rows: pd.DataFrame) -> str:
    """Why differences to the best have no interval: `2 objects`, `each is the same in every run`."""
    clusters = find_clusters(study.results.known)
    kinds = list(rows["interval"].dropna().unique()) if "interval" in rows else []
    reasons = []
    if ALL_ALIKE in kinds:
        reasons.append(f"each is the same in every {CLUSTERS[clusters.over][0] if clusters else 'object'}")
    if NOTHING_DRAWN in kinds:
        reasons.append("nothing is drawn, every run is the same")
    if not reasons:
        reasons.append(explain_no_intervals(study.results) or "too few have it")
    return " or ".join(reasons)


NO_RECORDING = "the recording is not there as it was; copem-replay plot says more"
"""Why a page lacks what needs a recording: without a path, for a page is the same wherever its folder lies."""


@dataclass(frozen=True)
class ReportData:
    """Results with their comparisons.

    `baseline`: None if there is nothing to compare; `regret`: the differences to it. `best`: the contender that detects
    soonest, None if no object is measured; `lead`: the differences of the other contenders to it. `sliced`: rows of
    `summary_by.csv`, None: there are none.
    """

    results: Results
    baseline: str | None
    regret: Comparison | None
    best: str | None
    lead: Comparison | None
    sliced: pd.DataFrame | None = None

    @property
    def provenance(self) -> Mapping[str, Any]:
        """The whole of `provenance.json`."""
        return self.results.provenance.data

    @property
    def names(self) -> tuple[str, ...]:
        """All configurations, in their order."""
        return tuple(self.results.experiment.configurations)

    @property
    def contenders(self) -> tuple[str, ...]:
        """Configurations that are not the truth; all, if there are no others."""
        return find_contenders(self.results)

    @cached_property
    def ranked(self) -> tuple[str, ...]:
        """All configurations as figures have them: the truth, then the soonest first."""
        truths = tuple(name for name in self.names if name not in self.contenders)
        return (*truths, *sort_soonest_first(self.results, self.contenders))

    @property
    def looks(self) -> dict[str, Appearance]:
        """How each configuration is drawn."""
        return choose_appearances(self.results)

    @cached_property
    def as_soon(self) -> tuple[str, ...]:
        """The best, and all contenders that detect the same objects at the same times in the same runs."""
        return find_ties(str(self.best), self.contenders, self.results)

    @cached_property
    def verdicts(self) -> Judgement | None:
        """The verdicts in the folder, else of the criteria of the experiment; None: no criteria."""
        folder = self.results.folder
        return (None if folder is None else find_verdicts(folder)) or judge_own_criteria(self.results)

    def of(self, name: str) -> pd.Series:
        """The row of `summary.csv` of a configuration."""
        return self.results.summary.set_index("configuration").loc[name]


def load_study(given: Path | Results, baseline: str | None = None, by: Sequence[str] | None = None) -> ReportData:
    """Compare the configurations of results, or of a results folder, with a baseline.

    None: that of `compare`. `by`: entries of slices, None: those of the experiment. Raises InputError: no or damaged
    results, no such baseline.
    """
    results = given if isinstance(given, Results) else read_results(given, rowless=True)
    check_summary(results)
    names = tuple(results.experiment.configurations)
    if baseline is not None and baseline not in names:
        raise InputError(f"--baseline: {unknown_name_message('configuration', baseline, names)}")
    if not len(results.known):
        return ReportData(results, None, None, None, None)
    sliced = summarise_slices(results, by)
    ranked = find_contenders(results)
    best = sort_soonest_first(results, ranked)[0]
    if len(names) < 2:
        return ReportData(results, None, None, best, None, sliced)
    regret = compare_folders([results], baseline=baseline)
    lead = None
    if len(ranked) > 1:
        lead = (
            regret
            if best == regret.baseline and ranked == names
            else compare_folders([results], configurations=ranked, baseline=best, metrics=(RANKED_BY,))
        )
    return ReportData(results, regret.baseline, regret, best, lead, sliced)
