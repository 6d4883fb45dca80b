"""Labels: names of configurations and logs across results folders, what these must have in common, and the baselines.

Configurations of one folder are held against one baseline, those of several folders each against itself in the first
folder. Logs of one drive match by their truth, so that recordings that differ in all else are paired. Random numbers
are addressed by the log's name: where names differ, only configurations without random draws can be paired.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from copem_replay.core.errors import InputError, unknown_name_message
from copem_replay.metrics.columns import COMPARED_FILES
from copem_replay.metrics.summary_metrics import COMPARED

if TYPE_CHECKING:
    from copem_replay.pipeline.expansion import ConfigurationFacts
    from copem_replay.results.provenance import RecordedLog
    from copem_replay.results.read import Results


# Logs of one drive.

_SHOWN = 12
"""Differences of two folders that are listed, at most: with more it is another study."""


def log_keys(first: Results, other: Results) -> tuple[dict[tuple[str, int], RecordedLog], ...]:
    """By name of a log the digest of its truth, and its number among the logs with an equal one."""
    logs_of: list[dict[tuple[str, int], RecordedLog]] = []
    for folder in (first, other):
        times = Counter[str]()
        logs_of.append({})
        for log in sorted(folder.provenance.logs, key=lambda log: log.name):
            logs_of[-1][log.truth, times[log.truth]] = log
            times[log.truth] += 1
    return tuple(logs_of)


def rename_logs(folders: Sequence[Results]) -> tuple[list[Results], dict[Results, dict[str, str]]]:
    """The folders with logs named as in the first; and by folder the old names of renamed logs, by new name."""
    renamed, names = [folders[0]], {}
    for other in folders[1:]:
        first, second = log_keys(folders[0], other)
        new_names = {second[key].name: first[key].name for key in second if key in first}
        changed = {new: old for old, new in new_names.items() if old != new}
        folder = _replace_log_names(other, new_names) if changed else other
        renamed.append(folder)
        names[folder] = changed
    return renamed, names


def _replace_log_names(results: Results, to: Mapping[str, str]) -> Results:
    logs = tuple(replace(log, name=to.get(log.name, log.name)) for log in results.provenance.logs)
    renamed, by_log = copy(results), {name: rows.renamed(to) for name, rows in results.by_log.items()}
    vars(renamed).update(provenance=replace(results.provenance, logs=logs), by_log=by_log)
    return renamed


def check_log_names(pairs: Pairs, names: Mapping[Results, Mapping[str, str]]) -> None:
    """Raise InputError, a line for every log of another name, where random draws are compared."""
    problems: list[str] = []
    for labelled, baseline in pairs.items():
        own_names, theirs = names.get(labelled.results, {}), names.get(baseline.results, {})
        if own_names == theirs or (_is_same_in_every_run(labelled) and _is_same_in_every_run(baseline)):
            continue
        for log in sorted({*own_names, *theirs}):
            name, expected = own_names.get(log, log), theirs.get(log, log)
            problem = (
                f"{labelled.results.place}: log {name}: expected the name {expected} as in "
                f"{baseline.results.place}, for what is drawn depends on it; run it again with "
                f"`logs: [{{file: …, name: {expected}}}]`"
            )
            problems += [] if name == expected or problem in problems else [problem]
    if problems:
        raise InputError(problems)


def _is_same_in_every_run(labelled: LabelledConfiguration) -> bool:
    with_verdicts = labelled.results.provenance.braking is not None
    return labelled.facts.fixed_verdicts if with_verdicts else labelled.facts.fixed


def notes_on_differences(folders: Sequence[Results], names: Mapping[Results, Mapping[str, str]]) -> Iterator[str]:
    """A note per folder on its differences to the first one: recordings, versions, keys, rates."""
    for other in folders[1:]:
        differences = list(_describe_differences(folders[0], other, names))
        if differences:
            more = f"; and {len(differences) - _SHOWN} more" if len(differences) > _SHOWN else ""
            yield f"{other.place} differs from {folders[0].place} in {'; '.join(differences[:_SHOWN])}{more}"


def _describe_differences(first: Results, other: Results, names: Mapping[Results, Mapping[str, str]]) -> Iterator[str]:
    """Each difference that does not prevent a comparison: log names, recordings, versions, models, list rates."""
    own_names, theirs = log_keys(first, other)
    for key in sorted(own_names, key=lambda key: own_names[key].name):
        log, other_log = own_names[key], theirs[key]
        names_of_log = [names.get(folder, {}).get(log.name, log.name) for folder in (first, other)]
        if names_of_log[0] != names_of_log[1]:
            yield f"the name of log {names_of_log[0]} ({names_of_log[1]})"
        if log.sha256 != other_log.sha256:
            yield f"the recording of log {log.name} (same truth)"
        if log.topic != other_log.topic:
            yield f"the topic of its truth ({_format_pair(log.topic, other_log.topic)})"
    for name in ("copem_replay", "python"):
        before, after = (folder.provenance.data.get(name) for folder in (first, other))
        if before != after and None not in (before, after):
            yield f"{name} ({_format_pair(before, after)})"
    for part in ("pems", "units", "obstacles", "links", "configurations"):
        yield from _compare_keys(part, first.source.data.get(part), other.source.data.get(part))
    before, after = _rates_by_configuration(first), _rates_by_configuration(other)
    for name in before:
        if name in after and f"{before[name]:.4g}" != f"{after[name]:.4g}":
            yield f"list_rate_hz of {name} ({before[name]:.4g}, {after[name]:.4g})"


def _compare_keys(where: str, before: Any, after: Any) -> Iterator[str]:
    """`key (before, after)` of values that differ; of models of two kinds only `kind`, of new keys only deep ones."""
    lists = isinstance(before, list) and isinstance(after, list) and len(before) == len(after)
    if lists and all(isinstance(value, dict) for value in (*before, *after)):
        before, after = dict(enumerate(before)), dict(enumerate(after))
    if isinstance(before, dict) and isinstance(after, dict):
        alone = "." in where  # a unit or configuration that only one has is no difference of those that both have
        kinds = before.get("kind") != after.get("kind")
        for key in ["kind"] if kinds else dict.fromkeys([*before, *after]):
            if alone or (key in before and key in after):
                yield from _compare_keys(f"{where}.{key}", before.get(key), after.get(key))
    elif before != after:
        yield f"{where} ({_format_pair(before, after)})"


def _format_pair(before: object, after: object) -> str:
    texts = (json.dumps(value, ensure_ascii=False).strip('"') for value in (before, after))
    return ", ".join(text if len(text) <= 40 else text[:39] + "…" for text in texts)


def _rates_by_configuration(results: Results) -> dict[str, float]:
    if not results.has("summary.csv"):
        return {}
    rates = results.summary.set_index("configuration")["list_rate_hz"].dropna()
    return {str(name): float(rate) for name, rate in rates.items()}


# What folders must have in common to be compared.

_MEASURE = (
    "objects", "onset", "began", "count_earlier", "confirm", "match", "distance_to", "gospa", "annotated", "weigh",
)  # fmt: skip
"""Keys of `measure` that the compared metrics depend on."""


def check_comparable(folders: Sequence[Results]) -> None:
    """Raise InputError, a line for every reason why a folder cannot be compared with the first."""
    problems = [problem for other in folders[1:] for problem in _find_problems(folders[0], other)]
    if problems:
        raise InputError(problems)


def _find_problems(first: Results, other: Results) -> Iterator[str]:
    """A line for each difference that prevents a comparison: truth, seed, window, ego, measures, driver."""
    before, after = first.provenance, other.provenance
    other_logs = list(_compare_logs(first, other))
    if before.window_s == after.window_s:  # else their truths may differ for that reason alone
        yield from other_logs
    for key in ("seed", "window_s", "max_gap_s"):
        yield from _describe_mismatch(first, other, key, getattr(before, key), getattr(after, key))
    # As written, for the ego that `null` stands for is in the logs.
    if other_logs:  # equal truths have the same ego
        yield from _describe_mismatch(first, other, "ego", first.source.data.get("ego"), other.source.data.get("ego"))
    for key in _MEASURE:
        yield from _describe_mismatch(first, other, f"measure.{key}", before.measure.get(key), after.measure.get(key))
    if any(of.needs_visibility for of in first.facts.values()):
        yield from _describe_mismatch(first, other, "visibility", before.visibility, after.visibility)
    if before.braking is not None and after.braking is not None:
        yield from _describe_mismatch(first, other, "braking", before.braking, after.braking)
        if before.braking.get("brakes_for") == after.braking.get("brakes_for") == "conflict":
            conflicts = before.measure.get("conflict"), after.measure.get("conflict")
            yield from _describe_mismatch(first, other, "measure.conflict", *conflicts)


def _describe_mismatch(first: Results, other: Results, key: str, expected: object, actual: object) -> Iterator[str]:
    if expected != actual:
        yield (
            f"{other.place}: {key}: expected {json.dumps(expected, ensure_ascii=False)} as in {first.place}, found "
            f"{json.dumps(actual, ensure_ascii=False)}"
        )


def _compare_logs(first: Results, other: Results) -> Iterator[str]:
    """A problem where the logs are of other drives."""
    expected, found = log_keys(first, other)
    missing = sorted(expected[key].name for key in expected if key not in found)
    more = sorted(found[key].name for key in found if key not in expected)
    says = [f"{', '.join(missing)} missing"] * bool(missing) + [f"{', '.join(more)} of another truth"] * bool(more)
    if says:
        yield f"{other.place}: expected the logs of {first.place}, found {' and '.join(says)}"


def notes_on_folders(folders: Sequence[Results]) -> Iterator[str]:
    """Notes on folders that have other numbers of runs, or lack tables or braking."""
    runs = {str(folder.place): folder.provenance.runs for folder in folders}
    of_lists_first = sorted(COMPARED.values(), key=lambda metric: metric.part != "lists")
    if len(set(runs.values())) > 1:
        has = ", ".join(f"{path} {count}" for path, count in runs.items())
        yield f"other numbers of runs ({has}): the first {min(runs.values())} are compared"
    for folder in folders:
        missing = [name for name in COMPARED_FILES if name not in folder.by_log]
        asked = "needless_s" in folder.provenance.kinds("lists.parquet")
        compared = (m for m in of_lists_first if m.compared and (m.part != "needless" or asked))
        metrics = [m.name for m in compared if m.compared and {*m.compared.files} & {*missing}]
        if metrics:
            yield (
                f"{folder.place}: no {', '.join(missing)} (without accuracy, or of "
                f"an older version): not compared: {', '.join(metrics)}"
            )
    with_braking = [folder for folder in folders if folder.provenance.braking is not None]
    if with_braking and len(with_braking) < len(folders):
        without = ", ".join(str(folder.place) for folder in folders if folder.provenance.braking is None)
        yield f"{without}: no braking: pass_share is compared only among those that have it"


# The baseline where none is asked for.

IDEAL_NAME = "ideal"
"""A configuration of this name is the baseline where none is asked for."""


class Baseline(NamedTuple):
    """The default baseline of an experiment. `why`: the reason in words."""

    name: str
    why: str


def find_baseline(facts: Mapping[str, ConfigurationFacts], names: Sequence[str]) -> Baseline:
    """The baseline among `names`, configurations of an experiment: one rule for all commands.

    It is the configuration named `ideal`; else the ideal of the first configuration that fuses otherwise and has one;
    else the first that is not the truth.
    """
    if IDEAL_NAME in names:
        return Baseline(IDEAL_NAME, "by its name")
    for name in names:
        if (ideal := facts[name].ideal) in names:
            return Baseline(str(ideal), f"ideal fusion of the {facts[name].ideal_of} of {name}")
    fused = [name for name in names if not facts[name].truth]
    return Baseline(fused[0], "the first that is not the truth") if fused else Baseline(names[0], "the first")


def find_alone(results: Results, names: Sequence[str]) -> str | None:
    """The configuration of the car alone among `names`: units on the ego only; a real fusion before an ideal one.

    Where no unit is on the ego it is the best with one unit. None: there is none.
    """
    experiment = results.experiment
    on_ego = {unit for unit, of in experiment.units.items() if of.on == "ego"}
    units_of = {name: set(experiment.units_of(experiment.configurations[name])) for name in names}
    if on_ego:
        alone = [name for name, units in units_of.items() if units and units <= on_ego]
        return next(iter([*(name for name in alone if not results.facts[name].by_truth_id), *alone]), None)
    mean_s = results.summary.set_index("configuration")["ttd_rmst_s"].astype(float)
    alone = [name for name, units in units_of.items() if len(units) == 1 and not np.isnan(mean_s[name])]
    return min(alone, key=lambda name: mean_s[name], default=None)


def notes_on_output_baseline(pairs: Pairs) -> Iterator[str]:
    """Notes on recorded outputs whose difference to the baseline is no regret."""
    for labelled, baseline in pairs.items():
        ideal = labelled.facts.ideal
        if not labelled.facts.recorded or labelled.configuration == baseline.configuration:
            continue
        if labelled.facts.ideal_of != "inputs":
            yield f"{labelled.label}: no regret, for it has no `inputs`: only a difference to {baseline.label}"
        elif baseline.configuration != ideal:
            yield f"{labelled.label}: its regret is to {ideal}, ideal fusion of its inputs (--baseline {ideal})"


def find_remembering(known: Sequence[LabelledConfiguration], pairs: Pairs) -> Pairs:
    """By configuration with memory the ideal fusion with memory that its accuracy is compared with.

    Those whose baseline is their own ideal.
    """
    named = {(one.results, one.configuration): one for one in known}
    own = [
        one for one, other in pairs.items() if (one.results, one.facts.ideal) == (other.results, other.configuration)
    ]
    found = {one: named.get((one.results, str(one.facts.remembering))) for one in own}
    return {one: other for one, other in found.items() if other is not None}


def notes_on_remembering(pairs: Pairs) -> Iterator[str]:
    """A note on each ideal fusion with memory that accuracy is held against."""
    for ideal in dict.fromkeys(pairs.values()):
        names = ", ".join(labelled.label for labelled, other in pairs.items() if other == ideal)
        yield f"{names}: accuracy held against {ideal.label}, ideal fusion of the same lists that remembers, too"


# Labels, and the configurations that are meant.


@dataclass(frozen=True, eq=False)
class LabelledConfiguration:
    """A configuration of a folder with its label: its name, with the folder's where several have that name."""

    results: Results
    configuration: str
    label: str

    @property
    def facts(self) -> ConfigurationFacts:
        """What the configuration is."""
        return self.results.facts[self.configuration]


