"""Results of one drive: logs told by their truth, so that recordings that differ in all else are paired.

What is drawn is addressed by the log's name: where names differ only what is not drawn can be paired.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from copem_replay.core.errors import InputError

if TYPE_CHECKING:
    from copem_replay.results.compare.labels import Named
    from copem_replay.results.provenance import LogFile
    from copem_replay.results.read import Results

_SHOWN = 12
"""So many differences of two folders are listed (chosen: what is more is another study)."""


def log_keys(first: Results, other: Results) -> tuple[dict[str, LogFile], dict[str, LogFile]]:
    """The logs of two folders by what tells them: their truth, or the file where that is not known of all, or twice."""
    folders = first.provenance.logs, other.provenance.logs
    truths = [[log.truth for log in logs] for logs in folders]
    if all(None not in of and len(set(of)) == len(of) for of in truths):
        return tuple({str(log.truth): log for log in logs} for logs in folders)  # type: ignore[return-value]
    return tuple({log.sha256: log for log in logs} for logs in folders)  # type: ignore[return-value]


def by_truth(first: Results, other: Results) -> bool:
    """Whether their logs are told by the truth."""
    return all(log.truth in keys for keys in log_keys(first, other) for log in keys.values())


def renamed(folders: Sequence[Results]) -> tuple[list[Results], dict[Results, dict[str, str]]]:
    """The folders with logs named as in the first one, and what was renamed in each, by the first's names."""
    result, names = [folders[0]], {}
    for other in folders[1:]:
        mine, theirs = log_keys(folders[0], other)
        to = {theirs[key].name: mine[key].name for key in theirs if key in mine}
        changed = {new: old for old, new in to.items() if old != new}
        one = _with_names(other, to) if changed else other
        result.append(one)
        names[one] = changed
    return result, names


def _with_names(results: Results, to: Mapping[str, str]) -> Results:
    logs = tuple(replace(log, name=to.get(log.name, log.name)) for log in results.provenance.logs)
    copy = replace(results, provenance=replace(results.provenance, logs=logs))
    vars(copy)["by_log"] = {name: rows.renamed(to) for name, rows in results.by_log.items()}
    return copy


def check_names(against: Named, others: Sequence[Named], names: Mapping[Results, Mapping[str, str]]) -> None:
    """Raise InputError, a line for every log of another name, where what is drawn by it is compared."""
    problems: list[str] = []
    for one in others:
        mine, theirs = names.get(one.results, {}), names.get(against.results, {})
        if mine == theirs or (_same_in_every_run(one) and _same_in_every_run(against)):
            continue
        for log in sorted({*mine, *theirs}):
            found, expected = mine.get(log, log), theirs.get(log, log)
            said = (
                f"{one.results.folder}: log {found}: expected the name {expected} as in {against.results.folder}, for "
                f"what is drawn depends on it; run it again with `logs: [{{file: …, name: {expected}}}]`"
            )
            problems += [] if found == expected or said in problems else [said]
    if problems:
        raise InputError(problems)


def _same_in_every_run(one: Named) -> bool:
    fixed = one.results.fixed
    if one.results.provenance.braking is not None and not fixed.passes(one.configuration):
        return False
    return fixed.known(one.configuration)


def notes_on_differences(folders: Sequence[Results], names: Mapping[Results, Mapping[str, str]]) -> Iterator[str]:
    """What differs between each folder and the first one used: recordings, versions, keys, rates."""
    for other in folders[1:]:
        found = list(_differences(folders[0], other, names))
        if found:
            more = f"; and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
            yield f"{other.folder} differs from {folders[0].folder} in {'; '.join(found[:_SHOWN])}{more}"


def _differences(first: Results, other: Results, names: Mapping[Results, Mapping[str, str]]) -> Iterator[str]:
    mine, theirs = log_keys(first, other)
    for key in mine:
        log, again = mine[key], theirs[key]
        called = [names.get(folder, {}).get(log.name, log.name) for folder in (first, other)]
        if called[0] != called[1]:
            yield f"the name of log {called[0]} ({called[1]})"
        if log.sha256 != again.sha256:
            yield f"the recording of log {log.name} (same truth)"
        if log.topic != again.topic:
            yield f"the topic of its truth ({_pair(log.topic, again.topic)})"
    for name in ("copem_replay", "python"):
        before, after = (folder.provenance.data.get(name) for folder in (first, other))
        if before != after and None not in (before, after):
            yield f"{name} ({_pair(before, after)})"
    for part in ("pems", "units", "obstacles", "configurations"):
        yield from _keys(part, first.source.data.get(part), other.source.data.get(part))
    before, after = _rates(first), _rates(other)
    for name in before:
        if name in after and f"{before[name]:.4g}" != f"{after[name]:.4g}":
            yield f"list_rate_hz of {name} ({before[name]:.4g}, {after[name]:.4g})"


def _keys(where: str, before: Any, after: Any) -> Iterator[str]:
    """Keys that both have, and differ in; at the first level those that only one has say nothing of the others."""
    if isinstance(before, dict) and isinstance(after, dict):
        alone = "." in where  # a unit or configuration that only one has is no difference of those that both have
        for key in dict.fromkeys([*before, *after]):
            if alone or (key in before and key in after):
                yield from _keys(f"{where}.{key}", before.get(key), after.get(key))
    elif before != after:
        yield f"{where} ({_pair(before, after)})"


def _pair(before: object, after: object) -> str:
    texts = (json.dumps(value, ensure_ascii=False).strip('"') for value in (before, after))
    return ", ".join(text if len(text) <= 40 else text[:39] + "…" for text in texts)


def _rates(results: Results) -> dict[str, float]:
    if not (results.folder / "summary.csv").is_file():
        return {}
    rates = results.summary.set_index("configuration")["list_rate_hz"].dropna()
    return {str(name): float(rate) for name, rate in rates.items()}
