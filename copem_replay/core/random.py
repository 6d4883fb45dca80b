"""Random numbers addressed by what they are for.

No number is taken from a stream: each is computed from its address, (seed, log, purpose, unit, run; object,
capture stamp). So a run alone equals the same run in a batch, adding a unit or a configuration leaves all other
draws as they were, and all configurations use common random numbers.

Generator: Philox4x32-10 (Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011).
Key: a 64-bit hash of (seed, log, purpose, unit), its low word xor the run. Counter: 64-bit hash of the object's
id, 64-bit capture stamp in nanoseconds as in the message. Normals by inversion (AS 241), one uniform each: monotone,
so that draws which are common stay ordered.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b

import numba as nb
import numpy as np
from numpy.typing import NDArray

from copem_replay.core.compiled import callee, kernel, vectorised_kernel
from copem_replay.core.tracks import Bool, Float, Int

Words = NDArray[np.uint64]


@lru_cache(2**16, typed=True)  # few units and objects, asked for in every time chunk
def stable_hash(*parts: str | int) -> int:
    """A 64-bit hash that is equal on every machine and in every process."""
    return int.from_bytes(blake2b(json.dumps(parts).encode(), digest_size=8).digest(), "little")


def object_words(object_ids: Sequence[str]) -> Words:
    """(N,) the 64-bit word in the addresses of each object's random numbers."""
    return np.array([stable_hash("object", name) for name in object_ids], dtype=np.uint64)


@dataclass(frozen=True)
class RandomKey:
    """Addresses of random numbers, row by row: one number per run and row.

    `units` are the U names, `unit_ix (P,)` is the unit of each row; `object_word (P,)` comes from `object_words`.
    """

    units: tuple[str, ...]
    unit_ix: Int
    object_word: Words
    stamp_ns: Int

    def take(self, rows: Int) -> RandomKey:
        """The addresses of the rows `rows (K,)`: their numbers do not change."""
        return RandomKey(self.units, self.unit_ix[rows], self.object_word[rows], self.stamp_ns[rows])


@dataclass(frozen=True)
class CounterRng:
    """The random numbers of one log under one seed. Two logs never share any: the log's name is part of the address."""

    seed: int
    log: str

    def uniform(self, purpose: str, random_key: RandomKey, runs: Int) -> Float:
        """(S, P) uniform in (0, 1), ends excluded, for runs (S,)."""
        out = np.empty((len(runs), len(random_key.stamp_ns)))
        _draw_uniform(*self.words(purpose, random_key, runs), out)
        return out

    def bernoulli(self, purpose: str, random_key: RandomKey, runs: Int, probability: Float) -> Bool:
        """(S, P) True with `probability (P,)`: the addressed uniform is below it (0: never, 1: always)."""
        out = np.empty((len(runs), len(random_key.stamp_ns)), dtype=np.bool_)
        _draw_bernoulli(*self.words(purpose, random_key, runs), np.ascontiguousarray(probability), out)
        return out

    def normal(self, purpose: str, random_key: RandomKey, runs: Int, where: Bool | None = None) -> Float:
        """(S, P) standard normal; 0 where `where (S, P)` is False, which costs nothing."""
        out = np.zeros((len(runs), len(random_key.stamp_ns)))
        mask = np.ones((1, 1), dtype=np.bool_) if where is None else where
        _draw_normal(*self.words(purpose, random_key, runs), mask, out)
        return out

    def words(self, purpose: str, random_key: RandomKey, runs: Int) -> tuple[Words, Words, Words, Words]:
        """Key, object's word and stamp of each row (P,), and the runs (S,)."""
        keys = [stable_hash(self.seed, self.log, purpose, unit) for unit in random_key.units]
        key = np.array(keys, dtype=np.uint64)[random_key.unit_ix]
        return key, random_key.object_word, random_key.stamp_ns.astype(np.uint64), runs.astype(np.uint64)


_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)
_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
"""Philox's multipliers, and its increments of the key."""
_UNIT = 2.0**-52
_MIDDLE = 0.425
"""Within so much of the median `normal_quantile` has its central formula (AS 241)."""
_WORTH_ALL = 6
"""If fewer than one number in so many is wanted, drawing all takes longer than drawing each (measured)."""