Pairs = Mapping[LabelledConfiguration, LabelledConfiguration]
"""What each configuration is held against."""


def label_configurations(folders: Sequence[Results]) -> list[LabelledConfiguration]:
    """All configurations of all folders, each by a label of its own."""
    labelled = [
        LabelledConfiguration(folder, name, name) for folder in folders for name in _configuration_names(folder)
    ]
    for prefix in (lambda folder: folder.name, lambda folder: str(folder.place)):
        times = Counter(labelled.label for labelled in labelled)
        labelled = [
            replace(labelled, label=f"{prefix(labelled.results)}:{labelled.configuration}")
            if times[labelled.label] > 1
            else labelled
            for labelled in labelled
        ]
    return labelled


def name_folders(folders: Sequence[Results]) -> list[str]:
    """Distinct names of folders, for labels: paths where names are the same."""
    times = Counter(folder.name for folder in folders)
    return [folder.name if times[folder.name] == 1 else str(folder.place) for folder in folders]


def _configuration_names(results: Results) -> list[str]:
    """Names of the configurations that have rows, in their order."""
    return list(results.by_log["detections.parquet"].configurations)


def pair_configurations(
    folders: Sequence[Results], configurations: Sequence[str] | None, baseline: str | None
) -> dict[LabelledConfiguration, LabelledConfiguration]:
    """The configurations to compare, each once, with the baseline of each. Raises InputError.

    `configurations`: names, of which one that several folders have stands for all of them; None: all. `baseline`: a
    name that is one configuration; None: of one folder that of `find_baseline`, of several each against itself in the
    first folder.
    """
    known = label_configurations(folders)
    chosen: list[LabelledConfiguration] = list(known) if configurations is None else []
    problems = []
    for name in configurations or ():
        matching = _find_meant(known, name)
        chosen += matching
        if not matching:
            hint = unknown_name_message("configuration", name, dict.fromkeys(one.configuration for one in known))
            problems.append(f"--configurations: {hint}")
    if problems:
        raise InputError(problems)
    if baseline is None and len(folders) > 1:
        return _pair_with_first(folders, known, chosen)
    if baseline is None:
        baseline = find_baseline(folders[0].facts, [labelled.configuration for labelled in known]).name
    reference = _find_named_baseline(known, baseline)
    others = [labelled for labelled in dict.fromkeys(chosen) if labelled is not reference]
    if not others:
        raise InputError(f"compare: expected a configuration beside the baseline {reference.label}, found none")
    return dict.fromkeys(others, reference)


