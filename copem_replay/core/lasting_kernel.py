"""Kernels of numbers that last: Poisson renewals, an Ornstein–Uhlenbeck path on a dyadic clock, births with a life.

Every value is a function of its address and of absolute time. A kernel walks the rows of one series (one key and word)
in order of time and keeps what the next row can use; a row that does not follow the one before starts anew and gives
the same bits. Counters are as in `core/random.py`: word and a stamp in nanoseconds.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from copem_replay.core.random import Words, normal_quantile, philox4x32
from copem_replay.core.tracks import Bool, Float, Int

_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
_SIX, _BITS = np.uint64(6), np.uint64(26)
_UNIT = 2.0**-52
_BELOW = 1 - 2.0**-53
"""Times a power of two: the number next below it."""


@nb.njit(inline="always")
def _two_uniforms(key: np.uint64, word: np.uint64, stamp: int, run: np.uint64) -> tuple[float, float]:
    """Both 52-bit uniforms of one Philox call; the first is the addressed uniform of `core/random.py`."""
    counter = np.uint64(stamp)
    a, b, c, d = philox4x32(
        word & _LOW, word >> _SHIFT, counter & _LOW, counter >> _SHIFT, (key & _LOW) ^ run, key >> _SHIFT
    )
    first = (np.float64(((a >> _SIX) << _BITS) | (b >> _SIX)) + 0.5) * _UNIT
    second = (np.float64(((c >> _SIX) << _BITS) | (d >> _SIX)) + 0.5) * _UNIT
    return first, second


@nb.njit(inline="always")
def _eta(key: np.uint64, word: np.uint64, stamp: int, run: np.uint64) -> float:
    """The addressed standard normal."""
    return normal_quantile(_two_uniforms(key, word, stamp, run)[0])


@nb.njit(inline="always")
def _log(x: float) -> float:
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
"""Renewals of a cell that are drawn in advance: it has 1 to 2 on average."""


@nb.njit(cache=True, nogil=True)
def _beyond(
    key: np.uint64, word: np.uint64, run: np.uint64, start: int, number: int, at: float, tau_ns: float, until: float
) -> tuple[int, float]:
    """From the renewal `number`, `at` so many ns into its cell: the last one that is no later than `until`."""
    value = _two_uniforms(key, word, start + number, run)[1]
    while True:
        u, v = _two_uniforms(key, word, start + number + 1, run)
        at += -tau_ns * _log(u)
        if at > until:
            return number, value
        number, value = number + 1, v


@nb.njit(cache=True, nogil=True)
def _last_of(
    key: np.uint64, word: np.uint64, run: np.uint64, cell: int, tau_ns: float, shift: int
) -> tuple[int, float]:
    """The last renewal in a cell, or in the nearest one before it that has any: its stamp, and its number."""
    last = np.float64(np.int64(1) << shift) * _BELOW
    while True:
        start = cell << shift
        at = -tau_ns * _log(_two_uniforms(key, word, start, run)[0])
        if at <= last:
            number, value = _beyond(key, word, run, start, 0, at, tau_ns, last)
            return start + number, value
        cell -= 1


@nb.njit(cache=True, nogil=True, error_model="numpy")  # a division that may raise is not compiled to vectors
def held_rows(
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
    at, value = np.empty((_AT_ONCE, block)), np.empty((_AT_ONCE, block))
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
        known, carried, carried_ns = False, 0.0, 0  # of the cell before
        for c0 in range(0, len(cell_of), block):
            size = min(block, len(cell_of) - c0)
            keys, words, starts = cell_key[c0 : c0 + size], cell_word[c0 : c0 + size], begin_ns[c0 : c0 + size]
            for i in range(_AT_ONCE):
                at_i, value_i = at[i], value[i]  # loop by loop, from 0 on: each is compiled to vectors
                for j in range(size):
                    u, v = _two_uniforms(keys[j], words[j], starts[j] + i, run)
                    at_i[j] = u
                    value_i[j] = v
                for j in range(size):
                    at_i[j] = -tau_ns * _log(at_i[j])
                if i:
                    sum_before = at[i - 1]
                    for j in range(size):
                        at_i[j] += sum_before[j]
            for j in range(size):
                c = c0 + j
                k, w, start = cell_key[c], cell_word[c], begin_ns[c]
                known = known and follows[c]
                a0, a1, a2, a3 = at[0, j], at[1, j], at[2, j], at[3, j]
                v0, v1, v2, v3 = value[0, j], value[1, j], value[2, j], value[3, j]
                if not known and off_ns[begin[c]] < a0:
                    carried_ns, carried = _last_of(k, w, run, cell_of[c] - 1, tau_ns, shift)
                    known = True
                if a2 > last:  # mostly; chosen without a branch: which way it goes could not be foreseen
                    for p in range(begin[c], begin[c + 1]):
                        found = v0 if a0 <= off_ns[p] else carried
                        row[p] = v1 if a1 <= off_ns[p] else found
                else:
                    for p in range(begin[c], begin[c + 1]):
                        found = v0 if a0 <= off_ns[p] else carried
                        found = v1 if a1 <= off_ns[p] else found
                        found = v2 if a2 <= off_ns[p] else found
                        row[p] = v3 if a3 <= off_ns[p] else found
                if stamps_too or a3 <= last:
                    for p in range(begin[c], begin[c + 1]):
                        off = off_ns[p]
                        count = int(a0 <= off) + int(a1 <= off) + int(a2 <= off) + int(a3 <= off)
                        if count == _AT_ONCE:
                            more, row[p] = _beyond(k, w, run, start, count - 1, a3, tau_ns, off)
                            count = more + 1
                        if stamps_too:
                            renewal[s, p] = start + count - 1 if count else carried_ns
                # What the next cell finds, if it is the next.
                if stamps_too and a0 <= last:
                    carried_ns = start + int(a1 <= last) + int(a2 <= last) + int(a3 <= last)
                known = known or a0 <= last
                carried = v0 if a0 <= last else carried
                carried = v1 if a1 <= last else carried
                carried = v2 if a2 <= last else carried
                if a3 <= last:
                    more, carried = _beyond(k, w, run, start, _AT_ONCE - 1, a3, tau_ns, last)
                    carried_ns = start + more
            if not everywhere:
                for p in range(begin[c0], begin[c0 + size]):
                    row[p] = row[p] if where[s, p] else 0.0


@nb.njit(cache=True, nogil=True)
def drifting_rows(
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
    frame, first, list_ns, from_before, from_right, own = lists
    chained = len(frame) > 0
    everywhere = where.shape[0] == 1 and where.shape[1] == 1
    # Values at the ends of the interval of each level, 2^(leaf + i) long, around the row before.
    left, right = np.empty(top - leaf + 1), np.empty(top - leaf + 1)
    for s in range(out.shape[0]):
        run = runs[s]
        before = -1
        at_list, value = -1, 0.0
        for p in range(out.shape[1]):
            if not (everywhere or where[s, p]):
                continue
            k, w, t = key[p], word[p], stamp[p]
            follows = before >= 0 and key[before] == k and word[before] == w and stamp[before] <= t
            known = top  # level of the interval to go down from
            if follows:
                t_before = stamp[before]
                known = leaf
                while known < top and (t >> known) != (t_before >> known):
                    known += 1
            if not follows or (t >> top) != (stamp[before] >> top):
                begin = (t >> top) << top
                if follows and (t >> top) == (stamp[before] >> top) + 1:
                    left[top - leaf] = right[top - leaf]
                else:
                    left[top - leaf] = _eta(k, w, begin, run)
                right[top - leaf] = _eta(k, w, begin + (np.int64(1) << top), run)
                known, follows = top, False
            if not follows or known > leaf:
                at_list = -1
            for level in range(known - 1, leaf - 1, -1):
                i = level - leaf
                middle_ns = (((t >> (level + 1)) << 1) + 1) << level
                if follows and level == known - 1:  # out of the left half, whose right end it is
                    middle = right[i]
                else:
                    middle = shared[level] * (left[i + 1] + right[i + 1]) + fresh[level] * _eta(k, w, middle_ns, run)
                if t >= middle_ns:
                    left[i], right[i] = middle, right[i + 1]
                else:
                    left[i], right[i] = left[i + 1], middle
            before = p
            if not chained:
                out[s, p] = left[0]
                continue
            f = frame[p]
            if at_list < 0 or at_list > f:
                at_list, value = first[f] - 1, left[0]
            for g in range(at_list + 1, f + 1):
                value = from_before[g] * value + from_right[g] * right[0]
                if own[g] > 0:
                    value += own[g] * _eta(k, w, list_ns[g], run)
            at_list = f
            out[s, p] = value


@nb.njit(cache=True, nogil=True)
def births_of(
    key: Words,
    word: Words,
    runs: Words,
    every_ns: float,
    lasts_ns: float,
    shift: int,
    cells: tuple[int, int],
    alive_ns: tuple[int, int],
    found: tuple[Int, Int, Int, Int, Int],
) -> int:
    """How many births of rows (R,) in runs (S,) live at some instant of `alive_ns` (from, and before).

    Cells from and before. `found` (B,) each: run, row, address, begin and end of each, filled as far as there is room.
    """
    length = np.float64(np.int64(1) << shift)
    run_ix, row_ix, address_ns, born_ns, gone_ns = found
    count = 0
    for s in range(len(runs)):
        for r in range(len(key)):
            for cell in range(cells[0], cells[1]):
                start, number = cell << shift, 0
                u, v = _two_uniforms(key[r], word[r], start, runs[s])
                at = -every_ns * _log(u)
                while at < length:
                    born = start + np.int64(at)
                    gone = born + np.int64(np.ceil(-lasts_ns * _log(v)))
                    if born < alive_ns[1] and gone > alive_ns[0]:
                        if count < len(run_ix):
                            run_ix[count], row_ix[count], address_ns[count] = s, r, start + number
                            born_ns[count], gone_ns[count] = born, gone
                        count += 1
                    number += 1
                    u, v = _two_uniforms(key[r], word[r], start + number, runs[s])
                    at += -every_ns * _log(u)
    return count
