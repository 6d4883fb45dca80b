"""Free keys: numbers of an experiment by their path, and the values that are tried of them.

A path is written as messages write it, `pems.camera[0].detection.probability`; names may hold dots and colons. Without
`=FROM:TO:STEP` behind it the values are those that a key of this name usually has.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from copem_replay.core.errors import ExperimentError, InputError
from copem_replay.core.yaml import Key
from copem_replay.experiment.cross_references import check_references
from copem_replay.experiment.file import format_key, make_plain_source, parse_experiment
from copem_replay.experiment.schema import Experiment

Want = Literal["largest", "smallest"]
SECTIONS = ("pems", "units", "links", "configurations")
"""Sections of an experiment that a free key is in: what replays go by, not what is measured of them."""


_USUAL: tuple[tuple[str, Want, float, float], ...] = (
    (r"sigma.*_deg$", "largest", 0.0, 10.0),
    (r"sigma", "largest", 0.0, 4.0),
    (r"covariance", "largest", 0.0, 10.0),
    (r"^in_list$", "largest", 0.0, 5.0),
    (r"probability$|^(visible_share|penetration_rate|existence)$", "smallest", 0.0, 1.0),
    (r"loss$|_share$", "largest", 0.0, 1.0),
    (r"^range_m$", "smallest", 0.0, 200.0),
    (r"_hz$", "smallest", 0.5, 20.0),
    (r"^kbps$", "smallest", 10.0, 1000.0),
    (r"_s$|^(latency|ready)$", "largest", 0.0, math.inf),  # up to the horizon
)
"""By the names of keys whether the largest or the smallest value is wanted, and between which values it is sought."""
_MOST_VALUES, _COUPLES = 10_000, ".couples["
_SPAN = re.compile(r"(.*)=([^=:]*):([^=:]*)(?::([^=:]*))?")


@dataclass(frozen=True)
class FreeKey:
    """A key whose value is sought. `values`: those that may be tried, ascending; `want`: of which side, if it is known.

    `about`: the end of the path, from the name that says what it is.
    """

    key: Key
    values: tuple[float, ...]
    want: Want | None
    about: str

    @property
    def name(self) -> str:
        """The path."""
        return format_key(self.key)


def _set_value(data: Any, key: Key, value: float) -> Any:
    """A copy of plain data with another value at a key."""
    if not key:
        return value
    copy: Any = list(data) if isinstance(data, list) else dict(data)
    copy[key[0]] = _set_value(copy[key[0]], key[1:], value)
    return copy


def set_values(experiment: Experiment, keys: Sequence[FreeKey], values: Sequence[float]) -> Experiment:
    """The experiment with other values of free keys. Raises ExperimentError where it does not take them."""
    data: dict[str, Any] = experiment.as_written()
    for key, value in zip(keys, values, strict=True):
        data = _set_value(data, key.key, value)
    at = ", ".join(f"{key.about} {value:g}" for key, value in zip(keys, values, strict=True))
    source = replace(make_plain_source(data), path=Path(f"with {at}"))
    parsed, problems = parse_experiment(source)
    if parsed is None or (problems := [*problems, *check_references(source)]):
        raise ExperimentError([f"{problem}; KEY=FROM:TO limits what is tried" for problem in problems])
    changes: dict[str, Any] = {section: getattr(parsed, section) for section in {str(key.key[0]) for key in keys}}
    if "configurations" in changes:  # without the ideals of recorded outputs that are left out
        changes["configurations"] = {name: parsed.configurations[name] for name in experiment.configurations}
    return experiment.model_copy(update=changes)


def read_free_key(text: str, experiment: Experiment, steps: int) -> FreeKey:
    """A free key, from `KEY`, `KEY=FROM:TO` or `KEY=FROM:TO:STEP`. `steps`: about so many where no step is said.

    Raises InputError for a key that is not there, is no number, or nothing is known of between which values it is.
    """
    span = _SPAN.fullmatch(text)
    path, numbers = (text, ("", "", "")) if span is None else (span[1], (span[2], span[3], span[4] or ""))
    try:
        low, high, step = (float(number) if number.strip() else None for number in numbers)
    except ValueError:
        raise InputError(f"free {path}: expected numbers, KEY=FROM:TO:STEP, found {text[len(path) :]}") from None
    key, present = _find_key(path, experiment)
    names = [k for k, part in enumerate(key) if isinstance(part, str)]
    known = ((k, one) for k in names[:0:-1] for one in _USUAL if re.search(one[0], str(key[k])))
    at, (_, want, least, most) = next(known, (names[-1], ("", None, None, None)))
    if most is not None and most != 1.0:  # of what is no share
        most = experiment.measure.horizon_s if math.isinf(most) else max(most, 2.0 * (present or 0.0))
    low, high = least if low is None else low, most if high is None else high
    if low is None or high is None:
        raise InputError(f"free {path}: nothing says between which values it is sought; say {path}=FROM:TO")
    step = _choose_step((high - low) / steps) if step is None else step
    if not (low < high and 0 < step <= high - low and (high - low) / step <= _MOST_VALUES):
        expected = f"FROM below TO, and a step with which there are 2 to {_MOST_VALUES:,} values"
        raise InputError(f"free {path}: expected {expected}, found {low:g}:{high:g}:{step:g}")
    listed = [round(low + k * step, 10) for k in range(math.floor((high - low) / step + 1e-9) + 1)]
    values = listed if high - listed[-1] < 1e-9 else [*listed, high]
    if isinstance(present, int):
        values = sorted({round(value) for value in values})
    return FreeKey(key, tuple(values), want, format_key(key[at:]))


def _choose_step(length: float) -> float:
    """The length rounded down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(length, 1e-300)) + 1e-9)
    return max(power * k for k in (1, 2, 5) if power * k <= length * (1 + 1e-9) or k == 1)


def _find_key(path: str, experiment: Experiment) -> tuple[Key, float | None]:
    """The key of a path, and its number; None: it is null. A PEM may be a list, or have it below `couples`."""
    data = experiment.as_written()
    known = {format_key(key).replace(_COUPLES, "["): (key, of) for key, of in _list_numbers(data, ()) if len(key) > 1}
    if (found := known.get(path.replace(_COUPLES, "["))) is None:
        near = difflib.get_close_matches(path, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"such as {next(iter(known), 'none')}"
        raise InputError(f"free {path}: expected the key of a number below {', '.join(SECTIONS)}; {hint}")
    return found


def _list_numbers(value: Any, above: Key) -> Iterator[tuple[Key, float | None]]:
    """The keys of all numbers of sections that free keys are of, and of what is null."""
    if isinstance(value, Mapping):
        for name in value if above else SECTIONS:
            yield from _list_numbers(value.get(name), (*above, name))
    elif isinstance(value, list):
        for k, one in enumerate(value):
            yield from _list_numbers(one, (*above, k))
    elif not isinstance(value, bool | str):
        yield above, value
