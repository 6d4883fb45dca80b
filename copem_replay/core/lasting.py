"""Numbers that last: functions of their address and of absolute time, like all others, but not new in every list.

`held`: a uniform that is renewed at the instants of a Poisson process. `drifting`: a normal that wanders, the
stationary Ornstein–Uhlenbeck process. Both have autocorrelation e^(−Δ/τ) at any stamps; there is no state and no
burn-in: any rows in any order, of any part of a log, have the same bits. `births`: Poisson points in time, each with an
exponential life.

Sources: a Poisson process restarts at any instant without a change of its law (memoryless), so cells of time have their
renewals each by itself. The path is made by bridges in a binary tree, as Brownian paths are in Li, Wong, Chen and
Duvenaud, "Scalable gradients for stochastic differential equations", AISTATS 2020; the bridge is that of any
Gauss–Markov process. docs/develop/decisions/0023-errors-that-last.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from copem_replay.core.lasting_kernel import births_of, drifting_rows, held_rows
from copem_replay.core.random import CounterRng, RandomKey, Words, stable_hash
from copem_replay.core.tracks import Bool, Float, Int

Of = Literal["pair", "unit", "object", "all"]
"""The rows that share a number: one unit and object, all objects of a unit, all units of an object, all rows."""

LEAF = 27
"""Leaves of a path are 2^27 ns, 134 ms (chosen: it changes cost and the path, not the law)."""
LEAF_SHARED = 20
"""Of a path that units of different rhythms share: 2^20 ns, 1 ms (chosen)."""
FORGOTTEN = 37.0
"""After so many correlation times nothing is left of a number: e^(−37) < 2^(−53)."""


@dataclass(frozen=True)
class ListTimes:
    """The lists of units, all of a log's: `stamp_ns (F,)` unit by unit and ascending, `unit_ix (F,)` the unit of each.

    `frame_ix (P,)`: the list of each row.
    """

    stamp_ns: Int
    unit_ix: Int
    frame_ix: Int

    def take(self, rows: Int) -> ListTimes:
        """The same lists for some rows only (K,)."""
        return replace(self, frame_ix=self.frame_ix[rows])


@dataclass(frozen=True)
class Births:
    """Births (B,) in the order of runs, rows and time.

    `run_ix`, `row_ix`: in which of the runs and of which row of the address. `address_ns`: a stamp that no other birth
    of this run and row has, by which more can be drawn for it. It lives from `born_ns` on and before `gone_ns`.
    """

    run_ix: Int
    row_ix: Int
    address_ns: Int
    born_ns: Int
    gone_ns: Int


def shared(random_key: RandomKey, of: Of) -> RandomKey:
    """The address (P,) of a number that more than one unit and object have in common: without what may differ."""
    if of in ("object", "all"):
        random_key = replace(random_key, units=("",), unit_ix=np.zeros(len(random_key.stamp_ns), dtype=np.int64))
    if of in ("unit", "all"):
        of_all = np.full(len(random_key.stamp_ns), stable_hash("everyone"), dtype=np.uint64)
        random_key = replace(random_key, object_word=of_all)
    return random_key


def always(random_key: RandomKey) -> RandomKey:
    """The address (P,) of a number that lasts for a whole run: without the capture."""
    return replace(random_key, stamp_ns=np.zeros(len(random_key.stamp_ns), dtype=np.int64))


def held(
    rng: CounterRng, purpose: str, random_key: RandomKey, runs: Int, correlation_s: float, *, where: Bool | None = None
) -> Float:
    """(S, P) uniforms in (0, 1), renewed at Poisson instants `correlation_s` apart on average; 0 where not `where`.

    For any functions f, g of it: E f(U(t)) g(U(t + Δ)) = φ E fg + (1 − φ) E f E g with φ = e^(−Δ/τ), at any list rate.
    """
    return _held(rng, purpose, random_key, runs, correlation_s, where, renewals_too=False)[0]


def renewal_stamps(
    rng: CounterRng, purpose: str, random_key: RandomKey, runs: Int, correlation_s: float, *, where: Bool | None = None
) -> Int:
    """(S, P) a stamp that tells the renewal in force from all others of its series, by which more can be drawn."""
    return _held(rng, purpose, random_key, runs, correlation_s, where, renewals_too=True)[1]


def _held(
    rng: CounterRng,
    purpose: str,
    random_key: RandomKey,
    runs: Int,
    correlation_s: float,
    where: Bool | None,
    renewals_too: bool,
) -> tuple[Float, Int]:
    out = np.zeros((len(runs), len(random_key.stamp_ns)))
    renewal = np.zeros(out.shape if renewals_too else (0, 0), dtype=np.int64)
    tau_ns = correlation_s * 1e9
    key, word, _, run = rng.words(purpose, random_key, runs)
    stamp, shift = _stamps(random_key), level_of(tau_ns)
    held_rows(_cells(key, word, stamp, shift), stamp, run, tau_ns, shift, _mask(where), out, renewal)
    return out, renewal


def _cells(key: Words, word: Words, stamp: Int, shift: int) -> tuple[Words, Words, Int, Int]:
    """Stays of rows in one cell of one series, in time: key, word and cell (C,), and where each begins (C + 1,)."""
    cell = stamp >> shift
    new = (cell[1:] != cell[:-1]) | (stamp[1:] < stamp[:-1]) | (key[1:] != key[:-1]) | (word[1:] != word[:-1])
    begin = np.concatenate([np.arange(min(len(cell), 1)), np.flatnonzero(new) + 1])
    return key[begin], word[begin], cell[begin], np.append(begin, len(cell))


def drifting(
    rng: CounterRng,
    purpose: str,
    random_key: RandomKey,
    runs: Int,
    correlation_s: float,
    *,
    lists: ListTimes | None,
    where: Bool | None = None,
) -> Float:
    """(S, P) standard normals with autocorrelation e^(−Δ/τ), normal jointly, too; 0 where not `where`.

    `lists`: of the units that the rows are of; each list of a leaf follows from the one before it, whether anything
    in it is asked for or not. None: the numbers are shared by units of different rhythms, which then see that of the
    millisecond (2^20 ns) in which a capture falls.
    """
    tau_ns = correlation_s * 1e9
    leaf = LEAF_SHARED if lists is None else LEAF
    top = max(leaf, level_of(FORGOTTEN * tau_ns))
    d = 2.0 ** np.arange(top) / tau_ns
    with np.errstate(over="ignore"):  # far apart: nothing in common
        weights = (1 / (2 * np.cosh(d)), np.sqrt(np.tanh(d)))
    out = np.zeros((len(runs), len(random_key.stamp_ns)))
    key, word, _, run = rng.words(purpose, random_key, runs)
    chain = _chain(lists, tau_ns)
    drifting_rows(key, word, _stamps(random_key), run, (top, leaf), weights, chain, _mask(where), out)
    return out


def births(
    rng: CounterRng,
    purpose: str,
    random_key: RandomKey,
    runs: Int,
    *,
    every_s: float,
    lasts_s: float,
    from_ns: int,
    until_ns: int,
) -> Births:
    """All births of the address's rows (R,; their stamps do not count) that live in some of [from_ns, until_ns).

    One every `every_s` on average, at the instants of a Poisson process, for `lasts_s` on average: at any instant
    Poisson(lasts_s / every_s) of them live. Those born more than 37 `lasts_s` before are gone.
    """
    shift = level_of(every_s * 1e9)
    cells = (from_ns - int(FORGOTTEN * lasts_s * 1e9)) >> shift, (max(until_ns - 1, from_ns) >> shift) + 1
    key, word, _, run = rng.words(purpose, random_key, runs)
    count = 0
    while True:
        found = Births(*(np.empty(count, dtype=np.int64) for _ in range(5)))
        size = births_of(
            key, word, run, every_s * 1e9, lasts_s * 1e9, shift, cells, (from_ns, until_ns), tuple(vars(found).values())
        )
        if size == count:
            return found
        count = size


def dwelling(rng: CounterRng, purpose: str, random_key: RandomKey, runs: Int, lasts_s: float) -> Float:
    """(S, P) uniforms in (0, 1) that are below any number for `lasts_s` on average, exponentially.

    "Below a" is the chain of two states that is in it with probability a and leaves it after `lasts_s`, for every a at
    once: a larger one only adds to the time below. At the instants of a Poisson process, `lasts_s` apart on average,
    the number starts from 1, and sinks as life / (life + age), with an exponential life of the same mean.
    """
    out = np.empty((len(runs), len(random_key.stamp_ns)))
    if not out.size:
        return out
    series, which = np.unique(
        np.stack([random_key.unit_ix.astype(np.uint64), random_key.object_word]), axis=1, return_inverse=True
    )
    stamp = random_key.stamp_ns
    from_ns, until_ns = int(stamp.min() - FORGOTTEN * lasts_s * 1e9), int(stamp.max()) + 1
    zeros = np.zeros(series.shape[1], dtype=np.int64)
    of_series = RandomKey(random_key.units, series[0].astype(np.int64), series[1], zeros)
    found = births(rng, purpose, of_series, runs, every_s=lasts_s, lasts_s=lasts_s, from_ns=from_ns, until_ns=until_ns)
    life_ns = (found.gone_ns - found.born_ns).astype(float)
    for s in range(len(runs)):
        for k in range(series.shape[1]):
            mine = np.flatnonzero((found.run_ix == s) & (found.row_ix == k))
            rows = np.flatnonzero(which == k)
            last = mine[np.maximum(np.searchsorted(found.born_ns[mine], stamp[rows], side="right") - 1, 0)]
            out[s, rows] = life_ns[last] / (life_ns[last] + (stamp[rows] - found.born_ns[last]))
    return np.minimum(out, 1 - 2.0**-53)


def level_of(length_ns: float) -> int:
    """The least whole l with 2^l ns no shorter than this."""
    return max(int(np.ceil(np.log2(length_ns))), 0)


def _stamps(random_key: RandomKey) -> Int:
    return np.ascontiguousarray(random_key.stamp_ns, dtype=np.int64)


def _mask(where: Bool | None) -> Bool:
    return np.ones((1, 1), dtype=np.bool_) if where is None else np.ascontiguousarray(where)


def _chain(lists: ListTimes | None, tau_ns: float) -> tuple[Int, Int, Int, Float, Float, Float]:
    """How each list's number follows from the one before it in its leaf, or from the leaf's left end; see the kernel.

    The bridge from s to t to the leaf's right end B: x = (t − s) / τ, y = (B − t) / τ.
    """
    if lists is None:
        none, nothing = np.empty(0, dtype=np.int64), np.empty(0)
        return none, none, none, nothing, nothing, nothing
    stamp = np.ascontiguousarray(lists.stamp_ns)
    leaf = stamp >> LEAF
    new = (np.diff(leaf, prepend=-1) != 0) | (np.diff(lists.unit_ix, prepend=-1) != 0)
    first = np.maximum.accumulate(np.where(new, np.arange(len(stamp)), 0))
    before = np.where(new, leaf << LEAF, np.roll(stamp, 1))
    x, y = (stamp - before) / tau_ns, (((leaf + 1) << LEAF) - stamp) / tau_ns
    ahead, behind, whole = -np.expm1(-2 * y), -np.expm1(-2 * x), -np.expm1(-2 * (x + y))
    from_before, from_right = np.exp(-x) * ahead / whole, np.exp(-y) * behind / whole
    own = np.sqrt(ahead * behind / whole)
    return np.ascontiguousarray(lists.frame_ix), first, stamp, from_before, from_right, own
