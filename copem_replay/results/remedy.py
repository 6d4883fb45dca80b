"""Remedies: what would help the configuration that knows an object last, of one run: a key of another, or its units."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import numpy as np
import pandas as pd

from copem_replay.core.errors import count_noun
from copem_replay.core.tracks import SAME_INSTANT_S, TRUTH
from copem_replay.experiment.schema import Experiment

_KEYS = {
    "units": "units", "link": "link", "latency_s": "latency", "fusion": "fusion", "issue_hz": "issue rate",
    "max_age_s": "greatest age",
}  # fmt: skip
"""Keys of configurations that are compared, and their words."""
_MOST_UNITS = 3
"""Most units that a sentence names."""


def tell_what_helps(experiment: Experiment, rows: pd.DataFrame) -> str:
    """What would help the configuration that knows an object last: “What would help PEM: the lists of mast1 as well …”.

    It is another configuration that knows the object earlier, with the same draws, and differs in one key or has more
    units: of those with the fewest other keys the earliest; “” where there is none. `rows`: of one object and run, a
    row per configuration.
    """
    asked = {name: experiment.configurations[name] for name in rows["configuration"]}
    known_s = dict(zip(rows["configuration"], rows["time_to_detection_s"].fillna(np.inf).tolist(), strict=True))
    names = [name for name, one in asked.items() if one.recorded is None and one.units != TRUTH]
    last_s = max((known_s[name] for name in names), default=0.0)
    pairs = [
        (len(keys), known_s[other], last, other, change)
        for last in names
        for other in names
        if known_s[last] == last_s > known_s[other] + SAME_INSTANT_S
        and (change := _describe_change(experiment, keys := find_changed_keys(experiment, last, other), last, other))
    ]
    if not pairs:
        return ""
    _, best_s, last, best, change = min(pairs, key=itemgetter(0, 1))
    gain = f"{last_s - best_s:.2f} s earlier" if np.isfinite(last_s) else f"after {best_s:.2f} s instead of never"
    return f"What would help {last}: {change} ({best}): known {gain}."


def find_changed_keys(experiment: Experiment, last: str, other: str) -> list[str]:
    """Keys in which two configurations differ."""
    return [key for key in _KEYS if _value_of(experiment, key, last) != _value_of(experiment, key, other)]


def _value_of(experiment: Experiment, key: str, name: str) -> Any:
    asked = experiment.configurations[name]
    return frozenset(experiment.units_of(asked)) if key == "units" else getattr(asked, key)


def _describe_change(experiment: Experiment, keys: Sequence[str], last: str, best: str) -> str:
    """What `best` changes of `last` in `keys`: “without the 1.5 s of latency”; “” where much is different."""
    values = {key: (_value_of(experiment, key, last), _value_of(experiment, key, best)) for key in keys}
    old_units, new_units = values.pop("units", (frozenset(), frozenset()))
    other_changes = f" (and another {' and '.join(_KEYS[key] for key in values)})" if values else ""
    if new_units > old_units:
        return f"the lists of {_name_units(new_units - old_units)} as well{other_changes}"
    if len(keys) != 1:
        return ""
    if not values:
        return f"the lists of {_name_units(new_units)} instead"
    [(key, (old, new))] = values.items()
    if key == "latency_s" and not isinstance(old, dict) and not isinstance(new, dict):
        return f"{new:g} s of latency instead of {old:g} s" if new else f"without the {old:g} s of latency"
    if key == "fusion" and old.kind != new.kind:
        return f"fusion {new.kind} instead of {old.kind}"
    return "no link" if key == "link" and new is None else f"another {_KEYS[key]}"


def _name_units(units: frozenset[str]) -> str:
    return ", ".join(sorted(units)) if len(units) <= _MOST_UNITS else count_noun(len(units), "unit")
