"""Results that are the same in every run, as no random number is behind them: an interval over runs tells nothing.

By kind of unit: the lists of the truth and of recorded units are not drawn, those of a unit with a PEM are (and so are
its carriers), even where its probabilities are 0 or 1. A driver's delay is drawn, but for the `constant` reaction.
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
    links = _mapping(experiment.get("links"))
    recorded = {name for name, unit in units.items() if _mapping(unit).get("recorded")}
    lists = set()
    for name, configuration in _mapping(experiment.get("configurations")).items():
        said = _mapping(configuration)
        alike = _not_drawn(said.get("units"), recorded) and not _by_chance(said.get("link"), links)
        if said.get("recorded") or alike:
            lists.add(str(name))
    driver = _mapping(_mapping(experiment.get("braking")).get("driver"))
    reaction = driver.get("reaction")  # left out, it is no delay at all
    return Fixed(frozenset(lists), bool(driver) and (not reaction or _mapping(reaction).get("kind") == "constant"))


def _not_drawn(units: Any, recorded: set[str]) -> bool:
    return units == TRUTH or (isinstance(units, list) and set(units) <= recorded)


def _by_chance(link: Any, links: Mapping[str, Any]) -> bool:
    """Whether a configuration's link, or any of those by unit, delays or loses lists by chance."""
    by_unit = link.values() if isinstance(link, dict) and "kind" not in link else [link]
    for one in by_unit:
        said = links.get(one) if isinstance(one, str) else one
        radio = _mapping(said)
        latency, reception = _mapping(radio.get("latency")), _mapping(radio.get("reception"))
        sure = latency.get("kind") == "constant" and reception == {"kind": "constant", "probability": 1.0}
        if radio.get("kind") == "radio" and not (sure and not radio.get("channel")):
            return True
    return False


def _mapping(said: Any) -> Mapping[str, Any]:
    return said if isinstance(said, dict) else {}