def _pair_with_first(
    folders: Sequence[Results], known: Sequence[LabelledConfiguration], chosen: Sequence[LabelledConfiguration]
) -> dict[LabelledConfiguration, LabelledConfiguration]:
    """Each chosen configuration of a later folder → its namesake in the first. Raises InputError: there is none."""
    in_first = {labelled.configuration: labelled for labelled in known if labelled.results is folders[0]}
    later = [labelled for labelled in dict.fromkeys(chosen) if labelled.results is not folders[0]]
    pairs = {labelled: in_first[labelled.configuration] for labelled in later if labelled.configuration in in_first}
    if not pairs:
        names = ", ".join(dict.fromkeys(labelled.configuration for labelled in later)) or "none"
        raise InputError(
            f"compare: expected a configuration of {folders[0].place} ({', '.join(in_first)}) in a later folder, found "
            f"{names}; --baseline NAME holds all against one"
        )
    return pairs


def notes_on_missing(folders: Sequence[Results]) -> Iterator[str]:
    """Notes on configurations that only the first folder has, or only a later one."""
    for other in folders[1:]:
        names = [_configuration_names(results) for results in (folders[0], other)]
        for results, own, theirs in zip((folders[0], other), names, names[::-1], strict=True):
            if alone := [name for name in own if name not in theirs]:
                yield f"only in {results.place}, so not compared: {', '.join(alone)}"


def _find_meant(known: Sequence[LabelledConfiguration], name: str) -> list[LabelledConfiguration]:
    """The configuration of this label, else all that have the name, by itself or after their folder's."""
    return [one for one in known if one.label == name] or [
        one for one in known if name in (one.configuration, f"{one.results.name}:{one.configuration}")
    ]


def _find_named_baseline(known: Sequence[LabelledConfiguration], name: str) -> LabelledConfiguration:
    matching = _find_meant(known, name)
    if len(matching) == 1:
        return matching[0]
    if matching:
        several = ", ".join(labelled.label for labelled in matching)
        raise InputError(f"--baseline: expected one of {several}, found {matching[0].configuration}, which may be any")
    hint = unknown_name_message("configuration", name, [labelled.label for labelled in known])
    raise InputError(f"--baseline: {hint}")
