"""Sensitivity: how much the answer hangs on the perception error models, configuration by configuration.

The study is replayed with the odds p / (1 − p) of every detection halved and doubled, with memory of detection that
lasts twice as long, and with errors 1.5 times as large where a fusion goes by them. A change of order of two
configurations counts where both differences, as it is and as it is varied, are beyond two standard errors of the pairs
of runs. p = 0 and p = 1 do not move by odds. docs/guide/why.md
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np
import pandas as pd

from copem_replay.core.errors import ExperimentError
from copem_replay.core.memory import Memory
from copem_replay.core.tracks import TRUTH, Float
from copem_replay.core.view_geometry import Errors, Noise, ViewGeometry
from copem_replay.experiment.schema import Experiment
from copem_replay.extras.why.causes import change_couples, change_pems, measure_times_only, replay_rows
from copem_replay.io.recording import Recording
from copem_replay.metrics.exact_survival import scale_odds
from copem_replay.perception.pem.condition import Couple
from copem_replay.perception.pem.detection import DetectionModel
from copem_replay.perception.pem.error import ErrorModel
from copem_replay.perception.pem.model import Pem
from copem_replay.pipeline.expansion import find_facts
from copem_replay.pipeline.prepare import prepare_log

AS_IT_IS = "as it is"
_BEYOND = 2.0
"""Standard errors beyond which a difference is one."""


class _ScaledOdds(DetectionModel):
    """The odds of a model's probabilities, times a factor."""

    kind: Literal["scaled_odds"] = "scaled_odds"
    of: DetectionModel
    odds: float

    def probability(self, view: ViewGeometry) -> Float:
        listed = np.clip(self.of.probability(view), 0.0, 1.0)
        return np.where((listed > 0) & (listed < 1), scale_odds(listed, self.odds), listed)


class _WiderErrors(ErrorModel):
    """The random part of a model's errors times a factor, and the variances that the unit states with it."""

    kind: Literal["wider"] = "wider"
    of: ErrorModel
    factor: float

    def perturb(self, view: ViewGeometry, noise: Noise) -> Errors:
        errors = self.of.perturb(view, lambda name, **how: self.factor * noise(name, **how))
        stated = [field.name for field in fields(errors) if field.name.startswith("cov_") or "_var_" in field.name]
        wider = {name: self.factor**2 * value for name in stated if (value := getattr(errors, name)) is not None}
        return replace(errors, **wider)


def _scale_odds(odds: float) -> Callable[[Experiment], Experiment]:
    def change(couple: Couple) -> Couple:
        return couple.model_copy(update={"detection": _ScaledOdds(of=couple.detection, odds=odds)})

    return lambda experiment: change_pems(experiment, change_couples(change))


def _widen_errors(experiment: Experiment) -> Experiment:
    if all(of.by_truth_id for of in find_facts(experiment).values()):
        return experiment

    def change(couple: Couple) -> Couple:
        wider = None if couple.error is None else _WiderErrors(of=couple.error, factor=1.5)
        return couple.model_copy(update={"error": wider})

    return change_pems(experiment, change_couples(change))


def _remember_longer(experiment: Experiment) -> Experiment:
    """The experiment in which lasting detection of all PEMs lasts twice as long."""

    def longer(memory: Memory | None) -> Any:
        if memory is None or "detection" not in memory:
            return memory
        parts = [
            part
            if isinstance(part.correlation_s, str)
            else part.model_copy(update={"correlation_s": 2 * part.correlation_s})
            for part in memory["detection"]
        ]
        return {**memory, "detection": tuple(parts)}

    def changed(pem: Pem) -> Pem:
        couples = [couple.model_copy(update={"memory": longer(couple.memory)}) for couple in pem.couples]
        return pem.model_copy(update={"couples": tuple(couples), "memory": longer(pem.memory)})

    return change_pems(experiment, changed)


VARIATIONS: dict[str, Callable[[Experiment], Experiment]] = {
    AS_IT_IS: lambda experiment: experiment,
    "odds × ½": _scale_odds(0.5),
    "odds × 2": _scale_odds(2.0),
    "memory × 2": _remember_longer,
    "errors × 1.5": _widen_errors,
}
"""What is varied; where it changes nothing, as no detection lasts or no fusion goes by errors, it is left out."""


