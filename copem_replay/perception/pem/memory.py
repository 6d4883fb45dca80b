"""Memory of a PEM: which of its draws last, for how long, and who has them in common. Keys of the experiment file.

Models do not know of it: what changes is which numbers they are handed. docs/guide/perception-models.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic_core import InitErrorDetails, PydanticCustomError, ValidationError

from copem_replay.core.components import Frozen, Id, Share

QUANTITIES = ("detection", "position", "yaw", "speed", "size", "class", "existence")
"""What any PEM may have drawn; models of the user's own have names of their own besides."""
_OF_SIZE = ("length", "width", "height")


def _not_fresh(value: object) -> object:
    if isinstance(value, int | float) and not isinstance(value, bool) and value == 0:
        raise ValueError("0 is what the rest is anyway; leave the part out")
    return value


CorrelationTime = Annotated[
    Annotated[float, Field(strict=True, ge=0.001, le=86_400)] | Literal["always"], BeforeValidator(_not_fresh)
]
"""Seconds after which e^(−1) of the correlation is left; `always`: one number for the whole run."""


class Part(Frozen):
    """A part of a quantity's draws that lasts.

    `share`: of the variance where normals are drawn (errors), of the lists where uniforms are (detection).
    `correlation_s`: how long. `of`: who has the number in common: one unit and object, all objects of a unit, all units
    of an object, everybody. `path`: whether it is `held` and then another, or `drifts`; left out, uniforms are held and
    normals drift.
    """

    share: Share
    correlation_s: CorrelationTime
    of: Literal["pair", "unit", "object", "all"] = "pair"
    path: Literal["held", "drifts"] | None = Field(default=None, exclude_if=lambda path: path is None)


def _at_most_one(parts: tuple[Part, ...]) -> tuple[Part, ...]:
    total = math.fsum(part.share for part in parts)
    if total > 1 + 1e-9:
        raise ValueError(f"shares sum to {total:g}, expected at most 1")
    return parts


Parts = Annotated[tuple[Part, ...], Field(min_length=1), AfterValidator(_at_most_one)]
Memory = dict[Id, Parts]
"""By quantity the parts of it that last; the rest is new in every list."""


def quantity_of(noise: str) -> str:
    """The quantity that an error model's `noise(name)` belongs to: the first word of the name."""
    first = noise.partition(" ")[0]
    return "size" if first in _OF_SIZE else first


def numbered(parts: tuple[Part, ...]) -> Iterator[tuple[int, Part]]:
    """Each part with its number among those that the same units and objects have in common."""
    of = [part.of for part in parts]
    for k, part in enumerate(parts):
        yield of[:k].count(part.of), part


def check_names(memory: Mapping[str, Parts], asked: frozenset[str] | None, who: str) -> None:
    """Raise pydantic's ValidationError, at the name, for quantities that nothing draws; `asked` None: not known."""
    if asked is None:
        return
    there = ", ".join(sorted(asked)) or "none"
    problems = []
    for name in memory.keys() - asked - set(QUANTITIES):
        message = f'no model of this {who} asks for noise "{name}" (they ask for {there})'
        kind = PydanticCustomError("memory", "{m}", {"m": message})
        problems.append(InitErrorDetails(type=kind, loc=("memory", name), input=name))
    if problems:
        raise ValidationError.from_exception_data("memory", sorted(problems, key=lambda one: one["loc"]))
