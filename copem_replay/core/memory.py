"""Memory: the parts of a quantity's draws that last, as keys of the experiment file, and the draws of units with them.

Normals are sums, z = Σ √shareᵢ nᵢ + √(1 − Σ shareᵢ) n_fresh, uniforms mixtures: an addressed choice names the part that
a list uses. Either way the law in one list stays what it is without memory. Addresses beside those of fresh numbers:
`<name> <of> <number> held` and `… drifts`, with `of` as in a part, and `<name> part` for the choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from copem_replay.core.components import Frozen, Id, Share
from copem_replay.core.lasting import (
    ListStamps,
    draw_correlated_normals,
    draw_held_uniforms,
    drop_capture,
    drop_unshared,
)
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import Bool, Float, Int


def _refuse_fresh(value: object) -> object:
    if isinstance(value, int | float) and not isinstance(value, bool) and value == 0:
        raise ValueError("0 is what the rest is anyway; leave the part out")
    return value


CorrelationTime = Annotated[
    Annotated[float, Field(strict=True, ge=0.001, le=86_400)] | Literal["always"], BeforeValidator(_refuse_fresh)
]
"""Seconds after which e^(−1) of the correlation is left; `always`: one number for the whole run."""


class MemoryPart(Frozen):
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


def _check_shares(parts: tuple[MemoryPart, ...]) -> tuple[MemoryPart, ...]:
    total = math.fsum(part.share for part in parts)
    if total > 1 + 1e-9:
        raise ValueError(f"shares sum to {total:g}, expected at most 1")
    return parts


Parts = Annotated[tuple[MemoryPart, ...], Field(min_length=1), AfterValidator(_check_shares)]
Memory = dict[Id, Parts]
"""By quantity the parts of it that last; the rest is new in every list."""


def number_parts(parts: tuple[MemoryPart, ...]) -> Iterator[tuple[int, MemoryPart]]:
    """Each part, with its number among the parts of the same `of`."""
    of = [part.of for part in parts]
    for k, part in enumerate(parts):
        yield of[:k].count(part.of), part


_WHOLE = 1 - 1e-9
"""Shares that sum to this leave no rest, in spite of rounding."""
_LOWEST = 2.0**-53
"""No uniform number is nearer to 0 or 1."""


@dataclass(frozen=True)
class UnitDraws:
    """Numbers for rows (P,) of the lists of units, in the runs (S,).

    `random_key (P,)`: their addresses; `lists`: all lists of these units, and the list of each row.
    """

    rng: CounterRng
    random_key: RandomKey
    lists: ListStamps
    runs: Int

    def take(self, rows: Int) -> UnitDraws:
        """The draws of the rows `rows (K,)` alone: their numbers do not change."""
        return UnitDraws(self.rng, self.random_key.take(rows), self.lists.take(rows), self.runs)

    def uniform(self, name: str, parts: tuple[MemoryPart, ...] = ()) -> Float:
        """(S, P) uniforms in (0, 1), ends excluded."""
        bounds = np.cumsum([0.0, *(part.share for part in parts)])
        if len(parts) == 1 and bounds[-1] >= _WHOLE:
            return self._part(name, 0, parts[0], None, normal=False)
        out = self.rng.uniform(name, self.random_key, self.runs)
        if not parts:
            return out
        if bounds[-1] >= _WHOLE:
            bounds[-1] = 1.0
        choice = self.rng.uniform(f"{name} part", self.random_key, self.runs)
        for (number, part), (low, high) in zip(number_parts(parts), pairwise(bounds), strict=True):
            uses_part = (choice >= low) & (choice < high)
            np.copyto(out, self._part(name, number, part, uses_part, normal=False), where=uses_part)
        return out

    def normal(self, name: str, parts: tuple[MemoryPart, ...] = (), where: Bool | None = None) -> Float:
        """(S, P) standard normals; 0 where `where (S, P)` is False."""
        rest = 1 - float(np.sum([part.share for part in parts]))
        if not parts:
            return self.rng.normal(name, self.random_key, self.runs, where)
        out = np.zeros((len(self.runs), len(self.random_key.stamp_ns)))
        if rest > 1 - _WHOLE:
            out += np.sqrt(rest) * self.rng.normal(name, self.random_key, self.runs, where)
        for number, part in number_parts(parts):
            out += np.sqrt(part.share) * self._part(name, number, part, where, normal=True)
        return out if where is None else np.where(where, out, 0.0)

    def _part(self, name: str, number: int, part: MemoryPart, where: Bool | None, *, normal: bool) -> Float:
        """(S, P) the numbers of one part; any where not `where`."""
        drifts = (part.path or ("drifts" if normal else "held")) == "drifts"
        purpose = f"{name} {part.of} {number} {'drifts' if drifts else 'held'}"
        random_key = drop_unshared(self.random_key, part.of)
        tau_s = part.correlation_s
        if isinstance(tau_s, str):  # always
            return self._once(purpose, drop_capture(random_key), normal)
        if tau_s == 0:  # only a sweep has it: new in every list
            return (
                self.rng.normal(purpose, random_key, self.runs)
                if normal
                else self.rng.uniform(purpose, random_key, self.runs)
            )
        if not drifts:
            drawn = draw_held_uniforms(self.rng, purpose, random_key, self.runs, tau_s, where=where)
            if normal:
                from scipy.special import ndtri  # here and below: its import takes long

                drawn = ndtri(np.clip(drawn, _LOWEST, 1 - _LOWEST))
            return drawn
        lists = None if part.of in ("object", "all") else self.lists
        if part.of == "unit":  # of a list, not of each row in it
            of_list = RandomKey(
                random_key.units,
                self.lists.unit_ix,
                np.repeat(random_key.object_word[:1], len(self.lists.stamp_ns)),
                self.lists.stamp_ns,
            )
            frames = np.unique(self.lists.frame_ix)
            listed = ListStamps(self.lists.stamp_ns, self.lists.unit_ix, frames)
            drawn = draw_correlated_normals(self.rng, purpose, of_list.take(frames), self.runs, tau_s, lists=listed)
            drawn = drawn[:, np.searchsorted(frames, self.lists.frame_ix)]
        else:
            drawn = draw_correlated_normals(self.rng, purpose, random_key, self.runs, tau_s, lists=lists, where=where)
        if normal:
            return drawn
        from scipy.special import ndtr

        uniform: Float = np.clip(ndtr(drawn), _LOWEST, 1 - _LOWEST)
        return uniform

    def _once(self, purpose: str, random_key: RandomKey, normal: bool) -> Float:
        """(S, P) one number for each series of rows that follow each other, drawn once."""
        new = np.ones(len(random_key.stamp_ns), dtype=bool)
        new[1:] = (np.diff(random_key.unit_ix) != 0) | (random_key.object_word[1:] != random_key.object_word[:-1])
        draw: Callable[[str, RandomKey, Int], Float] = self.rng.normal if normal else self.rng.uniform
        drawn = draw(purpose, random_key.take(np.flatnonzero(new)), self.runs)
        return np.repeat(drawn, np.diff(np.append(np.flatnonzero(new), len(new))), axis=1)
