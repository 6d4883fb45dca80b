"""What is the same in every run, because no random number is behind it: an interval over runs would tell nothing.

By kind of unit: the lists of the truth and of recorded units are not drawn, those of a unit with a PEM are (and so is
who carries it), even where its probabilities are 0 or 1. A driver's delay is drawn, but for the `constant` reaction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from copem_replay.core.tracks import TRUTH

NOTHING_DRAWN = "nothing drawn"
"""Why there is no interval over runs: they are all the same."""


@dataclass(frozen=True)
class Fixed:
    """Configurations whose lists are the same in every run; whether the driver's reaction is, too."""

    lists: frozenset[str] = frozenset()
    reaction: bool = False

    def known(self, configuration: str) -> bool:
        """Whether every object is known at the same time in every run."""
        return configuration in self.lists

    def passes(self, configuration: str) -> bool:
        """Whether braking is the same in every run."""
        return self.reaction and configuration in self.lists


def fixed_in(experiment: Mapping[str, Any]) -> Fixed:
    """What is the same in every run of an experiment, given as plain data with every default filled in.

    What is not said is taken to be drawn.
    """
    units = _mapping(experiment.get("units"))
    recorded = {name for name, unit in units.items() if _mapping(unit).get("recorded")}
    lists = {
        str(name)
        for name, said in _mapping(experiment.get("configurations")).items()
        if _mapping(said).get("recorded") or _not_drawn(_mapping(said).get("units"), recorded)
    }
    driver = _mapping(_mapping(experiment.get("braking")).get("driver"))
    reaction = driver.get("reaction")  # left out, it is no delay at all
    return Fixed(frozenset(lists), bool(driver) and (not reaction or _mapping(reaction).get("kind") == "constant"))


def _not_drawn(units: Any, recorded: set[str]) -> bool:
    return units == TRUTH or (isinstance(units, list) and set(units) <= recorded)


def _mapping(said: Any) -> Mapping[str, Any]:
    return said if isinstance(said, dict) else {}
