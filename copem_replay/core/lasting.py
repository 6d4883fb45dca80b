"""Numbers that last: functions of their address and of absolute time, like all others, but not new in every list.

`draw_held_uniforms`: a uniform that is renewed at the instants of a Poisson process. `draw_correlated_normals`: a
normal that drifts, the stationary Ornstein–Uhlenbeck process. Both have autocorrelation e^(−Δ/τ) at any stamps; there
is no state and no burn-in: any rows in any order, of any part of a log, have the same bits. `draw_births`: Poisson
points in time, each with an exponential life. `draw_dwelling_uniforms`: a uniform that stays below any number for a
given time.

Sources: a Poisson process restarts at any instant without a change of its law (memoryless), so cells of time have their
renewals each by itself. The path is made by bridges in a binary tree, as Brownian paths are in Li, Wong, Chen and
Duvenaud, "Scalable gradients for stochastic differential equations", AISTATS 2020; the bridge is that of any
Gauss–Markov process. docs/develop/decisions/random-numbers.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numba as nb
import numpy as np

from copem_replay.core.compiled import callee, kernel, vectorised_kernel
from copem_replay.core.random import CounterRng, RandomKey, Words, normal_quantile, philox4x32, stable_hash
from copem_replay.core.tracks import Bool, Float, Int

Of = Literal["pair", "unit", "object", "all"]
"""The rows that share a number: one unit and object, all objects of a unit, all units of an object, all rows."""

LEAF = 27
"""Leaves of a path are 2^27 ns long, 134 ms: about one list each at 10 Hz. Another length changes the cost and the
draws, not their law."""
LEAF_SHARED = 20
"""Leaves of a path that units of different rhythms share: 2^20 ns, 1 ms, far below any interval of lists."""
FORGOTTEN = 37.0
"""After so many correlation times nothing is left of a number: e^(−37) < 2^(−53)."""


@dataclass(frozen=True)
class ListStamps:
    """All lists of units in a log: `stamp_ns (F,)` unit by unit and ascending, `unit_ix (F,)` the unit of each.

    `frame_ix (P,)`: the list of each row.
    """

    stamp_ns: Int
    unit_ix: Int
    frame_ix: Int

    def take(self, rows: Int) -> ListStamps:
        """All lists, with only the rows `rows (K,)`."""
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


def drop_unshared(random_key: RandomKey, shared_by: Of) -> RandomKey:
    """The address (P,) of a number that units or objects share: without the parts in which they differ."""
    if shared_by in ("object", "all"):
        random_key = replace(random_key, units=("",), unit_ix=np.zeros(len(random_key.stamp_ns), dtype=np.int64))
    if shared_by in ("unit", "all"):
        of_all = np.full(len(random_key.stamp_ns), stable_hash("everyone"), dtype=np.uint64)
        random_key = replace(random_key, object_word=of_all)
    return random_key


def drop_capture(random_key: RandomKey) -> RandomKey:
    """The address (P,) of a number that lasts a whole run: without the capture."""
    return replace(random_key, stamp_ns=np.zeros(len(random_key.stamp_ns), dtype=np.int64))


def draw_held_uniforms(
    rng: CounterRng, purpose: str, random_key: RandomKey, runs: Int, correlation_s: float, *, where: Bool | None = None
) -> Float:
    """(S, P) uniforms in (0, 1), renewed at Poisson instants `correlation_s` apart on average; 0 where not `where`.

    For any functions f, g of it: E f(U(t)) g(U(t + Δ)) = φ E fg + (1 − φ) E f E g with φ = e^(−Δ/τ), at any list rate.
    """
    return _draw_held(rng, purpose, random_key, runs, correlation_s, where, renewals_too=False)[0]


def renewal_stamps(
    rng: CounterRng, purpose: str, random_key: RandomKey, runs: Int, correlation_s: float, *, where: Bool | None = None
) -> Int:
    """(S, P) a stamp of the renewal in force, unique in its series: an address under which more numbers are drawn."""
    return _draw_held(rng, purpose, random_key, runs, correlation_s, where, renewals_too=True)[1]


def _draw_held(
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
    stamp, shift = _capture_stamps(random_key), dyadic_level(tau_ns)
    fill_held_rows(_find_cells(key, word, stamp, shift), stamp, run, tau_ns, shift, _make_mask(where), out, renewal)
    return out, renewal


def _find_cells(key: Words, word: Words, stamp: Int, shift: int) -> tuple[Words, Words, Int, Int]:
    """Stays of rows in one cell of one series, in time: key, word and cell (C,), and where each begins (C + 1,)."""
    cell = stamp >> shift
    new = (cell[1:] != cell[:-1]) | (stamp[1:] < stamp[:-1]) | (key[1:] != key[:-1]) | (word[1:] != word[:-1])
    begin = np.concatenate([np.arange(min(len(cell), 1)), np.flatnonzero(new) + 1])
    return key[begin], word[begin], cell[begin], np.append(begin, len(cell))


def draw_correlated_normals(
    rng: CounterRng,
    purpose: str,
    random_key: RandomKey,
    runs: Int,
    correlation_s: float,
    *,
    lists: ListStamps | None,
    where: Bool | None = None,
) -> Float:
    """(S, P) standard normals with autocorrelation e^(−Δ/τ), normal jointly, too; 0 where not `where`.

    `lists`: of the units that the rows are of; each list of a leaf follows from the one before it, whether anything
    in it is asked for or not. None: the numbers are shared by units of different rhythms, which then see that of the
    millisecond (2^20 ns) in which a capture falls.
    """
    tau_ns = correlation_s * 1e9
    leaf = LEAF_SHARED if lists is None else LEAF
    top = max(leaf, dyadic_level(FORGOTTEN * tau_ns))
    d = 2.0 ** np.arange(top) / tau_ns
    with np.errstate(over="ignore"):  # far apart: nothing in common
        weights = (1 / (2 * np.cosh(d)), np.sqrt(np.tanh(d)))
    out = np.zeros((len(runs), len(random_key.stamp_ns)))
    key, word, _, run = rng.words(purpose, random_key, runs)
    chain = _transition_weights(lists, tau_ns)
    fill_correlated_rows(
        key, word, _capture_stamps(random_key), run, (top, leaf), weights, chain, _make_mask(where), out
    )
    return out


def draw_births(
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
    shift = dyadic_level(every_s * 1e9)
    cells = (from_ns - int(FORGOTTEN * lasts_s * 1e9)) >> shift, (max(until_ns - 1, from_ns) >> shift) + 1
    key, word, _, run = rng.words(purpose, random_key, runs)
    count = 0
    while True:
        births = Births(*(np.empty(count, dtype=np.int64) for _ in range(5)))
        size = list_births(
            key,
            word,
            run,
            every_s * 1e9,
            lasts_s * 1e9,
            shift,
            cells,
            (from_ns, until_ns),
            tuple(vars(births).values()),
        )
        if size == count:
            return births
        count = size


def draw_dwelling_uniforms(rng: CounterRng, purpose: str, random_key: RandomKey, runs: Int, lasts_s: float) -> Float:
    """(S, P) uniforms in (0, 1) that are below any number for `lasts_s` on average, exponentially.

    "Below a" is the chain of two states that is in it with probability a and leaves it after `lasts_s`, for every a at
    once: a larger one only adds to the time below. At the instants of a Poisson process, `lasts_s` apart on average,
    the number starts from 1, and sinks as life / (life + age), with an exponential life of the same mean.
    """
    out = np.empty((len(runs), len(random_key.stamp_ns)))
    if not out.size:
        return out
    series, series_ix = np.unique(
        np.stack([random_key.unit_ix.astype(np.uint64), random_key.object_word]), axis=1, return_inverse=True
    )
    stamp = random_key.stamp_ns
    from_ns, until_ns = int(stamp.min() - FORGOTTEN * lasts_s * 1e9), int(stamp.max()) + 1
    zeros = np.zeros(series.shape[1], dtype=np.int64)
    of_series = RandomKey(random_key.units, series[0].astype(np.int64), series[1], zeros)
    births = draw_births(
        rng, purpose, of_series, runs, every_s=lasts_s, lasts_s=lasts_s, from_ns=from_ns, until_ns=until_ns
    )
    life_ns = (births.gone_ns - births.born_ns).astype(float)
    for s in range(len(runs)):
        for k in range(series.shape[1]):
            own = np.flatnonzero((births.run_ix == s) & (births.row_ix == k))
            rows = np.flatnonzero(series_ix == k)
            last = own[np.maximum(np.searchsorted(births.born_ns[own], stamp[rows], side="right") - 1, 0)]
            out[s, rows] = life_ns[last] / (life_ns[last] + (stamp[rows] - births.born_ns[last]))
    return np.minimum(out, 1 - 2.0**-53)


def dyadic_level(length_ns: float) -> int:
    """The least whole l with 2^l ns no shorter than this."""
    return max(int(np.ceil(np.log2(length_ns))), 0)


def _capture_stamps(random_key: RandomKey) -> Int:
    return np.ascontiguousarray(random_key.stamp_ns, dtype=np.int64)


def _make_mask(where: Bool | None) -> Bool:
    return np.ones((1, 1), dtype=np.bool_) if where is None else np.ascontiguousarray(where)


def _transition_weights(lists: ListStamps | None, tau_ns: float) -> tuple[Int, Int, Int, Float, Float, Float]:
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


# Kernels. Each walks the rows of one series (one key and word) in order of time and keeps what the next row can use; a
# row that does not follow the one before starts anew and gives the same bits. Counters are as in core/random.py: word
# and a stamp in nanoseconds.

_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
_SIX, _BITS = np.uint64(6), np.uint64(26)
_UNIT = 2.0**-52
_BELOW = 1 - 2.0**-53
"""A power of two times this is the number next below it."""


@nb.njit(inline="always")
def _draw_two_uniforms(key: np.uint64, word: np.uint64, stamp: int, run: np.uint64) -> tuple[float, float]:
    """Both 52-bit uniforms of one Philox call; the first is the addressed uniform of `core/random.py`."""
    counter = np.uint64(stamp)
    a, b, c, d = philox4x32(
        word & _LOW, word >> _SHIFT, counter & _LOW, counter >> _SHIFT, (key & _LOW) ^ run, key >> _SHIFT
    )
    first = (np.float64(((a >> _SIX) << _BITS) | (b >> _SIX)) + 0.5) * _UNIT
    second = (np.float64(((c >> _SIX) << _BITS) | (d >> _SIX)) + 0.5) * _UNIT
    return first, second


@nb.njit(inline="always")
def _draw_standard_normal(key: np.uint64, word: np.uint64, stamp: int, run: np.uint64) -> float:
    """The addressed standard normal."""
    return normal_quantile(_draw_two_uniforms(key, word, stamp, run)[0])


@nb.njit(inline="always")
def _natural_log(x: float) -> float:
    """Natural logarithm of a normal x > 0, without a branch, so that loops over it are compiled to vectors.

    Source: the method of FDLIBM's e_log.c (Sun Microsystems, 1993) and its coefficients; error below 1 ulp.
    """
    bits = np.float64(x).view(np.int64)
    low = bits & np.int64(0xFFFFFFFFFFFFF)
    up = np.int64(low > np.int64(0x6A09E667F3BCD))  # above √2: as the half of it
    m = np.int64(low | ((np.int64(1023) - up) << np.int64(52))).view(np.float64)
    k = np.float64((bits >> np.int64(52)) - np.int64(1023) + up)
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    w = z * z
    odd = w * (3.999999999940941908e-01 + w * (2.222219843214978396e-01 + w * 1.531383769920937332e-01))
    even = 1.818357216161805012e-01 + w * 1.479819860511658591e-01
    even = z * (6.666666666666735130e-01 + w * (2.857142874366239149e-01 + w * even))
    half = 0.5 * f * f
    return k * 6.93147180369123816490e-01 - ((half - (s * (half + odd + even) + k * 1.90821492927058770002e-10)) - f)


_AT_ONCE = 4
"""Renewals of a cell that are drawn in advance; a cell has 1 to 2 on average."""


@callee
def _advance_renewal(
    key: np.uint64,
    word: np.uint64,
    run: np.uint64,
    start: int,
    number: int,
    since_ns: float,
    tau_ns: float,
    until: float,
) -> tuple[int, float]:
    """The last renewal no later than `until`, and its number: on from the `number`-th, `since_ns` into the cell."""
    value = _draw_two_uniforms(key, word, start + number, run)[1]
    while True:
        u, v = _draw_two_uniforms(key, word, start + number + 1, run)
        since_ns += -tau_ns * _natural_log(u)
        if since_ns > until:
            return number, value
        number, value = number + 1, v


@callee
def _find_last_renewal(
    key: np.uint64, word: np.uint64, run: np.uint64, cell: int, tau_ns: float, shift: int
) -> tuple[int, float]:
    """The last renewal in a cell, or in the nearest one before it that has any: its stamp, and its number."""
    last = np.float64(np.int64(1) << shift) * _BELOW
    while True:
        start = cell << shift
        since_ns = -tau_ns * _natural_log(_draw_two_uniforms(key, word, start, run)[0])
        if since_ns <= last:
            number, value = _advance_renewal(key, word, run, start, 0, since_ns, tau_ns, last)
            return start + number, value
        cell -= 1


@vectorised_kernel
def fill_held_rows(
    cells: tuple[Words, Words, Int, Int],
    stamp: Int,
    runs: Words,
    tau_ns: float,
    shift: int,
    where: Bool,
    out: Float,
    renewal: Int,
) -> None:
    """Fill `out (S, P)` with the numbers in force; `renewal (S, P)`, unless it is empty, with the stamps they have.

    Renewals in cells of 2^shift ns: t₀ = start − τ ln u₀, tᵢ = tᵢ₋₁ − τ ln uᵢ, each with a number vᵢ. `cells` (C,)
    each: the key, word, number and first row of every stay of rows in a cell, ascending in time; the last one is where
    rows end.
    """
    cell_key, cell_word, cell_of, begin = cells
    everywhere = where.shape[0] == 1 and where.shape[1] == 1
    last = np.float64(np.int64(1) << shift) * _BELOW
    block, stamps_too = 256, renewal.shape[0] > 0
    renewed_ns, value = np.empty((_AT_ONCE, block)), np.empty((_AT_ONCE, block))
    begin_ns = cell_of << shift
    follows = np.zeros(len(cell_of), dtype=np.bool_)  # the cell before it, of the same series
    for c in range(1, len(cell_of)):
        same = cell_key[c - 1] == cell_key[c] and cell_word[c - 1] == cell_word[c]
        follows[c] = same and cell_of[c - 1] == cell_of[c] - 1
    off_ns = np.empty(len(stamp))  # since the cell began
    for c in range(len(cell_of)):
        for p in range(begin[c], begin[c + 1]):
            off_ns[p] = np.float64(stamp[p] - begin_ns[c])
    for s in range(out.shape[0]):
        run, row = runs[s], out[s]
        carries, carried, carried_ns = False, 0.0, 0  # of the cell before
        for c0 in range(0, len(cell_of), block):
            size = min(block, len(cell_of) - c0)
            keys, words, starts = cell_key[c0 : c0 + size], cell_word[c0 : c0 + size], begin_ns[c0 : c0 + size]
            for i in range(_AT_ONCE):
                renewed_i, value_i = renewed_ns[i], value[i]  # loop by loop, from 0 on: each is compiled to vectors
                for j in range(size):
                    u, v = _draw_two_uniforms(keys[j], words[j], starts[j] + i, run)
                    renewed_i[j] = u
                    value_i[j] = v
                for j in range(size):
                    renewed_i[j] = -tau_ns * _natural_log(renewed_i[j])
                if i:
                    sum_before = renewed_ns[i - 1]
                    for j in range(size):
                        renewed_i[j] += sum_before[j]
            for j in range(size):
                c = c0 + j
                k, w, start = cell_key[c], cell_word[c], begin_ns[c]
                carries = carries and follows[c]
                a0, a1, a2, a3 = renewed_ns[0, j], renewed_ns[1, j], renewed_ns[2, j], renewed_ns[3, j]
                v0, v1, v2, v3 = value[0, j], value[1, j], value[2, j], value[3, j]
                if not carries and off_ns[begin[c]] < a0:
                    carried_ns, carried = _find_last_renewal(k, w, run, cell_of[c] - 1, tau_ns, shift)
                    carries = True
                if a2 > last:  # mostly; selected without a branch, which could not be predicted
                    for p in range(begin[c], begin[c + 1]):
                        in_force = v0 if a0 <= off_ns[p] else carried
                        row[p] = v1 if a1 <= off_ns[p] else in_force
                else:
                    for p in range(begin[c], begin[c + 1]):
                        in_force = v0 if a0 <= off_ns[p] else carried
                        in_force = v1 if a1 <= off_ns[p] else in_force
                        in_force = v2 if a2 <= off_ns[p] else in_force
                        row[p] = v3 if a3 <= off_ns[p] else in_force
                if stamps_too or a3 <= last:
                    for p in range(begin[c], begin[c + 1]):
                        off = off_ns[p]
                        count = int(a0 <= off) + int(a1 <= off) + int(a2 <= off) + int(a3 <= off)
                        if count == _AT_ONCE:
                            more, row[p] = _advance_renewal(k, w, run, start, count - 1, a3, tau_ns, off)
                            count = more + 1
                        if stamps_too:
                            renewal[s, p] = start + count - 1 if count else carried_ns
                # What the next cell starts with, if it follows this one.
                if stamps_too and a0 <= last:
                    carried_ns = start + int(a1 <= last) + int(a2 <= last) + int(a3 <= last)
                carries = carries or a0 <= last
                carried = v0 if a0 <= last else carried
                carried = v1 if a1 <= last else carried
                carried = v2 if a2 <= last else carried
                if a3 <= last:
                    more, carried = _advance_renewal(k, w, run, start, _AT_ONCE - 1, a3, tau_ns, last)
                    carried_ns = start + more
            if not everywhere:
                for p in range(begin[c0], begin[c0 + size]):
                    row[p] = row[p] if where[s, p] else 0.0


@kernel
def fill_correlated_rows(
    key: Words,
    word: Words,
    stamp: Int,
    runs: Words,
    levels: tuple[int, int],
    weights: tuple[Float, Float],
    lists: tuple[Int, Int, Int, Float, Float, Float],
    where: Bool,
    out: Float,
) -> None:
    """Fill `out (S, P)` with the path's values.

    `levels`: of the top spacing and of the leaves (2^level ns). `weights (top,)` each: the middle of an interval of
    2^(l + 1) is weights[0][l] · (left + right) + weights[1][l] · η. `lists`: by row the list it is in (P,), or nothing,
    and then the value is that of the node at or before the stamp; of the lists (F,) the first one in the same leaf,
    their stamps, and the weights of what is before, of the leaf's right end and of η.
    """
    top, leaf = levels
    shared, fresh = weights
    frame, first, list_ns, from_before, from_right, from_noise = lists
    chained = len(frame) > 0
    everywhere = where.shape[0] == 1 and where.shape[1] == 1
    # Values at the ends of the interval of each level, 2^(leaf + i) long, around the row before.
    left, right = np.empty(top - leaf + 1), np.empty(top - leaf + 1)
    for s in range(out.shape[0]):
        run = runs[s]
        before = -1
        last_list, value = -1, 0.0
        for p in range(out.shape[1]):
            if not (everywhere or where[s, p]):
                continue
            k, w, t = key[p], word[p], stamp[p]
            follows = before >= 0 and key[before] == k and word[before] == w and stamp[before] <= t
            below = top  # level of the interval to go down from
            if follows:
                t_before = stamp[before]
                below = leaf
                while below < top and (t >> below) != (t_before >> below):
                    below += 1
            if not follows or (t >> top) != (stamp[before] >> top):
                begin = (t >> top) << top
                if follows and (t >> top) == (stamp[before] >> top) + 1:
                    left[top - leaf] = right[top - leaf]
                else:
                    left[top - leaf] = _draw_standard_normal(k, w, begin, run)
                right[top - leaf] = _draw_standard_normal(k, w, begin + (np.int64(1) << top), run)
                below, follows = top, False
            if not follows or below > leaf:
                last_list = -1
            for level in range(below - 1, leaf - 1, -1):
                i = level - leaf
                middle_ns = (((t >> (level + 1)) << 1) + 1) << level
                if follows and level == below - 1:  # out of the left half, whose right end it is
                    middle = right[i]
                else:
                    middle = shared[level] * (left[i + 1] + right[i + 1]) + fresh[level] * _draw_standard_normal(
                        k, w, middle_ns, run
                    )
                if t >= middle_ns:
                    left[i], right[i] = middle, right[i + 1]
                else:
                    left[i], right[i] = left[i + 1], middle
            before = p
            if not chained:
                out[s, p] = left[0]
                continue
            f = frame[p]
            if last_list < 0 or last_list > f:
                last_list, value = first[f] - 1, left[0]
            for g in range(last_list + 1, f + 1):
                value = from_before[g] * value + from_right[g] * right[0]
                if from_noise[g] > 0:
                    value += from_noise[g] * _draw_standard_normal(k, w, list_ns[g], run)
            last_list = f
            out[s, p] = value


@kernel
def list_births(
    key: Words,
    word: Words,
    runs: Words,
    every_ns: float,
    lasts_ns: float,
    shift: int,
    cells: tuple[int, int],
    alive_ns: tuple[int, int],
    births: tuple[Int, Int, Int, Int, Int],
) -> int:
    """Count the births of rows (R,) in runs (S,) that live at some instant of `alive_ns` (from, and before).

    Cells from and before. `births` (B,) each: run, row, address, begin and end of each, filled as far as there is room.
    """
    length = np.float64(np.int64(1) << shift)
    run_ix, row_ix, address_ns, born_ns, gone_ns = births
    count = 0
    for s in range(len(runs)):
        for r in range(len(key)):
            for cell in range(cells[0], cells[1]):
                start, number = cell << shift, 0
                u, v = _draw_two_uniforms(key[r], word[r], start, runs[s])
                since_ns = -every_ns * _natural_log(u)
                while since_ns < length:
                    born = start + np.int64(since_ns)
                    gone = born + np.int64(np.ceil(-lasts_ns * _natural_log(v)))
                    if born < alive_ns[1] and gone > alive_ns[0]:
                        if count < len(run_ix):
                            run_ix[count], row_ix[count], address_ns[count] = s, r, start + number
                            born_ns[count], gone_ns[count] = born, gone
                        count += 1
                    number += 1
                    u, v = _draw_two_uniforms(key[r], word[r], start + number, runs[s])
                    since_ns += -every_ns * _natural_log(u)
    return count
