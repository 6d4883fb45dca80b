"""Records made of columns, many at once: first how many bytes each takes, then all of them to their places.

A part of a record knows its size in every row, `sizes` (N,), and puts its bytes where it is told, `at` (N,). Records
are the parts one after the other. Letters: N rows, M rows of a repeated part.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from copem_replay.core.tracks import Bool, Int
from copem_replay.io.encodings import column_bytes_kernel as kernel

Bytes = NDArray[np.uint8]


class Part(Protocol):
    """A part of the records."""

    @property
    def sizes(self) -> Int:
        """(N,) bytes in each row."""

    def put(self, out: Bytes, at: Int) -> None:
        """Write the bytes of every row to its place."""


class Texts:
    """Texts to choose from: number k is `pool[first[k]:first[k] + lengths[k]]`."""

    def __init__(self, pool: bytes, first: Int, lengths: Int) -> None:
        self._pool, self._first, self._lengths = np.frombuffer(pool, dtype=np.uint8), first, lengths

    @classmethod
    def of(cls, texts: Sequence[bytes]) -> Texts:
        """These texts."""
        lengths = np.fromiter(map(len, texts), dtype=np.int64, count=len(texts))
        return cls(b"".join(texts), np.cumsum(lengths) - lengths, lengths)

    def at(self, which: Int | Bool) -> Pieces:
        """In row n the text `which[n]`."""
        places = np.asarray(which, dtype=np.int64)
        return Pieces(self._pool, self._first[places], self._lengths[places])


class Pieces:
    """In each row a text as it is."""

    def __init__(self, pool: Bytes, first: Int, lengths: Int) -> None:
        self._pool, self._first, self.sizes = pool, first, lengths

    def put(self, out: Bytes, at: Int) -> None:
        """As `Part` has it."""
        kernel.put_pieces(out, at, self._pool, self._first, self.sizes)


def constant(text: bytes, rows: int) -> Pieces:
    """The same in every row."""
    return Texts.of([text]).at(np.zeros(rows, dtype=np.int64))


class Number:
    """A tag and a number: a varint, or of a double its eight bytes; left out where it is 0 unless `always`."""

    def __init__(self, tag: int, values: NDArray[Any], always: bool) -> None:
        self._fixed = values.dtype.kind == "f"
        dtype = np.float64 if self._fixed else np.uint64 if values.dtype.kind == "u" else np.int64
        self._bits = np.ascontiguousarray(values, dtype=dtype).view(np.uint64)
        self._tag = np.uint64(tag)
        head = int(kernel.varint_sizes(np.array([tag], dtype=np.uint64))[0])
        sizes = np.full(len(values), head + 8) if self._fixed else kernel.varint_sizes(self._bits) + head
        self.sizes: Int = sizes if always else np.where(self._bits != 0, sizes, 0)

    def put(self, out: Bytes, at: Int) -> None:
        """As `Part` has it."""
        fill = kernel.put_fixed if self._fixed else kernel.put_varints
        fill(out, at, self.sizes, self._tag, self._bits)


class Sized:
    """A tag, how many bytes follow, and parts; left out where these are empty unless `always`."""

    def __init__(self, tag: int, parts: Sequence[Part], rows: int, always: bool) -> None:
        self._parts = parts
        inner = total(parts, rows)
        self._head = Number(tag, inner, always)
        self.sizes = self._head.sizes + inner

    def put(self, out: Bytes, at: Int) -> None:
        """As `Part` has it."""
        self._head.put(out, at)
        put(self._parts, out, at + self._head.sizes)


class Each:
    """In row n the rows `start[n]:start[n + 1]` of other parts, (M,), one after the other."""

    def __init__(self, start: Int, parts: Sequence[Part]) -> None:
        self._start, self._parts = start, parts
        self._before: Int = np.concatenate([[0], np.cumsum(total(parts, int(start[-1])))])

    @cached_property
    def sizes(self) -> Int:
        """As `Part` has it."""
        return np.diff(self._before[self._start])

    def put(self, out: Bytes, at: Int) -> None:
        """As `Part` has it."""
        shift = at - self._before[self._start[:-1]]
        put(self._parts, out, np.repeat(shift, np.diff(self._start)) + self._before[:-1])


def starts(counts: Int | Bool) -> Int:
    """(N + 1,) where the rows of each begin that has so many, and where the last ends."""
    result: Int = np.concatenate([[0], np.cumsum(counts)])
    return result


def total(parts: Sequence[Part], rows: int) -> Int:
    """(N,) bytes of all parts."""
    result = np.zeros(rows, dtype=np.int64)
    for part in parts:
        result += part.sizes
    return result


def put(parts: Sequence[Part], out: Bytes, at: Int) -> None:
    """The parts one after the other, from `at` (N,) on."""
    for part in parts:
        part.put(out, at)
        at = at + part.sizes


def records(parts: Sequence[Part], rows: int) -> list[bytes]:
    """The bytes of every row."""
    bounds = starts(total(parts, rows))
    out = np.empty(bounds[-1], dtype=np.uint8)
    put(parts, out, bounds[:-1])
    whole, cuts = out.tobytes(), bounds.tolist()
    return [whole[first:last] for first, last in pairwise(cuts)]
