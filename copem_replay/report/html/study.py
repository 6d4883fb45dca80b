"""Data of a report: the results, where they come from, and their comparison with the baseline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.core.text import unknown
from copem_replay.report.figures.contenders import RANKED_BY, contenders, default_baseline, soonest_first
from copem_replay.report.figures.style import Appearance, appearances
from copem_replay.report.html.ties import as_soon_as
from copem_replay.results.compare import Comparison, compare
from copem_replay.results.read import Results, load_results

_COLUMNS = (
    "detected_share", "interval", "interval_over", "ttd_median_s", "ttd_rmst_s", "ttd_rmst_horizon_s", "dad_median_m",
)  # fmt: skip
_BRAKING = ("n_conflict", "pass_share", "pass_share_low", "pass_share_high", "pass_interval", "pass_interval_over")


@dataclass(frozen=True)
class Study:
    """Results, and what of them is compared.

    `baseline`: None where there is nothing to compare; `regret` are the differences to it. `best`: the configuration
    that detects soonest of those that are not the truth; None: no object is measured. `lead`: their differences to it.
    """

    results: Results
    baseline: str | None
    regret: Comparison | None
    best: str | None
    lead: Comparison | None

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
        """Those that are not the truth itself; all, if there is nothing else."""
        return contenders(self.results)

    @property
    def looks(self) -> dict[str, Appearance]:
        """How each configuration is drawn."""
        return appearances(self.names)

    @cached_property
    def as_soon(self) -> tuple[str, ...]:
        """The best and all other contenders that detect the same objects in the same runs, each at the same time."""
        return as_soon_as(str(self.best), self.contenders, self.results)

    def of(self, name: str) -> pd.Series:
        """The row of `summary.csv` of a configuration."""
        return self.results.summary.set_index("configuration").loc[name]


def load_study(folder: Path, baseline: str | None = None) -> Study:
    """Read a results folder and compare what is in it with a baseline.

    That is by default `ideal`, else the first configuration that is not the truth. Raises InputError.
    """
    results = load_results(folder, rowless=True)
    _check_summary(results)
    names = tuple(results.experiment.configurations)
    if baseline is not None and baseline not in names:
        raise InputError(f"--baseline: {unknown('configuration', baseline, names)}")
    if not len(results.known):
        return Study(results, None, None, None, None)
    ranked = contenders(results)
    best = soonest_first(results, ranked)[0]
    if len(names) < 2:
        return Study(results, None, None, best, None)
    against = baseline or default_baseline(results)
    regret = compare([results], baseline=against)
    lead = None
    if len(ranked) > 1:
        lead = (
            regret
            if best == against and ranked == names
            else compare([results], configurations=ranked, baseline=best, metrics=(RANKED_BY,))
        )
    return Study(results, against, regret, best, lead)


def _check_summary(results: Results) -> None:
    """Raise InputError where `summary.csv` is not that of the experiment."""
    place, again = results.folder / "summary.csv", "run the experiment again with --overwrite"
    needed = _COLUMNS + (_BRAKING if results.experiment.braking is not None else ())
    if missing := [name for name in needed if name not in results.summary]:
        raise InputError(f"{place}: expected the column {missing[0]}, found none; {again}")
    expected, found = list(results.experiment.configurations), list(results.summary["configuration"])
    if found != expected:
        raise InputError(f"{place}: expected rows of {', '.join(expected)}, found {', '.join(found)}; {again}")
