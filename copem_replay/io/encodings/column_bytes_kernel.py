"""Bytes of columns, compiled: how many each number takes, and all of a column put to their places at once."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def _put_varint(out, at, value):  # type: ignore[no-untyped-def]
    """A number in groups of seven bits; returns where it ends."""
    while value >= np.uint64(128):
        out[at] = np.uint8(value & np.uint64(127)) | np.uint8(128)
        value >>= np.uint64(7)
        at += 1
    out[at] = np.uint8(value)
    return at + 1


@njit(cache=True, nogil=True)
def varint_sizes(values):  # type: ignore[no-untyped-def]
    """(N,) bytes of numbers (N,) as varints."""
    sizes = np.empty(len(values), dtype=np.int64)
    for k in range(len(values)):
        rest, size = values[k] >> np.uint64(7), 1
        while rest:
            rest >>= np.uint64(7)
            size += 1
        sizes[k] = size
    return sizes


@njit(cache=True, nogil=True)
def put_varints(out, at, sizes, tag, values):  # type: ignore[no-untyped-def]
    """Tags and varints at places `at` (N,), but where the size is 0."""
    for k in range(len(at)):
        if sizes[k]:
            _put_varint(out, _put_varint(out, at[k], tag), values[k])


@njit(cache=True, nogil=True)
def put_fixed(out, at, sizes, tag, bits):  # type: ignore[no-untyped-def]
    """Tags and eight bytes each, the lowest first."""
    for k in range(len(at)):
        if sizes[k]:
            place = _put_varint(out, at[k], tag)
            for i in range(8):
                out[place + i] = np.uint8((bits[k] >> np.uint64(8 * i)) & np.uint64(255))


@njit(cache=True, nogil=True)
def put_pieces(out, at, pool, first, sizes):  # type: ignore[no-untyped-def]
    """`pool[first[k]:first[k] + sizes[k]]` at `at[k]`."""
    for k in range(len(at)):
        for i in range(sizes[k]):
            out[at[k] + i] = pool[first[k] + i]
