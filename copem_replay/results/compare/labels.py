"""What configurations are called across results folders, and which are meant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from copem_replay.core.errors import InputError
from copem_replay.core.text import unknown
from copem_replay.results.compare.ideals import ideals

if TYPE_CHECKING:
    from copem_replay.results.read import Results

DEFAULT_BASELINE = "ideal"
"""With this configuration the others are compared, if there is one and nothing else is said."""


@dataclass(frozen=True, eq=False)
class Named:
    """A configuration of a folder, and what it is called: its name, with the folder's where that is not enough."""

    results: Results
    configuration: str
    label: str

    def is_meant_by(self, name: str) -> bool:
        """Whether a name stands for it (and perhaps for others, too)."""
        return name in (self.label, self.configuration, f"{self.results.name}:{self.configuration}")


def named(folders: Sequence[Results]) -> list[Named]:
    """All configurations of all folders, each by a label of its own."""
    found = [Named(folder, name, name) for folder in folders for name in _configurations(folder)]
    for prefix in (lambda folder: folder.name, lambda folder: str(folder.folder)):
        times = Counter(one.label for one in found)
        found = [
            replace(one, label=f"{prefix(one.results)}:{one.configuration}") if times[one.label] > 1 else one
            for one in found
        ]
    return found


def _configurations(results: Results) -> list[str]:
    """Names of the configurations that have rows, in their order."""
    return list(results.by_log["detections.parquet"].configurations)


def chosen(known: Sequence[Named], configurations: Sequence[str] | None, baseline: str | None) -> tuple[Named, ...]:
    """The baseline, then the configurations to compare with it, each once. Raises InputError.

    By default the baseline is `ideal`, else the only ideal fusion of the inputs of a recorded output. A name that
    several folders have stands for all of them; as a baseline it has to be one.
    """
    labels = [one.label for one in known]
    against = _baseline(known, labels, baseline)
    wanted: list[Named] = list(known) if configurations is None else []
    problems = []
    for name in configurations or ():
        meant = _meant(known, name)
        wanted += meant
        if not meant:
            problems.append(f"--configurations: {unknown('configuration', name, labels)}")
    if problems:
        raise InputError(problems)
    others = [one for one in dict.fromkeys(wanted) if one is not against]
    if not others:
        raise InputError(f"compare: expected a configuration beside the baseline {against.label}, found none")
    return against, *others


def _meant(known: Sequence[Named], name: str) -> list[Named]:
    return [one for one in known if one.label == name] or [one for one in known if one.is_meant_by(name)]


def _baseline(known: Sequence[Named], labels: Sequence[str], name: str | None) -> Named:
    meant = _meant(known, DEFAULT_BASELINE if name is None else name)
    if not meant and name is None:
        meant = [one for one in known if one.configuration in ideals(one.results).values()]
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
    raise InputError(f"--baseline: {unknown('configuration', name, labels)}")
