"""Every estimate of a fit by its name, wherever it stands in what the parts of a fit return."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from copem_replay.pipeline.fit.estimate import PER_ROW, Estimate

_ROUNDING = 1e-9
"""Numbers that differ by no more than this share of them are the same, but for the order in which they are summed."""


def named_estimates(found: Any, name: str = "") -> Iterator[tuple[str, Estimate]]:
    """`detection.memory.share` and its estimate, and so on, in the order of the fields."""
    if isinstance(found, Estimate):
        yield name, found
        return
    for key, value in _members(found):
        yield from named_estimates(value, f"{name}.{key}" if name else key)


def _members(found: Any) -> Iterator[tuple[str, Any]]:
    if is_dataclass(found):
        yield from (
            (field.name, getattr(found, field.name)) for field in fields(found) if not field.metadata.get(PER_ROW)
        )
    elif isinstance(found, Mapping):
        yield from ((" ".join(key) if isinstance(key, tuple) else str(key), value) for key, value in found.items())
    elif isinstance(found, list | tuple):
        yield from ((str(k), value) for k, value in enumerate(found))


def moved_by(main: Any, others: Mapping[float, Any]) -> list[str]:
    """Which estimates another gate moves out of their intervals; `others` by the gate, in metres."""
    held = {gate_m: dict(named_estimates(found)) for gate_m, found in others.items()}
    lines = []
    for name, estimate in named_estimates(main):
        shown = name.removeprefix("rest.")
        for gate_m, found in held.items():
            other = found.get(name)
            if other is None or other.why is not None or estimate.why is not None or math.isnan(estimate.low):
                continue
            slack = _ROUNDING * abs(estimate.value)
            if not (math.isnan(other.value) or estimate.low - slack <= other.value <= estimate.high + slack):
                lines.append(f"{shown}: {estimate.words()}, but {other.value:.3g} with a gate of {gate_m:g} m")
    return lines


def as_plain(found: Any) -> Any:
    """Anything a fit holds as plain data for JSON; NaN and infinity as null."""
    if isinstance(found, float | np.floating):
        return float(found) if math.isfinite(found) else None
    if isinstance(found, np.ndarray):
        return as_plain(found.tolist())
    if isinstance(found, np.generic):
        return found.item()
    if isinstance(found, list | tuple):
        return [as_plain(value) for value in found]
    if is_dataclass(found) or isinstance(found, Mapping):
        return {key: as_plain(value) for key, value in _members(found)}
    return found
