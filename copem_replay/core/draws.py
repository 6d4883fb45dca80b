"""Draws of a unit: parts that last, and a rest that is new in every list.

Normals are sums, z = Σ √shareᵢ nᵢ + √(1 − Σ shareᵢ) n_fresh, uniforms mixtures: an addressed choice names the part that
a list uses. Either way the law in one list stays what it is without memory. Addresses beside those of fresh numbers:
`<name> <of> <number> held` and `… drifts`, with `of` as in a part, and `<name> part` for the choice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from copem_replay.core.lasting import ListTimes, always, drifting, held, shared
from copem_replay.core.memory import Part, numbered
from copem_replay.core.random import CounterRng, RandomKey
from copem_replay.core.tracks import Bool, Float, Int

_WHOLE = 1 - 1e-9
"""Shares that sum to this leave no rest."""
_LOWEST = 2.0**-53
"""A uniform number is no less, and as far from 1."""


@dataclass(frozen=True)
class Draws:
    """Numbers for rows (P,) of the lists of units, in the runs (S,).

    `random_key (P,)`: their addresses; `lists`: all lists of these units, and the list of each row.
    """

    rng: CounterRng
    random_key: RandomKey
    lists: ListTimes
    runs: Int

    def take(self, rows: Int) -> Draws:
        """The same for some rows only (K,): their numbers do not change."""
        return Draws(self.rng, self.random_key.take(rows), self.lists.take(rows), self.runs)

    def uniform(self, name: str, parts: tuple[Part, ...] = ()) -> Float:
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
        for (number, part), (low, high) in zip(numbered(parts), pairwise(bounds), strict=True):
            by_it = (choice >= low) & (choice < high)
            np.copyto(out, self._part(name, number, part, by_it, normal=False), where=by_it)
        return out

    def normal(self, name: str, parts: tuple[Part, ...] = (), where: Bool | None = None) -> Float:
        """(S, P) standard normals; 0 where `where (S, P)` is False."""
        rest = 1 - float(np.sum([part.share for part in parts]))
        if not parts:
            return self.rng.normal(name, self.random_key, self.runs, where)
        out = np.zeros((len(self.runs), len(self.random_key.stamp_ns)))
        if rest > 1 - _WHOLE:
            out += np.sqrt(rest) * self.rng.normal(name, self.random_key, self.runs, where)
        for number, part in numbered(parts):
            out += np.sqrt(part.share) * self._part(name, number, part, where, normal=True)
        return out if where is None else np.where(where, out, 0.0)

    def _part(self, name: str, number: int, part: Part, where: Bool | None, *, normal: bool) -> Float:
        """(S, P) the numbers of one part; any where not `where`."""
        drifts = (part.path or ("drifts" if normal else "held")) == "drifts"
        purpose = f"{name} {part.of} {number} {'drifts' if drifts else 'held'}"
        random_key = shared(self.random_key, part.of)
        tau_s = part.correlation_s
        if isinstance(tau_s, str):  # always
            return self._once(purpose, always(random_key), normal)
        if tau_s == 0:  # of a sweep: new in every list
            return (
                self.rng.normal(purpose, random_key, self.runs)
                if normal
                else self.rng.uniform(purpose, random_key, self.runs)
            )
        if not drifts:
            found = held(self.rng, purpose, random_key, self.runs, tau_s, where=where)
            if normal:
                from scipy.special import ndtri  # it takes long to import, as below

                found = ndtri(np.clip(found, _LOWEST, 1 - _LOWEST))
            return found
        lists = None if part.of in ("object", "all") else self.lists
        if part.of == "unit":  # of a list, not of each row in it
            of_list = RandomKey(
                random_key.units,
                self.lists.unit_ix,
                np.repeat(random_key.object_word[:1], len(self.lists.stamp_ns)),
                self.lists.stamp_ns,
            )
            there = np.unique(self.lists.frame_ix)
            some = ListTimes(self.lists.stamp_ns, self.lists.unit_ix, there)
            found = drifting(self.rng, purpose, of_list.take(there), self.runs, tau_s, lists=some)
            found = found[:, np.searchsorted(there, self.lists.frame_ix)]
        else:
            found = drifting(self.rng, purpose, random_key, self.runs, tau_s, lists=lists, where=where)
        if normal:
            return found
        from scipy.special import ndtr

        uniform: Float = np.clip(ndtr(found), _LOWEST, 1 - _LOWEST)
        return uniform

    def _once(self, purpose: str, random_key: RandomKey, normal: bool) -> Float:
        """(S, P) one number for each series, drawn once where its rows follow each other."""
        new = np.ones(len(random_key.stamp_ns), dtype=bool)
        new[1:] = (np.diff(random_key.unit_ix) != 0) | (random_key.object_word[1:] != random_key.object_word[:-1])
        draw: Callable[[str, RandomKey, Int], Float] = self.rng.normal if normal else self.rng.uniform
        found = draw(purpose, random_key.take(np.flatnonzero(new)), self.runs)
        return np.repeat(found, np.diff(np.append(np.flatnonzero(new), len(new))), axis=1)
