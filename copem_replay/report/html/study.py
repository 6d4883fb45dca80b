"""What a report is made of: the results, where they come from, and who is compared with whom."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from copem_replay.core.errors import InputError
from copem_replay.core.text import unknown
from copem_replay.report.figures.style import Appearance, appearances
from copem_replay.results.compare import Comparison, compare
from copem_replay.results.compare.labels import DEFAULT_BASELINE
from copem_replay.results.read import Results, load_results

_COLUMNS = (
    "detected_share", "interval", "interval_over", "ttd_median_s", "ttd_rmst_s", "ttd_rmst_horizon_s", "dad_median_m",
)  # fmt: skip
_BRAKING = ("n_conflict", "pass_share", "pass_share_low", "pass_share_high", "pass_interval", "pass_interval_over")
RANKED_BY = "ttd_rmst_s"
"""Who knows soonest: the mean that counts those who were never detected, too."""


@dataclass(frozen=True)
class Study:
    """Results, and what of them is compared.

    `baseline`: None where there is nothing to compare; `regret` are the differences to it. `best`: the configuration
    that knows soonest of those that are not the truth; None: nobody was measured. `lead` are their differences to it.
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
        return _contenders(self.results)

    @property
    def looks(self) -> dict[str, Appearance]:
        """How each configuration is drawn."""
        return appearances(self.names)

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
    if not len(results.table):
        return Study(results, None, None, None, None)
    best = _soonest(results)
    if len(names) < 2:
        return Study(results, None, None, best, None)
    contenders = _contenders(results)
    against = baseline or (DEFAULT_BASELINE if DEFAULT_BASELINE in names else contenders[0])
    regret = compare([folder], baseline=against)
    lead = None
    if len(contenders) > 1:
        lead = (
            regret
            if best == against and contenders == names
            else compare([folder], configurations=contenders, baseline=best)
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


def _contenders(results: Results) -> tuple[str, ...]:
    configurations = results.experiment.configurations
    return tuple(name for name, c in configurations.items() if c.units != "truth") or tuple(configurations)


def _soonest(results: Results) -> str:
    """Of equals the one with which more pass, then the first."""
    rows = results.summary.set_index("configuration")

    def rank(name: str) -> tuple[float, float]:
        row = rows.loc[name]
        mean_s, passes = float(row[RANKED_BY]), float(row.get("pass_share", math.nan))
        return (math.inf if math.isnan(mean_s) else mean_s, 0.0 if math.isnan(passes) else -passes)

    return min(_contenders(results), key=rank)
