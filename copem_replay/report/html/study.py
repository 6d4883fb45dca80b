"""Data of a report: results, provenance, their comparison with the baseline, and ties with the best."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from copem_replay.core.errors import InputError, unknown_name_message
from copem_replay.report.figures.style import (
    Appearance,
    check_summary,
    choose_appearances,
    find_contenders,
    sort_soonest_first,
)
from copem_replay.results.compare import Comparison, compare_folders
from copem_replay.results.judge import judge_own_criteria
from copem_replay.results.read import Results, read_results
from copem_replay.results.slices import summarise_slices
from copem_replay.results.verdicts import Judgement, find_verdicts

NO_RECORDING = "the recording is not there as it was; copem-replay plot says more"
"""Why a page lacks what needs a recording: without a path, for a page is the same wherever its folder lies."""


@dataclass(frozen=True)
class ReportData:
    """Results with their comparisons.

    `baseline`: None if there is nothing to compare; `regret`: the differences to it. `sliced`: rows of
    `summary_by.csv`, None: there are none.
    """

    results: Results
    baseline: str | None
    regret: Comparison | None
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
    def verdicts(self) -> Judgement | None:
        """The verdicts in the folder, else of the criteria of the experiment; None: no criteria."""
        folder = self.results.folder
        return (None if folder is None else find_verdicts(folder)) or judge_own_criteria(self.results)

    def view_command(self, log: str, object_id: str) -> str:
        """The command that opens the viewer at an object; empty where the results have no recording of its log."""
        logs = self.results.provenance.run_shown
        of_log = f" --log {shlex.quote(log)}" if len(self.results.provenance.logs) > 1 else ""
        return f"copem-replay view FOLDER --object {shlex.quote(object_id)}{of_log}" if log in logs else ""

    def of(self, name: str) -> pd.Series:
        """The row of `summary.csv` of a configuration."""
        return self.results.summary.set_index("configuration").loc[name]


def load_study(source: Path | Results, baseline: str | None = None, by: Sequence[str] | None = None) -> ReportData:
    """Compare the configurations of results, or of a results folder, with a baseline. None: that of `compare`. `by`:
    entries of slices, None: those of the experiment. Raises InputError: no or damaged results, no such baseline.
    """
    results = source if isinstance(source, Results) else read_results(source, rowless=True)
    check_summary(results)
    names = tuple(results.experiment.configurations)
    if baseline is not None and baseline not in names:
        raise InputError(f"--baseline: {unknown_name_message('configuration', baseline, names)}")
    if not len(results.known):
        return ReportData(results, None, None)
    sliced = summarise_slices(results, by)
    if len(names) < 2:
        return ReportData(results, None, None, sliced)
    regret = compare_folders([results], baseline=baseline)
    return ReportData(results, regret.baseline, regret, sliced)
