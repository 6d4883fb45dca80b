"""Numbers that last, computed plainly: whole integers, one number at a time, nothing kept.

Philox from its paper; renewals and the path straight from their definitions
(docs/develop/decisions/random-numbers.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

from scipy.special import ndtri

from copem_replay.core.random import stable_hash

LOW = 0xFFFFFFFF


def philox(counter: int, key: int) -> list[int]:
    """Four words of 32 bits of a counter of 128 bits and a key of 64."""
    words = [counter >> (32 * k) & LOW for k in range(4)]
    k0, k1 = key & LOW, key >> 32
    for _ in range(10):
        p0, p1 = 0xD2511F53 * words[0], 0xCD9E8D57 * words[2]
        words = [(p1 >> 32) ^ words[1] ^ k0, p1 & LOW, (p0 >> 32) ^ words[3] ^ k1, p0 & LOW]
        k0, k1 = (k0 + 0x9E3779B9) & LOW, (k1 + 0xBB67AE85) & LOW
    return words


@dataclass(frozen=True)
class Series:
    """All numbers of one (seed, log, purpose, unit; object's word) in one run."""

    seed: int
    log: str
    purpose: str
    unit: str
    word: int
    run: int

    def uniforms(self, stamp_ns: int) -> tuple[float, float]:
        key = stable_hash(self.seed, self.log, self.purpose, self.unit) ^ self.run
        a, b, c, d = philox(self.word | (stamp_ns % 2**64) << 64, key)
        return tuple((((x >> 6) * 2**26 + (y >> 6)) + 0.5) / 2**52 for x, y in ((a, b), (c, d)))  # type: ignore[return-value]

    def normal(self, stamp_ns: int) -> float:
        return float(ndtri(self.uniforms(stamp_ns)[0]))

    def renewals(self, tau_ns: float, cell: int) -> Iterator[tuple[float, float, int]]:
        """Of one cell: when (ns since its start), the number, and the stamp it is drawn by."""
        length = 2 ** math.ceil(math.log2(tau_ns))
        at = 0.0
        for number in range(length):
            u, v = self.uniforms(cell * length + number)
            at -= tau_ns * math.log(u)
            if at >= length:
                return
            yield at, v, cell * length + number

    def held(self, tau_ns: float, stamp_ns: int) -> tuple[float, int]:
        """The number in force at a stamp, and what it is drawn by."""
        length = 2 ** math.ceil(math.log2(tau_ns))
        cell, off = divmod(stamp_ns, length)
        while True:
            there = [(v, stamp) for at, v, stamp in self.renewals(tau_ns, cell) if at <= off]
            if there:
                return there[-1]
            cell, off = cell - 1, length

    def path(self, tau_ns: float, stamp_ns: int, lists_ns: Sequence[int] | None) -> float:
        """The wandering normal at a stamp, which is one of the lists'; None: that of its millisecond."""
        leaf = 2**20 if lists_ns is None else 2**27
        top = max(leaf, 2 ** math.ceil(math.log2(37 * tau_ns)))

        @lru_cache(None)
        def node(at_ns: int) -> float:
            step = at_ns & -at_ns if at_ns else top
            if step >= top:
                return self.normal(at_ns)
            d = step / tau_ns
            ends = node(at_ns - step) + node(at_ns + step)
            return ends / (2 * math.cosh(d)) + math.sqrt(math.tanh(d)) * self.normal(at_ns) if d < 300 else 0.0

        begin = stamp_ns // leaf * leaf
        s, value, right = begin, node(begin), node(begin + leaf)
        for t in [] if lists_ns is None else sorted(lists_ns):
            if not begin <= t <= stamp_ns:
                continue
            x, y = (t - s) / tau_ns, (begin + leaf - t) / tau_ns
            whole = 1 - math.exp(-2 * (x + y))
            before, after = 1 - math.exp(-2 * x), 1 - math.exp(-2 * y)
            value = (math.exp(-x) * after * value + math.exp(-y) * before * right) / whole
            value += math.sqrt(before * after / whole) * (self.normal(t) if t > begin else 0)
            s = t
        return value

    def births(self, every_ns: float, lasts_ns: float, from_ns: int, until_ns: int) -> list[tuple[int, int, int]]:
        """Those who live in [from_ns, until_ns): drawn by, born, gone."""
        length = 2 ** math.ceil(math.log2(every_ns))
        cells = range((from_ns - int(37 * lasts_ns)) // length, until_ns // length + 1)
        every = [
            (stamp, cell * length + int(at), cell * length + int(at) + math.ceil(-lasts_ns * math.log(v)))
            for cell in cells
            for at, v, stamp in self.renewals(every_ns, cell)
        ]
        return [(stamp, born, gone) for stamp, born, gone in every if born < until_ns and gone > from_ns]
