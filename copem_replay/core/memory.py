"""Parts of a quantity's draws that last. Keys of the experiment file, wherever something is drawn."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from copem_replay.core.components import Frozen, Id, Share


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

    `share`: of the variance where normals are drawn (errors), of the lists where uniforms are (detection, class,
    existence).
    `correlation_s`: the time in which the correlation decays to 1/e. `of`: what shares the number: one unit and object
    (`pair`), all objects of a unit, all units of an object, or everything. `path`: the number is `held` and then
    replaced, or it `drifts`; by default uniforms are held and normals drift.
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


def numbered(parts: tuple[Part, ...]) -> Iterator[tuple[int, Part]]:
    """Each part with its number among those that the same units and objects have in common."""
    of = [part.of for part in parts]
    for k, part in enumerate(parts):
        yield of[:k].count(part.of), part
