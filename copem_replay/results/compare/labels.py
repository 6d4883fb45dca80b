"""Labels: names of configurations and logs across results folders, what these must have in common, and the baseline.

Logs of one drive match by their truth, so that recordings that differ in all else are paired. Random numbers are
addressed by the log's name: where names differ, only configurations without random draws can be paired.
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


def log_keys(first: Results, other: Results) -> tuple[dict[str, RecordedLog], dict[str, RecordedLog]]:
    """The logs of two folders by the digest of their truth; by that of the file where a truth is unknown or there
    twice.
    """
    folders = first.provenance.logs, other.provenance.logs
    truths = [[log.truth for log in logs] for logs in folders]
    if all(None not in of and len(set(of)) == len(of) for of in truths):
        return tuple({str(log.truth): log for log in logs} for logs in folders)  # type: ignore[return-value]
    return tuple({log.sha256: log for log in logs} for logs in folders)  # type: ignore[return-value]


def logs_match_by_truth(first: Results, other: Results) -> bool:
    """Whether the logs of two folders match by their truth."""
    return all(log.truth in keys for keys in log_keys(first, other) for log in keys.values())


def rename_logs(folders: Sequence[Results]) -> tuple[list[Results], dict[Results, dict[str, str]]]:
    """The folders with logs named as in the first one; by folder the old names of renamed logs, by their new names."""
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


def check_log_names(
    against: LabelledConfiguration, others: Sequence[LabelledConfiguration], names: Mapping[Results, Mapping[str, str]]
) -> None:
    """Raise InputError, a line for every log of another name, where random draws are compared."""
    problems: list[str] = []
    for labelled in others:
        own_names, theirs = names.get(labelled.results, {}), names.get(against.results, {})
        if own_names == theirs or (_is_same_in_every_run(labelled) and _is_same_in_every_run(against)):
            continue
        for log in sorted({*own_names, *theirs}):
            found, expected = own_names.get(log, log), theirs.get(log, log)
            problem = (
                f"{labelled.results.place}: log {found}: expected the name {expected} as in "
                f"{against.results.place}, for what is drawn depends on it; run it again with "
                f"`logs: [{{file: …, name: {expected}}}]`"
            )
            problems += [] if found == expected or problem in problems else [problem]
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
    own_names, theirs = log_keys(first, other)
    for key in own_names:
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
    for part in ("pems", "units", "obstacles", "configurations"):
        yield from _compare_keys(part, first.source.data.get(part), other.source.data.get(part))
    before, after = _rates_by_configuration(first), _rates_by_configuration(other)
    for name in before:
        if name in after and f"{before[name]:.4g}" != f"{after[name]:.4g}":
            yield f"list_rate_hz of {name} ({before[name]:.4g}, {after[name]:.4g})"


def _compare_keys(where: str, before: Any, after: Any) -> Iterator[str]:
    """Values that differ; below the first level also keys that only one has."""
    if isinstance(before, dict) and isinstance(after, dict):
        alone = "." in where  # a unit or configuration that only one has is no difference of those that both have
        for key in dict.fromkeys([*before, *after]):
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
    "objects",
    "onset",
    "began",
    "count_earlier",
    "confirm",
    "match",
    "distance_to",
    "gospa",
    "annotated",
    "weigh",
)
"""Keys of `measure` that the compared metrics depend on."""


def check_comparable(folders: Sequence[Results]) -> None:
    """Raise InputError, a line for every reason why a folder cannot be compared with the first."""
    problems = [problem for other in folders[1:] for problem in _find_problems(folders[0], other)]
    if problems:
        raise InputError(problems)


def _find_problems(first: Results, other: Results) -> Iterator[str]:
    before, after = first.provenance, other.provenance
    other_logs = list(_compare_logs(first, other))
    if before.window_s == after.window_s:  # else their truths may differ for that reason alone
        yield from other_logs
    for key in ("seed", "window_s", "max_gap_s"):
        yield from _describe_mismatch(first, other, key, getattr(before, key), getattr(after, key))
    # As written, for the ego that `null` stands for is in the logs.
    if other_logs or not logs_match_by_truth(first, other):  # equal truths have the same ego
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


def _describe_mismatch(first: Results, other: Results, key: str, expected: object, found: object) -> Iterator[str]:
    if expected != found:
        yield (
            f"{other.place}: {key}: expected {_shorten_value(expected)} as in {first.place}, found "
            f"{_shorten_value(found)}"
        )


def _shorten_value(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _compare_logs(first: Results, other: Results) -> Iterator[str]:
    """Problems of the logs: other drives; where logs match by file only, other names or topics too."""
    by_truth = logs_match_by_truth(first, other)
    expected, found = ({key: log.name for key, log in keys.items()} for keys in log_keys(first, other))
    missing, more = ([a[sha] for sha in a if sha not in b] for a, b in ((expected, found), (found, expected)))
    if missing or more:
        lacks = [f"{', '.join(missing)} missing"] if missing else []
        other_ones = (
            [f"{', '.join(more)} of {'another truth' if by_truth else 'other content (SHA-256)'}"] if more else []
        )
        yield f"{other.place}: expected the logs of {first.place}, found {' and '.join(lacks + other_ones)}"
        return
    if by_truth:
        return
    names, other_names = (sorted(log.name for log in folder.provenance.logs) for folder in (first, other))
    if names != other_names or expected != found:
        yield (
            f"{other.place}: expected the logs to be named as in {first.place}, {', '.join(names)}, found "
            f"{', '.join(other_names)}: draws are by the log's name"
        )
        return
    topics, other_topics = ({log.name: log.topic for log in folder.provenance.logs} for folder in (first, other))
    for name, topic in topics.items():
        yield from _describe_mismatch(first, other, f"log {name}: topic", topic, other_topics[name])


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
    """The baseline of an experiment where none is asked for. `why`: in words; `rank`: 0 by name, 1 the ideal of the
    same inputs, 2 the first.
    """

    rank: int
    name: str
    why: str


def find_baseline(facts: Mapping[str, ConfigurationFacts], names: Sequence[str]) -> Baseline:
    """The baseline among `names`, configurations of an experiment: one rule for all commands.

    It is the configuration named `ideal`; else the ideal of the first configuration that fuses otherwise and has one;
    else the first that is not the truth.
    """
    if IDEAL_NAME in names:
        return Baseline(0, IDEAL_NAME, "by its name")
    for name in names:
        if (ideal := facts[name].ideal) in names:
            return Baseline(1, str(ideal), f"ideal fusion of the {facts[name].ideal_of} of {name}")
    fused = [name for name in names if not facts[name].truth]
    return Baseline(2, fused[0], "the first that is not the truth") if fused else Baseline(2, names[0], "the first")


def find_alone(results: Results, names: Sequence[str]) -> str | None:
    """Of `names` the configuration of the car alone: units on the ego only; a real fusion rather than an ideal one.

    Where no unit is on the ego it is the best with one unit. None: there is none.
    """
    experiment = results.experiment
    on_ego = {unit for unit, of in experiment.units.items() if of.on == "ego"}
    units_of = {name: set(experiment.units_of(experiment.configurations[name])) for name in names}
    if on_ego:
        own = [name for name, units in units_of.items() if units and units <= on_ego]
        return next(iter([*(name for name in own if not results.facts[name].by_truth_id), *own]), None)
    mean_s = results.summary.set_index("configuration")["ttd_rmst_s"].astype(float)
    own = [name for name, units in units_of.items() if len(units) == 1 and not np.isnan(mean_s[name])]
    return min(own, key=lambda name: mean_s[name], default=None)


def notes_on_output_baseline(baseline: LabelledConfiguration, others: Sequence[LabelledConfiguration]) -> Iterator[str]:
    """Notes on recorded outputs whose difference to the baseline is no regret."""
    for labelled in (labelled for labelled in others if labelled.facts.recorded):
        ideal = labelled.facts.ideal
        if labelled.facts.ideal_of != "inputs":
            yield f"{labelled.label}: no regret, for it has no `inputs`: only a difference to {baseline.label}"
        elif baseline.configuration != ideal:
            yield f"{labelled.label}: its regret is to {ideal}, ideal fusion of its inputs (--baseline {ideal})"


def find_remembering(
    known: Sequence[LabelledConfiguration], baseline: LabelledConfiguration, others: Sequence[LabelledConfiguration]
) -> dict[LabelledConfiguration, LabelledConfiguration]:
    """The ideal fusions with memory that accuracy is held against, of configurations that remember.

    Those whose baseline is their own ideal.
    """
    named = {(labelled.results, labelled.configuration): labelled for labelled in known}
    pairs = ((labelled, named.get((labelled.results, str(labelled.facts.remembering)))) for labelled in others)
    own = ((labelled.results, labelled.facts.ideal) for labelled in others)
    is_own = [one == (baseline.results, baseline.configuration) for one in own]
    return {one: other for (one, other), mine in zip(pairs, is_own, strict=True) if mine and other is not None}


def notes_on_remembering(pairs: Mapping[LabelledConfiguration, LabelledConfiguration]) -> Iterator[str]:
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

    def is_meant_by(self, name: str) -> bool:
        """Whether a name stands for it, and perhaps for others."""
        return name in (self.label, self.configuration, f"{self.results.name}:{self.configuration}")


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


def _configuration_names(results: Results) -> list[str]:
    """Names of the configurations that have rows, in their order."""
    return list(results.by_log["detections.parquet"].configurations)


def choose_configurations(
    known: Sequence[LabelledConfiguration], configurations: Sequence[str] | None, baseline: str | None
) -> tuple[LabelledConfiguration, ...]:
    """The baseline, then the configurations to compare with it, each once. Raises InputError.

    `baseline`: None: that of `choose_baseline`. A name that several folders have stands for all of them; as a baseline
    it has to be one.
    """
    labels = [labelled.label for labelled in known]
    against = choose_baseline(known)[0] if baseline is None else _find_named_baseline(known, labels, baseline)
    wanted: list[LabelledConfiguration] = list(known) if configurations is None else []
    problems = []
    for name in configurations or ():
        meant = _find_meant(known, name)
        wanted += meant
        if not meant:
            problems.append(f"--configurations: {unknown_name_message('configuration', name, labels)}")
    if problems:
        raise InputError(problems)
    others = [labelled for labelled in dict.fromkeys(wanted) if labelled is not against]
    if not others:
        raise InputError(f"compare: expected a configuration beside the baseline {against.label}, found none")
    return against, *others


def choose_baseline(known: Sequence[LabelledConfiguration]) -> tuple[LabelledConfiguration, str]:
    """The baseline where none is asked for, and why: by the first clause of `find_baseline` that holds in a folder.

    Where it holds in several folders, that of the first one.
    """
    folders: dict[Results, dict[str, LabelledConfiguration]] = {}
    for labelled in known:
        folders.setdefault(labelled.results, {})[labelled.configuration] = labelled
    found = [(find_baseline(folder.facts, list(those)), those) for folder, those in folders.items()]
    baseline, those = min(found, key=lambda pair: pair[0].rank)
    return those[baseline.name], baseline.why


def _find_meant(known: Sequence[LabelledConfiguration], name: str) -> list[LabelledConfiguration]:
    return [labelled for labelled in known if labelled.label == name] or [
        labelled for labelled in known if labelled.is_meant_by(name)
    ]


def _find_named_baseline(
    known: Sequence[LabelledConfiguration], labels: Sequence[str], name: str
) -> LabelledConfiguration:
    meant = _find_meant(known, name)
    if len(meant) == 1:
        return meant[0]
    if meant:
        several = ", ".join(labelled.label for labelled in meant)
        raise InputError(f"--baseline: expected one of {several}, found {meant[0].configuration}, which may be any")
    raise InputError(f"--baseline: {unknown_name_message('configuration', name, labels)}")
