"""`cr.require`: for which values of a key, or of two, a criterion holds, and which value is wanted of them.

Each value that is tried is a replay of the configurations that the criterion is about, on the same draws, and the
criterion is judged of it as `verdict` judges. docs/guide/require.md
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from copem_replay.api.run import replay_study
from copem_replay.api.study import AnyExperiment, AnyPath, AnyRecordings, LoadedStudy, make_study, prepare_study
from copem_replay.core.errors import InputError, name_first, unknown_name_message
from copem_replay.core.tracks import Int
from copem_replay.experiment.criteria import Criterion, choose_judged
from copem_replay.experiment.cross_references import read_criteria
from copem_replay.experiment.drive import resolve_for_log
from copem_replay.experiment.schema import Experiment
from copem_replay.extras.require.keys import FreeKey, Want, read_free_key, set_values
from copem_replay.metrics.row_figures import JUDGED
from copem_replay.pipeline.parts import PartCache, write_recipe
from copem_replay.pipeline.run import Progress
from copem_replay.results.judge import judge_results
from copem_replay.results.read import Results
from copem_replay.results.verdicts import MET, NOT_MEASURED, NOT_MET, UNDECIDED, Verdict, judge_limits

if TYPE_CHECKING:
    from copem_replay.pipeline.prepare import Replay

_Index = tuple[int, ...]
_FIRST, _STEPS, _FORESEEN = {1: 9, 2: 5}, {1: 200, 2: 20}, {1: 20, 2: 100}
"""By the number of keys: of each the values of the first grid and, about, all; and how many are tried, about."""


@dataclass(frozen=True)
class Trial:
    """The verdicts of the criterion at one value of each free key."""

    values: tuple[float, ...]
    verdicts: tuple[Verdict, ...]

    @cached_property
    def word(self) -> str:
        """`met` where all verdicts are, `not met` where one is, `not measured` where all are, else `undecided`."""
        words = {one.verdict for one in self.verdicts}
        return NOT_MET if NOT_MET in words else words.pop() if len(words) == 1 else UNDECIDED

    @property
    def passes(self) -> bool:
        """Whether every verdict passes."""
        return all(one.passes for one in self.verdicts)

    @property
    def level(self) -> int:
        """0: not met, 3: met; between them whether the figures themselves are beyond the bound (1), or keep it (2)."""
        numbers = ((math.nan if one.estimate is None else one.estimate, one) for one in self.verdicts)
        kept = all(judge_limits(number, number, of.bound, of.direction) == MET for number, of in numbers)
        return {NOT_MET: 0, MET: 3, NOT_MEASURED: 1}.get(self.word, 1 + kept)


@dataclass(frozen=True, eq=False)
class Requirement:
    """For which values of free keys a criterion holds.

    `trials`: every value that was tried, ascending. `levels`: `Trial.level` on the grid of all values, those between
    alike ones taken to be alike. `study`: what was asked about; `named`: the criterion's name.

    >>> key = "pems.camera[0].detection.probability=0:0.9:0.1"
    >>> needed = cr.require("logs/crossing_required.yaml", criterion="known in time", free=[key])
    >>> needed.wants, needed.monotone, needed.required
    (['smallest'], True, (0.2,))
    """

    criterion: Criterion
    named: str
    keys: tuple[FreeKey, ...]
    trials: tuple[Trial, ...]
    levels: Int
    study: LoadedStudy
    asked: tuple[Want, ...] = ()

    @cached_property
    def _turns(self) -> list[tuple[bool, ...]]:
        """Of each axis whether it holds behind a value at which it does not, and whether the other way round."""
        held, refuted = self.levels == 3, self.levels == 0
        return [
            tuple(
                bool((np.maximum.accumulate(one, axis) & then).any())
                for one, then in ((refuted, held), (held, refuted))
            )
            for axis in range(len(self.keys))
        ]

    @property
    def monotone(self) -> bool:
        """Whether it holds on one side of each key alone, as far as is decided."""
        return not any(map(all, self._turns))

    @property
    def wants(self) -> list[Want]:
        """Of each key which value is wanted: what is asked for, else as the verdicts say, or the name of the key."""
        found: list[Want] = []
        for axis, (key, (up, down)) in enumerate(zip(self.keys, self._turns, strict=True)):
            slope = up - down or (0 if up else np.diff(self.levels, axis=axis).sum())
            found.append("smallest" if slope > 0 else "largest" if slope < 0 else key.want or "largest")
        return [*self.asked, *found[len(self.asked) :]]

    def name_values(self, values: Sequence[float]) -> str:
        """Values of the keys with their names: `latency_s 0.3 and probability 0.5`."""
        return " and ".join(f"{key.about} {value:g}" for key, value in zip(self.keys, values, strict=True))

    @cached_property
    def segments(self) -> list[tuple[str, list[Trial]]]:
        """Of one key the verdicts one after the other, each with its trials."""
        return [(word, list(of)) for word, of in groupby(self.trials, key=lambda one: one.word)]

    @cached_property
    def required(self) -> tuple[float, ...] | None:
        """The value that is wanted of each key; of two keys the middle of their front. None: no value passes."""
        signs = [1.0 if want == "largest" else -1.0 for want in self.wants]
        if len(self.keys) == 1:
            ordered = self.trials if signs[0] > 0 else self.trials[::-1]
            runs = (list(of) for passes, of in groupby(ordered, key=lambda one: one.passes) if passes)
            return next((run[-1].values for run in runs), None)
        passing = [one.values for one in self.trials if one.passes]
        costs = np.array(passing).reshape(-1, 2) * signs
        worse = [((costs >= cost) & (costs != cost).any(axis=1, keepdims=True)).all(axis=1).any() for cost in costs]
        front = [values for values, is_worse in zip(passing, worse, strict=True) if not is_worse]
        return front[len(front) // 2] if front else None

    @property
    def experiment(self) -> Experiment | None:
        """The experiment with the required values, and with the criterion as it was judged."""
        given = self.study.experiment
        kept = given.model_copy(update={"criteria": given.criteria | {self.named: self.criterion}})
        return None if self.required is None else set_values(kept, self.keys, self.required)

    @property
    def table(self) -> pd.DataFrame:
        """A row for each verdict of each value that was tried, the values first."""
        columns = ("configuration", "group", "estimate", "low", "high", "verdict", "passes", "over", "clusters", "why")
        rows = [(*one.values, *(getattr(of, name) for name in columns)) for one in self.trials for of in one.verdicts]
        return pd.DataFrame(rows, columns=[*(key.name for key in self.keys), *columns])


def require(
    experiment: AnyExperiment,
    recordings: AnyRecordings | None = None,
    *,
    criterion: str,
    free: Sequence[str],
    criteria: Mapping[str, Any] | AnyPath | None = None,
    want: Sequence[str] = (),
    jobs: int | None = None,
    pieces: AnyPath | None = None,
    progress: Progress | None = None,
) -> Requirement:
    """Find for which values of one key, or of two, a criterion holds, by replays on the same draws.

    `experiment`, `recordings`, `jobs`, `pieces`: as `cr.run` takes them. `criterion`: its name, among those of the
    experiment or of `criteria`, which `cr.judge` takes, too. `free`: keys below `pems`, `units`, `links` or
    `configurations` by their paths; `KEY=FROM:TO:STEP` where other values are tried than the usual ones. `want`: of
    each key whether its `largest` or `smallest` value is wanted; by default as the verdicts say. `progress(done,
    total)` is called after each value.

    Raises InputError: what `cr.run` raises, a criterion or a key that is not there, a key that no configuration of the
    criterion uses, a value that the experiment does not take.

    >>> soon = {"metric": "ttd_rmst_s", "at_most": 0.75, "population": "these_logs", "configurations": ["coPEM:0.5s"]}
    >>> key = "configurations.coPEM:0.5s.latency_s=0:1:0.05"
    >>> cr.require("logs/tc016d.yaml", criterion="soon", free=[key], criteria={"soon": soon}).required
    (0.75,)
    """
    if not 1 <= len(free) <= len(_FIRST):
        raise InputError(f"free: expected one key or two, found {len(free)}")
    if len(want) > len(free) or set(want) - {"largest", "smallest"}:
        raise InputError(f"want: expected largest or smallest of each key, found {', '.join(want)}")
    study = make_study(experiment, recordings)
    judged = _find_criterion(study.experiment, criterion, criteria)
    reduced = _reduce(study.experiment, criterion, judged)
    keys = tuple(read_free_key(path, study.experiment, _STEPS[len(free)]) for path in free)
    for key in keys:
        _check_used(study, key, list(reduced.configurations))
    with tempfile.TemporaryDirectory(prefix="copem-replay-") as scratch:
        cache = PartCache(str(pieces or scratch))
        trials, levels = _search(replace(study, experiment=reduced), keys, jobs, cache, progress)
    return Requirement(judged, criterion, keys, trials, levels, study, cast("tuple[Want, ...]", tuple(want)))


def _find_criterion(experiment: Experiment, name: str, given: Mapping[str, Any] | AnyPath | None) -> Criterion:
    """The criterion as it is judged: in closed form if the experiment asks for that and its metric has one."""
    criteria: Mapping[str, Criterion] = experiment.criteria
    if given is not None:
        criteria = read_criteria(given if isinstance(given, Mapping) else Path(given), experiment.as_written())
    if name not in criteria:
        raise InputError(unknown_name_message("criterion", name, criteria))
    criterion = criteria[name]
    if criterion.against is not None and criterion.find_against("", list(experiment.configurations))[1]:
        raise InputError(f"criterion {name}: expected `against` a configuration, found results of before")
    exact = f"{criterion.metric}_exact"
    in_closed_form = experiment.measure.exact and criterion.against is None and exact in JUDGED
    return criterion.model_copy(update={"metric": exact}) if in_closed_form else criterion


def _reduce(experiment: Experiment, name: str, criterion: Criterion) -> Experiment:
    """The experiment with this criterion alone, the configurations it is about, and only what it uses measured."""
    names = {*choose_judged(criterion, experiment.configurations), criterion.against}
    measure: dict[str, Any] = {"exact": criterion.metric.endswith("_exact"), "by": ()}
    changes: dict[str, Any] = {"sweep": None, "show": None, "criteria": {name: criterion}}
    changes["configurations"] = {one: of for one, of in experiment.configurations.items() if one in names}
    if criterion.metric in JUDGED:
        measure |= {"accuracy": False, "metrics": ()}
        if JUDGED[criterion.metric].rows in ("detected", "exact"):
            measure["conflict"] = changes["braking"] = None
    return experiment.model_copy(update=changes | {"measure": experiment.measure.model_copy(update=measure)})


def _check_used(study: LoadedStudy, key: FreeKey, names: Sequence[str]) -> None:
    """Raises InputError where rows of none of these configurations depend on a key."""
    ends = [set_values(study.experiment, [key], [value]) for value in (key.values[0], key.values[-1])]
    users = list[str]()
    for log in study.logs:
        one, other = (resolve_for_log(end, log.scene.log) for end in ends)
        users += [c for c in one.configurations if write_recipe(one, c, {}, None) != write_recipe(other, c, {}, None)]
    if not {*users} & {*names}:
        found = f"one of {name_first(list(dict.fromkeys(users)), 5)}" if users else "one that none uses"
        used = f"used by {name_first(names, 5)}, which the criterion is about"
        raise InputError(f"free {key.name}: expected a key {used}, found {found}")


def _search(
    study: LoadedStudy, keys: Sequence[FreeKey], jobs: int | None, cache: PartCache, progress: Progress | None
) -> tuple[tuple[Trial, ...], Int]:
    """The trials of a study at values of its keys, ascending, and the levels (how good) at all values."""
    trials: dict[_Index, Trial] = {}
    ready: Sequence[Replay] = ()

    def find_level(index: _Index) -> int:
        nonlocal ready
        values = tuple(key.values[k] for key, k in zip(keys, index, strict=True))
        tried_study = replace(study, experiment=set_values(study.experiment, keys, values))
        if not ready or {key.key[0] for key in keys} & {"pems", "units"}:
            ready = prepare_study(tried_study)[0]
        results = Results(study=replay_study(tried_study, ready, jobs, None, cache))
        trials[index] = Trial(values, judge_results(results, tried_study.experiment.criteria).all)
        if progress is not None:
            progress(len(trials), max(_FORESEEN[len(keys)], len(trials) + 1))
        return trials[index].level

    levels = _search_grid(tuple(len(key.values) for key in keys), find_level)
    return tuple(trials[index] for index in sorted(trials)), levels


def _search_grid(shape: _Index, level_of: Callable[[_Index], int]) -> Int:
    """The levels (*shape) on a grid of one dimension or two; `level_of` is asked of few of its points, once each.

    Blocks whose corners differ are halved, in one dimension a bisection; what is alike at all corners is taken to be
    alike between them.
    """
    level_by_index: dict[_Index, int] = {}

    def find(index: _Index) -> int:
        if index not in level_by_index:
            level_by_index[index] = level_of(index)
        return level_by_index[index]

    places = (np.linspace(0, number - 1, min(_FIRST[len(shape)], number)) for number in shape)
    first_ticks = [sorted(set(map(round, of))) for of in places]
    for index in product(*first_ticks):
        find(index)
    levels = np.zeros(shape, dtype=int)
    blocks = list(product(*map(pairwise, first_ticks)))
    while blocks:
        block = blocks.pop(0)
        corners = list(product(*block))
        differs = [
            any(find(index) != find((*index[:axis], ends[1], *index[axis + 1 :])) for index in corners)
            for axis, ends in enumerate(block)
        ]
        parts = [
            [(a, (a + b) // 2), ((a + b) // 2, b)] if differ and b - a > 1 else [(a, b)]
            for differ, (a, b) in zip(differs, block, strict=True)
        ]
        if any(len(part) > 1 for part in parts):
            blocks += product(*parts)
            continue
        for index in corners:
            along = zip(index, differs, block, strict=True)
            levels[tuple(slice(k, k + 1) if differ else slice(a, b + 1) for k, differ, (a, b) in along)] = find(index)
    for index, level in level_by_index.items():
        levels[index] = level
    return levels