def vary_pems(
    logs: Sequence[tuple[Recording, Experiment]],
    names: Sequence[str] | None = None,
    known: Mapping[str, pd.DataFrame] | None = None,
) -> pd.DataFrame:
    """The time unknown of each configuration in each variation, run by run: variation, run, configuration, `unknown_s`.

    `names`: only these configurations; None: all. `known`: by configuration the rows of all logs as they are, which are
    not replayed again. Raises ExperimentError where no configuration has modelled units alone.
    """
    modelled, tables = [(recording, _select_modelled(e, names)) for recording, e in logs], []
    configurations, known = modelled[0][1].configurations, known or {}
    for variation, vary in VARIATIONS.items():
        if variation != AS_IT_IS and all(vary(e) == e for _, e in modelled):
            continue
        if variation == AS_IT_IS and known.keys() >= configurations.keys():
            rows = pd.concat([known[name] for name in configurations], ignore_index=True)
        else:
            rows = pd.concat([_replay(recording, vary(e)) for recording, e in modelled], ignore_index=True)
        means = rows.groupby(["configuration", "run"], sort=False)["unknown_s"].mean().reset_index()
        tables.append(means.assign(variation=variation))
    return pd.concat(tables, ignore_index=True)


def _select_modelled(experiment: Experiment, names: Sequence[str] | None) -> Experiment:
    """The experiment with configurations of modelled units alone (of `names`). Raises ExperimentError: none."""
    configurations = {
        name: configuration
        for name, configuration in experiment.configurations.items()
        if configuration.recorded is None
        and configuration.units != TRUTH
        and (names is None or name in names)
        and not set(experiment.units_of(configuration)) & set(experiment.recorded)
    }
    if not configurations:
        raise ExperimentError("sensitivity: expected a configuration with modelled units alone, found none")
    return measure_times_only(experiment.model_copy(update={"configurations": configurations}))


def _replay(recording: Recording, experiment: Experiment) -> pd.DataFrame:
    return replay_rows(prepare_log(recording, experiment), experiment)[["configuration", "run", "unknown_s"]]


def compare_orders(varied: pd.DataFrame) -> pd.DataFrame:
    """By variation the pairs of configurations whose order changes, with both differences and their errors.

    Rows: variation, better, worse (as it is), `difference_s`, `error_s` as it is, `varied_s`, `varied_error_s`, and
    `beyond`: both beyond two standard errors over the runs. A difference without an error (one run) is never beyond.
    """
    by_run = {
        name: of.pivot(index="run", columns="configuration", values="unknown_s")
        for name, of in varied.groupby("variation")
    }
    base, rows = by_run.pop(AS_IT_IS), []
    for variation, table in by_run.items():
        for one, other in combinations(base.columns, 2):
            before_s, before_error_s = _difference(base[other] - base[one])
            better, worse = (one, other) if before_s >= 0 else (other, one)
            before_s = abs(before_s)
            after_s, after_error_s = _difference(table[worse] - table[better])
            if before_s > 0 > after_s:
                beyond = before_s > _BEYOND * before_error_s and -after_s > _BEYOND * after_error_s
                rows.append((variation, better, worse, before_s, before_error_s, after_s, after_error_s, beyond))
    columns = ["variation", "better", "worse", "difference_s", "error_s", "varied_s", "varied_error_s", "beyond"]
    return pd.DataFrame(rows, columns=columns)


def _difference(of_runs: pd.Series) -> tuple[float, float]:
    """The mean over runs, and its standard error; infinite of one run."""
    return float(of_runs.mean()), float(of_runs.std(ddof=1)) / math.sqrt(len(of_runs)) if len(of_runs) > 1 else math.inf


def tabulate_variations(varied: pd.DataFrame) -> pd.DataFrame:
    """Mean seconds unknown: a row for each configuration, a column for each variation."""
    means = varied.groupby(["configuration", "variation"], sort=False)["unknown_s"].mean().unstack(sort=False)
    return means.reset_index().rename_axis(columns=None)


def describe_orders(varied: pd.DataFrame, orders: pd.DataFrame) -> list[str]:
    """One sentence per variation: how many pairs keep their order, and which do not; none without a pair."""
    count = varied["configuration"].nunique()
    if count < 2:
        return []
    pairs, lines = count * (count - 1) // 2, []
    for variation in varied["variation"].unique():
        if variation == AS_IT_IS:
            continue
        of = orders[orders["variation"] == variation]
        sure = of[of["beyond"]]
        kept = f"{variation}: the order of {pairs - len(sure)} of {pairs} pairs stays"
        unsure = f" ({len(of) - len(sure)} more change places within chance)" if len(of) > len(sure) else ""
        told = [f"{row.better} falls behind {row.worse}" for row in sure.itertuples()]
        lines.append(kept + unsure + (f"; {', '.join(told)}" if told else ""))
    return lines