@nb.njit(inline="always")
def philox4x32(
    c0: np.uint64, c1: np.uint64, c2: np.uint64, c3: np.uint64, k0: np.uint64, k1: np.uint64
) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Ten rounds of Philox4x32: counter and key words in, four words out, all below 2³²."""
    for _ in range(10):
        p0, p1 = _M0 * c0, _M1 * c2
        c0, c1, c2, c3 = (p1 >> _SHIFT) ^ c1 ^ k0, p1 & _LOW, (p0 >> _SHIFT) ^ c3 ^ k1, p0 & _LOW
        k0, k1 = (k0 + _W0) & _LOW, (k1 + _W1) & _LOW
    return c0, c1, c2, c3


@nb.njit(inline="always")
def _unit_interval(key: np.uint64, word: np.uint64, stamp: np.uint64, run: np.uint64) -> float:
    """52 bits in the middle of their cell: never 0 and never 1, so p = 0 never fires and p = 1 always does."""
    a, b, _c, _d = philox4x32(
        word & _LOW, word >> _SHIFT, stamp & _LOW, stamp >> _SHIFT, (key & _LOW) ^ run, key >> _SHIFT
    )
    bits = ((a >> np.uint64(6)) << np.uint64(26)) | (b >> np.uint64(6))
    return (np.float64(bits) + 0.5) * _UNIT


@kernel
def _draw_uniform(key: Words, word: Words, stamp: Words, runs: Words, out: Float) -> None:
    for s in range(out.shape[0]):
        for p in range(out.shape[1]):
            out[s, p] = _unit_interval(key[p], word[p], stamp[p], runs[s])


@kernel
def _draw_bernoulli(key: Words, word: Words, stamp: Words, runs: Words, probability: Float, out: Bool) -> None:
    for s in range(out.shape[0]):
        for p in range(out.shape[1]):
            out[s, p] = _unit_interval(key[p], word[p], stamp[p], runs[s]) < probability[p]


@vectorised_kernel
def _draw_normal(key: Words, word: Words, stamp: Words, runs: Words, where: Bool, out: Float) -> None:
    everywhere = where.shape[0] == 1 and where.shape[1] == 1
    uniform = np.empty(out.shape[1])
    for s in range(out.shape[0]):
        if not everywhere and _WORTH_ALL * where[s].sum() < out.shape[1]:
            for p in range(out.shape[1]):
                if where[s, p]:
                    out[s, p] = normal_quantile(_unit_interval(key[p], word[p], stamp[p], runs[s]))
            continue
        # To draw all at once, as if none were in the tails, takes less time than to draw half of them one by one.
        for p in range(out.shape[1]):
            uniform[p] = _unit_interval(key[p], word[p], stamp[p], runs[s])
        for p in range(out.shape[1]):
            out[s, p] = _central_quantile(uniform[p] - 0.5)
        for p in range(out.shape[1]):
            if not (everywhere or where[s, p]):
                out[s, p] = 0.0
            elif abs(uniform[p] - 0.5) > _MIDDLE:
                out[s, p] = normal_quantile(uniform[p])


@nb.njit(inline="always")
def _central_quantile(q: float) -> float:
    """`normal_quantile` at u = 0.5 + q, |q| ≤ 0.425."""
    r = 0.180625 - q * q
    num = 2.5090809287301226727e3
    num = num * r + 3.3430575583588128105e4
    num = num * r + 6.7265770927008700853e4
    num = num * r + 4.5921953931549871457e4
    num = num * r + 1.3731693765509461125e4
    num = num * r + 1.9715909503065514427e3
    num = num * r + 1.3314166789178437745e2
    num = num * r + 3.3871328727963666080
    den = 5.2264952788528545610e3
    den = den * r + 2.8729085735721942674e4
    den = den * r + 3.9307895800092710610e4
    den = den * r + 2.1213794301586595867e4
    den = den * r + 5.3941960214247511077e3
    den = den * r + 6.8718700749205790830e2
    den = den * r + 4.2313330701600911252e1
    return q * num / (den * r + 1.0)


@callee
def normal_quantile(u: float) -> float:
    """Inverse of the standard normal distribution, u in (0, 1); relative error about 1e-16.

    Source: Wichura, "Algorithm AS 241: the percentage points of the normal distribution", Applied Statistics 37
    (1988), routine PPND16; its coefficients.
    """
    q = u - 0.5
    if abs(q) <= _MIDDLE:
        return _central_quantile(q)
    r = np.sqrt(-np.log(u if q < 0 else 1.0 - u))
    if r <= 5.0:
        r -= 1.6
        num = 7.74545014278341407640e-4
        num = num * r + 2.27238449892691845833e-2
        num = num * r + 2.41780725177450611770e-1
        num = num * r + 1.27045825245236838258
        num = num * r + 3.64784832476320460504
        num = num * r + 5.76949722146069140550
        num = num * r + 4.63033784615654529590
        num = num * r + 1.42343711074968357734
        den = 1.05075007164441684324e-9
        den = den * r + 5.47593808499534494600e-4
        den = den * r + 1.51986665636164571966e-2
        den = den * r + 1.48103976427480074590e-1
        den = den * r + 6.89767334985100004550e-1
        den = den * r + 1.67638483018380384940
        den = den * r + 2.05319162663775882187
    else:
        r -= 5.0
        num = 2.01033439929228813265e-7
        num = num * r + 2.71155556874348757815e-5
        num = num * r + 1.24266094738807843860e-3
        num = num * r + 2.65321895265761230930e-2
        num = num * r + 2.96560571828504891230e-1
        num = num * r + 1.78482653991729133580
        num = num * r + 5.46378491116411436990
        num = num * r + 6.65790464350110377720
        den = 2.04426310338993978564e-15
        den = den * r + 1.42151175831644588870e-7
        den = den * r + 1.84631831751005468180e-5
        den = den * r + 7.86869131145613259100e-4
        den = den * r + 1.48753612908506148525e-2
        den = den * r + 1.36929880922735805310e-1
        den = den * r + 5.99832206555887937690e-1
    value = num / (den * r + 1.0)
    return float(-value) if q < 0 else float(value)
