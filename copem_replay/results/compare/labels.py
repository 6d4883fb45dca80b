"""Labels: names of configurations and logs across results folders, and the choice of the baseline.

Logs of one drive match by their truth, so that recordings that differ in all else are paired. Random numbers are
addressed by the log's name: where names differ, only configurations without random draws can be paired.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from copem_replay.core.errors import InputError, unknown_name_message

if TYPE_CHECKING:
    from copem_replay.results.read import Results
    from copem_replay.results.schema import RecordedLog


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
    copy = replace(results, provenance=replace(results.provenance, logs=logs))
    vars(copy)["by_log"] = {name: rows.renamed(to) for name, rows in results.by_log.items()}
    return copy


def check_log_names(
    against: LabelledConfiguration, others: Sequence[LabelledConfiguration], names: Mapping[Results, Mapping[str, str]]
) -> None:
    """Raise InputError, a line for every log of another name, where random draws are compared."""
    problems: list[str] = []
    for one in others:
        mine, theirs = names.get(one.results, {}), names.get(against.results, {})
        if mine == theirs or (_is_same_in_every_run(one) and _is_same_in_every_run(against)):
            continue
        for log in sorted({*mine, *theirs}):
            found, expected = mine.get(log, log), theirs.get(log, log)
            problem = (
                f"{one.results.folder}: log {found}: expected the name {expected} as in {against.results.folder}, for "
                f"what is drawn depends on it; run it again with `logs: [{{file: …, name: {expected}}}]`"
            )
            problems += [] if found == expected or problem in problems else [problem]
    if problems:
        raise InputError(problems)


def _is_same_in_every_run(one: LabelledConfiguration) -> bool:
    fixed = one.results.fixed
    if one.results.provenance.braking is not None and not fixed.passes(one.configuration):
        return False
    return fixed.known(one.configuration)


def notes_on_differences(folders: Sequence[Results], names: Mapping[Results, Mapping[str, str]]) -> Iterator[str]:
    """A note per folder on its differences to the first one: recordings, versions, keys, rates."""
    for other in folders[1:]:
        differences = list(_describe_differences(folders[0], other, names))
        if differences:
            more = f"; and {len(differences) - _SHOWN} more" if len(differences) > _SHOWN else ""
            yield f"{other.folder} differs from {folders[0].folder} in {'; '.join(differences[:_SHOWN])}{more}"


def _describe_differences(first: Results, other: Results, names: Mapping[Results, Mapping[str, str]]) -> Iterator[str]:
    mine, theirs = log_keys(first, other)
    for key in mine:
        log, other_log = mine[key], theirs[key]
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
    if not (results.folder / "summary.csv").is_file():
        return {}
    rates = results.summary.set_index("configuration")["list_rate_hz"].dropna()
    return {str(name): float(rate) for name, rate in rates.items()}


# The ideal of a recorded output, to which its regret is: ideal fusion of its inputs.


def find_ideals(results: Results) -> dict[str, str | None]:
    """By recorded output its ideal; None: it has no `inputs`, or no configuration is their ideal fusion."""
    configurations = results.source.data.get("configurations") or {}
    settings_of = {str(name): settings for name, settings in configurations.items() if isinstance(settings, dict)}
    return {
        name: next(
            (other for other, candidate in settings_of.items() if _is_ideal_over(candidate, settings.get("inputs"))),
            None,
        )
        for name, settings in settings_of.items()
        if settings.get("recorded")
    }


def _is_ideal_over(configuration: dict[str, Any], inputs: object) -> bool:
    units, fusion = configuration.get("units"), configuration.get("fusion") or {}
    return (
        isinstance(units, list)
        and isinstance(inputs, list)
        and set(map(str, units)) == set(map(str, inputs))
        and {"kind": "ideal", "combine": "samples"} | fusion == {"kind": "ideal", "combine": "samples"}
        and not configuration.get("latency_s")
        and not configuration.get("link")
        and not configuration.get("issue_hz")
    )


def notes_on_output_baseline(baseline: LabelledConfiguration, others: Sequence[LabelledConfiguration]) -> Iterator[str]:
    """Notes on recorded outputs whose difference to the baseline is no regret."""
    for one in others:
        of_folder = find_ideals(one.results)
        if one.configuration not in of_folder:
            continue
        ideal = of_folder[one.configuration]
        if ideal is None:
            yield f"{one.label}: no regret, for it has no `inputs`: only a difference to {baseline.label}"
        elif baseline.configuration != ideal:
            yield f"{one.label}: its regret is to {ideal}, ideal fusion of its inputs (--baseline {ideal})"


# Labels, and the configurations that are meant.

DEFAULT_BASELINE = "ideal"
"""The baseline where none is given and a configuration has this name."""


@dataclass(frozen=True, eq=False)
class LabelledConfiguration:
    """A configuration of a folder with its label: its name, with the folder's where several have that name."""

    results: Results
    configuration: str
    label: str

    def is_meant_by(self, name: str) -> bool:
        """Whether a name stands for it, and perhaps for others."""
        return name in (self.label, self.configuration, f"{self.results.name}:{self.configuration}")


