"""What results must have in common to be compared: the recordings, the random numbers, and what is measured how."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from copem_replay.core.errors import InputError
from copem_replay.results.compare.same_drive import by_truth, log_keys

if TYPE_CHECKING:
    from copem_replay.results.read import Results

_MEASURE = ("objects", "onset", "count_earlier", "confirm", "match", "distance_to", "horizon_s", "gospa", "annotated")
"""Keys of `measure` that the compared metrics depend on."""


def check_comparable(folders: Sequence[Results]) -> None:
    """Raise InputError, a line for every reason why a folder cannot be compared with the first."""
    problems = [problem for other in folders[1:] for problem in _problems(folders[0], other)]
    if problems:
        raise InputError(problems)


def _problems(first: Results, other: Results) -> Iterator[str]:
    before, after = first.provenance, other.provenance
    other_logs = list(_logs(first, other))
    if before.window_s == after.window_s:  # else their truths differ for that reason alone, perhaps
        yield from other_logs
    for key in ("seed", "window_s", "max_gap_s"):
        yield from _differs(first, other, key, getattr(before, key), getattr(after, key))
    # As written: the ego that `null` stands for is in the logs.
    if other_logs or not by_truth(first, other):  # whose truths are the same have the same ego
        yield from _differs(first, other, "ego", first.source.data.get("ego"), other.source.data.get("ego"))
    for key in _MEASURE:
        yield from _differs(first, other, f"measure.{key}", before.measure.get(key), after.measure.get(key))
    onset = before.measure.get("onset")
    if isinstance(onset, dict) and str(onset.get("kind")).startswith("line_of_sight"):
        yield from _differs(first, other, "visibility", before.visibility, after.visibility)
    if before.braking is not None and after.braking is not None:
        yield from _differs(first, other, "braking", before.braking, after.braking)
        if before.braking.get("brakes_for") == after.braking.get("brakes_for") == "conflict":
            of = "measure.conflict"
            yield from _differs(first, other, of, before.measure.get("conflict"), after.measure.get("conflict"))


def _differs(first: Results, other: Results, key: str, expected: object, found: object) -> Iterator[str]:
    if expected != found:
        yield f"{other.folder}: {key}: expected {_brief(expected)} as in {first.folder}, found {_brief(found)}"


def _brief(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


def _logs(first: Results, other: Results) -> Iterator[str]:
    """Other drives; or, where only files tell them, the same by another name or another truth."""
    known = by_truth(first, other)
    expected, found = ({key: log.name for key, log in keys.items()} for keys in log_keys(first, other))
    missing, more = ([a[sha] for sha in a if sha not in b] for a, b in ((expected, found), (found, expected)))
    if missing or more:
        lacks = [f"{', '.join(missing)} missing"] if missing else []
        other_ones = [f"{', '.join(more)} of {'another truth' if known else 'other content (SHA-256)'}"] if more else []
        yield f"{other.folder}: expected the logs of {first.folder}, found {' and '.join(lacks + other_ones)}"
        return
    if known:
        return
    names, other_names = (sorted(log.name for log in folder.provenance.logs) for folder in (first, other))
    if names != other_names or expected != found:
        yield (
            f"{other.folder}: expected the logs to be named as in {first.folder}, {', '.join(names)}, found "
            f"{', '.join(other_names)}: draws are by the log's name"
        )
        return
    topics, other_topics = ({log.name: log.topic for log in folder.provenance.logs} for folder in (first, other))
    for name, topic in topics.items():
        yield from _differs(first, other, f"log {name}: topic", topic, other_topics[name])