def label_configurations(folders: Sequence[Results]) -> list[LabelledConfiguration]:
    """All configurations of all folders, each by a label of its own."""
    labelled = [
        LabelledConfiguration(folder, name, name) for folder in folders for name in _configuration_names(folder)
    ]
    for prefix in (lambda folder: folder.name, lambda folder: str(folder.folder)):
        times = Counter(one.label for one in labelled)
        labelled = [
            replace(one, label=f"{prefix(one.results)}:{one.configuration}") if times[one.label] > 1 else one
            for one in labelled
        ]
    return labelled


def _configuration_names(results: Results) -> list[str]:
    """Names of the configurations that have rows, in their order."""
    return list(results.by_log["detections.parquet"].configurations)


def choose_configurations(
    known: Sequence[LabelledConfiguration], configurations: Sequence[str] | None, baseline: str | None
) -> tuple[LabelledConfiguration, ...]:
    """The baseline, then the configurations to compare with it, each once. Raises InputError.

    By default the baseline is `ideal`, else the only ideal fusion of the inputs of a recorded output. A name that
    several folders have stands for all of them; as a baseline it has to be one.
    """
    labels = [one.label for one in known]
    against = _find_baseline(known, labels, baseline)
    wanted: list[LabelledConfiguration] = list(known) if configurations is None else []
    problems = []
    for name in configurations or ():
        meant = _find_meant(known, name)
        wanted += meant
        if not meant:
            problems.append(f"--configurations: {unknown_name_message('configuration', name, labels)}")
    if problems:
        raise InputError(problems)
    others = [one for one in dict.fromkeys(wanted) if one is not against]
    if not others:
        raise InputError(f"compare: expected a configuration beside the baseline {against.label}, found none")
    return against, *others


def _find_meant(known: Sequence[LabelledConfiguration], name: str) -> list[LabelledConfiguration]:
    return [one for one in known if one.label == name] or [one for one in known if one.is_meant_by(name)]


def _find_baseline(
    known: Sequence[LabelledConfiguration], labels: Sequence[str], name: str | None
) -> LabelledConfiguration:
    meant = _find_meant(known, DEFAULT_BASELINE if name is None else name)
    if not meant and name is None:
        meant = [one for one in known if one.configuration in find_ideals(one.results).values()]
    if len(meant) == 1:
        return meant[0]
    if meant:
        several = ", ".join(one.label for one in meant)
        raise InputError(f"--baseline: expected one of {several}, found {meant[0].configuration}, which may be any")
    if name is None:
        raise InputError(
            f"--baseline: expected a configuration to compare with, as none is named {DEFAULT_BASELINE}; "
            f"there are {', '.join(labels)}"
        )
    raise InputError(f"--baseline: {unknown_name_message('configuration', name, labels)}")
